"""Makes Gaussians from NumPy arrays, renders them, and saves them as a capture."""

from __future__ import annotations

import numpy as np

import lumisplat as ls

SH_C0 = 0.28209479177387814  # the constant basis function: colour = 0.5 + SH_C0 * coefficient


def spiral(count: int = 2000) -> ls.Gaussians:
    """Returns a helix of flat, coloured discs that climbs along y."""
    angle = np.linspace(0.0, 8.0 * np.pi, count)
    height = np.linspace(-1.0, 1.0, count)
    means = np.stack([np.cos(angle), height, np.sin(angle)], axis=1)
    half = -0.5 * angle  # half the angle of a rotation about y, as a quaternion (w, x, y, z)
    rotations = np.stack([np.cos(half), np.zeros(count), np.sin(half), np.zeros(count)], axis=1)
    scales = np.broadcast_to([0.004, 0.03, 0.03], (count, 3))  # thin along the radius
    colors = 0.5 + 0.5 * np.cos(np.pi * height[:, None] + np.array([0.0, 2.1, 4.2]))
    return ls.Gaussians(means, rotations, scales, np.full(count, 0.9), ((colors - 0.5) / SH_C0)[:, None, :])


def main() -> None:
    """Writes out/spiral.png and out/spiral.ply."""
    gaussians = spiral()
    scene = ls.Scene(splats=[gaussians])
    camera = ls.Camera.look_at(eye=(0.0, 1.2, 3.5), target=(0.0, 0.0, 0.0), width=640, height=480)
    ls.render(scene, camera).save("out/spiral.png")
    ls.save("out/spiral.ply", gaussians)


if __name__ == "__main__":
    main()
