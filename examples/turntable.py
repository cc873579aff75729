"""Renders a turntable of a capture; one renderer reuses assets, buffers and kernels between frames."""

from __future__ import annotations

import sys

import numpy as np

import lumisplat as ls


def orbit(capture: ls.Gaussians, count: int, width: int, height: int) -> list[ls.Camera]:
    """Returns cameras on a circle around the bulk of a capture (y down)."""
    low, high = np.percentile(capture.means, (2, 98), axis=0)
    middle, radius = 0.5 * (low + high), 1.5 * float(np.linalg.norm(high - low))
    return [
        ls.Camera.look_at(
            middle + radius * np.array([np.sin(angle), -0.2, -np.cos(angle)]),
            middle,
            up=(0.0, -1.0, 0.0),
            width=width,
            height=height,
            name=f"{index:03d}",
        )
        for index, angle in enumerate(np.linspace(0.0, 2.0 * np.pi, count, endpoint=False))
    ]


def main(path: str, count: int = 12) -> None:
    """Writes out/turntable/000.png and on."""
    capture = ls.load(path)
    if not isinstance(capture, ls.Gaussians):
        sys.exit(f"{path} is not a capture")
    scene = ls.Scene(splats=[capture])
    renderer = ls.create_renderer(ls.RenderConfig(background=(1.0, 1.0, 1.0)))
    for camera in orbit(capture, count, 480, 480):
        renderer.render(scene, camera).save(f"out/turntable/{camera.name}.png")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python examples/turntable.py CAPTURE")
    main(sys.argv[1])
