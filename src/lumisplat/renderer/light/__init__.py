"""The interactions of a wave of rays with surfaces, and direct light at them."""
