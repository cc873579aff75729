"""What is checked before the library opens a file."""
