"""Normals and materials in the columns of a PLY: who wrote them, and what their numbers mean.

Trainers of relightable captures store materials before their activation, under names of their own or under ours:

- Lumisplat: linear values, which a comment in the header says (`LINEAR_COMMENT`);
- Relightable 3D Gaussians (Gao et al. 2024, save_ply of scene/gaussian_model.py): ``base_color_*``, which no reader but
  theirs would know, beside incident light as harmonics, which is read by those who ask for it, and visibility, which is
  not read;
- the first release of the same, with ``metallic`` and plain sigmoids;
- GS-IR (Liang et al. 2024, the same function): our names, logits.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from lumisplat.constants import LOGIT_MAX

Floats = npt.NDArray[np.floating]

FIELDS = ("normals", "albedo", "roughness", "metallic")
"""Fields of a capture that only some files have."""

LINEAR_COMMENT = "lumisplat materials linear"
"""Our comment in the header: albedo is linear Rec.709, and all materials are within 0..1."""

_LINEAR = re.compile(r"\s*lumisplat\s+materials\s+linear\s*", re.I)

_NORMALS = ("nx", "ny", "nz")


@dataclass(frozen=True, slots=True)
class MaterialColumns:
    """How one trainer stores normals and materials."""

    properties: Mapping[str, tuple[str, ...]]
    """PLY properties of each field, in order."""
    sigmoids: Mapping[str, tuple[float, float]] = field(default_factory=dict[str, tuple[float, float]])
    """Factor and offset: the value is factor * sigmoid(stored) + offset. Fields that are not listed are stored as they
    are."""

    def activated(self, name: str, stored: Floats) -> Floats:
        """The values of a field; those that are not finite stay so."""
        if name not in self.sigmoids:
            return stored
        factor, offset = self.sigmoids[name]
        with np.errstate(over="ignore", invalid="ignore"):
            values = factor / (1.0 + np.exp(-stored.astype(np.float64))) + offset
        return np.where(np.isfinite(stored), values, np.nan).astype(np.float32)

    def stored(self, name: str, values: Floats) -> Floats:
        """What is read as these values of a field, or as the nearest that it can have, float32."""
        if name not in self.sigmoids:
            return values
        factor, offset = self.sigmoids[name]
        with np.errstate(divide="ignore"):  # of the limits
            share = np.clip((values.astype(np.float64) - offset) / factor, 0.0, 1.0)
            logits = np.log(share) - np.log1p(-share)
        return np.clip(logits, -LOGIT_MAX, LOGIT_MAX).astype(np.float32)

    def limits(self, name: str) -> tuple[np.float32, np.float32]:
        """The least and the largest value that a field of logits can have."""
        factor, offset = self.sigmoids[name]
        return np.float32(offset), np.float32(offset + factor)


LINEAR = MaterialColumns(
    {
        "normals": _NORMALS,
        "albedo": ("albedo_0", "albedo_1", "albedo_2"),
        "roughness": ("roughness",),
        "metallic": ("metallic",),
    }
)
"""Our own."""

R3DG = MaterialColumns(
    {
        "normals": _NORMALS,
        "albedo": ("base_color_0", "base_color_1", "base_color_2"),
        "roughness": ("roughness",),
    },
    {"albedo": (0.77, 0.03), "roughness": (0.9, 0.09)},
)

R3DG_FIRST = MaterialColumns(
    {**R3DG.properties, "metallic": ("metallic",)},
    {"albedo": (1.0, 0.0), "roughness": (1.0, 0.0), "metallic": (1.0, 0.0)},
)

GS_IR = MaterialColumns(
    {**LINEAR.properties, "normals": ("normal_0", "normal_1", "normal_2")},
    R3DG_FIRST.sigmoids,
)


def says_linear(comments: tuple[str, ...]) -> bool:
    """Whether header comments say that the materials are ours."""
    return any(map(_LINEAR.fullmatch, comments))


def material_columns_of(names: tuple[str, ...], comments: tuple[str, ...]) -> MaterialColumns:
    """Who wrote the materials of a file.

    Args:
        names: The properties of its Gaussians.
        comments: The comments of its header.

    Returns:
        One of the four above; `LINEAR` also if nobody is recognised.
    """
    if says_linear(comments):
        return LINEAR
    if {"base_color_0", "incidents_dc_0"} <= set(names):
        return R3DG_FIRST if "metallic" in names else R3DG
    if {"albedo_0", "normal_0"} <= set(names) and "nx" not in names:
        return GS_IR
    return LINEAR
