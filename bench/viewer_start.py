"""How soon ``lumisplat view`` shows a scene, and how it moves from then on, over a bare WebSocket: no browser is in it.

``python -m bench.viewer_start CAPTURE`` starts the command several times on the capture and on the same relit by a
lamp, and prints seconds from the start to the address and to the first picture, and processor time until then. With
``--large``, it makes scenes of 3 million Gaussians of the capture, as one merged capture and as instances, and moves
their camera for some seconds from the first picture on, and once levels are there: pictures a second.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import lumisplat as ls
from bench.page_client import PageClient
from bench.timing import parser
from bench.viewer import HEIGHT, WIDTH, scene_of

STEPS = 240
GAUSSIANS = 3_000_000
WINDOW_S = 5.0
"""Time over which pictures are counted."""
LEVELS_S = 300.0
"""Levels that are not there by then are not waited for."""


def main() -> None:
    """Prints a table."""
    arguments = parser("viewer_start", __doc__)
    arguments.add_argument("capture", type=Path)
    arguments.add_argument("--runs", type=int, default=7, help="starts of each scene; the first does not count")
    arguments.add_argument("--large", action="store_true", help="scenes of 3 million Gaussians, which move")
    options = arguments.parse_args()
    capture = options.capture.resolve()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        print(f"load of the machine before: {os.getloadavg()[0]:.1f}\n")
        if options.large:
            print_moving(capture, folder, options.device)
        else:
            print_starts(capture, folder, options.device, options.runs)
        print(f"\nload of the machine after: {os.getloadavg()[0]:.1f}")


def print_starts(capture: Path, folder: Path, device: str, runs: int) -> None:
    """A row for each scene: best and median over the starts."""
    print("| | address, s: best | median | first picture, s: best | median | processor, s: best |")
    print("| --- |" + " ---: |" * 5)
    for kind, file in (("captured", capture), ("lit", lit_file(capture, folder))):
        starts: list[tuple[float, float, float]] = []
        for _ in range(runs + 1):
            with started(file, device, folder) as view:
                starts.append((view.address_s, view.first_s, view.processor_s))
        best, middle = np.min(starts[1:], axis=0), np.median(starts[1:], axis=0)
        print(
            f"| {kind} | {best[0]:.2f} | {middle[0]:.2f} | **{best[1]:.2f}** | **{middle[1]:.2f}** | {best[2]:.2f} |",
            flush=True,
        )


def print_moving(capture: Path, folder: Path, device: str) -> None:
    """A row for each large scene, whose camera moves from the first picture on."""
    print("| | first picture, s | pictures a second, at once | worst gap, ms | with levels | these after, s | MiB |")
    print("| --- |" + " ---: |" * 6)
    with started(capture, device, folder):
        pass  # compiles
    for kind, file in large_files(capture, folder):
        scene = ls.io.SceneDocument.open([file]).scene()
        cameras = ls.orbit_cameras(scene, STEPS, ls.frame_camera(scene, width=WIDTH, height=HEIGHT, all_around=True))
        del scene
        with started(file, device, folder) as view:
            rate, gap = orbited(view, cameras)
            while not view.has_levels and time.monotonic() - view.begun < LEVELS_S:
                time.sleep(0.2)
            levels_s = time.monotonic() - view.begun if view.has_levels else np.nan
            later, _ = orbited(view, cameras)
            print(
                f"| {kind} | {view.first_s:.1f} | **{rate:.0f}** | {gap:.0f} | **{later:.0f}** | {levels_s:.0f} | "
                f"{view.memory_mib:,.0f} |",
                flush=True,
            )


def lit_file(capture: Path, folder: Path) -> Path:
    """The capture relit by a lamp above it, as a scene file."""
    (lamp,) = scene_of(capture, "lit").lights
    assert isinstance(lamp, ls.LightPoint)
    file = folder / "lit.toml"
    file.write_text(
        f'[[splats]]\npath = "{capture}"\nmaterial = {{ type = "pbr" }}\n\n'
        f'[[lights]]\ntype = "point"\nposition = {[float(x) for x in lamp.position]}\nintensity = {lamp.intensity}\n'
    )
    return file


def large_files(capture: Path, folder: Path) -> list[tuple[str, Path]]:
    """Files of 3 million Gaussians: copies of a capture in a square, merged, and as instances."""
    gaussians = ls.load(capture)
    assert isinstance(gaussians, ls.Gaussians)
    low, high = ls.Scene([gaussians]).bulk_bounds()
    count = -(-GAUSSIANS // gaussians.count)
    side = int(np.ceil(np.sqrt(count)))
    step = 1.2 * (high - low) * (1.0, 0.0, 1.0)
    places = [(step * (number % side, 0.0, number // side)).tolist() for number in range(count)]
    merged, instances = folder / "merged.ply", folder / "instances.toml"
    ls.save(merged, ls.merge([ls.transform(gaussians, translation=(x, y, z)) for x, y, z in places]))
    instances.write_text("".join(f'[[splats]]\npath = "{capture}"\nposition = {place}\n\n' for place in places))
    return [("one capture", merged), (f"{count} instances", instances)]


@dataclass
class Started:
    """A viewer that runs as a command, and a page of it that has its first picture."""

    page: PageClient
    process: subprocess.Popen[str]
    begun: float
    address_s: float
    first_s: float
    processor_s: float

    @property
    def memory_mib(self) -> float:
        """The most memory that it has had."""
        lines = Path(f"/proc/{self.process.pid}/status").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024.0

    @property
    def has_levels(self) -> bool:
        """Whether the page has been told that all levels are there."""
        updates = [str(message.get("updates", "")) for message in list(self.page.messages)]
        return any("coarser levels" in update and "100%" in update for update in updates)


@contextlib.contextmanager
def started(file: Path, device: str, folder: Path) -> Generator[Started]:
    """Starts the command, and opens a page. Python keeps what it compiles of the source, as it does where it may."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    environment["PYTHONPYCACHEPREFIX"] = str(folder / "bytecode")
    command = [sys.executable, "-m", "lumisplat", "view", str(file), "--no-browser", "--port", "0"]
    command += ["--height", str(HEIGHT), "--device", device]
    begun = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    assert process.stdout is not None
    try:
        url = process.stdout.readline().strip()
        address_s = time.monotonic() - begun
        with PageClient(url) as page:
            page.look(
                ls.Camera.look_at((0.0, 0.0, -3.0), (0.0, 0.0, 0.0), (0.0, -1.0, 0.0), width=WIDTH, height=HEIGHT)
            )
            page.picture(timeout=120.0)
            fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
            processor_s = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
            first_s = page.pictures[0][0] - begun
            yield Started(page, process, begun, address_s, first_s, processor_s)
    finally:
        process.terminate()
        process.wait()
        process.stdout.close()


def orbited(view: Started, cameras: list[ls.Camera], seconds: float = WINDOW_S) -> tuple[float, float]:
    """Pictures a second while the camera moves all the time, and the longest that none came, milliseconds."""
    count, begun = len(view.page.pictures), time.monotonic()
    while (now := time.monotonic()) - begun < seconds:
        view.page.look(cameras[int(30.0 * (now - view.begun)) % STEPS])
        time.sleep(0.02)
    times = [begun, *(came for came, _ in view.page.pictures[count:])]
    return (len(times) - 1) / seconds, 1e3 * float(np.max(np.diff([*times, begun + seconds])))


if __name__ == "__main__":
    main()
