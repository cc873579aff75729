"""What stands beside the picture: settings, lights, materials, the list of things, and what people can do with them."""
