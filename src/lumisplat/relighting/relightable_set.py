"""Reads a folder of images whose materials, normals and light are known (docs/guide/materials.md#sets)."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn, cast

import numpy as np

from lumisplat.errors import FormatError, MissingFileError
from lumisplat.io.files.source import PathLike
from lumisplat.io.images.exr import read_exr
from lumisplat.io.images.radiance import read_picture, read_radiance
from lumisplat.io.scene_toml.scene_file import read_scene_file
from lumisplat.io.training_images.loading import Photograph, load_photographs
from lumisplat.math.arrays import Flags, FloatArray
from lumisplat.scene.lights import Light, LightEnvironment

INSIDE = 0.5
"""Share of a pixel that the object covers from which on it counts, as photographs' masks do."""

LAYERS = {"albedo": "RGB", "normal": "XYZ", "roughness": "Y"}
"""Channels of the layers."""
LIGHTS = {".exr", ".toml"}
"""Files of light: an environment, or the lamps of a scene file."""
_MAKER = "tools/make_relightable_set.py makes sets that have all of it"


@dataclass(frozen=True, slots=True)
class RelightableSet:
    """What the folder has; files are read when they are asked for, and each error names one."""

    folder: Path
    views: tuple[Photograph, ...]
    """Photographs held out, over black."""
    layers: tuple[str, ...]
    """Those of `LAYERS` whose truth is there."""
    unseen: tuple[str, ...]
    """Names of the light of ``relit``."""
    specular: float
    """Strength of the highlights of the surfaces: 0 if they are Lambertian."""

    @classmethod
    def open(cls, folder: PathLike) -> RelightableSet:
        """Finds what is there.

        Raises:
            FormatError: It lists no photographs held out, or has neither a layer nor relit pictures.
            MissingFileError: There is no such folder.
        """
        place = Path(folder)
        if place.is_dir() and not (place / "transforms_test.json").is_file():
            raise FormatError(place, f"has no transforms_test.json, of whose cameras the truth is; {_MAKER}")
        views = load_photographs(place).held_out
        layers = tuple(name for name in LAYERS if (place / "truth" / name).is_dir())
        unseen = tuple(sorted({path.stem for path in (place / "relit").glob("*") if path.suffix in LIGHTS}))
        if not layers and not unseen:
            raise FormatError(
                place, f"has neither truth/albedo, truth/normal and the like nor relit/*.exr or *.toml; {_MAKER}"
            )
        return cls(place, views, layers, unseen, _specular(place / "set.json"))

    def region(self, view: Photograph) -> Flags:
        """Where the object covers at least half of a pixel, shape (H, W); everywhere without transparency.

        Raises:
            FormatError: Nowhere.
        """
        shares = [share for share in (view.alpha(), view.mask()) if share is not None]
        inside = np.ones((view.camera.height, view.camera.width), np.bool_)
        for share in shares:
            inside &= share >= INSIDE
        if not inside.any():
            raise FormatError(view.path, "shows nothing: no pixel is covered by half or more")
        return inside

    def layer(self, name: str, view: Photograph) -> FloatArray:
        """The truth of a view, shape (H, W, C).

        Raises:
            FormatError: It is missing, damaged, of another size, or not finite.
        """
        path = self.folder / "truth" / name / f"{view.name}.exr"
        stored, channels = read_exr(_existing(path)), LAYERS[name]
        missing = [channel for channel in channels if channel not in stored]
        if missing:
            raise FormatError(path, f"has no channel {missing[0]}, expected {', '.join(channels)} and A")
        values = np.stack([stored[channel] for channel in channels], axis=-1).astype(np.float32)
        _check_size(path, values, view)
        if not np.isfinite(values).all():
            raise FormatError(path, "has values that are not finite")
        return values

    def relit(self, name: str, view: Photograph) -> FloatArray:
        """What is seen in unseen light: display-referred, over black, shape (H, W, 3).

        Raises:
            FormatError: It is missing, damaged, or of another size.
        """
        path = self.folder / "relit" / name / f"{view.name}.png"
        picture = read_picture(_existing(path))
        _check_size(path, picture, view)
        return picture

    @property
    def has_lamps(self) -> bool:
        """Whether some of the unseen light is of lamps."""
        return any((self.folder / "relit" / f"{name}.toml").is_file() for name in self.unseen)

    def lights(self, name: str) -> tuple[Light, ...]:
        """Unseen light.

        Raises:
            FormatError: Its file is missing or damaged, or has something else in it.
        """
        lamps = self.folder / "relit" / f"{name}.toml"
        if not lamps.is_file():
            return (LightEnvironment(read_radiance(_existing(lamps.with_suffix(".exr"))), visible=False),)
        return read_scene_file(lamps, _refuse).lights

    def environment(self) -> FloatArray | None:
        """That of the photographs: linear radiance, shape (H, W, 3); None: lamps of a room made them.

        Raises:
            FormatError: It is missing or damaged.
        """
        path = self.folder / "environment.exr"
        if not path.exists() and (self.folder / "lamps.toml").exists():
            return None
        return read_radiance(_existing(path))


def _refuse(path: PathLike) -> NoReturn:
    """Refuses what a scene file of lamps names besides."""
    raise FormatError(path, "is in the light of a set, expected [[lights]] and [environment] alone")


def _existing(path: Path) -> Path:
    if not path.is_file():
        raise MissingFileError(path, "no such file: the set is incomplete")
    return path


def _check_size(path: Path, values: FloatArray, view: Photograph) -> None:
    height, width = values.shape[:2]
    if (width, height) != (view.camera.width, view.camera.height):
        wanted = f"{view.camera.width} x {view.camera.height} of {view.path}"
        raise FormatError(path, f"has {width} x {height} pixels, expected the {wanted}")


def _specular(path: Path) -> float:
    """What ``set.json`` says of highlights; 1 without it."""
    if not path.exists():
        return 1.0
    try:
        told = cast("object", json.loads(path.read_bytes()))
    except (OSError, ValueError) as error:
        raise FormatError(path, f"cannot be read as JSON: {error}") from None
    specular = cast("dict[str, object]", told).get("specular", 1.0) if isinstance(told, dict) else None
    if not isinstance(specular, (int, float)) or not 0.0 <= specular <= 1.0:
        raise FormatError(path, f"has specular {specular!r}, expected a number in 0..1")
    return float(specular)
