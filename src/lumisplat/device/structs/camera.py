"""Data of cameras and samples. One struct is one noun of the method."""

import warp as wp

from lumisplat.device.structs.declare import struct


@struct
class CameraData:
    """A camera as one sample of each pixel sees through it. Lives in a 1-element array, so that graphs see changes."""

    world_from_camera: wp.mat33
    """Rotation; with a rolling shutter, at the start of the first row."""
    eye: wp.vec3
    """Centre of projection, world space; with a rolling shutter, then."""
    model: int
    """PINHOLE, FISHEYE or ORTHOGRAPHIC of ``lumisplat.device.camera.camera``."""
    focal: wp.vec2
    """Pixels; fisheye: per radian, orthographic: per scene unit."""
    center: wp.vec2
    """Principal point, pixels."""
    offset: wp.vec2
    """Where in each pixel the sample lies, 0..1."""
    raster_center: wp.vec2
    """The principal point moved against the offset: there, the centre of a pixel is where its sample lies."""
    jacobian_min: wp.vec2
    """Lowest x/z and y/z at which the projection is linearised."""
    jacobian_max: wp.vec2
    """Highest x/z and y/z at which the projection is linearised."""
    width: int
    height: int
    tiles_x: int
    tiles_y: int
    near: float
    aperture: float
    """Radius of the lens, scene units; 0: a pinhole."""
    focus_distance: float
    shutter: int
    """1: the pose changes from row to row, as the next three say."""
    turn_axis: wp.vec3
    """World space, unit: what the camera turns about while the rows are exposed."""
    turn_angle: float
    """Until the end of the last row, radians."""
    motion: wp.vec3
    """Of the eye until then, world space."""


@struct
class SampleData:
    """The sample of each pixel that a frame is at. Lives in a 1-element array."""

    index: int
    """From 0."""
    seed: wp.uint32
    is_last: int
    """1: of those that this call adds; the linear colour of lit pixels is made then."""
