"""Settings of data sets: many views of a scene from random places, in random light, with objects put into it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Annotated

import numpy as np

from lumisplat.config.checks import Range, is_number, listed_names, quoted, suggestion
from lumisplat.config.setting import Seed, Share, Span, WholeSpan, frozen, given, take_fields
from lumisplat.errors import ConfigError

DATASET_LAYERS = ("depth", "normal", "albedo", "alpha", "mask", "instance", "category", "exr")
"""What data sets may hold beside the pictures."""
_VIEWS_MAX = 10_000_000


class PosePlaces(Enum):
    """Where the cameras of a data set stand."""

    DOME = "dome"
    """Around the scene, looking at it."""
    INSIDE = "inside"
    """In its free space, looking anywhere."""
    CAMERAS = "cameras"
    """Near given cameras: those of a capture's photographs, say, from where it looks best."""


def _file_names(value: Iterable[str], name: str = "files") -> tuple[str, ...]:
    """Returns a list of names as a tuple."""
    names = None if isinstance(value, str) else listed_names(value)
    if names is None:
        raise ConfigError(f"{name} is {quoted(value)}, expected a list of names of files")
    return names


def _checked_layers(value: str | Iterable[str], name: str = "layers") -> tuple[str, ...]:
    """Returns names of layers, in the order of `DATASET_LAYERS`, each once."""
    names = listed_names(value)
    if names is None:
        raise ConfigError(f"{name} is {quoted(value)}, expected some of {', '.join(DATASET_LAYERS)}")
    for layer in names:
        if layer not in (*DATASET_LAYERS, "color"):
            raise ConfigError(f"{name} has {layer!r}, {suggestion(layer, DATASET_LAYERS)}")
    return tuple(layer for layer in DATASET_LAYERS if layer in names)  # the picture, "color", is always there


def _checked_split(value: Sequence[float], name: str = "split") -> tuple[float, float, float]:
    """Returns three shares whose sum is 1."""
    shares: list[object] = list(value) if isinstance(value, tuple | list | np.ndarray) and np.ndim(value) == 1 else []
    numbers = [float(share) for share in shares if is_number(share) and 0.0 <= share < math.inf]
    if len(shares) != 3 or len(numbers) != 3 or not sum(numbers) > 0.0:
        raise ConfigError(f"{name} is {quoted(value)}, expected three shares, to train, validate and test by")
    train, validation, test = (number / sum(numbers) for number in numbers)
    return train, validation, test


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetPoses:
    """Where the cameras of a data set stand, and what they look at.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    where: PosePlaces = PosePlaces.DOME
    """Where they stand."""
    azimuth: Annotated[Span, Range(-360.0, 360.0, "degrees")] = (0.0, 360.0)
    """Of ``DOME``: angle about the vertical, counter-clockwise seen from above; 0 is the front."""
    elevation: Annotated[Span, Range(-90.0, 90.0, "degrees")] = (5.0, 60.0)
    """Of ``DOME``: angle above the horizon."""
    distance: Annotated[Span, Range(1e-3, 1e3)] = (1.0, 1.5)
    """Of ``DOME``: distance from the point that is looked at, as a factor of the distance at which the whole scene just
    fits into the image. Below 1, images may cut parts of the scene off."""
    height: Annotated[Span, Range(0.0, 1.0)] = (0.2, 0.8)
    """Of ``INSIDE``: height of the eye, as a share of the scene's."""
    pitch: Annotated[Span, Range(-90.0, 90.0, "degrees")] = (-25.0, 10.0)
    """Of ``INSIDE``: angle by which cameras look up."""
    shift: Share = 0.02
    """Of ``CAMERAS``: how far eyes are moved at most, as a share of the scene's diagonal."""
    turn: Annotated[float, Range(0.0, 180.0, "degrees")] = 5.0
    """Of ``CAMERAS``: angle by which cameras are turned at most, about any axis."""
    aim: Share = 0.1
    """Of ``DOME``: how far from its middle the scene is looked at, as a share of its size along each axis."""
    roll: Annotated[float, Range(0.0, 180.0, "degrees")] = 0.0
    """Angle by which cameras lean to a side at most."""
    fov: Annotated[Span, Range(1.0, 179.0, "degrees")] = (35.0, 60.0)
    """Vertical field of view."""
    at_objects: Share = 0.5
    """Share of views that look at one of the objects put into the scene, where there are any; not of
    ``CAMERAS``."""
    object_distance: Annotated[Span, Range(1.0, 1e3)] = (3.0, 8.0)
    """Of views of objects from ``DOME``: distance in radii of the object."""
    clearance: Share = 0.02
    """Free space that cameras have on all sides, as a share of the scene's diagonal."""
    seen: Share = 0.1
    """Share of the picture that must show a surface."""

    __post_init__ = take_fields


