"""Light that a capture itself shows: what its surfaces send out, what reaches them, and what both say of albedo."""
