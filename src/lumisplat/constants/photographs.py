"""Constants of photographs."""

PHOTOGRAPH_CACHE_BYTES = 1 << 30
"""Memory for photographs that have been decoded, by default: 520 of 960 x 720, and more would not fit beside a trainer
on small machines."""

CAMERA_MARGIN = 1.1
"""By how much a scene is taken to be larger than the sphere of its cameras, as INRIA's trainer does."""

HOLD_OUT = 8
"""One photograph of so many is not trained with, as Mip-NeRF 360 and those after it do."""

SAME_PLACE = 1e-3
"""Distance of two cameras, as a share of the extent of all, up to which they stand in one place: between them, hardly
anything moves in the picture."""

SAME_TURN = 1e-3
"""Angle between two cameras, radians, up to which they are turned alike: a pixel or two."""

PLACES_MIN = 3
"""Places from which photographs are taken, below which a line says that this is few: two say nothing of what only one
of them sees."""
