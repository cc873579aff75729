"""Device math: colour, SH, directions, random numbers, memory helpers and sorting."""
