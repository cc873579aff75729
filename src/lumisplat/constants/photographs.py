"""Constants of photographs."""

PHOTOGRAPH_CACHE_BYTES = 1 << 30
"""Memory for photographs that have been decoded, by default: 520 of 960 x 720, and more would not fit beside a trainer
on small machines."""

CAMERA_MARGIN = 1.1
"""By how much a scene is taken to be larger than the sphere of its cameras, as INRIA's trainer does."""

HOLD_OUT = 8
"""One photograph of so many is not trained with, as Mip-NeRF 360 and those after it do."""

ONE_PLACE = 1e-7
"""Extent of cameras, as a share of how far they are from zero, below which it is rounding: they stand in one place."""

SAME_PLACE = 1e-3
"""Distance of two cameras, as a share of the extent of all, up to which they stand in one place: between them, hardly
anything moves in the picture."""

SAME_TURN = 1e-3
"""Angle between two cameras, radians, up to which they are turned alike: a pixel or two."""

PLACES_MIN = 3
"""Places from which photographs are taken, below which a line says that this is few: two say nothing of what only one
of them sees."""

COMPARED_FEATURES = 2048
"""Features of a photograph that COLMAP compares, at most; docs/adr/0056-poses-of-films.md has what more cost."""

COMPARED_PIXELS = 1000
"""Longer side that photographs have for COLMAP, pixels, at most: features of larger ones cost time and add nothing."""

DOUBLED_PIXELS = 800
"""Longer side of photographs that COLMAP sees at twice their size, at most: small ones have too few features else, and
large ones take three times as long for as many."""

LENS_MODEL = "RADIAL"
"""Lens of photographs whose poses are found, as COLMAP calls it: one focal length, and two terms of distortion. Pixels
are square, and with two focal lengths, what shows little depth leaves their quotient open."""

NEXT_FRAMES = 10
"""With how many of the next frames of a film a frame is compared."""

ALL_PAIRS_UP_TO = 40
"""So many photographs in any order are all compared with each other."""

MOST_ALIKE = 5
"""With how many photographs that look like it each one is compared, beside its neighbours in a film."""

ALIKE_FEATURES = 128
"""Largest features of a photograph, by which those that look like it are found."""

ALIKE_MATCHES = 4
"""Fewer of these in common are chance (Wu 2013, section 4)."""

ALIKE_RATIO = 0.8
"""Features match if their angle is below this share of that to the next best one (Lowe 2004, section 7.1)."""

SMALLEST_PIECE = 3
"""Photographs of a model, at least: with two, nothing tells a right pose from a wrong one."""

FEW_POINTS = 50
"""Points that a photograph shows, in the mean, below which poses are likely to be wrong: COLMAP asks for 30."""

LARGE_ERROR = 1.5
"""Mean distance of points from where their photographs show them, in pixels of `COMPARED_PIXELS`, above which poses are
likely to be wrong: 0.4 to 1 is usual, and COLMAP leaves out what is beyond 4."""

LOST_SHARE = 0.25
"""Share of photographs without a pose above which a film wants to be taken anew."""

USUAL_VIEW_DEGREES = 15.0, 130.0
"""Angles of view along the longer side that lenses of telephones and cameras have."""
