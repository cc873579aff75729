"""Times the viewer from a camera message to the frame that follows, over a WebSocket without a browser (a minute).

``python -m bench.viewer CAPTURE`` starts the viewer in its own process, on the unlit capture and on the capture relit
by a point light, and prints a table: seconds from the start to the address and to the first frame; milliseconds from a
camera message to its frame while the camera moves in steps; the part of that outside of rendering; and frames per
second while the camera moves continuously. A frame of a moving view keeps the budget of 40 milliseconds.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

import lumisplat as ls
from bench.timing import parser, print_head, print_row
from support.viewer.page_client import PageClient

WIDTH, HEIGHT = 640, 360
STEPS = 60
PAUSE_S = 0.05
ORBIT_S = 5.0
"""Duration of the continuous camera motion, seconds."""


def main() -> None:
    """Prints the table, or with ``--serve`` runs the viewer."""
    arguments = parser("viewer", __doc__)
    arguments.add_argument("capture", type=Path)
    arguments.add_argument("--serve", choices=("captured", "lit"), help="run the viewer; used internally")
    options = arguments.parse_args()
    if options.serve:
        serve(options.capture, options.serve, options.device)
        return
    print_head(
        "", "address, s", "first frame, s", "median, ms", "best", "90 %", "outside of rendering", "frames per second"
    )
    for kind in ("captured", "lit"):
        print_row(kind, *measure(options.capture, kind, options.device))


def scene_of(capture: Path, kind: str) -> ls.Scene:
    """Returns the unlit capture, or the capture relit by a point light above it."""
    gaussians = ls.load(capture)
    assert isinstance(gaussians, ls.Gaussians)
    if kind == "captured":
        return ls.Scene([gaussians])
    scene = ls.Scene([ls.SplatInstance(gaussians, material=ls.MaterialPbr())])
    low, high = scene.bulk_bounds()
    size = float(np.linalg.norm(high - low))
    light = 0.5 * (low + high) + 0.6 * size * np.array(scene.up_direction)
    return replace(scene, lights=(ls.LightPoint(light, intensity=size**2),))


def serve(capture: Path, kind: str, device: str) -> None:
    """Serves until standard input ends; prints the address, then the end time and the duration of each frame."""
    viewer = ls.view(scene_of(capture, kind), height=HEIGHT, device=device)
    print(viewer.url, flush=True)
    shown = viewer._loop._on_frame

    def on_frame(page: Any, step: Any, took: float) -> None:
        print(json.dumps([time.monotonic(), took]), flush=True)
        shown(page, step, took)

    viewer._loop._on_frame = on_frame
    sys.stdin.read()
    viewer.close()


@dataclass
class Served:
    """Viewer in its own process, and the frames that it has rendered."""

    process: subprocess.Popen[str]
    frames: list[tuple[float, float]] = field(default_factory=list[tuple[float, float]])

    def read(self) -> None:
        """Collects the lines of frames until the output ends."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            done, took = json.loads(line)
            self.frames.append((done, took))


def measure(capture: Path, kind: str, device: str) -> tuple[str, ...]:
    """Returns the figures of a row."""
    command = [sys.executable, "-m", "bench.viewer", str(capture), "--serve", kind, "--device", device]
    started = time.monotonic()
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True)
    served = Served(process)
    assert process.stdout is not None and process.stdin is not None
    url = process.stdout.readline().strip()
    address_s = time.monotonic() - started
    threading.Thread(target=served.read, daemon=True).start()
    scene = scene_of(capture, kind)
    cameras = ls.orbit_cameras(scene, STEPS, ls.frame_camera(scene, width=WIDTH, height=HEIGHT, all_around=True))
    with PageClient(url) as page:
        page.look(cameras[0])
        page.picture()
        first_s = page.pictures[0][0] - started
        time.sleep(5.0)  # time to build levels of detail
        latencies, beside = stepped(page, served, cameras[1:])
        count, begun = len(page.pictures), time.monotonic()
        while time.monotonic() - begun < ORBIT_S:
            page.look(cameras[int(30.0 * (time.monotonic() - begun)) % STEPS])
            time.sleep(0.02)
        rate = (len(page.pictures) - count) / (time.monotonic() - begun)
    process.stdin.close()
    process.wait()
    middle, best, late = np.median(latencies), min(latencies), np.percentile(latencies, 90)
    return (
        *(f"{address_s:.2f}", f"{first_s:.2f}", f"**{middle:.0f}**", f"{best:.0f}", f"{late:.0f}"),
        *(f"{np.median(beside):.1f}", f"**{rate:.0f}**"),
    )


def stepped(page: PageClient, served: Served, cameras: list[ls.Camera]) -> tuple[list[float], list[float]]:
    """Returns milliseconds from each camera to its frame, and the part outside of rendering."""
    latencies: list[float] = []
    beside: list[float] = []
    for camera in cameras:
        count, sent = len(page.pictures), time.monotonic()
        page.look(camera)
        page.picture(after=count)
        latencies.append(1e3 * (page.pictures[count][0] - sent))
        time.sleep(PAUSE_S)
        took = [took for done, took in served.frames if sent < done <= page.pictures[count][0] + 0.01]
        if took:
            beside.append(latencies[-1] - took[0])
    return latencies, beside


if __name__ == "__main__":
    main()
