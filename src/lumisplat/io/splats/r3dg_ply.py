"""Captures in the columns of Relightable 3D Gaussians (Gao et al. 2024), which their programs read.

130 properties in their order: those of INRIA's files of SH degree 3, base colour and roughness before their activation,
incident light and visibility as harmonics of degree 3.
"""

from __future__ import annotations

import logging
import os
from dataclasses import replace

import numpy as np

from lumisplat.constants import SH_DEGREE_MAX
from lumisplat.errors import FormatError
from lumisplat.io.files.source import PathLike
from lumisplat.io.splats.columns import Floats, columns_from_gaussians
from lumisplat.io.splats.material_columns import R3DG, says_linear
from lumisplat.io.splats.splat_ply import (
    column_views,
    comments_as_stored,
    harmonics_in_order,
    inria_names,
    write_columns,
)
from lumisplat.scene.gaussians import Gaussians

_log = logging.getLogger("lumisplat")

COEFFICIENTS = (SH_DEGREE_MAX + 1) ** 2
"""Of each channel; their programs refuse files of another degree."""


def write_r3dg_ply(path: PathLike, gaussians: Gaussians) -> None:
    """Writes a capture with materials as R3DG's second stage does.

    Base colours outside 0.03..0.8 and roughness outside 0.09..0.99 become the nearest value that their columns can
    hold, which is logged, as is metalness, for which there is no column. Incident light is 0 where there is none, and
    visibility always: their programs trace it.

    Raises:
        FormatError: The capture lacks albedo, roughness or normals, or the file cannot be written.
    """
    missing = [name for name in ("albedo", "roughness", "normals") if getattr(gaussians, name) is None]
    if missing:
        raise FormatError(
            path,
            f"R3DG's columns hold albedo, roughness and normals, and the capture has no {' and no '.join(missing)}: "
            "lumisplat delight, or lumisplat train --relightable, finds them",
        )
    light = gaussians.incident
    whole = replace(
        gaussians,
        sh=_padded(gaussians.sh),
        incident=np.zeros((gaussians.count, COEFFICIENTS, 3), np.float32) if light is None else _padded(light),
    )
    columns = columns_from_gaussians(whole)
    columns.material_columns = R3DG
    for name in R3DG.sigmoids:
        values = getattr(columns, name)
        _say_if_outside(path, name, values)
        setattr(columns, name, R3DG.stored(name, values))
    if columns.metallic is not None and columns.metallic.any():
        _log.warning("%s: R3DG's columns cannot store metallic: left out, metals become dielectrics", os.fspath(path))
    columns.metallic = None
    names = [*inria_names(COEFFICIENTS), *R3DG.properties["albedo"], *R3DG.properties["roughness"]]
    names += [*harmonics_in_order("incidents", COEFFICIENTS), *harmonics_in_order("visibility", COEFFICIENTS, 1)]
    comments = tuple(comment for comment in comments_as_stored(gaussians, columns) if not says_linear((comment,)))
    write_columns(path, comments, names, dict(column_views(columns)), columns.count)


def _padded(sh: Floats) -> Floats:
    """Harmonics up to the degree of their files."""
    return np.pad(sh, ((0, 0), (0, COEFFICIENTS - sh.shape[1]), (0, 0)))


def _say_if_outside(path: PathLike, name: str, values: Floats) -> None:
    """Logs how many values their columns cannot hold."""
    low, high = R3DG.limits(name)
    beyond = np.maximum(low - values, values - high)
    count = np.count_nonzero(beyond > 0.0)
    if count:
        _log.warning(
            "%s: R3DG's columns hold %s from %.2f to %.2f: %s of %s values are outside, by up to %.2g, and become the "
            "nearest of these",
            os.fspath(path),
            name,
            low,
            high,
            f"{count:,}",
            f"{values.size:,}",
            beyond.max(),
        )
