"""What stands beside the picture: settings, views, videos, files, and what is being done."""
