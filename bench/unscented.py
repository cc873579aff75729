"""What frames along rays cost beside ellipses and the tracer: ``python -m bench.unscented [--device cuda]``.

The biker at 640x360, through a pinhole, a distorting lens and a fisheye of the same focal length: processor time of a
frame, of all threads, and how alike the pictures are; then, through the pinhole, of derivatives beside their frames.
Settings take turns.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import lumisplat as ls

FRAMES = 9
COVERED = 0.02
"""Alpha from which a pixel counts."""
BARREL = (-0.25, 0.04, 0.0, 0.0, 0.0, 0.0)


def main() -> None:
    """Prints a table."""
    import lumisplat as ls
    from bench.presets import DATA, load_capture
    from bench.timing import parser, quiet_warp

    device = parser("unscented", __doc__).parse_args().device
    quiet_warp()
    scene = ls.Scene([load_capture(DATA / "splats" / "biker.compressed.ply")])
    camera = ls.frame_camera(scene, width=640, height=360)
    along_rays = ls.RenderConfig(raster=ls.RasterConfig(projection=ls.config.Projection.UNSCENTED))
    configs = [ls.RenderConfig(), along_rays, ls.RenderConfig(pipeline=ls.Pipeline.TRACE)]
    print("| camera | ewa | unscented | trace | unscented : ewa | unscented : trace |")
    print("| --- | ---: | ---: | ---: | ---: | ---: |")
    lenses = {
        "pinhole": camera,
        "distorting, -0.25 0.04": replace(camera, distortion=BARREL),
        "fisheye": replace(camera, model=ls.CameraModel.FISHEYE),
    }
    for name, lens in lenses.items():
        suited = configs if lens.model is ls.CameraModel.PINHOLE else configs[1:]
        frames, times = timed([ls.create_renderer(config, device) for config in suited], scene, lens)
        *ewa, rays, traced = frames
        cells = [f"{1e3 * seconds:.0f} ms" for seconds in times]
        alike = [f"{psnr(rays, other):.1f} dB" for other in (*ewa, traced)]
        missing = ["-"] * (len(configs) - len(suited))
        print(f"| {' | '.join([name, *missing, *cells, *missing, *alike])} |", flush=True)

    print("\n| through the pinhole | ewa | unscented | trace |")
    print("| --- | ---: | ---: | ---: |")
    print(f"| {' | '.join(['frame, way back, ratio', *way_back(configs, scene, camera, device)])} |")


def way_back(configs: list[ls.RenderConfig], scene: ls.Scene, camera: ls.Camera, device: str) -> list[str]:
    """Medians of the processor times of a frame and of its derivatives, and their ratio."""
    import lumisplat as ls

    renderers = [ls.DifferentiableRenderer(config, device) for config in configs]
    by_color = np.random.default_rng(1).normal(size=(camera.height, camera.width, 3)).astype(np.float32)
    times: list[list[tuple[float, float]]] = [[] for _ in renderers]
    for _ in range(FRAMES):
        for renderer, found in zip(renderers, times, strict=True):
            start = time.process_time()
            renderer.render(scene, camera)
            drawn = time.process_time()
            renderer.gradients(by_color)
            found.append((drawn - start, time.process_time() - drawn))
    medians = [np.median(np.array(found[2:]), axis=0) for found in times]
    return [f"{1e3 * frame:.0f} ms, {1e3 * back:.0f} ms, {back / frame:.2f}" for frame, back in medians]


def timed(renderers: list[ls.Renderer], scene: ls.Scene, camera: ls.Camera) -> tuple[list[ls.Frame], list[float]]:
    """The last frame of each renderer, and the median of its processor times, seconds."""
    frames: list[ls.Frame] = [renderer.render(scene, camera) for renderer in renderers]
    times: list[list[float]] = [[] for _ in renderers]
    for _ in range(FRAMES):
        for number, renderer in enumerate(renderers):
            start = time.process_time()
            frames[number] = renderer.render(scene, camera)
            times[number].append(time.process_time() - start)
    return frames, [float(np.median(values)) for values in times]


def psnr(frame: ls.Frame, other: ls.Frame) -> float:
    """Over what either covers."""
    covered = np.maximum(frame.alpha, other.alpha) > COVERED
    return float(-10.0 * np.log10(np.mean((frame.color[covered] - other.color[covered]) ** 2)))


if __name__ == "__main__":
    main()
