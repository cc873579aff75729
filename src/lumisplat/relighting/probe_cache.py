"""Probes of one scene, captured once for each place."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.config import RenderConfig
from lumisplat.progress import Progress
from lumisplat.relighting.probe import EnvironmentProbe
from lumisplat.renderer.renderer import Renderer, create_renderer
from lumisplat.scene.scene import Scene

_PROBES_HELD = 64
"""Probes that are kept, at most: more than there are actors."""


class ProbeCache:
    """Captures probes of a scene, and keeps them for actors that stand still.

    Args:
        scene: The scene, without actors.
        background: Display-referred sRGB behind everything, 0..1 each.
        device: As for `create_renderer`.
        progress: Called with a label and a fraction 0..1, while kernels compile.
    """

    def __init__(
        self, scene: Scene, background: tuple[float, float, float], device: str, progress: Progress | None
    ) -> None:
        self._scene, self._config = scene, RenderConfig(background=background)
        self._device, self._progress = device, progress
        self._renderer: Renderer | None = None
        """Made for the first probe: scenes that need none load no kernels."""
        self._probes: dict[bytes, EnvironmentProbe] = {}

    def at(self, place: npt.NDArray[np.float64]) -> EnvironmentProbe:
        """The probe of a place, world space, shape (3,)."""
        key = place.tobytes()
        if key not in self._probes:
            if self._renderer is None:
                self._renderer = create_renderer(self._config, self._device, progress=self._progress)
            if len(self._probes) >= _PROBES_HELD:
                self._probes.clear()
            self._probes[key] = EnvironmentProbe.capture(self._scene, place, renderer=self._renderer)
        return self._probes[key]
