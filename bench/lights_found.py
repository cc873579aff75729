"""Counts the lights and suns found in captures that were not used to tune thresholds (5 minutes).

``python -m bench.lights_found`` generates rooms, nights and grounds of known light (`support.scenes.lit_captures`),
estimates their lights, and prints a line of JSON per capture and a table. The demo room and the captures of the data
come last. ``--first 0`` uses the development seeds; seeds from 100 on are for evaluation only.

``--trained FOLDER ...`` measures trained captures instead: folders of tools/make_relightable_room.py, whose lights are
in lamps.toml, each with a capture.ply that was trained from its images.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

import numpy as np

import lumisplat as ls
from bench.presets import DATA, load_capture
from bench.timing import parser, quiet_warp
from lumisplat.demo.scene import DAYLIGHT
from support.scenes.lit_captures import KINDS, LitCapture, lit_capture

NEAR = 0.4
"""Largest distance of an estimated light from a true one that counts as found, metres."""
ASKED = 4
"""Number of lights requested, more than any capture has."""


def demo_capture() -> LitCapture:
    """Returns the demo's room, whose sun is known."""
    towards = np.array(DAYLIGHT.sun_direction) / np.linalg.norm(DAYLIGHT.sun_direction)
    room = ls.Scene(splats=ls.demo_scene().splats)
    return LitCapture("demo room", room, np.array([0.0, 0.9, 0.4]), np.zeros((0, 3)), towards, 1.0)


def captures_of_objects() -> list[LitCapture]:
    """Returns the captures of the data; none contains its own lights or sun."""
    paths = [DATA / "splats" / name for name in ("biker.spz", "playbot/0_0", "logo_sog")]
    sets = {path: load_capture(path) for path in paths if path.exists()}
    return [
        LitCapture(path.parent.name + "/" + path.name, ls.Scene(splats=(ls.SplatInstance(one),)), middle(one),
                   np.zeros((0, 3)), None, float(np.ptp(one.means, axis=0).max()) / 3.0)
        for path, one in sets.items()
    ]  # fmt: skip


def middle(gaussians: ls.Gaussians) -> np.ndarray:
    """Returns a point beside the captured object, halfway out and halfway up."""
    low, high = np.quantile(gaussians.means.astype(np.float64), (0.02, 0.98), axis=0)
    return 0.5 * (low + high) + (0.35 * (high - low)[0], 0.0, 0.0)


def trained(folder: Path) -> LitCapture:
    """Returns the capture trained from photographs of a place with known lights, seen from the middle."""
    known = ls.load(folder / "lamps.toml")
    assert isinstance(known, ls.Scene)
    lights = known.lights
    suns = [np.array(light.direction) for light in lights if isinstance(light, ls.LightDirectional)]
    lamps = [light.position for light in lights if isinstance(light, ls.LightRect | ls.LightSphere)]
    scene = ls.Scene(splats=(ls.SplatInstance(load_capture(folder / "capture.ply")),))
    sun = -suns[0] / np.linalg.norm(suns[0]) if suns else None
    return LitCapture(folder.name, scene, np.array([0.0, 0.9, 0.0]), np.reshape(lamps, (-1, 3)), sun, 1.0)


def found_lights(capture: LitCapture) -> dict:
    """Estimates lights and sun of a capture, and counts how many are right."""
    try:
        estimate = ls.inverse.estimate_lights(capture.scene, capture.center, ASKED)
        positions, shares = np.array([light.position for light in estimate.lights]), estimate.evidence.tolist()
        problem = ""
    except ls.SceneError as error:
        positions, shares, problem = np.zeros((0, 3)), [], str(error)
    gaps = np.linalg.norm(positions[:, None] - capture.lights[None], axis=-1) / capture.unit
    sun = ls.inverse.estimate_sun(capture.scene, capture.center)
    off = None
    if sun is not None and capture.sun is not None:
        cosine = -np.dot(sun.light.direction, capture.sun)
        off = round(float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))), 1)
    return {
        "name": capture.name,
        "lamps": len(capture.lights),
        "lamps_found": int((gaps <= NEAR).any(axis=0).sum()),
        "lights": len(positions),
        "lights_right": int((gaps <= NEAR).any(axis=1).sum()),
        "shares": [round(share, 3) for share in shares],
        "has_sun": capture.sun is not None,
        "sun_found": sun is not None,
        "sun_confidence": sun and round(sun.confidence, 2),
        "degrees_off": off,
        "says": problem[:14],
    }


def table(rows: Sequence[dict]) -> list[str]:
    """Returns the lines of a Markdown table, one row per kind of capture."""
    head = ["captures", "number", "lamps", "found", "lights given", "of them lamps", "suns", "found", "degrees off"]
    lines = ["| " + " | ".join(head) + " |", "| --- |" + " ---: |" * (len(head) - 1)]
    kinds = [*KINDS, *(row["name"] for row in rows if row["name"].split()[0] not in KINDS)]
    for kind in kinds:
        of = [row for row in rows if row["name"] == kind or (kind in KINDS and row["name"].split()[0] == kind)]
        if not of:
            continue
        off = sorted(row["degrees_off"] for row in of if row["degrees_off"] is not None)
        degrees = f"{np.median(off):.1f} (at most {off[-1]:.1f})" if off else ""
        sums = [sum(row[key] for row in of) for key in ("lamps", "lamps_found", "lights", "lights_right", "has_sun")]
        cells = [kind, len(of), *sums, sum(row["sun_found"] for row in of), degrees]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return lines


def main() -> None:
    """Measures and prints."""
    quiet_warp()
    given = parser("lights_found", __doc__)
    given.add_argument("--first", type=int, default=100, help="the first seed (default: 100)")
    given.add_argument("--count", type=int, default=10, help="captures of each kind (default: 10)")
    given.add_argument("--trained", type=Path, nargs="+", default=[], metavar="FOLDER", help="trained captures instead")
    chosen = given.parse_args()
    seeds = range(chosen.first, chosen.first + chosen.count)
    drawn = (lit_capture(kind, seed, chosen.device) for kind in KINDS for seed in seeds)
    rows: list[dict] = []
    generated = chain(drawn, [demo_capture()], captures_of_objects())
    for capture in map(trained, chosen.trained) if chosen.trained else generated:
        rows.append(found_lights(capture))
        print(json.dumps(rows[-1]), flush=True)
    print("\n".join(table(rows)))


if __name__ == "__main__":
    main()
