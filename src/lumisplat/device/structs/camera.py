"""Data of cameras and samples. One struct is one noun of the method."""

import warp as wp

from lumisplat.device.structs.declare import struct


@struct
class CameraData:
    """A camera for one sample of each pixel. Lives in a 1-element array, so that captured graphs read its changes."""

    world_from_camera: wp.mat33
    """Rotation; with a rolling shutter, at the start of the first row."""
    eye: wp.vec3
    """Centre of projection, world space; with a rolling shutter, at the start of the first row."""
    model: int
    """PINHOLE, FISHEYE or ORTHOGRAPHIC of ``lumisplat.device.camera.camera``."""
    focal: wp.vec2
    """Pixels; fisheye: per radian, orthographic: per scene unit."""
    center: wp.vec2
    """Principal point, pixels."""
    offset: wp.vec2
    """Position of the sample in each pixel, 0..1."""
    raster_center: wp.vec2
    """The principal point, moved so that the rasteriser's pixel centres are the samples: plus 0.5, minus ``offset``."""
    jacobian_min: wp.vec2
    """Lowest x/z and y/z at which the projection is linearised."""
    jacobian_max: wp.vec2
    """Highest x/z and y/z at which the projection is linearised."""
    width: int
    """Of the image: of the window that is drawn, or of the whole picture; pixels."""
    height: int
    left: int
    """Of the window in the picture, pixels. Coordinates and random numbers are those of the picture."""
    top: int
    picture_width: int
    """Of the whole picture, pixels."""
    picture_height: int
    tiles_x: int
    tiles_y: int
    near: float
    aperture: float
    """Radius of the lens, scene units; 0: a pinhole."""
    focus_distance: float
    distorted: int
    """1: the lens distorts, by the next three."""
    radial: wp.vec4
    """Coefficients k1 to k4."""
    tangential: wp.vec2
    """Coefficients p1 and p2."""
    distortion_reach: float
    """Radius up to which the distortion is one to one, before it is applied."""
    shutter: int
    """1: a rolling shutter, the pose changes from row to row by the next three."""
    turn_axis: wp.vec3
    """Axis of the rotation while the rows are exposed, world space, unit."""
    turn_angle: float
    """Its angle at the end of the last row, radians."""
    motion: wp.vec3
    """Translation of the eye until then, world space."""


@struct
class SampleData:
    """The current sample of each pixel. Lives in a 1-element array."""

    index: int
    """From 0; where some pixels have fewer samples than others, the number in those that have all."""
    seed: wp.uint32


@struct
class ListedRays:
    """The rays of those pixels that a sample is drawn for, in the order of all; without elements: all pixels' rays."""

    place: wp.array[int]
    """Of the ray among those of all pixels; -1: there is none."""
    sample: wp.array[int]
    """Number of the sample in its pixel."""
    offset: wp.array[wp.vec2]
    """Position of the sample in its pixel, 0..1."""
