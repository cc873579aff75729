"""Materials and light of a capture, found from what it shows alone."""