@frozen(kw_only=True, eq=True)
class DatasetLights:
    """The light of a data set, another one in each view.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    own: bool = True
    """Whether the lights of the scene stay."""
    environments: tuple[str, ...] = given(converter=_file_names, default=())
    """Files of environments, .hdr or .exr, one of which each view has, in place of the scene's own. In a settings file
    paths begin at its folder."""
    turned: bool = True
    """Whether environments, the scene's own too, are turned about the vertical."""
    brightness: Annotated[Span, Range(1e-6, 1e6)] = (0.5, 2.0)
    """Factor of their radiance; its logarithm is spread evenly."""
    visible: bool = True
    """Whether the environments of files are the background of pictures."""
    suns: Annotated[WholeSpan, Range(0, 16)] | None = None
    """How many suns there are. None: one, if there is something to light and nothing else lights it."""
    sun_elevation: Annotated[Span, Range(-90.0, 90.0, "degrees")] = (15.0, 75.0)
    """Angle above the horizon."""
    sun_lux: Annotated[Span, Range(0.0, 1e6)] = (1.0, 4.0)
    """Illuminance that a sun gives what faces it: what is white is as bright as display white at pi."""
    sun_angle: Annotated[Span, Range(0.0, 90.0, "degrees")] = (0.0, 2.0)
    """Angular radius, of soft shadows."""
    lamps: Annotated[WholeSpan, Range(0, 16)] = (0, 0)
    """How many lamps there are: above and around the scene, or in its free space where cameras are in it."""
    lamp_lux: Annotated[Span, Range(0.0, 1e6)] = (1.0, 4.0)
    """Illuminance that a lamp gives the middle of the scene."""
    sky: Annotated[Span, Range(0.0, 1e6)] = (0.1, 0.5)
    """Radiance of an even, invisible sky in views with suns or lamps and without an environment."""
    tint: Share = 0.2
    """How coloured suns, lamps and skies are: each channel is between 1 less this and 1."""
    exposure: Annotated[Span, Range(-100.0, 100.0, "stops")] = (0.0, 0.0)
    """Added to the exposure of lit pictures."""

    __post_init__ = take_fields


@frozen(kw_only=True, eq=True)
class DatasetObjects:
    """What is put into the scene, elsewhere in each view.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    files: tuple[str, ...] = given(converter=_file_names, default=())
    """Captures, meshes and scenes, of which some are put into each view; a file may be named more than once. In a
    settings file paths begin at its folder."""
    count: Annotated[WholeSpan, Range(0, 1000)] = (1, 3)
    """How many there are; those that find no room are left out."""
    size: Annotated[Span, Range(1e-6, 1e3)] = (0.08, 0.2)
    """Diameter of an object's bounding sphere, as a share of the scene's diagonal."""
    own_size: bool = False
    """Whether they keep the size that they have, in place of ``size``, times ``scale``."""
    scale: Annotated[Span, Range(1e-6, 1e6)] = (1.0, 1.0)
    """Factor of the size of those that keep theirs."""
    upright: bool = True
    """Whether they stay upright, turned about the vertical alone; else they lie any way round."""
    unevenness: Share = 0.1
    """How uneven the ground below an object may be, as a share of its diameter."""
    shadows: bool = True
    """Whether captures that keep their look receive the shadows of objects in lit views."""

    __post_init__ = take_fields


@frozen(kw_only=True, eq=True)
class DatasetConfig:
    """Settings of a data set (docs/guide/dataset.md).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    views: Annotated[int, Range(1, _VIEWS_MAX)] = 100
    """How many views there are. A view is the same however many there are."""
    seed: Seed = 0
    """Of all that is random. Each view has random numbers of its own, and its poses, lights and objects
    have theirs."""
    width: Annotated[int, Range(1, 65536, "pixels")] = 640
    """Of pictures."""
    height: Annotated[int, Range(1, 65536, "pixels")] = 480
    """Of pictures."""
    layers: tuple[str, ...] = given(converter=_checked_layers, default=("depth", "normal", "instance"))
    """Beside the pictures, some of ``depth``, ``normal``, ``albedo``, ``alpha``, ``mask``, ``instance``, ``category``
    and ``exr``; as a list, or as a text with commas."""
    split: tuple[float, float, float] = given(converter=_checked_split, default=(0.8, 0.1, 0.1))
    """Shares of views to train by, to validate by and to test by, at least 0; the sum counts as all. A view stays in
    its part, however many there are."""
    shard_views: Annotated[int, Range(0, _VIEWS_MAX)] = 0
    """Views of a shard, at most: shards of WebDataset beside the files. 0: no shards."""
    poses: DatasetPoses = DatasetPoses()
    """Where cameras stand."""
    lights: DatasetLights = DatasetLights()
    """The light."""
    objects: DatasetObjects = DatasetObjects()
    """What is put into the scene."""

    __post_init__ = take_fields
