"""Runs a light grid without a renderer: tests give the cells, and choose their lights frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

import lumisplat as ls
from lumisplat.constants import GRID_LIGHTS
from lumisplat.device.gi.light_grid import LightGrid
from lumisplat.device.structs.camera import SampleData
from lumisplat.device.structs.shading import ShadingScene, ShadingSettings
from lumisplat.renderer.realtime import light_grid_kernels as kernels
from lumisplat.renderer.scene.lights import LightTable
from lumisplat.runtime.buffers import Buffers, assign_table
from lumisplat.runtime.launcher import Launcher
from lumisplat.runtime.struct_tables import table_dtype, upload_structs
from lumisplat.scene.lights import Light
from support.probes import probe_light_grid_kernels as probes

CAMERA = ls.Camera.look_at((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), width=8, height=8)


@dataclass(frozen=True)
class Cell:
    """A cell of the light grid."""

    key: int
    center: np.ndarray
    half: float


def cell_at(position: Sequence[float], from_eye: float) -> Cell:
    """Returns the cell of a position, without jitter between cells."""
    keys, centers = wp.zeros(1, dtype=wp.int64, device="cpu"), wp.zeros(1, dtype=wp.vec3, device="cpu")
    halves = wp.zeros(1, dtype=float, device="cpu")
    placement = wp.array([wp.vec3(*position)], dtype=wp.vec3, device="cpu")
    draw = wp.array([wp.vec4(0.5, 0.5, 0.5, 0.0)], dtype=wp.vec4, device="cpu")
    distance = wp.array([from_eye], dtype=float, device="cpu")
    wp.launch(probes.probe_cells, dim=1, inputs=[placement, distance, draw, keys, centers, halves], device="cpu")
    return Cell(int(keys.numpy()[0]), centers.numpy()[0].astype(float), float(halves.numpy()[0]))


class LightGridRig:
    """Holds lights and some cells on the device.

    Args:
        lights: Lights of the scene.
        cells: Cells of the grid.
    """

    def __init__(self, lights: Sequence[Light], cells: Sequence[Cell]) -> None:
        self.launcher, self._buffers = Launcher("cpu", threads=1), Buffers("cpu")
        table = LightTable()
        table.sync(ls.Scene(lights=lights), CAMERA, self._buffers)
        settings = np.zeros(1, table_dtype(ShadingSettings))
        settings["light_count"] = len(lights)
        row: Any = ShadingScene()
        row.settings = self._buffers.upload("settings", ShadingSettings, settings)
        row.sample = self._sample = self._buffers.get("sample", SampleData, 1)
        row.lights, row.environment = table.lights, table.environment
        self.scene = upload_structs([row], ShadingScene, "cpu")
        self.cells = list(cells)
        self._keys = wp.array([cell.key for cell in cells], dtype=wp.int64, device="cpu")
        size = len(cells) * (GRID_LIGHTS + 1)
        self.grid: Any = LightGrid()
        self.grid.cell_of = self._buffers.get("cell_of", wp.int32, 1)
        self.grid.numbers = self._buffers.get("numbers", wp.int32, size)
        self.grid.chances = self._buffers.get("chances", wp.float32, size)

    def choose(self, frame: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Chooses the lights of each cell for a frame; returns indices and probabilities, shape (cells, slots) each."""
        sample = np.zeros(1, table_dtype(SampleData))
        sample["index"], sample["seed"] = frame, seed
        assign_table(self._sample, sample)
        ends = wp.array([len(self.cells)], dtype=wp.int32, device="cpu")
        self.launcher.run_banded(kernels.choose_lights, len(self.cells), self._keys, ends, self.scene, self.grid)
        shape = len(self.cells), GRID_LIGHTS + 1
        return self.grid.numbers.numpy().reshape(shape).copy(), self.grid.chances.numpy().reshape(shape).copy()

    def pick(
        self, draws: np.ndarray, cell: int, position: Sequence[float], normal: Sequence[float]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns the light that each draw selects at a surface, and its probability; cell -1 stands for all lights."""
        count = len(draws)
        numbers, chances = wp.zeros(count, dtype=int, device="cpu"), wp.zeros(count, dtype=float, device="cpu")
        given = wp.array(draws, dtype=float, device="cpu")
        inputs = [given, cell, wp.vec3(*position), wp.vec3(*normal), self.grid, self.scene, numbers, chances]
        wp.launch(probes.probe_choices, dim=count, inputs=inputs, device="cpu")
        return numbers.numpy(), chances.numpy()

    def reaches(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the weight of light i in cell i, and the importance of light i at point i."""
        count = len(points)
        weights, importances = (wp.zeros(count, dtype=float, device="cpu") for _ in range(2))
        centers = wp.array(np.array([cell.center for cell in self.cells]), dtype=wp.vec3, device="cpu")
        halves = wp.array([cell.half for cell in self.cells], dtype=float, device="cpu")
        places = wp.array(points, dtype=wp.vec3, device="cpu")
        inputs = [centers, halves, places, self.scene, weights, importances]
        wp.launch(probes.probe_reach, dim=count, inputs=inputs, device="cpu")
        return weights.numpy(), importances.numpy()
