"""Settings of data sets: many views of a scene from random places, in random light, with objects put into it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import cast

from lumisplat.config.checks import (
    check_flag,
    check_kind,
    check_range,
    check_whole,
    is_number,
    listed_names,
    quoted,
    suggestion,
    take_enum,
    take_names,
    take_range,
    take_whole_range,
)
from lumisplat.errors import ConfigError

Range = tuple[float, float]
"""The least and the largest value, both included; every value between is as likely."""
WholeRange = tuple[int, int]

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


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetPoses:
    """Where the cameras of a data set stand, and what they look at.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    where: PosePlaces = PosePlaces.DOME
    """Where they stand."""
    azimuth: Range = (0.0, 360.0)
    """Of ``DOME``: degrees about the vertical, counter-clockwise seen from above; 0 is the front."""
    elevation: Range = (5.0, 60.0)
    """Of ``DOME``: degrees above the horizon, -90 to 90."""
    distance: Range = (1.0, 1.5)
    """Of ``DOME``: distance from the point that is looked at, as a factor of the distance at which the whole scene just
    fits into the image, above 0. Below 1, images may cut parts of the scene off."""
    height: Range = (0.2, 0.8)
    """Of ``INSIDE``: height of the eye, as a share of the scene's, 0..1."""
    pitch: Range = (-25.0, 10.0)
    """Of ``INSIDE``: degrees by which cameras look up, -90 to 90."""
    shift: float = 0.02
    """Of ``CAMERAS``: how far eyes are moved at most, as a share of the scene's diagonal, 0..1."""
    turn: float = 5.0
    """Of ``CAMERAS``: degrees by which cameras are turned at most, about any axis, 0 to 180."""
    aim: float = 0.1
    """Of ``DOME``: how far from its middle the scene is looked at, as a share of its size along each axis, 0..1."""
    roll: float = 0.0
    """Degrees by which cameras lean to a side at most, 0 to 180."""
    fov: Range = (35.0, 60.0)
    """Vertical field of view, degrees, more than 0 and less than 180."""
    at_objects: float = 0.5
    """Share of views that look at one of the objects put into the scene, where there are any, 0..1; not of
    ``CAMERAS``."""
    object_distance: Range = (3.0, 8.0)
    """Of views of objects from ``DOME``: distance in radii of the object, above 1."""
    clearance: float = 0.02
    """Free space that cameras have on all sides, as a share of the scene's diagonal, 0..1."""
    seen: float = 0.1
    """Share of the picture that must show a surface, 0..1."""

    def __post_init__(self) -> None:
        take_enum(self, "where", PosePlaces)
        take_range(self, "azimuth", -360.0, 360.0)
        take_range(self, "elevation", -90.0, 90.0)
        take_range(self, "distance", 1e-3, 1e3)
        take_range(self, "height", 0.0, 1.0)
        take_range(self, "pitch", -90.0, 90.0)
        check_range("turn", self.turn, 0.0, 180.0)
        check_range("roll", self.roll, 0.0, 180.0)
        for name in ("shift", "aim", "at_objects", "clearance", "seen"):
            check_range(name, getattr(self, name), 0.0, 1.0)
        take_range(self, "fov", 1.0, 179.0)
        take_range(self, "object_distance", 1.0, 1e3)


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetLights:
    """The light of a data set, another one in each view.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    own: bool = True
    """Whether the lights of the scene stay."""
    environments: tuple[str, ...] = ()
    """Files of environments, .hdr or .exr, one of which each view has, in place of the scene's own. In a settings file
    paths begin at its folder."""
    turned: bool = True
    """Whether environments, the scene's own too, are turned about the vertical."""
    brightness: Range = (0.5, 2.0)
    """Factor of their radiance, above 0; its logarithm is spread evenly."""
    visible: bool = True
    """Whether the environments of files are the background of pictures."""
    suns: WholeRange | None = None
    """How many suns there are, 0 to 16. None: one, if there is something to light and nothing else lights it."""
    sun_elevation: Range = (15.0, 75.0)
    """Degrees above the horizon, -90 to 90."""
    sun_lux: Range = (1.0, 4.0)
    """Illuminance that a sun gives what faces it, at least 0: what is white is as bright as display white at pi."""
    sun_angle: Range = (0.0, 2.0)
    """Angular radius, degrees, 0 to 90, of soft shadows."""
    lamps: WholeRange = (0, 0)
    """How many lamps there are, 0 to 16: above and around the scene, or in its free space where cameras are in it."""
    lamp_lux: Range = (1.0, 4.0)
    """Illuminance that a lamp gives the middle of the scene, at least 0."""
    sky: Range = (0.1, 0.5)
    """Radiance of an even, invisible sky in views with suns or lamps and without an environment, at least 0."""
    tint: float = 0.2
    """How coloured suns, lamps and skies are, 0..1: each channel is between 1 less this and 1."""
    exposure: Range = (0.0, 0.0)
    """Stops that are added to the exposure of lit pictures, -100 to 100."""

    def __post_init__(self) -> None:
        for name in ("own", "turned", "visible"):
            check_flag(name, getattr(self, name))
        take_names(self, "environments")
        take_range(self, "brightness", 1e-6, 1e6)
        for name in ("suns", "lamps"):
            if getattr(self, name) is not None:
                take_whole_range(self, name, 0, 16)
        take_range(self, "sun_elevation", -90.0, 90.0)
        take_range(self, "sun_angle", 0.0, 90.0)
        for name in ("sun_lux", "lamp_lux", "sky"):
            take_range(self, name, 0.0, 1e6)
        check_range("tint", self.tint, 0.0, 1.0)
        take_range(self, "exposure", -100.0, 100.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetObjects:
    """What is put into the scene, elsewhere in each view.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    files: tuple[str, ...] = ()
    """Captures, meshes and scenes, of which some are put into each view; a file may be named more than once. In a
    settings file paths begin at its folder."""
    count: WholeRange = (1, 3)
    """How many there are, 0 to 1000; those that find no room are left out."""
    size: Range = (0.08, 0.2)
    """Diameter of an object's bounding sphere, as a share of the scene's diagonal, above 0."""
    own_size: bool = False
    """Whether they keep the size that they have, in place of ``size``, times ``scale``."""
    scale: Range = (1.0, 1.0)
    """Factor of the size of those that keep theirs, above 0."""
    upright: bool = True
    """Whether they stay upright, turned about the vertical alone; else they lie any way round."""
    unevenness: float = 0.1
    """How uneven the ground below an object may be, as a share of its diameter, 0..1."""
    shadows: bool = True
    """Whether captures that keep their look receive the shadows of objects in lit views."""

    def __post_init__(self) -> None:
        take_names(self, "files")
        take_whole_range(self, "count", 0, 1000)
        take_range(self, "size", 1e-6, 1e3)
        take_range(self, "scale", 1e-6, 1e6)
        check_range("unevenness", self.unevenness, 0.0, 1.0)
        for name in ("own_size", "upright", "shadows"):
            check_flag(name, getattr(self, name))


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetConfig:
    """Settings of a data set (docs/guide/dataset.md).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    views: int = 100
    """How many views there are, 1 to 10,000,000. A view is the same however many there are."""
    seed: int = 0
    """Of all that is random, 0..2^32 - 1. Each view has random numbers of its own, and its poses, lights and objects
    have theirs."""
    width: int = 640
    """Of pictures, pixels, 1 to 65,536."""
    height: int = 480
    """Of pictures, pixels, 1 to 65,536."""
    layers: tuple[str, ...] = ("depth", "normal", "instance")
    """Beside the pictures, some of ``depth``, ``normal``, ``albedo``, ``alpha``, ``mask``, ``instance``, ``category``
    and ``exr``; as a list, or as a text with commas."""
    split: tuple[float, float, float] = (0.8, 0.1, 0.1)
    """Shares of views to train by, to validate by and to test by, at least 0; the sum counts as all. A view stays in
    its part, however many there are."""
    shard_views: int = 0
    """Views of a shard, at most: shards of WebDataset beside the files. 0: no shards."""
    poses: DatasetPoses = DatasetPoses()
    """Where cameras stand."""
    lights: DatasetLights = DatasetLights()
    """The light."""
    objects: DatasetObjects = DatasetObjects()
    """What is put into the scene."""

    def __post_init__(self) -> None:
        check_whole("views", self.views, 1, _VIEWS_MAX)
        check_whole("seed", self.seed, 0, 2**32 - 1)
        check_whole("width", self.width, 1, 65536)
        check_whole("height", self.height, 1, 65536)
        object.__setattr__(self, "layers", _checked_layers(self.layers))
        object.__setattr__(self, "split", _checked_split(self.split))
        check_whole("shard_views", self.shard_views, 0, _VIEWS_MAX)
        check_kind("poses", self.poses, DatasetPoses)
        check_kind("lights", self.lights, DatasetLights)
        check_kind("objects", self.objects, DatasetObjects)


def _checked_layers(value: object) -> tuple[str, ...]:
    """Names of layers, in the order of `DATASET_LAYERS`, each once."""
    names = listed_names(value)
    if names is None:
        raise ConfigError(f"layers is {quoted(value)}, expected some of {', '.join(DATASET_LAYERS)}")
    for name in names:
        if name not in (*DATASET_LAYERS, "color"):
            raise ConfigError(f"layers has {name!r}, {suggestion(name, DATASET_LAYERS)}")
    return tuple(name for name in DATASET_LAYERS if name in names)  # the picture, "color", is always there


def _checked_split(value: object) -> tuple[float, float, float]:
    """Three shares whose sum is 1."""
    shares = list(cast(list[object], value)) if isinstance(value, tuple | list) else []
    numbers = [float(share) for share in shares if is_number(share) and 0.0 <= share < math.inf]
    if len(shares) != 3 or len(numbers) != 3 or not sum(numbers) > 0.0:
        raise ConfigError(
            f"split is {quoted(cast(object, value))}, expected three shares, to train, validate and test by"
        )
    train, validation, test = (number / sum(numbers) for number in numbers)
    return train, validation, test
