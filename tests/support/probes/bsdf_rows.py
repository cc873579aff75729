"""Evaluates and samples the BSDFs of materials on a device."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

import lumisplat as ls
from lumisplat.device.material.bsdf import BsdfSample
from lumisplat.device.structs.shading import Bsdf, MaterialData
from lumisplat.renderer.scene.materials import material_table
from lumisplat.runtime.launcher import Launcher
from support.probes import probe_light_kernels

Doubles = npt.NDArray[np.float64]
UP = np.array([0.0, 0.0, 1.0])


def bsdf_row(material: ls.MaterialPbr, *, compensates: bool = False) -> npt.NDArray[Any]:
    """Returns the BSDF of a material as an array of one row."""
    mesh = ls.Mesh(np.eye(3), [[0, 1, 2]], material=material)
    table = material_table(ls.Scene(meshes=[mesh]), lambda _: 0, is_lit=True, compensates=compensates)
    bsdf = wp.zeros(1, dtype=Bsdf, device="cpu")
    given = wp.array(table, dtype=MaterialData, device="cpu")
    color = wp.vec3(*material.mesh_color)
    Launcher("cpu", threads=1).run(probe_light_kernels.probe_material, 1, given, color, False, bsdf)
    return bsdf.numpy()


def direction(cosine: npt.ArrayLike, turn: npt.ArrayLike) -> Doubles:
    """Returns unit vectors from their cosine with the normal and their azimuth."""
    z, turn = np.broadcast_arrays(np.asarray(cosine, np.float64), np.asarray(turn, np.float64))
    sine = np.sqrt(1.0 - z**2)
    return np.stack([sine * np.cos(turn), sine * np.sin(turn), z], axis=-1)


def samples_of(row: npt.NDArray[Any], view: Doubles, count: int) -> npt.NDArray[Any]:
    """Returns sampled directions with weights and pdfs."""
    randoms = np.random.default_rng(3).random((count, 3), dtype=np.float32)
    vectors = [np.broadcast_to(v, (count, 3)).astype(np.float32) for v in (UP, view)]
    inputs = [wp.array(np.repeat(row, count), dtype=Bsdf, device="cpu")]
    inputs += [wp.array(v, dtype=wp.vec3, device="cpu") for v in (*vectors, randoms)]
    found = wp.zeros(count, dtype=BsdfSample, device="cpu")
    Launcher("cpu", threads=1).run(probe_light_kernels.probe_bsdf_samples, count, *inputs, found)
    return found.numpy()
