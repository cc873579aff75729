"""Constants of photographs."""

PHOTOGRAPH_CACHE_BYTES = 1 << 30
"""Memory for photographs that have been decoded, by default: 520 of 960 x 720, and more would not fit beside a trainer
on small machines."""

CAMERA_MARGIN = 1.1
"""By how much a scene is taken to be larger than the sphere of its cameras, as INRIA's trainer does."""

HOLD_OUT = 8
"""One photograph of so many is not trained with, as Mip-NeRF 360 and those after it do."""
