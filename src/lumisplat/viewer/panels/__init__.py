"""What stands beside the picture: settings, views, films, files, and what is being done."""
