"""Deep shadow maps in files: an ``.npz`` of what is tabulated, and the settings as JSON."""

from __future__ import annotations

import json
import math
import os
import zipfile
import zlib
from dataclasses import asdict
from enum import Enum
from typing import Any

import numpy as np
import warp as wp

from lumisplat.config import Absorption, AtlasLayout, DeepShadowConfig, ReceiverSampling
from lumisplat.constants import SHADOW_TILE
from lumisplat.device.shadow_map.atlas import Atlas
from lumisplat.errors import FormatError, LumisplatError
from lumisplat.math.arrays import FloatArray
from lumisplat.scene.lights import LightDirectional
from lumisplat.shadow_maps.atlas import Source
from lumisplat.shadow_maps.region import Region, texel_count

_VERSION = 1
_ENUMS: dict[str, type[Enum]] = {"layout": AtlasLayout, "absorption": Absorption, "sampling": ReceiverSampling}
_NOT_OURS = (
    *(ArithmeticError, EOFError, LookupError, RuntimeError, TypeError, ValueError),
    *(LumisplatError, zipfile.BadZipFile, zlib.error),
)
"""What comes of reading a file that is another, or damaged."""
_SCALARS = ("layout", "size", "texel_length", "bins", "bin_length")


def write_map(
    path: str | os.PathLike[str],
    config: DeepShadowConfig,
    source: Source,
    atlas: Atlas,
    *,
    region: Region,
    table: FloatArray,
    follows: bool,
) -> None:
    """Writes a map; the file appears whole or not at all. ``follows``: the region is that of its casters.

    Raises:
        FormatError: The name does not end in ``.npz``, or the file cannot be written.
    """
    from lumisplat.io.files.atomic import atomic_write

    if not os.fspath(path).lower().endswith(".npz"):
        raise FormatError(path, "a deep shadow map is saved as .npz")
    settings = {name: value.value if isinstance(value, Enum) else value for name, value in asdict(config).items()}
    header = {
        "version": _VERSION,
        "config": settings,
        "parallel": list(source.direction) if isinstance(source, LightDirectional) else None,
        "atlas": {name: float(getattr(atlas, name)) for name in _SCALARS},
        "origin": [float(x) for x in atlas.origin],
        "follows": follows,
        "axes": [float(x) for x in np.array(atlas.axes).ravel()],
    }
    arrays = {"texels": region.texels, "first": region.first, "count": region.count, "table": table}
    with atomic_write(path) as temporary:
        np.savez_compressed(temporary, header=np.frombuffer(json.dumps(header).encode(), np.uint8), **arrays)


def read_map(path: str | os.PathLike[str]) -> tuple[DeepShadowConfig, Source, Atlas, Region, FloatArray, bool]:
    """Reads what `write_map` wrote, in its order.

    Raises:
        FormatError: The file is missing, or is none of these.
    """
    try:
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            header = json.loads(file["header"].tobytes())
            if header["version"] != _VERSION:
                raise FormatError(path, f"is a deep shadow map of version {header['version']}, expected {_VERSION}")
            region = Region(*(file[name].astype(np.int32) for name in ("texels", "first", "count")))
            table = file["table"].astype(np.float32)
            follows = bool(header["follows"])
        config, source, atlas = _config(header["config"]), _source(header), _atlas(header)
    except FormatError:
        raise
    except OSError as error:
        raise FormatError(path, f"cannot be read: {error.strerror or error}") from None
    except _NOT_OURS:
        raise FormatError(path, "is no deep shadow map, or a damaged one") from None
    if not _fits(atlas, region, table):
        raise FormatError(path, "is a damaged deep shadow map: what it tabulates does not fit its settings")
    return config, source, atlas, region, table, follows


def _config(settings: dict[str, Any]) -> DeepShadowConfig:
    members: dict[str, Any] = {name: _ENUMS[name](settings[name]) for name in _ENUMS}
    return DeepShadowConfig(**(settings | members))


def _source(header: dict[str, Any]) -> Source:
    if header["parallel"] is not None:
        return LightDirectional(tuple(header["parallel"]))
    return np.array(header["origin"], dtype=np.float64)


def _atlas(header: dict[str, Any]) -> Atlas:
    atlas = Atlas()
    for name in _SCALARS:
        value = header["atlas"][name]
        setattr(atlas, name, value if name.endswith("length") else int(value))
    atlas.origin, atlas.axes = wp.vec3(*header["origin"]), wp.mat33(*header["axes"])
    return atlas


def _fits(atlas: Atlas, region: Region, table: FloatArray) -> bool:
    """Whether columns are where the atlas has texels and bins, and the table is theirs."""
    texels, first, count = region.texels, region.first, region.count
    sound = atlas.layout in (0, 1, 2) and SHADOW_TILE <= atlas.size <= 8192 and atlas.size % SHADOW_TILE == 0
    if not sound or not (atlas.bins >= 1 and 0.0 < atlas.bin_length < math.inf):
        return False
    if not (texels.ndim == 1 and texels.shape == first.shape == count.shape and table.shape == (region.voxel_count,)):
        return False
    if not (np.isfinite(np.array(atlas.origin)).all() and np.isfinite(np.array(atlas.axes)).all()):
        return False
    inside = (texels >= 0) & (texels < texel_count(atlas)) & (first >= 0) & (count >= 0)
    ascending = bool((np.diff(texels) > 0).all()) if len(texels) else True
    shares = bool(((table >= 0.0) & (table <= 1.0)).all())
    return bool(inside.all() and (first + count <= atlas.bins).all() and ascending and shares)
