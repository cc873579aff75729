"""From pixels to rays, and the blocks and tiles that pixels come in."""
