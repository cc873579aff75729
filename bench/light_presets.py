"""What lit frames are timed on: the demo scene, by pipeline and by what light has to do there."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, replace
from pathlib import Path

import lumisplat as ls

WIDTH, HEIGHT = 640, 360

KINDS = {
    "unlit": "unlit",
    "lit": "4 lights without shadows",
    "hard": "one light, hard shadow",
    "soft": "one light, soft shadow, 1 sample",
    "bounces": "one light, hard shadow, 3 bounces",
}
"""What light has to do, by its name in presets."""


@dataclass(frozen=True)
class LitPreset:
    """One pipeline and one kind of light."""

    pipeline: str
    kind: str

    @property
    def name(self) -> str:
        """As it is asked for."""
        return f"light-{self.pipeline}-{self.kind}"

    def config(self) -> ls.RenderConfig:
        """Settings of its frames."""
        shadows = {"lit": ls.Shadows.OFF, "soft": ls.Shadows.SOFT}.get(self.kind, ls.Shadows.HARD)
        return ls.RenderConfig(
            pipeline=ls.Pipeline(self.pipeline),
            lighting=self.kind != "unlit",
            shadows=shadows,
            samples=1,
            max_bounces=3 if self.kind == "bounces" else 0,
        )

    def scene(self, demo: ls.Scene) -> ls.Scene:
        """The demo, in its light; four lights are three more without extent, such as glTF files hold."""
        spot = demo.lights[0]
        more = (
            ls.LightPoint((-1.0, 1.8, 0.4), (1.0, 0.8, 0.6), intensity=2.0),
            ls.LightPoint((-0.62, 1.5, -1.42), (1.0, 0.66, 0.38), intensity=0.9),
            ls.LightDirectional((0.4, -1.0, -0.6), (0.7, 0.8, 1.0), intensity=0.8),
        )
        return replace(demo, lights=(spot, *more) if self.kind == "lit" else (spot,))


BASE = LitPreset("raster", "unlit")
"""What all others are compared with."""

LIGHT = [
    LitPreset(pipeline.value, kind)
    for pipeline in (ls.Pipeline.RASTER, ls.Pipeline.TRACE, ls.Pipeline.HYBRID)
    for kind in KINDS
    # The raster follows no mirrors.
    if not (pipeline is ls.Pipeline.RASTER and kind == "bounces")
]


def camera() -> ls.Camera:
    """The view."""
    return ls.demo_cameras(WIDTH, HEIGHT, count=1)[0]


def store_demo(path: Path) -> None:
    """Builds the lit demo scene, which takes longer than timing it."""
    path.write_bytes(pickle.dumps(ls.demo_scene_lit()))


def stored_demo(path: Path) -> ls.Scene:
    """What `store_demo` has left."""
    return pickle.loads(path.read_bytes())
