"""What is told of results: figures as JSON, and pictures beside each other."""
