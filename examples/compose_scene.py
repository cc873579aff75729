"""Places one capture twice with a mesh between them; all occlude one another in the same frame."""

from __future__ import annotations

import sys

import numpy as np

import lumisplat as ls


def placed(x: float, y: float, z: float, turn: float = 0.0, scale: float = 1.0) -> np.ndarray:
    """Returns a rotation about the vertical axis with a uniform scale and a translation, shape (4, 4)."""
    c, s = scale * np.cos(turn), scale * np.sin(turn)
    return np.array([[c, 0.0, s, x], [0.0, scale, 0.0, y], [-s, 0.0, c, z], [0.0, 0.0, 0.0, 1.0]])


def floor(y: float, half: float) -> ls.Mesh:
    """Returns a square that faces up in a y-down world."""
    corners = [(-half, y, -half), (half, y, -half), (half, y, half), (-half, y, half)]
    return ls.Mesh(corners, [(0, 2, 1), (0, 3, 2)], material=ls.MaterialPbr(base_color=(0.10, 0.12, 0.15)))


def main(path: str) -> None:
    """Writes out/composed.png with a transparent background."""
    capture = ls.load(path)
    if not isinstance(capture, ls.Gaussians):
        sys.exit(f"{path} is not a capture")
    low, high = capture.bounds()
    size = float((high - low).max())
    scene = ls.Scene(
        splats=[
            ls.SplatInstance(capture, placed(-0.3 * size, 0.0, 0.0)),
            ls.SplatInstance(capture, placed(0.3 * size, 0.0, 0.2 * size, turn=np.pi)),
        ],
        meshes=[floor(y=float(high[1]), half=size)],
    )
    middle = 0.5 * (low + high)
    camera = ls.Camera.look_at(
        middle - size * np.array([0.0, 0.4, 2.0]), middle, up=(0.0, -1.0, 0.0), width=960, height=540
    )
    ls.render(scene, camera, ls.RenderConfig(background=None)).save("out/composed.png")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python examples/compose_scene.py CAPTURE")
    main(sys.argv[1])
