"""Compares objects inserted into captures with the truth by paths, for each way to light them (8 CPU minutes).

``python -m bench.insertion [--places room yard]`` prints a JSON object per place and way, and writes images to
/tmp/insertion: the truth, then all ways in the order in which they are printed. Captures have the light of their lamp,
or of sun and sky, baked into the colours of their Gaussians, without the things: a knot of clay and a ball of brass.
The truth is path traced from the same Gaussians with true materials and lights, and with the things.

Ways are those of docs/guide/place_objects.md and the pages that it names, with 16 samples in hybrid and 64 in path
frames, without denoising:

- ``naive``: the things in the light of the camera, without shadows.
- ``raster, estimated lights``: as `ls.AvatarLighter` lights meshes, by a probe and lights that it estimates, with
  shadow maps. If it finds no light, the true ones are given (``raster, given lights``).
- ``hybrid, estimated lights``: the same lights, with shadow rays. The capture is a shadow catcher, here and below.
- ``captured light``: the capture alone is the light, with its estimated gain.
- ``found lights``: `ls.inverse.estimate_materials` finds the lights, as does `lumisplat delight`. In a room, a probe
  gives the ambient light of the shadow catcher.
- ``delighted``: the same lights; the capture has the materials found, and is relit.
- ``true lights``: as with found lights. What remains is due to the shadow catcher and the pipeline.

PSNR is over display values, of all cameras together: on the ``clay`` and the ``brass`` thing; where the capture is
``darker`` or ``brighter`` by more than 2 % than without the things, in shadows and where they reflect light or are
reflected; and in the whole ``frame``. ``cpu_seconds`` are those of a frame without its preparation: the least of all
cameras, and in real time of all frames. ``other paths`` is the truth again, with 64 other samples: its noise is the
best that any way can reach. ``capture`` has no things.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import maximum_filter, uniform_filter

import lumisplat as ls
from bench.delighted import AS_TRAINED, MATT, baked, colored, patterned, psnr
from bench.timing import parser, quiet_warp
from lumisplat.demo.shapes import torus_knot
from lumisplat.io.images.texture import write_png
from lumisplat.math.arrays import Doubles, Flags, FloatArray, IntArray
from support.scenes.light_scenes import matte, parallelogram
from support.scenes.path_rooms import (
    CEILING_LIGHT,
    SIZE,
    behind,
    ceiling,
    ceiling_light,
    faceted_ball,
    floor_and_walls,
    turned_box,
)

OUT = Path("/tmp/insertion")
WIDTH, HEIGHT = 120, 84
CHANGED = 0.02
"""Smallest difference of display values, averaged over 3 x 3 pixels, where things change a capture."""
COUNT = 3000
"""Gaussians of a place."""
STILL_FRAMES = 32
"""Frames in real time, of which the last counts."""
LEAST = 50
"""Smallest number of pixels of a part whose PSNR is given."""
Light = ls.LightDirectional | ls.LightEnvironment | ls.LightPoint | ls.LightRect


@dataclass(frozen=True)
class Place:
    """Capture of a place whose materials and lights are known."""

    truth: ls.Scene
    """Relit Gaussians with true materials and lights, without the things."""
    captured: ls.Gaussians
    """The same Gaussians as captured, without those of lamps."""
    lamps: tuple[ls.Gaussians, ...]
    """White Gaussians at the lamps."""
    cameras: list[ls.Camera]
    things: tuple[ls.MeshInstance, ...]
    """A matt thing and a shiny one."""

    @property
    def whole(self) -> ls.Gaussians:
        """The capture with its lamps."""
        return ls.merge([self.captured, *self.lamps])


def room(device: str) -> Place:
    """Returns a closed room with a ball and a box, lit by a lamp in its ceiling."""
    (x0, z0), (x1, z1) = CEILING_LIGHT
    center, shines = (0.5 * (x0 + x1), SIZE[1], 0.5 * (z0 + z1)), ceiling_light()
    assert isinstance(shines.material, ls.MaterialPbr)
    lamp = ls.LightRect(center, (x1 - x0, 0, 0), (0, 0, z1 - z0), shines.material.emissive)
    meshes = [*floor_and_walls(), *ceiling(), behind(), *objects()]
    eyes = ((2.1, 1.5, 4.8),)
    lamps = ls.gaussians_from_mesh(shines, 400)
    white = colored(lamps, np.ones((lamps.count, 3)))
    return captured_place(patterned(meshes, COUNT), (lamp,), eyes, (white,), device=device)


def yard(device: str) -> Place:
    """Returns a floor with a ball and a box on it, in the sun and under a clear sky."""
    sun, sky = ls.lights.Daylight(48.1, 11.6, "2026-06-21T17:00:00+02:00").lights()
    floor = parallelogram((-2.0, 0.0, -1.5), (0.0, 0.0, 8.0), (8.0, 0.0, 0.0), matte(0.7, 0.65, 0.6))
    eyes = ((2.1, 2.6, 5.4),)
    return captured_place(
        patterned([floor, *objects()], COUNT), (sun, replace(sky, visible=False)), eyes, (), device=device
    )


PLACES: dict[str, Callable[[str], Place]] = {"room": room, "yard": yard}


def objects() -> list[ls.Mesh]:
    """Returns the captured objects."""
    return [faceted_ball(0.0), turned_box(matte(0.2, 0.5, 0.8))]


def captured_place(
    gaussians: ls.Gaussians,
    lights: Sequence[Light],
    eyes: Sequence[tuple[float, float, float]],
    lamps: tuple[ls.Gaussians, ...],
    *,
    device: str,
) -> Place:
    """Bakes the light of a place and adds things and cameras."""
    truth = ls.Scene([ls.SplatInstance(gaussians, material=MATT)], lights=lights)
    captured = baked(truth, device)
    cameras = [
        ls.Camera.look_at(eye, (1.9, 0.45, 2.7), width=WIDTH, height=HEIGHT, fov_y=0.75 if lamps else 0.6)
        for eye in eyes
    ]
    return Place(truth, captured, lamps, cameras, things())


def things() -> tuple[ls.MeshInstance, ...]:
    """Returns a knot of clay and a ball of brass, which stand on the floor of every place."""
    clay = ls.MaterialPbr(base_color=(0.7, 0.4, 0.25), roughness=0.9, name="clay")
    brass = ls.MaterialPbr(base_color=(0.9, 0.7, 0.4), metallic=1.0, roughness=0.3, name="brass")
    knot = ls.MeshInstance(
        replace(torus_knot(), material=clay), position=(2.5, 0.5, 3.0), rotation_degrees=(75, 20, 0), scale_by=0.3
    )
    ball = ls.MeshInstance(replace(ls.sphere(0.3), material=brass), position=(1.2, 0.3, 3.3))
    return tuple(ls.stand_on_ground(thing, 0.0, up="y-up") for thing in (knot, ball))


@dataclass(frozen=True)
class Way:
    """Scene and settings of one way to insert things."""

    name: str
    scene: ls.Scene
    config: ls.RenderConfig


def references(place: Place) -> list[Way]:
    """Returns the truth with other random numbers, and the capture without things."""
    true = replace(place.truth, meshes=place.things)
    return [
        Way("other paths", true, replace(AS_TRAINED, samples=64)),
        Way("capture", ls.Scene([place.whole]), ls.RenderConfig()),
    ]


def ways(place: Place, device: str) -> Iterator[Way]:
    """Yields all ways to insert the things of a place."""
    things, whole, lights = place.things, place.whole, place.truth.lights
    yield Way("naive", ls.Scene([whole], things), ls.RenderConfig(lighting=True, shadows=ls.Shadows.OFF))
    lit, source = lit_by_probe(place, device)
    yield Way(f"raster, {source} lights", lit, SETTINGS["raster"])
    casting = [replace(light, casts_shadow=not isinstance(light, ls.LightEnvironment)) for light in lit.lights]
    yield Way(f"hybrid, {source} lights", ls.Scene([caught(whole)], things, casting), SETTINGS["hybrid"])
    alone = ls.Scene([caught(whole)], things)
    gain = ls.avatars.estimate_capture_gain(alone, device=device)
    for name in ("raster", "realtime", "path"):
        yield Way(f"{name}, captured light", alone, replace(SETTINGS[name], capture_gain=gain))
    config = ls.config.DelightConfig(matt=True, inside=bool(place.lamps))
    found = ls.inverse.estimate_materials(whole, config, device=device)
    print(json.dumps({"gain": gain, "remarks": found.remarks}), file=sys.stderr, flush=True)
    others = found.emitter_of < 0
    dark, estimated, ambient = whole.subset(others), lights_of(found), ambient_of(place, device)
    relit = ls.SplatInstance(found.gaussians.subset(others), material=MATT)
    for light, scene in {
        "found lights": ls.Scene([caught(dark, ambient)], things, estimated),
        "delighted": ls.Scene([relit], things, estimated),
        "true lights": ls.Scene([caught(place.captured, ambient)], things, lights),
    }.items():
        for name in ("hybrid", "realtime", "path"):
            yield Way(f"{name}, {light}", scene, SETTINGS[name])


SETTINGS = {
    "raster": ls.RenderConfig(),
    "hybrid": ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, shadows=ls.Shadows.SOFT, samples=16),
    "realtime": ls.RenderConfig(pipeline=ls.Pipeline.REALTIME),
    "path": ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=64),
}
"""Settings of each pipeline."""


def caught(capture: ls.Gaussians, ambient: ls.MaterialSimple | None = None) -> ls.SplatInstance:
    """Returns a capture that catches shadows."""
    return ls.SplatInstance(capture, material=ambient, shadow_catcher=True)


def ambient_of(place: Place, device: str) -> ls.MaterialSimple | None:
    """Returns the ambient light on the floor of a room, without its lamps, by a probe; None under a sky."""
    if not place.lamps:
        return None
    center = np.mean(ls.Scene(meshes=place.things).bounds(), axis=0)
    probe = ls.avatars.EnvironmentProbe.capture(ls.Scene([place.captured]), center, device=device)
    return ls.MaterialSimple(ambient=probe.irradiance(np.array([[0.0, 1.0, 0.0]]))[0] / np.pi)


def lit_by_probe(place: Place, device: str) -> tuple[ls.Scene, str]:
    """Returns the things lit by a probe and by lights that are estimated or, if none is found, given."""
    capture = ls.Scene([place.whole])
    try:
        return ls.AvatarLighter(capture, device=device).light(place.things), "estimated"
    except ls.SceneError as error:
        print(json.dumps({"no light": str(error)}), file=sys.stderr, flush=True)
        return ls.AvatarLighter(capture, place.truth.lights, device=device).light(place.things), "given"


def lights_of(found: ls.inverse.MaterialEstimate) -> list[Light]:
    """Returns the environment that was found, or in a room a rectangle for each group of emitting Gaussians."""
    if not found.is_inside:
        return [ls.LightEnvironment(found.environment_image(), visible=False)]
    middle, rectangles = found.gaussians.means.mean(axis=0), []
    for number, radiance in enumerate(found.emitters):
        means = found.gaussians.means[found.emitter_of == number].astype(np.float64)
        center = means.mean(axis=0)
        variances, axes = np.linalg.eigh(np.cov(means.T))
        u, v = np.sqrt(12.0 * variances[1:])[:, None] * axes.T[1:]  # of points spread evenly over a rectangle
        if np.cross(u, v) @ (middle - center) < 0.0:
            u, v = v, u
        rectangles.append(ls.LightRect(center, u, v, radiance))
    return rectangles


@dataclass(frozen=True)
class Truth:
    """Path-traced view with and without the things, display values."""

    with_things: Doubles
    without: Doubles
    thing: IntArray
    """Number of the thing at each pixel, -1 for none, shape (H, W)."""

    def masks(self) -> dict[str, Flags]:
        """Returns the pixels of each part of the view, (H, W) each."""
        around = maximum_filter(self.thing, 3) < 0  # without pixels that things cover in part
        change = (self.with_things - self.without).mean(axis=2)
        near = uniform_filter(around.astype(np.float64), 3)
        change = uniform_filter(np.where(around, change, 0.0), 3) / np.maximum(near, 1e-9)
        return {
            "clay": self.thing == 0,
            "brass": self.thing == 1,
            "darker": around & (change < -CHANGED),
            "brighter": around & (change > CHANGED),
            "frame": np.ones_like(around),
        }


def truths(place: Place, samples: int, device: str) -> list[Truth]:
    """Path traces all views of a place with its things and without."""
    config, found = replace(AS_TRAINED, samples=samples, seed=1), []
    for camera in place.cameras:
        frames = [
            ls.render(replace(place.truth, meshes=meshes), camera, config, device=device)
            for meshes in (place.things, ())
        ]
        with_things, without = (frame.pixels_srgb().astype(np.float64) for frame in frames)
        found.append(Truth(with_things, without, frames[0].instance_index - len(place.truth.splats)))
    return found


def rendered(way: Way, cameras: list[ls.Camera], device: str) -> tuple[list[Doubles], float]:
    """Returns display values of all views, and the least CPU seconds of a frame."""
    renderer = ls.create_renderer(way.config, device)
    images: list[Doubles] = []
    seconds: list[float] = []
    count = STILL_FRAMES if way.config.pipeline is ls.Pipeline.REALTIME else 1
    for number in range(count * len(cameras)):
        begun = time.process_time()
        shown = renderer.render(way.scene, cameras[number // count]).pixels_srgb().astype(np.float64)
        seconds.append(time.process_time() - begun)
        if number % count == count - 1:
            images.append(shown)
    return images, min(seconds)


def figures(images: list[Doubles], truth: list[Truth]) -> dict[str, float]:
    """Returns the PSNR of each part of all views together, dB; parts of few pixels are left out."""
    parts = [view.masks() for view in truth]
    found: dict[str, float] = {}
    for name in parts[0]:
        mine, true = (
            np.concatenate([image[part[name]] for image, part in zip(shown, parts, strict=True)])
            for shown in (images, [view.with_things for view in truth])
        )
        if len(true) >= LEAST:
            found[name] = psnr(mine, true)
    return found


def sheet(images: list[Doubles], columns: int = 5) -> FloatArray:
    """Returns images in rows."""
    missing = -len(images) % columns
    images = images + [np.zeros_like(images[0])] * missing
    rows = [np.concatenate(images[first : first + columns], axis=1) for first in range(0, len(images), columns)]
    return np.concatenate(rows).astype(np.float32)


def main() -> None:
    """Measures the requested places."""
    options = parser("insertion", __doc__)
    options.add_argument("--places", nargs="+", default=list(PLACES), choices=list(PLACES))
    options.add_argument("--samples", type=int, default=128, help="samples of the truth (default: 128)")
    given = options.parse_args()
    quiet_warp()
    OUT.mkdir(exist_ok=True)
    for name in given.places:
        place = PLACES[name](given.device)
        truth = truths(place, given.samples, given.device)
        views = [[view.with_things] for view in truth]
        for way in (*references(place), *ways(place, given.device)):
            images, seconds = rendered(way, place.cameras, given.device)
            row: dict[str, Any] = {"place": name, "way": way.name, **figures(images, truth)}
            print(json.dumps({**row, "cpu_seconds": round(seconds, 2)}), flush=True)
            for view, image in zip(views, images, strict=True):
                view.append(image)
        for number, view in enumerate(views):
            write_png(OUT / f"{name}_{number}.png", (sheet(view) * 255.0 + 0.5).astype(np.uint8))


if __name__ == "__main__":
    main()
