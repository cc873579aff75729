"""Lists the golden frames, for their test and for tools/regenerate_goldens.py."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import lumisplat as ls

FOLDER = Path(__file__).parents[2] / "golden"
LAYERS = ("color", "normal", "depth")


@dataclass(frozen=True)
class Golden:
    """A view of the demo scene that is small enough to be stored."""

    view: str
    """Name of the demo camera."""
    why: str
    config: ls.RenderConfig = field(default_factory=lambda: ls.RenderConfig(lighting=False))

    @property
    def path(self) -> Path:
        """Path of the file with the stored layers."""
        return FOLDER / f"{self.view}.npz"

    def render(self, scene: ls.Scene) -> dict[str, np.ndarray]:
        """Renders the layers of the view as float arrays, not as encoded images."""
        camera = next(camera for camera in ls.demo_cameras(160, 90) if camera.name == self.view)
        frame = ls.render(scene, camera, self.config, device="cpu")
        return {layer: getattr(frame, layer) for layer in LAYERS}


CASES = [
    Golden("hero", "the picture of the README: everything at once"),
    Golden(
        "detail",
        "splats larger than a pixel, a mesh against them",
        ls.RenderConfig(background=(1.0, 1.0, 1.0), lighting=False),
    ),
    Golden("above", "another up in the image, grazing walls"),
]
