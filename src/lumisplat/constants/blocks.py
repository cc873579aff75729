"""Captures in blocks (docs/adr/0073-captures-in-blocks.md)."""

BLOCK_GAUSSIANS_MAX = 2**19
"""Gaussians of a block: 29 MB at degree 0, which a disk reads in a moment; a billion are 2,000 blocks."""

BLOCK_DEPTH_MAX = 16
"""How often a cell is cut in eight: Gaussians that are in one place cannot be told apart."""

BLOCK_LEVEL_SHARE = 4
"""Gaussians of a level for one of the next coarser one."""

BLOCK_PIECE = 2**18
"""Gaussians that are read, sorted or copied at once."""
