"""Times the viewer from a camera message to the frame that follows, over a WebSocket without a browser (a minute).

``python -m bench.viewer CAPTURE`` starts the viewer in its own process, on the unlit capture and on the capture relit
by a point light with hard shadows, and prints a table: seconds from the start to the address and to the first frame;
milliseconds from a camera message to its frame while the camera moves in steps; the part of that outside of rendering;
frames per second while the camera moves continuously, and their most common detail; and milliseconds from the last
camera message of a motion to the first full frame, also as a multiple of that frame's own time, where the page says
that the camera has stopped, and where it says nothing, as while a pointer holds it. A frame of a moving view keeps the
budget of 40 milliseconds. A whole number as CAPTURE stands for so many synthetic Gaussians.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import lumisplat as ls
from bench.presets import synthetic
from bench.timing import parser, print_head, print_row
from lumisplat.viewer.thresholds import LEVEL_FRACTIONS
from support.viewer.page_client import PageClient

WIDTH, HEIGHT = 640, 360
STEPS = 60
PAUSE_S = 0.05
ORBIT_S = 5.0
"""Duration of the continuous camera motion, seconds."""
STOPS = 9
MOTION_S = 0.7
"""Duration of the motion before each stop, seconds."""
SAID_S = 0.025
"""Time from the last camera of a motion after which a browser's page says that the camera has stopped, seconds."""


def main() -> None:
    """Prints the table, or with ``--serve`` runs the viewer."""
    arguments = parser("viewer", __doc__)
    arguments.add_argument("capture")
    arguments.add_argument("--serve", choices=("captured", "lit"), help="run the viewer; used internally")
    options = arguments.parse_args()
    if options.serve:
        serve(Path(options.capture), options.serve, options.device)
        return
    print_head(
        *("", "address, s", "first frame, s", "median, ms", "best", "90 %", "outside of rendering"),
        *("frames per second", "Gaussians, pixels", "stop to full frame, ms", "full frames"),
        *("unsaid stop, ms", "full frames"),
    )
    with tempfile.TemporaryDirectory() as folder:
        capture = Path(options.capture)
        if options.capture.isdigit():
            capture = Path(folder) / "synthetic.ply"
            ls.save(capture, synthetic(int(options.capture)))
        for kind in ("captured", "lit"):
            print_row(kind, *measure(capture, kind, options.device))


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
    """Serves until standard input ends; prints the address, then time, duration and detail of each frame.

    The detail is that of `DetailStep`: fractions of the Gaussians, and of width and height; 0, 0 for a full frame.
    """
    viewer = ls.view(scene_of(capture, kind), height=HEIGHT, device=device)
    print(viewer.url, flush=True)
    shown = viewer._loop._on_frame

    def on_frame(page: Any, step: Any, took: float) -> None:
        detail = (0.0, 0.0) if step is None else (LEVEL_FRACTIONS[step.level], step.scale)
        print(json.dumps([time.monotonic(), took, *detail]), flush=True)
        shown(page, step, took)

    viewer._loop._on_frame = on_frame
    sys.stdin.read()
    viewer.close()


class ServedFrame(NamedTuple):
    """Frame that the viewer has rendered."""

    done: float
    """Time of the monotonic clock, seconds."""
    took: float
    """Duration, milliseconds."""
    gaussians: float
    """Fraction of the Gaussians; 0 for a full frame."""
    scale: float
    """Fraction of width and height; 0 for a full frame."""


@dataclass
class Served:
    """Viewer in its own process, and the frames that it has rendered."""

    process: subprocess.Popen[str]
    frames: list[ServedFrame] = field(default_factory=list[ServedFrame])

    def read(self) -> None:
        """Collects the lines of frames until the output ends."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.frames.append(ServedFrame(*json.loads(line)))


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
        orbit(page, cameras, ORBIT_S)
        rate = (len(page.pictures) - count) / (time.monotonic() - begun)
        detail, _ = Counter((f.gaussians, f.scale) for f in served.frames if f.done > begun).most_common(1)[0]
        stops = [stopped(page, served, cameras, is_said=number % 2 == 0) for number in range(2 * STOPS)]
    process.stdin.close()
    process.wait()
    middle, best, late = np.median(latencies), min(latencies), np.percentile(latencies, 90)
    return (
        *(f"{address_s:.2f}", f"{first_s:.2f}", f"**{middle:.0f}**", f"{best:.0f}", f"{late:.0f}"),
        *(f"{np.median(beside):.1f}", f"**{rate:.0f}**", f"{detail[0]:.0%}, {detail[1] ** 2:.0%}"),
        *(text for each in (stops[::2], stops[1::2]) for text in stop_columns(each)),
    )


def stop_columns(stops: list[tuple[float, float]]) -> tuple[str, str]:
    """Returns the medians of the two figures of `stopped`."""
    waited, share = np.median(stops, axis=0)
    return f"**{waited:.0f}**", f"{share:.2f}"


def orbit(page: PageClient, cameras: list[ls.Camera], seconds: float) -> float:
    """Moves the camera continuously; returns when it was sent last."""
    begun = sent = time.monotonic()
    while time.monotonic() - begun < seconds:
        sent = time.monotonic()
        page.look(cameras[int(30.0 * (sent - begun)) % len(cameras)])
        time.sleep(0.02)
    return sent


def stopped(page: PageClient, served: Served, cameras: list[ls.Camera], *, is_said: bool) -> tuple[float, float]:
    """Returns milliseconds from the end of a motion to the arrival of the first full frame, and that in full frames.

    Args:
        page: Client that moves the camera.
        served: Frames of the viewer.
        cameras: Cameras of the motion.
        is_said: Whether the client says that the camera has stopped, `SAID_S` after the last camera, as a browser does.
    """
    sent = orbit(page, cameras, MOTION_S)
    if is_said:
        time.sleep(max(sent + SAID_S - time.monotonic(), 0.0))
        page.stop()
    time.sleep(3.0)
    full = next(frame for frame in served.frames if frame.scale == 0.0 and frame.done > sent)
    arrived = next(at for at, _ in page.pictures if at > full.done - 0.001)
    waited = 1e3 * (arrived - sent)
    return waited, waited / full.took


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
        took = [frame.took for frame in served.frames if sent < frame.done <= page.pictures[count][0] + 0.01]
        if took:
            beside.append(latencies[-1] - took[0])
    return latencies, beside


if __name__ == "__main__":
    main()
