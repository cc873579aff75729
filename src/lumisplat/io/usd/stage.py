"""A USD file that is open: its stage, the time that is shown, and its axes and units against ours."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lumisplat.errors import FormatError, MissingFileError
from lumisplat.io.files.native import utf8_path
from lumisplat.io.usd.layers import check_layers
from lumisplat.io.usd.library import pxr
from lumisplat.io.usd.remarks import Remarks
from lumisplat.math.arrays import Doubles
from lumisplat.math.transforms import axis_rotation

HINT = "lumisplat"
"""Dictionary in the custom data of a prim in which we note what the format has no place for."""
UNIT_ERROR = 1e-9
"""Error of a unit of length that is none, relative."""


@dataclass(slots=True)
class UsdFile:
    """An open file."""

    path: Path
    stage: Any
    time: Any
    """The time code that is shown."""
    world_from_stage: Doubles
    """The world has y up and metres; shape (4, 4)."""
    remarks: Remarks
    held: list[Any]
    """Layers that the library finds only as long as they are held."""

    @property
    def unit(self) -> float:
        """Unit of length of the stage, metres."""
        return float(np.linalg.norm(self.world_from_stage[:3, 0]))

    def place_of(self, matrix: Any) -> Doubles:
        """``world_from_prim``, shape (4, 4), from a matrix of the library, which is for row vectors."""
        return self.world_from_stage @ np.array(matrix, dtype=np.float64).T


def open_usd(path: Path) -> UsdFile:
    """Opens a file, with all that it is composed of.

    Raises:
        FormatError: The file, or a layer that it names, is damaged, names a file outside of its folder, or says units
            or axes that do not exist.
    """
    px = pxr()
    if not path.exists():
        raise MissingFileError(path, "no such file")
    with utf8_path(path) as text:
        held = check_layers(path, text)
        stage = px.Usd.Stage.Open(text)
    if not stage:
        raise FormatError(path, "damaged, or not a USD file")
    remarks = Remarks(path, "not read, or read otherwise")
    for error in stage.GetCompositionErrors():
        remarks.add("layers that cannot be composed", _first_line(str(error), path))
    return UsdFile(path, stage, _shown_time(stage), _world_from_stage(path, stage, remarks), remarks, held)


def _shown_time(stage: Any) -> Any:
    """The first time code of a stage that says its times, else that of the first key of each value."""
    code = pxr().Usd.TimeCode
    return code(stage.GetStartTimeCode()) if stage.HasAuthoredTimeCodeRange() else code.EarliestTime()


def _world_from_stage(path: Path, stage: Any, remarks: Remarks) -> Doubles:
    """What turns a stage so that y is up, and scales it to metres, shape (4, 4)."""
    geom, matrix = pxr().UsdGeom, np.eye(4)
    axis = str(geom.GetStageUpAxis(stage))
    if axis not in ("Y", "Z"):
        raise FormatError(path, f"has upAxis {axis!r}, expected Y or Z")
    if axis == "Z":
        matrix[:3, :3] = axis_rotation((1.0, 0.0, 0.0), -0.5 * math.pi).round()
        remarks.add("z is up in it: turned, so that y is")
    if geom.StageHasAuthoredMetersPerUnit(stage):
        unit = float(geom.GetStageMetersPerUnit(stage))
        if not 0.0 < unit < math.inf:
            raise FormatError(path, f"has metersPerUnit {unit:g}, expected a length above 0")
        if abs(unit - 1.0) > UNIT_ERROR:
            matrix[:3, :3] *= unit
            remarks.add(f"its unit is {unit:g} m: scaled to metres")
    return matrix


def _first_line(text: str, path: Path) -> str:
    said = " ".join(text.replace(os.fspath(path), "it").split())
    return said[:120]
