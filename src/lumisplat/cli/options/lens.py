"""Options of the camera's lens: its size, and what is in focus."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import OmitArgPrefixes, arg

import lumisplat as ls
from lumisplat.cli.input.numbers import numbers


@dataclass(frozen=True, kw_only=True)
class LensOptions:
    """The aperture of `lumisplat.Camera`, and the pixel of `lumisplat.focused`."""

    aperture: Annotated[float | None, arg(metavar="UNITS", help_behavior_hint="")] = None
    """Radius of the lens, in units of the scene: what is not in focus is blurred. Without: the camera's own, else 0."""
    focus: Annotated[str | None, arg(metavar="X,Y", help_behavior_hint="")] = None
    """Focus on what this pixel shows, counted from the upper left, 0,0; along a path in each frame anew. Without: on
    --target, or as the camera says."""

    def pixel(self) -> tuple[int, int] | None:
        """The pixel of --focus; None: none was given.

        Raises:
            ConfigError: It is not two whole numbers.
        """
        if self.focus is None:
            return None
        x, y = numbers("--focus", self.focus, 2, "320,180")
        if x != int(x) or y != int(y):
            raise ls.ConfigError(f"--focus is '{self.focus}', expected the column and the row of a pixel")
        return int(x), int(y)


LensGroup = Annotated[LensOptions, arg(name="lens"), OmitArgPrefixes]
"""A field of a command that shows its options in a group of their own."""
