"""Reads and writes deep shadow maps: an ``.npz`` file with the tabulated values, and the settings as JSON."""

from __future__ import annotations

import json
import math
import os
from dataclasses import asdict, dataclass
from enum import Enum
from typing import Any

import numpy as np
import warp as wp

from lumisplat.config import Absorption, AtlasLayout, DeepShadowConfig, ReceiverSampling
from lumisplat.constants import SHADOW_TILE
from lumisplat.device.shadow_map.atlas import Atlas
from lumisplat.device.shadow_map.light_extent import LightExtent
from lumisplat.errors import FormatError, LumisplatError
from lumisplat.io.files.arrays import checked_array, read_arrays
from lumisplat.io.files.atomic import atomic_write
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.scene.lights import LightDirectional
from lumisplat.shadow_maps.atlas import Region, Source, texel_count
from lumisplat.shadow_maps.light_extent import extent_from_record, extent_record, has_extent

_VERSION = 2
_VERSIONS = (1, 2)
"""Versions that can be read; files of version 1 are maps of lights without an extent."""
_ENUMS: dict[str, type[Enum]] = {"layout": AtlasLayout, "absorption": Absorption, "sampling": ReceiverSampling}
_SCALARS = ("layout", "size", "texel_length", "bins", "bin_length")
"""Names of the fields of Atlas that are numbers."""
_FOREIGN_FILE_ERRORS = (
    *(ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError),
    LumisplatError,
)
"""Errors that may be raised when a foreign or damaged file is read as a deep shadow map."""


@dataclass(frozen=True, slots=True, eq=False)
class StoredMap:
    """Content of a file that stores a deep shadow map."""

    config: DeepShadowConfig
    source: Source
    """Position of the light relative to ``about``, or the directional light."""
    extent: LightExtent
    """Shape of the light."""
    about: Doubles
    """World position to which the map's coordinates are relative, shape (3,)."""
    atlas: Atlas
    region: Region
    values: FloatArray
    """Transmittance of each tabulated depth bin, 0..1, texel by texel; of a light with an extent, the optical depth."""
    follows_casters: bool
    """True if a rebuild with other casters fits the atlas to them; False if the map was built for receivers."""


def write_map(path: str | os.PathLike[str], stored: StoredMap) -> None:
    """Writes a deep shadow map; the file appears complete or not at all.

    Raises:
        FormatError: The name does not end in ``.npz``, or the file cannot be written.
    """
    if not os.fspath(path).lower().endswith(".npz"):
        raise FormatError(path, "a deep shadow map is saved as .npz")
    config, source, atlas, region = stored.config, stored.source, stored.atlas, stored.region
    settings = {name: value.value if isinstance(value, Enum) else value for name, value in asdict(config).items()}
    header = {
        "version": _VERSION,
        "config": settings,
        "parallel": list(source.direction) if isinstance(source, LightDirectional) else None,
        "atlas": {name: float(getattr(atlas, name)) for name in _SCALARS},
        "origin": [float(x) for x in atlas.origin],
        "extent": extent_record(stored.extent),
        "about": stored.about.tolist(),
        "follows": stored.follows_casters,
        "axes": [float(x) for x in np.array(atlas.axes).ravel()],
    }
    with atomic_write(path) as temporary:
        np.savez_compressed(
            temporary,
            header=np.frombuffer(json.dumps(header).encode(), np.uint8),
            texels=region.texels,
            first=region.first,
            count=region.count,
            table=stored.values,
        )


def read_map(path: str | os.PathLike[str]) -> StoredMap:
    """Reads a deep shadow map written by `write_map`.

    Raises:
        FormatError: The file is not a deep shadow map, or cannot be read.
        MissingFileError: There is no such file.
    """
    kind = "a deep shadow map"
    arrays = read_arrays(path, kind, compressed=True)
    try:
        header = json.loads(checked_array(arrays, "header", (None,), np.uint8).tobytes())
        if header["version"] not in _VERSIONS:
            raise FormatError(path, f"is a deep shadow map of version {header['version']}, expected {_VERSION}")
        region = Region(*(checked_array(arrays, name, (None,), np.int32) for name in ("texels", "first", "count")))
        values = checked_array(arrays, "table", (None,), np.float32)
        stored = StoredMap(
            _config(header["config"]),
            _source(header),
            extent_from_record(header["extent"]) if header["version"] > 1 else LightExtent(),
            _about(header),
            _atlas(header),
            region,
            values,
            bool(header["follows"]),
        )
    except FormatError:
        raise
    except _FOREIGN_FILE_ERRORS:
        raise FormatError(path, f"is damaged, or not {kind}") from None
    if not _is_consistent(stored):
        raise FormatError(path, "is a damaged deep shadow map: its values do not fit its settings")
    return stored


def _config(settings: dict[str, Any]) -> DeepShadowConfig:
    members: dict[str, Any] = {name: _ENUMS[name](settings[name]) for name in _ENUMS}
    return DeepShadowConfig(**(settings | members))


def _source(header: dict[str, Any]) -> Source:
    if header["parallel"] is not None:
        return LightDirectional(tuple(header["parallel"]))
    return np.array(header["origin"], dtype=np.float64)


def _about(header: dict[str, Any]) -> Doubles:
    about = np.array(header.get("about", (0.0, 0.0, 0.0)), dtype=np.float64)
    if about.shape != (3,) or not np.isfinite(about).all():
        raise ValueError("no origin")
    return about


def _atlas(header: dict[str, Any]) -> Atlas:
    atlas = Atlas()
    for name in _SCALARS:
        value = header["atlas"][name]
        setattr(atlas, name, value if name.endswith("length") else int(value))
    atlas.origin, atlas.axes = wp.vec3(*header["origin"]), wp.mat33(*header["axes"])
    return atlas


def _is_consistent(stored: StoredMap) -> bool:
    """Returns whether the atlas is valid, columns lie within the atlas's texels and bins, and every bin has a value."""
    most = math.inf if has_extent(stored.extent) else 1.0
    values = stored.values
    are_values = values.shape == (stored.region.voxel_count,) and bool(((values >= 0.0) & (values <= most)).all())
    return _is_sound(stored.atlas) and _fits(stored.region, stored.atlas) and are_values


def _is_sound(atlas: Atlas) -> bool:
    sizes = atlas.layout in (0, 1, 2) and SHADOW_TILE <= atlas.size <= 8192 and atlas.size % SHADOW_TILE == 0
    bins = atlas.bins >= 1 and 0.0 < atlas.bin_length < math.inf
    return bool(
        sizes and bins and np.isfinite(np.array(atlas.origin)).all() and np.isfinite(np.array(atlas.axes)).all()
    )


def _fits(region: Region, atlas: Atlas) -> bool:
    texels, first, count = region.texels, region.first, region.count
    if not (texels.ndim == 1 and texels.shape == first.shape == count.shape):
        return False
    inside = (texels >= 0) & (texels < texel_count(atlas)) & (first >= 0) & (count >= 0) & (first + count <= atlas.bins)
    return bool(inside.all() and (np.diff(texels) > 0).all())
