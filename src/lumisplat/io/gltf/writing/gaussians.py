"""Captures as meshes of glTF files, by KHR_gaussian_splatting."""

from __future__ import annotations

from typing import Any

import numpy as np

from lumisplat.constants import KERNEL_DEGREE, SH_C0
from lumisplat.io.gltf.extras import OURS
from lumisplat.io.gltf.gaussians.attributes import CAPTURE_SIGNS, EXTENSION, MATERIALS
from lumisplat.io.gltf.writing.document import GltfDocument
from lumisplat.io.splats.axes import mirror_axes
from lumisplat.io.splats.columns import SplatColumns
from lumisplat.io.splats.orientation import orientation_values
from lumisplat.math.color import decode_srgb
from lumisplat.scene.gaussians import Gaussians


def add_gaussians(document: GltfDocument, gaussians: Gaussians, name: str) -> int:
    """Appends a capture as a mesh of points, turned to y up; returns its index.

    Values are those of the capture, as float32. COLOR_0 is for programs that know no Gaussians: linear, with the
    opacity, in 8 bits. Normals and materials are attributes of our own (`MATERIALS`).
    """
    columns = mirror_axes(
        SplatColumns(
            gaussians.means,
            gaussians.rotations_wxyz,
            gaussians.scales,
            gaussians.opacities,
            gaussians.sh,
            normals=gaussians.normals,
            albedo=gaussians.albedo,
            roughness=gaussians.roughness,
            metallic=gaussians.metallic,
            scales_are_logarithms=False,
            opacities_are_logits=False,
        ),
        CAPTURE_SIGNS,
    )
    attributes = {
        "POSITION": document.accessor(columns.means, bounds=True),
        "COLOR_0": document.accessor(_fallback_colors(gaussians), normalized=True),
        f"{EXTENSION}:ROTATION": document.accessor(columns.rotations_wxyz[:, [1, 2, 3, 0]]),
        f"{EXTENSION}:SCALE": document.accessor(columns.log_scales),
        f"{EXTENSION}:OPACITY": document.accessor(columns.opacities),
    }
    for degree in range(gaussians.sh_degree + 1):
        for n in range(2 * degree + 1):
            accessor = document.accessor(columns.sh[:, degree**2 + n])
            attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{n}"] = accessor
    for field, (attribute, _) in MATERIALS.items():
        values = getattr(columns, field)
        if values is not None:
            attributes[attribute] = document.accessor(values)
    primitive = {
        "attributes": attributes,
        "mode": 0,
        "extensions": document.use(
            EXTENSION,
            kernel="ellipse",
            colorSpace="srgb_rec709_display",
            sortingMethod="cameraDistance",
            projection="perspective",
        ),
        "extras": {OURS: _settings(gaussians)},
    }
    return document.add("meshes", {"primitives": [primitive]} | ({"name": name} if name else {}))


def _fallback_colors(gaussians: Gaussians) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Mean colours in linear light, and opacities, shape (N, 4)."""
    display = np.clip(SH_C0 * gaussians.sh[:, 0] + 0.5, 0.0, 1.0)
    values = np.column_stack([decode_srgb(display), gaussians.opacities])
    return (values * 255.0 + 0.5).astype(np.uint8)


def _settings(gaussians: Gaussians) -> dict[str, Any]:
    """Settings of a capture that the extension does not have."""
    settings: dict[str, Any] = {"antialiased": True} if gaussians.antialiased else {}
    if gaussians.kernel_degree != KERNEL_DEGREE:
        settings["kernel_degree"] = gaussians.kernel_degree
    settings |= orientation_values(gaussians.up, gaussians.first_view)
    return settings | ({"comments": list(gaussians.comments)} if gaussians.comments else {})
