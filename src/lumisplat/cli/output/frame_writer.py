"""Pictures of ``--aov`` and ``--view``: what is written beside a frame, or instead of it."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import lumisplat as ls

ViewName = Literal[
    "normal", "depth", "index", "shadow", "hits", "transmittance", "direct_diffuse", "indirect_diffuse",
    "direct_glossy", "indirect_glossy", "emission", "motion", "history", "probes", "cache", "cache_cells",
]  # fmt: skip

_LEGENDS = {
    "depth": "depth in scene units from {:.4g} (red) to {:.4g} (blue)",
    "motion": "pixels a frame from {:.0f} (white) to {:.0f} (full), red to the right, yellow-green up; unknown: black",
    "history": "frames that direct light is the mean of, from {:.0f} (violet) to {:.0f} (yellow); no surface: black",
    "probes": "refreshes of screen probes from {:.0f} (violet) to {:.0f} (yellow), logarithmic",
    "hits": "Gaussians a ray from {:.0f} (violet) to {:.0f} (yellow), logarithmic; none: black",
}
"""What the colours of a view mean, of views whose colours depend on the scene."""


@dataclass(frozen=True)
class Layers:
    """What ``--aov`` asks for: layers of a frame, mattes, and samples in depth."""

    names: tuple[str, ...]
    """Layers of the frame itself."""
    cryptomatte: bool
    deep: bool

    @classmethod
    def of(cls, text: str) -> Layers:
        """Reads names with commas between.

        Raises:
            ConfigError: There is no such layer.
        """
        known = (*ls.Frame.LAYERS, "cryptomatte", "deep")
        given = [name.strip() for name in text.split(",") if name.strip()]
        for name in given:
            if name not in known:
                near = difflib.get_close_matches(name, known, 1)
                hint = f", did you mean {near[0]}?" if near else ""
                raise ls.ConfigError(f"--aov has '{name}'{hint or ','} expected some of {', '.join(known)}")
        names = tuple(name for name in given if name in ls.Frame.LAYERS)
        return cls(names, "cryptomatte" in given, "deep" in given)


@dataclass
class FrameWriter:
    """Writes frames with their layers, or a view of each; in all frames of a run the same colours mean the same.

    Raises:
        ConfigError: There is both a view and layers.
    """

    layers: tuple[str, ...]
    """Names of layers."""
    view: ViewName | None
    legend: str | None = field(default=None, init=False)
    """What the colours of the view or the values of the depth mean, once a frame has been written."""
    _limits: tuple[float, float] | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        if self.view and self.layers:
            raise ls.ConfigError("--view and --aov do not go together: a view is written instead of the picture")

    @property
    def aovs(self) -> tuple[str, ...]:
        """What ``RenderConfig.aovs`` must hold."""
        names = (*self.layers, self.view or "")
        return tuple(ls.Frame.NEEDS[name] for name in names if name in ls.Frame.NEEDS)

    def write(self, frame: ls.Frame, path: Path, mattes: ls.Mattes | None = None) -> None:
        """Writes one frame.

        Raises:
            ConfigError: It was rendered without a layer, or without what the view needs.
            FormatError: It cannot be written.
        """
        if self.view is None:
            frame.save(path, self.layers, mattes)
            if "depth" in self.layers and path.suffix.lower() == ".png":
                self.legend = _depth_legend(path.with_suffix(".depth16.png"), frame, first=self.legend is None)
            return
        self._limits = self._limits or frame.view_limits(self.view)
        if self.view in _LEGENDS:
            self.legend = _LEGENDS[self.view].format(*self._limits)
        frame.save_view(path, self.view, self._limits)


def _depth_legend(path: Path, frame: ls.Frame, *, first: bool) -> str:
    """What the values of 16-bit depth mean: of one frame its range, of several where it is."""
    if not first:
        return (
            ".depth16.png: depth in scene units, from depth_near (1) to depth_far (65535) of each file's text; 0: none"
        )
    if frame.depth_range is None:
        return f"{path}: no surface is seen, all values are 0"
    near, far = frame.depth_range
    return f"{path}: depth in scene units from {near:.6g} (1) to {far:.6g} (65535); 0: no surface"
