"""Settings of data sets: random views of a scene, with random light and objects."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Annotated

import numpy as np

from lumisplat.config.checks import Range, is_number, listed_names, refusal, suggestion
from lumisplat.config.setting import Seed, Share, Span, WholeSpan, frozen, given, take_fields
from lumisplat.errors import ConfigError

DATASET_LAYERS = ("depth", "normal", "albedo", "alpha", "mask", "instance", "category", "exr")
"""Layers that a data set may have beside the images."""
_VIEWS_MAX = 10_000_000


class PosePlaces(Enum):
    """Where the cameras of a data set are."""

    DOME = "dome"
    """Positions around the scene, looking at it."""
    INSIDE = "inside"
    """Positions in the free space of the scene, looking in any direction."""
    CAMERAS = "cameras"
    """Positions near given cameras, such as those of the images that the capture was trained on, where it looks best.
    """


def _file_names(value: Iterable[str], name: str = "files") -> tuple[str, ...]:
    """Returns a list of file names as a tuple."""
    names = None if isinstance(value, str) else listed_names(value)
    if names is None:
        raise refusal(ConfigError, name, value, "expected a list of file names")
    return names


def _checked_layers(value: str | Iterable[str], name: str = "layers") -> tuple[str, ...]:
    """Returns names of layers without duplicates, in the order of `DATASET_LAYERS`."""
    names = listed_names(value)
    if names is None:
        raise refusal(ConfigError, name, value, f"expected some of {', '.join(DATASET_LAYERS)}")
    for layer in names:
        if layer not in (*DATASET_LAYERS, "color"):
            raise ConfigError(f"{name} has {layer!r}, {suggestion(layer, DATASET_LAYERS)}")
    return tuple(layer for layer in DATASET_LAYERS if layer in names)  # "color", the image, is always written


def _checked_split(value: Sequence[float], name: str = "split") -> tuple[float, float, float]:
    """Returns three fractions, scaled to a sum of 1."""
    shares: list[object] = list(value) if isinstance(value, tuple | list | np.ndarray) and np.ndim(value) == 1 else []
    numbers = [float(share) for share in shares if is_number(share) and 0.0 <= share < math.inf]
    if len(shares) != 3 or len(numbers) != 3 or not sum(numbers) > 0.0:
        raise refusal(ConfigError, name, value, "expected three fractions, for training, validation and test")
    train, validation, test = (number / sum(numbers) for number in numbers)
    return train, validation, test


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetPoses:
    """Positions and viewing directions of a data set's cameras; each view draws them at random from these ranges.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    where: PosePlaces = PosePlaces.DOME
    """Where cameras are: around the scene, inside of it, or near given cameras."""
    azimuth: Annotated[Span, Range(-360.0, 360.0, "degrees")] = (0.0, 360.0)
    """Range of the camera's azimuth with ``DOME``: angle about the vertical, counter-clockwise from above; 0 is the
    front."""
    elevation: Annotated[Span, Range(-90.0, 90.0, "degrees")] = (5.0, 60.0)
    """Range of the camera's elevation above the horizon with ``DOME``, seen from what the camera looks at."""
    distance: Annotated[Span, Range(1e-3, 1e3)] = (1.0, 1.5)
    """Range of distances from the camera to the target with ``DOME``, as factors of the distance at which the whole
    scene just fits into the image. Below 1, images may cut off parts of the scene. Views that look at an added object
    have ``object_distance`` instead."""
    height: Annotated[Span, Range(0.0, 1.0)] = (0.2, 0.8)
    """Range of camera heights with ``INSIDE``, as fractions of the scene's height: 0 is its bottom, 1 its top."""
    pitch: Annotated[Span, Range(-90.0, 90.0, "degrees")] = (-25.0, 10.0)
    """Range of angles between the viewing direction and the horizon with ``INSIDE``; positive looks up. Views that look
    at an added object ignore this setting."""
    shift: Share = 0.02
    """Largest distance of a view's camera from the given camera that it starts from, with ``CAMERAS``, as a fraction
    of the scene's diagonal.
    """
    turn: Annotated[float, Range(0.0, 180.0, "degrees")] = 5.0
    """Largest rotation, about any axis, of a view's camera from the given camera that it starts from, with
    ``CAMERAS``."""
    aim: Share = 0.1
    """With ``DOME``: size of the box around the scene's centre in which targets of cameras are random, as a fraction of
    the scene's size along each axis. Views that look at an added object ignore this setting."""
    roll: Annotated[float, Range(0.0, 180.0, "degrees")] = 0.0
    """Largest rotation of cameras about their viewing direction, to either side."""
    fov: Annotated[Span, Range(1.0, 179.0, "degrees")] = (35.0, 60.0)
    """Range of vertical fields of view."""
    at_objects: Share = 0.5
    """Probability that a camera looks at one of the added objects, if there are any; not with ``CAMERAS``. Cameras from
    which the object is hidden are drawn again."""
    object_distance: Annotated[Span, Range(1.0, 1e3)] = (3.0, 8.0)
    """Range of distances between the camera and the centre of an added object that it looks at, with ``DOME``, in radii
    of the object's bounding sphere."""
    clearance: Share = 0.02
    """Smallest distance of a camera from surfaces, along 32 directions, and from the bounding spheres of added objects,
    as a fraction of the scene's diagonal."""
    seen: Share = 0.1
    """Smallest fraction of the image that shows a surface of the scene, without added objects. Cameras that see less
    are drawn again, up to 200 times; then an error is raised."""

    __post_init__ = take_fields


