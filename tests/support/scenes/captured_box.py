"""Builds a closed box as a capture: an emitting ceiling panel, walls of two albedos, interreflection by radiosity."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.constants import SH_C0
from lumisplat.math.color import encode_srgb

Doubles = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

ON_WALL, ACROSS, WITHIN = 120, 8, 4
"""Number of Gaussians on a wall, of patches across a wall, and of points across a patch."""
LIGHT = np.array((3.0, 3.0, 3.0))
"""Radiance of the ceiling light in units of display white; the capture clips it to white."""
ALBEDOS = np.array(((0.6, 0.5, 0.4), (0.3, 0.25, 0.2)))
ROTATIONS = np.array([np.roll(np.diag(sides), turn, axis=1) for turn in range(3) for sides in ((1, 1, 1), (1, -1, -1))])
"""World-from-wall rotations that take a ceiling (y up) to each of the six walls; the first one is the ceiling itself.
"""


@dataclass(frozen=True, slots=True, eq=False)
class CapturedBox:
    """The capture, with the true material and light of its N Gaussians."""

    gaussians: ls.Gaussians
    """The capture: colours of SH degree 0, without normals."""
    normals: Doubles
    """Normals that point into the box, shape (N, 3)."""
    albedo: Doubles
    """Albedo, shape (N, 3), also of the Gaussians of the light."""
    irradiance: Doubles
    """Irradiance divided by pi, shape (N, 3)."""
    direct: Doubles
    """Part of ``irradiance`` that comes directly from the light, shape (N, 3)."""
    is_emitter: Flags
    """True for Gaussians of the light, shape (N,)."""

    def with_radiance(self, radiance: Doubles) -> ls.Gaussians:
        """Returns the capture with colours of other linear radiances, shape (N, 3), clipped to 0..1."""
        sh = (encode_srgb(np.clip(radiance, 0.0, 1.0)) - 0.5) / SH_C0
        return replace(self.gaussians, sh=sh[:, None].astype(np.float32))


def captured_box() -> CapturedBox:
    """Builds the box, 2 units wide and centred at the origin."""
    flat = ls.gaussians_from_mesh(ls.plane(2.0, 2.0), ON_WALL)
    gaussians = ls.merge([_placed(flat, turn) for turn in ROTATIONS])
    normals = np.repeat(-ROTATIONS[:, :, 1], ON_WALL, axis=0).astype(np.float64)
    points, facing = _points(ACROSS * WITHIN)
    patches, patch_normals = _points(ACROSS)
    emitted = _is_emitter(patches)[:, None] * LIGHT
    transfer = _irradiances(patches, patch_normals, points, facing)
    radiance = np.empty((len(patches), 3))
    for channel in range(3):
        reflected = _albedo_at(patches)[:, channel, None] * transfer
        radiance[:, channel] = np.linalg.solve(np.eye(len(patches)) - reflected, emitted[:, channel])
    transfer_to_gaussians = _irradiances(gaussians.means.astype(np.float64), normals, points, facing)
    irradiance, albedo = transfer_to_gaussians @ radiance, _albedo_at(gaussians.means)
    box = CapturedBox(
        gaussians, normals, albedo, irradiance, transfer_to_gaussians @ emitted, _is_emitter(gaussians.means)
    )
    return replace(box, gaussians=box.with_radiance(albedo * irradiance + box.is_emitter[:, None] * LIGHT))


def _placed(flat: ls.Gaussians, turn: Doubles) -> ls.Gaussians:
    """Returns one wall as Gaussians without normals and materials."""
    placed = np.eye(4)
    placed[:3, :3], placed[:3, 3] = turn, turn[:, 1]
    return replace(ls.transform(flat, placed), normals=None, albedo=None, roughness=None)


def _points(across: int) -> tuple[Doubles, Doubles]:
    """Returns the centres and normals of ``across`` x ``across`` squares on each wall, wall by wall and row by row."""
    middles = (np.arange(across) + 0.5) * (2.0 / across) - 1.0
    x, z = np.meshgrid(middles, middles, indexing="ij")
    wall = np.stack([x, np.ones_like(x), z], axis=-1).reshape(-1, 3)
    points = np.concatenate([wall @ turn.T for turn in ROTATIONS])
    return points, np.repeat(-ROTATIONS[:, :, 1], len(wall), axis=0).astype(np.float64)


def _irradiances(at: Doubles, normals: Doubles, points: Doubles, facing: Doubles) -> Doubles:
    """Returns the irradiance over pi at A points from each patch of radiance 1, shape (A, patches)."""
    offsets = points[None] - at[:, None]
    square = np.maximum((offsets**2).sum(axis=2), 1e-9)
    cosines = np.maximum(np.einsum("apk,ak->ap", offsets, normals), 0.0)
    cosines *= np.maximum(-np.einsum("apk,pk->ap", offsets, facing), 0.0)
    shares = cosines / (np.pi * square**2) * (2.0 / (ACROSS * WITHIN)) ** 2
    return shares.reshape(len(at), 6, ACROSS, WITHIN, ACROSS, WITHIN).sum(axis=(3, 5)).reshape(len(at), -1)


def _is_emitter(points: npt.NDArray[np.floating]) -> Flags:
    return (points[:, 1] > 0.99) & (np.abs(points[:, [0, 2]]).max(axis=1) < 0.5)


def _albedo_at(points: npt.NDArray[np.floating]) -> Doubles:
    """Returns the albedo at points; each half of the box has its own."""
    return ALBEDOS[(points[:, 0] + 0.5 * points[:, 2] > 0.1).astype(int)]
