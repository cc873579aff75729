"""Captures in blocks (docs/adr/0073-captures-in-blocks.md)."""

BLOCK_GAUSSIANS_MAX = 2**19
"""Gaussians of a block: 29 MB at degree 0, which a disk reads in a moment; a billion are 2,000 blocks."""

BLOCK_DEPTH_MAX = 16
"""How often a cell is cut in eight: Gaussians that are in one place cannot be told apart."""

BLOCK_LEVEL_SHARE = 4
"""Gaussians of a level for one of the next coarser one."""

BLOCK_PIECE = 2**18
"""Gaussians that are read, sorted or copied at once."""

BLOCK_SAMPLE = 2**16
"""Gaussians of a file by which the edge of its cubes is chosen."""

BLOCK_CELLS = 4096
"""Cubes at most that such a sample is in."""

BLOCK_CELLS_MAX = 2**16
"""Cubes of a capture at most, each of which is a file: more are a wrong edge."""

BLOCK_PREVIEW = 2**18
"""Gaussians of a capture by which a view of all of it is framed."""

BLOCK_MEMORY = 5
"""Memory of Gaussians of blocks that are rendered, as a factor of their bytes on disk: 6.7 million of 56 bytes each
took 1.7 GiB on a CPU."""
