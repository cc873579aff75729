"""The PLY container: headers, rows and lists."""