@frozen(kw_only=True, eq=True)
class DatasetLights:
    """Lights of a data set; each view draws them at random from these ranges.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    own: bool = True
    """Keeps the lights of the scene itself beside the random ones, except its environment if there are
    ``environments``; otherwise only the random ones light a view."""
    environments: tuple[str, ...] = given(converter=_file_names, default=())
    """Environment images, .hdr or .exr. Each view has one of them in place of the scene's own environment. In a
    settings file paths are relative to its folder."""
    turned: bool = True
    """Rotates environments, also that of the scene itself, by a random angle about the vertical."""
    brightness: Annotated[Span, Range(1e-6, 1e6)] = (0.5, 2.0)
    """Range of the factor that multiplies the radiance of environments, also that of the scene itself but not
    ``ambient``; the factor's logarithm is uniform."""
    visible: bool = True
    """Shows the images of ``environments`` as background; otherwise they light the scene without being visible."""
    suns: Annotated[WholeSpan, Range(0, 16)] | None = None
    """Range of the number of suns. None: 1 if there is nothing but suns to light meshes, added ones too, or captures
    with a material; else 0."""
    sun_elevation: Annotated[Span, Range(-90.0, 90.0, "degrees")] = (15.0, 75.0)
    """Range of the suns' angles above the horizon."""
    sun_lux: Annotated[Span, Range(0.0, 1e6)] = (1.0, 4.0)
    """Range of a sun's illuminance on a surface that faces it, before ``tint``: at pi, a white surface is as bright as
    display white."""
    sun_angle: Annotated[Span, Range(0.0, 90.0, "degrees")] = (0.0, 2.0)
    """Range of the suns' angular radii. Larger suns have softer shadows in path-traced frames, and in others with
    ``RenderConfig.shadows`` ``SOFT``."""
    points: Annotated[WholeSpan, Range(0, 16)] = (0, 0)
    """Range of the number of point lights, which are above and around the scene, or with ``INSIDE`` and ``CAMERAS`` in
    the upper half of its free space."""
    point_lux: Annotated[Span, Range(0.0, 1e6)] = (1.0, 4.0)
    """Range of a point light's illuminance at the centre of the scene, before ``tint``; pi makes a white surface
    display white. For a light nearer to the centre than a quarter of the scene's diagonal, at that distance instead."""
    ambient: Annotated[Span, Range(0.0, 1e6)] = (0.1, 0.5)
    """Range of the radiance of a constant, invisible environment, in views with suns or point lights and no other
    environment.
    """
    tint: Share = 0.2
    """Saturation of suns, point lights and constant environments: each colour channel is between 1 minus this and 1."""
    exposure: Annotated[Span, Range(-100.0, 100.0, "stops")] = (0.0, 0.0)
    """Range of the exposure of lit images; each stop doubles their brightness."""

    __post_init__ = take_fields


@frozen(kw_only=True, eq=True)
class DatasetObjects:
    """Objects that are added to the scene, at other positions in each view.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    files: tuple[str, ...] = given(converter=_file_names, default=())
    """Captures, meshes and scenes, some of which are added to each view, without the lights of scenes; a file that is
    listed twice is chosen twice as often. In a settings file paths are relative to its folder."""
    count: Annotated[WholeSpan, Range(0, 1000)] = (1, 3)
    """Range of the number of objects that are added to a view; objects for which no free space is found are left out.
    """
    size: Annotated[Span, Range(1e-6, 1e3)] = (0.08, 0.2)
    """Range of the diameter of an object's bounding sphere, as a fraction of the scene's diagonal."""
    own_size: bool = False
    """Keeps the size that an object has in its file, times ``scale``; otherwise ``size`` sets it."""
    scale: Annotated[Span, Range(1e-6, 1e6)] = (1.0, 1.0)
    """Range of the factor of an object's size in its file, if ``own_size`` is set."""
    upright: bool = True
    """Keeps objects upright, rotated about the vertical alone; otherwise they have any orientation."""
    unevenness: Share = 0.1
    """Largest height difference of the ground below an object, as a fraction of the object's diameter."""
    shadows: bool = True
    """Makes the scene's captures without a material shadow catchers in views with lights, so that added objects cast
    shadows on them."""

    __post_init__ = take_fields


@frozen(kw_only=True, eq=True)
class DatasetConfig:
    """Settings of a data set (docs/guide/dataset.md).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    views: Annotated[int, Range(1, _VIEWS_MAX)] = 100
    """Number of views. View i is the same whatever this number is."""
    seed: Seed = 0
    """Seed of all random numbers. Each view has its own sequences, one each for poses, lights and objects."""
    width: Annotated[int, Range(1, 65536, "pixels")] = 640
    """Width of images."""
    height: Annotated[int, Range(1, 65536, "pixels")] = 480
    """Height of images."""
    layers: tuple[str, ...] = given(converter=_checked_layers, default=("depth", "normal", "instance"))
    """Layers beside the images: some of ``depth``, ``normal``, ``albedo``, ``alpha``, ``mask`` (alpha of at least a
    half), ``instance`` (number of the object), ``category`` and ``exr`` (linear colour, depth and normals in one file),
    as a list or a text with commas."""
    split: tuple[float, float, float] = given(converter=_checked_split, default=(0.8, 0.1, 0.1))
    """Fractions of the views for training, validation and test, scaled to a sum of 1. A view stays in its subset when
    the number of views changes."""
    shard_views: Annotated[int, Range(0, _VIEWS_MAX)] = 0
    """Largest number of views in a shard for WebDataset; 0 writes no shards."""
    poses: DatasetPoses = DatasetPoses()
    """Settings of the cameras."""
    lights: DatasetLights = DatasetLights()
    """Settings of the light."""
    objects: DatasetObjects = DatasetObjects()
    """Settings of the added objects."""

    __post_init__ = take_fields
