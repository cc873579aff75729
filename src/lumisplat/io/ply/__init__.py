"""The PLY container: headers, rows of numbers, rows of lists."""
