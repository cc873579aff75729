"""Lighting metrics of figures as captured, only darkened, and relit: table 1 of Mir et al. 2026 (20 minutes).

``python -m bench.relit_figure`` prints a line of JSON per figure and moment, and a table of means. The captured biker
walks through the robot's meadow and through the demo room, as in examples/gallery/walking_biker.py, and the robot
hovers beside the biker. *Darkened* figures have the luminance of the relit ones, by one factor on their linear colours:
a gain over them is one of light, and not of brightness. ``--samples N`` compares N points of each side.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

import lumisplat as ls
from bench.presets import BIKER, DATA, load_capture
from bench.timing import parser, print_head, print_row, quiet_warp
from lumisplat.constants import SH_C0
from lumisplat.math.color import decode_srgb
from lumisplat.scene.animation.actors import Instance

METRICS = {"PAA-Y": ls.metrics.paa_y, "APF-Y": ls.metrics.apf_y, "NCM-ab": ls.metrics.ncm_ab}
HEIGHT = 1.7
"""Height of each figure, metres."""
REACH = 1.5
"""Distance from a figure's centre within which its place is compared with it, metres."""
MOMENTS = (0.2, 1.5, 2.8)
"""Times of the walks, seconds."""


@dataclass(frozen=True)
class Moment:
    """A figure at one moment in a place."""

    place: str
    scene: ls.Scene
    lighter: ls.AvatarLighter
    others: tuple[Instance, ...]
    figure: ls.SplatInstance


def walks() -> Iterator[Moment]:
    """Yields the biker in the meadow and in the demo room."""
    from examples.gallery import walking_biker

    for film, place in (
        (walking_biker.meadow(), "biker in the robot's meadow"),
        (walking_biker.room(), "biker in a room"),
    ):
        lighter = ls.AvatarLighter(film.scene, None, film.lighting)
        for time in MOMENTS:
            figure, *others = (one for actor in film.actors for one in actor.at(time))
            assert isinstance(figure, ls.SplatInstance)
            yield Moment(place, film.scene, lighter, tuple(others), figure)


def beside_biker() -> Iterator[Moment]:
    """Yields the robot beside the biker, who was captured without surroundings, before grey."""
    robot = load_capture(DATA / "splats" / "playbot" / "0_0")
    robot = robot.subset(robot.means[:, 1] < -0.13)
    scene = ls.Scene([load_capture(BIKER)])
    lighter = ls.AvatarLighter(scene, None, ls.config.AvatarLightingConfig(shadows=False), background=(0.5, 0.5, 0.5))
    for z in (-1.4, 1.4):
        pose = np.diag([2.4, 2.4, 2.4, 1.0])
        pose[:3, 3] = -0.4, 0.0, z
        yield Moment("robot beside the biker", scene, lighter, (), ls.SplatInstance(robot, pose))


def main() -> None:
    """Prints the metrics of each moment, and their means."""
    options = parser("relit_figure", __doc__)
    options.add_argument("--samples", type=int, default=20_000)
    samples = options.parse_args().samples
    quiet_warp()
    rows: dict[str, list[dict[str, list[float]]]] = {}
    for moment in chain(walks(), beside_biker()):
        row = measured(moment, samples)
        rows.setdefault(moment.place, []).append(row)
        print(json.dumps({"place": moment.place, **row}), file=sys.stderr, flush=True)
    print_head("figure: captured, darkened, relit", *METRICS, "luminance")
    for place, found in rows.items():
        columns = [np.mean([row[name] for row in found], axis=0) for name in (*METRICS, "luminance")]
        print_row(place, *("; ".join(f"{value:.3g}" for value in column) for column in columns))


def measured(moment: Moment, samples: int) -> dict[str, list[float]]:
    """Returns each metric, and the mean luminance, of the figure as captured, darkened and relit."""
    before = ls.metrics.LitPoints.of(moment.figure)
    lit = moment.lighter.light([moment.figure, *moment.others]).splats[len(moment.scene.splats)]
    relit = replace(before, rgb=decode_srgb(np.maximum(lit.gaussians.sh[:, 0] * SH_C0 + 0.5, 0.0)))
    darkened = replace(before, rgb=before.rgb * (relit.luminance.mean() / before.luminance.mean()))
    metres = HEIGHT / float(np.ptp(before.positions[:, 1]))
    center = before.positions.mean(axis=0)
    around = ls.metrics.LitPoints.of(moment.scene, around=center, radius=REACH / metres)
    scene, *figures = (sampled(one, metres, samples) for one in (around, before, darkened, relit))
    found = {name: [metric(one, scene, radius=REACH) for one in figures] for name, metric in METRICS.items()}
    return {**found, "luminance": [float(one.luminance.mean()) for one in figures]}


def sampled(points: ls.metrics.LitPoints, metres: float, samples: int) -> ls.metrics.LitPoints:
    """Returns at most so many of the points, drawn at random, in metres."""
    rows = np.random.default_rng(0).permutation(points.count)[:samples]
    return ls.metrics.LitPoints(points.positions[rows] * metres, points.normals[rows], points.rgb[rows])


if __name__ == "__main__":
    os.environ.setdefault("DATA", str(DATA))
    main()
