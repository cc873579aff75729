"""Materials and light from photographs, of a capture whose geometry stays."""
