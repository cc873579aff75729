"""Scenes of OpenUSD files: what is shown of a stage, placed in the world."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.files.source import PathLike
from lumisplat.io.splats.columns import gaussians_from_columns
from lumisplat.io.usd.library import pxr, reading_usd
from lumisplat.io.usd.particles import is_field, read_particles
from lumisplat.io.usd.stage import UsdFile, open_usd
from lumisplat.io.usd.walk import Placed, placed_prims
from lumisplat.math.arrays import Doubles
from lumisplat.scene.editing.affine import under_affine
from lumisplat.scene.editing.transform import transform
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.scene import Scene, SplatInstance, check_similarity

_Y_DOWN = np.diag([1.0, -1.0, -1.0, 1.0])
"""Half a turn about x: captures have y down."""


def read_usd(path: PathLike, drop_invalid: bool = False) -> Gaussians | Scene:
    """Reads what a stage shows at its first time."""
    path = Path(path)
    pxr()
    with reading_usd(path):
        file = open_usd(path)
        found = _read(file, drop_invalid)
    file.remarks.report()
    return found


@dataclass(slots=True)
class _Found:
    splats: list[SplatInstance] = field(default_factory=list[SplatInstance])


def _read(file: UsdFile, drop_invalid: bool) -> Gaussians | Scene:
    found, captures = _Found(), dict[str, Gaussians | None]()
    for placed in placed_prims(file):
        if is_field(placed.prim) and placed.visible and not placed.is_flat:
            if placed.asset not in captures:
                columns = read_particles(file, placed.prim)
                captures[placed.asset] = columns and gaussians_from_columns(file.path, columns, drop_invalid=drop_invalid)
            gaussians = captures[placed.asset]
            if gaussians is not None:
                found.splats.append(_splat(file, placed, gaussians))
    if len(found.splats) == 1:
        only = found.splats[0]
        turn = np.eye(4) if file.says_up else _Y_DOWN
        place = turn @ only.transform
        return only.gaussians if np.array_equal(place, np.eye(4)) else transform(only.gaussians, place)
    return Scene(splats=found.splats, up=file.up)


def _splat(file: UsdFile, placed: Placed, gaussians: Gaussians) -> SplatInstance:
    """A capture at its place; what an instance cannot be, the Gaussians become."""
    try:
        check_similarity(placed.world_from_prim[:3, :3])
    except SceneError:
        return SplatInstance(under_affine(gaussians, placed.world_from_prim), name=placed.name)
    return SplatInstance(gaussians, placed.world_from_prim, name=placed.name)
