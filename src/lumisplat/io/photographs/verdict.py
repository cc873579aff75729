"""What is said of poses that were found: what is missing, and what is likely to be wrong."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from lumisplat.constants.photographs import (
    COMPARED_PIXELS,
    FEW_POINTS,
    LARGE_ERROR,
    LOST_SHARE,
    SMALLEST_PIECE,
    USUAL_VIEW_DEGREES,
)
from lumisplat.io.photographs.listing import some_names


@dataclass(frozen=True, slots=True)
class Placement:
    """A model of COLMAP, in figures."""

    names: Sequence[str]
    """Of all photographs."""
    placed: Sequence[str]
    """Of those that have a pose."""
    pieces: Sequence[int]
    """Photographs of the model that is taken, and those that only another one has, if they are more than a pair."""
    points: int
    shown: float
    """Points that a photograph shows, in the mean."""
    error: float
    """Mean distance of points from where photographs show them, pixels of the size that was compared."""
    view_degrees: float
    """Angle of view along the longer side, the one that is least usual."""

    @classmethod
    def of(cls, names: Sequence[str], models: Sequence[Any]) -> Placement:
        """The figures of models of COLMAP, of which the first is taken."""
        best = models[0]
        names_of = [{model.image(index).name for index in model.reg_image_ids()} for model in models]
        others = [len(found - names_of[0]) for found in names_of[1:]]
        cameras = best.cameras.values()
        views = [
            2.0 * math.degrees(math.atan2(0.5 * max(camera.width, camera.height), camera.mean_focal_length()))
            for camera in cameras
        ]
        shrink = min(COMPARED_PIXELS / max(max(camera.width, camera.height) for camera in cameras), 1.0)
        return cls(
            names=names,
            placed=sorted(names_of[0]),
            pieces=[len(names_of[0]), *(count for count in others if count >= SMALLEST_PIECE)],
            points=best.num_points3D(),
            shown=best.compute_mean_observations_per_reg_image(),
            error=best.compute_mean_reprojection_error() * shrink,
            view_degrees=max(views, key=lambda view: abs(view - sum(USUAL_VIEW_DEGREES) / 2.0)),
        )

    def remarks(self) -> list[str]:
        """What a user has to know, a line each; none: all is well."""
        low, high = USUAL_VIEW_DEGREES
        found: list[str] = []
        if len(self.pieces) > 1:
            *others, last = map(str, self.pieces)
            found.append(
                f"poses came out in {len(self.pieces)} pieces that do not join, of {', '.join(others)} and {last} "
                "photographs: the largest is taken"
            )
        if len(self.placed) < len(self.names):
            found.append(self._lost())
        if self.shown < FEW_POINTS:
            found.append(
                f"a photograph shows {self.shown:.0f} of {self.points:,} points, expected {FEW_POINTS} or more: "
                "poses are likely wrong; the background must have texture, too"
            )
        if self.error > LARGE_ERROR:
            found.append(
                f"points are {self.error:.1f} pixels off in the mean, expected below {LARGE_ERROR:g}: poses are likely "
                "wrong; nothing may move, blur or be zoomed"
            )
        if not low <= self.view_degrees <= high:
            found.append(
                f"the lens came out with a view of {self.view_degrees:.0f} degrees, expected {low:.0f} to {high:.0f}: "
                "poses are likely wrong; walk around things, rather than turn on the spot"
            )
        return found

    def _lost(self) -> str:
        lost = sorted({*self.names} - {*self.placed})
        line = f"no pose was found for {len(lost)} of {len(self.names)} photographs ({some_names(lost)})"
        if len(lost) > LOST_SHARE * len(self.names):
            line += ": walk slower, without blur, past more texture, or take more frames (frames --every)"
        return line
