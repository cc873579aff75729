"""How long live frames in a notebook take, beside the viewer's page, which a notebook could show in an IFrame.

``python -m bench.notebook CAPTURE`` moves the same camera in steps of a circle around the capture, as captured and
relit by a lamp: in a cell, by pointer events to the widget of jupyter_rfb, whose frames are caught where they leave for
Jupyter (`bench.cell_client`), and on the page, by camera messages over a bare WebSocket (`bench.page_client`). It tells
milliseconds from the event to the picture, what of these is not the frame itself, the size of a picture, and pictures a
second while the camera moves all the time. Neither has a browser in it, nor what Jupyter's server does with a message.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import lumisplat as ls
from bench.cell_client import CellClient
from bench.page_client import PageClient
from bench.timing import parser, quiet_warp
from bench.viewer import HEIGHT, ORBIT_S, PAUSE_S, STEPS, WIDTH, Served, scene_of
from lumisplat.viewer.frames.pose import ASPECT, FOV_Y, FirstView
from lumisplat.viewer.orbit import Orbit

LEVELS_S = 5.0
"""Time to make levels of the capture."""
EVENTS_S = 0.02
"""Between two events of a browser."""


def main() -> None:
    """Prints the table."""
    arguments = parser("notebook", __doc__)
    arguments.add_argument("capture", type=Path)
    options = arguments.parse_args()
    quiet_warp()
    print("| | median, ms | best | 90 % | beside the frame | kB a picture | pictures a second |")
    print("| --- |" + " ---: |" * 6)
    for kind in ("captured", "lit"):
        for where, measure in (("cell", measure_cell), ("page", measure_page)):
            print(f"| {where}, {kind} | {measure(options.capture, kind, options.device)} |", flush=True)
    print(f"load: {', '.join(f'{load:.1f}' for load in os.getloadavg())}", file=sys.stderr)


def measure_cell(capture: Path, kind: str, device: str) -> str:
    """A row of the table: the widget in a cell."""
    viewer = ls.view(scene_of(capture, kind), height=HEIGHT, device=device)
    frames = recorded(viewer)
    with CellClient() as cell:
        with contextlib.redirect_stdout(sys.stderr):  # where the widget's place for errors is shown without IPython
            viewer._repr_mimebundle_(include={"application/vnd.jupyter.widget-view+json"})
        held: dict[str, Any] = {"button": 1, "buttons": [1], "modifiers": [], "y": 0.5 * HEIGHT}
        cell.picture()
        cell.send("pointer_down", x=0.0, **held)
        row = measured(lambda step: cell.send("pointer_move", x=-HEIGHT / STEPS * step, **held), cell, frames)
    viewer.close()
    return row


def measure_page(capture: Path, kind: str, device: str) -> str:
    """A row of the table: the viewer's page, served by a process of its own."""
    scene = scene_of(capture, kind)
    view = FirstView.of(scene)
    orbit = Orbit.of(*view.at(ASPECT), view.up, FOV_Y)
    cameras = [
        orbit.turned(2.0 * np.pi / STEPS * step, 0.0).pose(WIDTH / HEIGHT).camera(HEIGHT) for step in range(STEPS)
    ]
    command = [sys.executable, "-m", "bench.viewer", str(capture), "--serve", kind, "--device", device]
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True)
    assert process.stdout is not None and process.stdin is not None
    served, url = Served(process), process.stdout.readline().strip()
    threading.Thread(target=served.read, daemon=True).start()
    with PageClient(url) as page:
        page.look(cameras[0])
        page.picture()
        row = measured(lambda step: page.look(cameras[step % STEPS]), page, served.frames)
    process.stdin.close()
    process.wait()
    return row


def recorded(viewer: ls.Viewer) -> list[tuple[float, float]]:
    """When frames of a viewer are done from now on, and what each took, milliseconds."""
    frames: list[tuple[float, float]] = []
    shown = viewer._loop._on_frame

    def on_frame(page: Any, step: Any, took: float) -> None:
        frames.append((time.monotonic(), took))
        shown(page, step, took)

    viewer._loop._on_frame = on_frame
    return frames


def measured(turn: Callable[[int], None], client: CellClient | PageClient, frames: list[tuple[float, float]]) -> str:
    """A row of the table.

    Args:
        turn: Turns the camera to so many steps of the circle.
        client: Where pictures come.
        frames: When frames are done, and what each took, milliseconds.
    """
    time.sleep(LEVELS_S)
    pictures = client.pictures
    latencies: list[float] = []
    beside: list[float] = []
    sizes: list[int] = []
    for step in range(1, STEPS):
        count, sent = len(pictures), time.monotonic()
        turn(step)
        client.picture(after=count)
        came, picture = pictures[count]
        latencies.append(1e3 * (came - sent))
        sizes.append(len(picture))
        time.sleep(PAUSE_S)
        took = [took for done, took in frames if sent < done <= came + 0.01]
        beside += [latencies[-1] - took[-1]] if took else []
    count, begun, step = len(pictures), time.monotonic(), STEPS
    while time.monotonic() - begun < ORBIT_S:
        turn(step)
        step += 1
        time.sleep(EVENTS_S)
    rate = (len(pictures) - count) / (time.monotonic() - begun)
    return (
        f"**{np.median(latencies):.0f}** | {min(latencies):.0f} | {np.percentile(latencies, 90):.0f} | "
        f"{np.median(beside):.1f} | {1e-3 * np.median(sizes):.0f} | **{rate:.0f}**"
    )


if __name__ == "__main__":
    main()
