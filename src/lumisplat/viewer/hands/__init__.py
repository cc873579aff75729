"""What hands do on the picture: pick, drag, turn; and the lines that show where lights are."""
