"""Builds glTF documents with Gaussians attribute by attribute, and loads them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import lumisplat as ls
from support.files.gltf_writer import Gltf
from support.kinds import expect_kind

EXTENSION = "KHR_gaussian_splatting"


def stored_values(count: int = 5, degree: int = 1, seed: int = 4) -> dict[str, np.ndarray]:
    """Returns float32 attributes of Gaussians in glTF's axes, keyed by names without the extension's prefix."""
    rng = np.random.default_rng(seed)
    rotations = rng.normal(size=(count, 4))
    values = {
        "POSITION": rng.normal(size=(count, 3)),
        "ROTATION": rotations / np.linalg.norm(rotations, axis=1, keepdims=True),
        "SCALE": np.exp(rng.uniform(-4.0, -1.0, (count, 3))),
        "OPACITY": rng.uniform(0.05, 0.95, count),
    }
    for level in range(degree + 1):
        for n in range(2 * level + 1):
            values[f"SH_DEGREE_{level}_COEF_{n}"] = rng.uniform(-0.5, 0.5, (count, 3)) / (level + 1)
    return {name: array.astype(np.float32) for name, array in values.items()}


def full_name(name: str) -> str:
    """Returns an attribute's name in a glTF file; attributes of the extension get the extension's name as prefix."""
    return name if name in ("POSITION", "COLOR_0", "NORMAL") or name.startswith("_") else f"{EXTENSION}:{name}"


def splat_gltf(values: dict[str, np.ndarray] | None = None, **extension: Any) -> Gltf:
    """Returns a document with one capture on one node.

    Args:
        values: Attributes by name, integers normalised; None for `stored_values`.
        **extension: Properties of the extension that replace the defaults.
    """
    gltf = Gltf()
    gltf.json |= {"extensionsUsed": [EXTENSION], "scene": 0, "scenes": [{"nodes": [0]}]}
    attributes = {}
    for name, array in (stored_values() if values is None else values).items():
        normalised = {"normalized": True} if array.dtype.kind in "iu" else {}
        attributes[full_name(name)] = gltf.accessor(array, **normalised)
    extension_values = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"} | extension
    primitive = {"attributes": attributes, "mode": 0, "extensions": {EXTENSION: extension_values}}
    gltf.add("meshes", primitives=[primitive], name="cloud")
    gltf.add("nodes", mesh=0)
    return gltf


def primitive_of(gltf: Gltf) -> dict[str, Any]:
    """Returns the primitive of `splat_gltf`."""
    return gltf.json["meshes"][0]["primitives"][0]


def loaded(folder: Path, gltf: Gltf, **options: Any) -> ls.Gaussians | ls.Mesh | ls.Scene:
    """Writes a document to a GLB file, and returns what `ls.load` reads from the file."""
    (folder / "splats.glb").write_bytes(gltf.glb())
    return ls.load(folder / "splats.glb", **options)


def loaded_gaussians(folder: Path, gltf: Gltf, **options: Any) -> ls.Gaussians:
    """Writes a document, and loads it as a capture."""
    return expect_kind(ls.Gaussians, loaded(folder, gltf, **options))


def loaded_scene(folder: Path, gltf: Gltf) -> ls.Scene:
    """Writes a document, and loads it as a scene."""
    return expect_kind(ls.Scene, loaded(folder, gltf))
