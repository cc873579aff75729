"""Constants of streamed SOGs that are written."""

SOG_CHUNK_COUNT = 512 * 1024
"""Gaussians of a capture of a streamed SOG, about, and at most of a leaf: what splat-transform takes, 7 MB."""

SOG_CHUNK_EXTENT = 16.0
"""Largest extent of a leaf, scene units, again splat-transform's: viewers choose the level of a leaf as a whole."""

SOG_LEAF_LEAST = 8192
"""Gaussians of a leaf that is not divided any more, however large: scenes need not be in metres."""

SOG_LEVEL_LEAST = 20_000
"""Gaussians that the coarsest level has at least, of a capture that has as many: they are loaded in an instant."""
