"""How alike traced and rasterised captures are, and what it costs: ``python -m bench.as_trained [--device cuda]``.

For each capture, view and size: PSNR of the traced frame over the pixels that the raster covers, and the least time
of a few frames, with and without footprints, in the order of peaks and in that of means. Settings take turns.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import lumisplat as ls

FRAMES = 4
COVERED = 0.02
"""Alpha from which a pixel counts."""


@dataclass(frozen=True)
class View:
    """A capture, how near, and how large its image is."""

    capture: str
    closeness: float
    """Distance of the eye from the middle, over that from which all of the capture is seen."""
    width: int


VIEWS = (
    *(View(name, near, 640) for name in ("biker.spz", "logo_sog", "playbot/1_0") for near in (1.0, 0.35)),
    View("biker.spz", 1.0, 320),
    View("biker.spz", 1.0, 1280),
)


def main() -> None:
    """Prints a table."""
    from bench.presets import DATA, load_capture
    from bench.timing import parser, quiet_warp

    device = parser("as_trained", __doc__).parse_args().device
    quiet_warp()
    print("| capture, distance, size | peaks, no footprint | peaks | means, no footprint | means | CUDA's schedule |")
    print("| --- | --- | --- | --- | --- | --- |")
    for view in VIEWS:
        print(row(view, load_capture(DATA / "splats" / view.capture), device), flush=True)


def row(view: View, capture: ls.Gaussians, device: str) -> str:
    """A line of the table; the last column is the time of the defaults over that of peaks without a footprint."""
    import lumisplat as ls
    from lumisplat.runtime.launcher import Launcher

    scene, camera = ls.Scene([capture]), camera_of(view, capture)
    raster = ls.render(scene, camera, device=device)
    covered = raster.alpha > COVERED
    cells: list[str] = []
    ways = [(order, dilation) for order in (ls.HitDistance.PEAK, ls.HitDistance.MEAN) for dilation in (0.0, 0.3)]
    configs = [
        ls.RenderConfig(pipeline=ls.Pipeline.TRACE, trace=ls.TraceConfig(hit_distance=order, dilation=dilation))
        for order, dilation in ways
    ]
    renderers = [ls.Renderer(config, Launcher(device)) for config in configs]
    frames, times = timed(renderers, scene, camera)
    for frame, seconds in zip(frames, times, strict=True):
        error = np.mean((frame.color[covered] - raster.color[covered]) ** 2)
        cells.append(f"{-10.0 * np.log10(error):.1f} dB, {1e3 * seconds:.0f} ms")
    by_ray = [ls.Renderer(config, Launcher(device, parallel=True)) for config in (configs[0], configs[-1])]
    _, (thin, wide) = timed(by_ray, scene, camera)
    name = f"{view.capture}, {view.closeness:g}, {camera.width} x {camera.height}"
    return f"| {' | '.join([name, *cells])} | {wide / thin:.1f} times |"


def timed(renderers: list[ls.Renderer], scene: ls.Scene, camera: ls.Camera) -> tuple[list[ls.Frame], list[float]]:
    """The last frame of each renderer, and its least time, seconds; they take turns."""
    least = [np.inf] * len(renderers)
    frames = [renderer.render(scene, camera) for renderer in renderers]  # uploads and trees
    for _ in range(FRAMES):
        for i, renderer in enumerate(renderers):
            begun = time.perf_counter()
            frames[i] = renderer.render(scene, camera)
            least[i] = min(least[i], time.perf_counter() - begun)
    return frames, least


def camera_of(view: View, capture: ls.Gaussians) -> ls.Camera:
    """The camera of `frame_camera`, moved towards the middle of the capture."""
    import lumisplat as ls

    whole = ls.frame_camera(ls.Scene([capture]), width=view.width, height=view.width * 9 // 16)
    middle = np.median(capture.means, axis=0)
    eye = middle + view.closeness * (whole.eye - middle)
    pose = whole.camera_from_world.copy()
    pose[:3, 3] = -pose[:3, :3] @ eye
    return replace(whole, camera_from_world=pose)


if __name__ == "__main__":
    main()
