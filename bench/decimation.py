"""What decimation costs and keeps: ``python -m bench.decimation CAPTURE...`` prints a table.

Decibels of pictures of fewer Gaussians against those of the whole capture, over five views around it: merged by
`lumisplat.decimate`, chosen at random, and the most opaque ones. Time is that of the processor, without loading.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

import lumisplat as ls

SHARES = (0.25, 0.10)
VIEWS = 5


def main(paths: list[str]) -> None:
    """Prints a row for each capture and share."""
    print("| capture | Gaussians | left | merged | at random | by opacity | CPU seconds |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for path in paths:
        whole = ls.load(path)
        if not isinstance(whole, ls.Gaussians):
            raise ls.FormatError(path, "is not a capture")
        pictures = views(whole)
        expected = pictures(whole)
        for share in SHARES:
            count = int(whole.count * share)
            start = time.process_time()
            merged = ls.decimate(whole, count)
            seconds = time.process_time() - start
            chosen = np.random.default_rng(0).choice(whole.count, count, replace=False)
            opaque = np.argsort(-whole.opacities, kind="stable")[:count]
            sets = (merged, whole.subset(chosen), whole.subset(opaque))
            decibels = [f"{ls.psnr(pictures(one), expected):.1f}" for one in sets]
            cells = [Path(path).name, f"{whole.count:,}", f"{share:.0%}", *decibels, f"{seconds:.1f}"]
            print(f"| {' | '.join(cells)} |", flush=True)


def views(capture: ls.Gaussians):
    """A function that renders pictures of the views around a capture, one above the other."""
    low, high = np.quantile(capture.means, (0.05, 0.95), axis=0)
    middle, size = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    renderer = ls.create_renderer(ls.RenderConfig(background=(0.5, 0.5, 0.5)), "cpu")
    cameras = []
    for view in range(VIEWS):
        angle = 2.0 * np.pi * view / VIEWS + 0.3
        away = np.array([np.sin(angle), -0.25, -np.cos(angle)])
        eye = middle + 2.4 * size * away / np.linalg.norm(away)
        cameras.append(ls.Camera.look_at(eye, middle, (0, -1, 0), width=480, height=360, fov_y=0.8))

    def pictures(gaussians: ls.Gaussians) -> np.ndarray:
        scene = ls.Scene(splats=[gaussians])
        return np.concatenate([np.clip(renderer.render(scene, camera).color, 0, 1) for camera in cameras])

    return pictures


if __name__ == "__main__":
    main(sys.argv[1:])
