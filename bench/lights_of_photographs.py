"""How well lights are found from rendered photographs: ``python -m bench.lights_of_photographs [--rows NAME ...]``.

A room of meshes with three lamps, seen by one camera or two at 96 x 72, once at 64 x 48, whose truth is known. Each row
prints the worst error of a lamp's power, in per cent of its brightest channel, that of its place, in per cent of the
room, and seconds of processor time.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import lumisplat as ls
from bench.timing import parser, quiet_warp
from support.scenes import fit_rooms as rooms


def main() -> None:
    """Prints one JSON object a row."""
    options = parser("lights_of_photographs", __doc__)
    options.add_argument("--rows", nargs="+", default=list(ROWS), choices=list(ROWS))
    args = options.parse_args()
    quiet_warp()
    for name in args.rows:
        start = time.process_time()
        found, lamps = ROWS[name](args.device)
        seconds = time.process_time() - start
        print(json.dumps({"row": name} | errors(found, lamps) | {"seconds": round(seconds, 1)}), flush=True)


def errors(found: ls.inverse.LightFit, lamps: tuple[ls.LightPoint, ...]) -> dict[str, float]:
    """The worst error of powers and of places, per cent; each lamp is compared with the light that is nearest."""
    lights = [light for light in found.lights if isinstance(light, ls.LightPoint)]
    powers: list[float] = []
    places: list[float] = []
    for lamp in lamps:
        away = [float(np.linalg.norm(np.subtract(light.position, lamp.position))) for light in lights]
        light = lights[int(np.argmin(away))]
        powers.append(100.0 * float(np.abs(rooms.power(light) - rooms.power(lamp)).max() / rooms.power(lamp).max()))
        places.append(100.0 * min(away) / rooms.ROOM)
    return {"power_percent": round(max(powers), 3), "place_percent": round(max(places), 3)}


def _intensities(device: str, *, noise: float = 0.0, hidden: bool = False) -> tuple[ls.inverse.LightFit, Any]:
    """Places are known, light does not bounce."""
    lamps, room = rooms.three_lamps(), rooms.closed(*rooms.three_lamps())
    photograph: Any = rooms.taken(rooms.with_strangers(room) if hidden else room, rooms.view())
    photograph = rooms.noisy(photograph, noise) if noise else photograph
    scene = rooms.closed(*rooms.unknown(*lamps))
    fit = ls.fit_lights(scene, rooms.view(), photograph, config=rooms.DIRECT, environment_degree=None, device=device)
    return fit, lamps


def _places(device: str, views: int) -> tuple[ls.inverse.LightFit, Any]:
    """All three lamps are moved by 0.3 of the room; noise of 0.01 and 8 bits."""
    lamps, cameras = rooms.three_lamps(), [rooms.view(), rooms.other_view()][:views]
    taken = [rooms.noisy(rooms.taken(rooms.closed(*lamps), camera), 0.01, n) for n, camera in enumerate(cameras)]
    scene = rooms.closed(*rooms.moved(lamps, 0.3))
    fit = ls.fit_lights(
        scene, cameras, taken, config=rooms.DIRECT, environment_degree=None, positions=True, size=64, device=device
    )
    return fit, lamps


def _bounced(
    device: str, *, direct: bool = False, samples: int = 64, width: int = 96
) -> tuple[ls.inverse.LightFit, Any]:
    """A photograph of 256 paths a pixel with noise and 8 bits, explained by paths, or by direct light alone."""
    lamps = rooms.three_lamps()
    paths = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=samples, max_bounces=6)
    camera = rooms.view(width, 3 * width // 4)
    photograph = rooms.taken(rooms.closed(*lamps), camera, replace(paths, samples=256, seed=5))
    scene, config = rooms.closed(*rooms.unknown(*lamps)), rooms.DIRECT if direct else paths
    fit = ls.fit_lights(
        scene, camera, rooms.noisy(photograph, 0.01), config=config, environment_degree=None, device=device
    )
    return fit, lamps


ROWS: dict[str, Callable[[str], tuple[ls.inverse.LightFit, Any]]] = {
    "perfect": _intensities,
    "noise": lambda device: _intensities(device, noise=0.02),
    "hidden": lambda device: _intensities(device, noise=0.02, hidden=True),
    "places_1": lambda device: _places(device, 1),
    "places_2": lambda device: _places(device, 2),
    "paths": _bounced,
    "paths_small": lambda device: _bounced(device, width=64),
    "paths_8": lambda device: _bounced(device, samples=8),
    "direct": lambda device: _bounced(device, direct=True),
}
"""By the names of rows."""


if __name__ == "__main__":
    main()
