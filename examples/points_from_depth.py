"""Turns the depth of a frame back into world points, with the colour and the Gaussian of each pixel."""

from __future__ import annotations

import sys

import numpy as np

import lumisplat as ls


def surface_points(frame: ls.Frame) -> np.ndarray:
    """Returns world points of the pixels that show a surface, shape (N, 3)."""
    camera = frame.camera
    rows, columns = np.nonzero(np.isfinite(frame.depth))
    # Depth is measured along the ray through the pixel centre, so directions have unit length.
    x, y = (columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy
    directions = np.stack([x, y, np.ones_like(x)], axis=1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = directions * frame.depth[rows, columns, None]
    return points @ camera.world_from_camera[:3, :3].T + camera.eye


def main(path: str) -> None:
    """Writes out/points.npz."""
    capture = ls.load(path)
    if not isinstance(capture, ls.Gaussians):
        sys.exit(f"{path} is not a capture")
    low, high = capture.bounds()
    middle, size = 0.5 * (low + high), float(np.linalg.norm(high - low))
    camera = ls.Camera.look_at(
        middle - np.array([0.0, 0.0, 1.5 * size]), middle, up=(0.0, -1.0, 0.0), width=320, height=240
    )
    frame = ls.render(ls.Scene(splats=[capture]), camera)
    shown = np.isfinite(frame.depth)
    points = surface_points(frame)
    frame.save("out/points.png")
    np.savez("out/points.npz", points=points, colors=frame.color[shown], gaussians=frame.gaussian_index[shown])
    print(f"{len(points):,} points between {points.min(axis=0)} and {points.max(axis=0)}")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python examples/points_from_depth.py CAPTURE")
    main(sys.argv[1])
