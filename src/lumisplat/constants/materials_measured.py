"""Thresholds of measuring found materials and light (docs/guide/materials.md#figures)."""

INSIDE = 0.5
"""Share of a pixel that the object covers from which on it counts, as photographs' masks do."""

BLACK = 0.0015
"""Linear values below this, 5 of 255 on a display, are black: their ratios to others tell nothing of a scale."""

LIT_SHARE = 0.02
"""Share of what counts that is not black, below which a channel is black: a few stray pixels are no median of it."""

ENVIRONMENT_ROWS = 16
"""Rows at which environments are compared: those of R3DG's, which are 16 x 32."""

RELIT_SAMPLES = 64
"""Of each pixel of relit pictures, unless it is said: docs/guide/materials.md#grain has what is left."""
