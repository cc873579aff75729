"""Reads and writes up direction, first view and origin of a capture, as JSON values or as PLY header comments.

Formats with JSON metadata store ``{"up": [x, y, z], "first_view": {"eye", "target", "up", "fov_y", "width",
"height"}}``, in the axes of the loaded Gaussians. PLY headers have a comment for each value: ``lumisplat up 0 0 1``,
``lumisplat first_view {...}``, and ``lumisplat origin 500000 4649000 0`` for the origin that positions are relative to.
nerfstudio's comment ``Vertical Axis: z`` is also read.
"""

from __future__ import annotations

import json
import logging
import os
import re
from collections.abc import Mapping
from typing import Any, NamedTuple, cast

import numpy as np

from lumisplat.errors import SceneError
from lumisplat.io.files.source import PathLike
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import vector
from lumisplat.scene.placing import Vector, up_vector

_log = logging.getLogger("lumisplat")

_UP = re.compile(r"\s*lumisplat\s+up\s+(?P<numbers>.*)", re.I)
_FIRST_VIEW = re.compile(r"\s*lumisplat\s+first_view\s+(?P<values>\{.*)", re.I)
_ORIGIN = re.compile(r"\s*lumisplat\s+origin\s+(?P<numbers>.*)", re.I)
_VERTICAL_AXIS = re.compile(r"\s*(?:vertical|up)[ _-]*axis\s*[:=]?\s*(?P<sign>[+-]?)(?P<axis>[xyz])\b.*", re.I)
"""Matches the vertical-axis comment that nerfstudio's ``ns-export gaussian-splat`` writes."""

_DIGITS = 9
"""Number of significant digits written: those of float32, the type of Gaussians."""


class Orientation(NamedTuple):
    """Up direction and first view of a capture; each is None if the file does not state it."""

    up: Vector | None = None
    first_view: Camera | None = None


UNSTATED = Orientation()
"""Orientation of a capture whose file states neither an up direction nor a first view: both None."""


def orientation_values(up: Vector | None, view: Camera | None) -> dict[str, Any]:
    """Converts up direction and first view to JSON values; a value of None is omitted."""
    values: dict[str, Any] = {}
    if up is not None:
        values["up"] = _rounded(up)
    if view is not None:
        down, forward = view.camera_from_world[1:3, :3]
        values["first_view"] = {
            "eye": _rounded(view.eye),
            "target": _rounded(view.eye + view.focus_distance * forward),
            "up": _rounded(-down),
            "fov_y": _rounded([view.fov_y])[0],
            "width": max(1, round(view.width * view.fy / view.fx)),  # the width with square pixels
            "height": view.height,
        }
    return values


def orientation_of(path: PathLike, values: object) -> Orientation:
    """Parses up direction and first view from JSON values. An invalid value is ignored, with a log line.

    Args:
        path: File to name in log lines.
        values: Values as from `orientation_values`, not trusted.
    """
    stated: Mapping[str, Any] = cast("Mapping[str, Any]", values) if isinstance(values, Mapping) else {}
    up = view = None
    if "up" in stated:
        try:
            up = up_vector(stated["up"])
        except SceneError as error:
            _log.warning("%s: %s: not used", os.fspath(path), error)
    if "first_view" in stated:
        try:
            with np.errstate(all="ignore"):  # an overflow makes the camera invalid
                view = _view_of(stated["first_view"])
        except (SceneError, KeyError, TypeError, ValueError, OverflowError) as error:
            _log.warning("%s: its first view is not used: %s", os.fspath(path), _reason(error))
    return Orientation(up, view)


def orientation_of_text(path: PathLike, text: str | bytes) -> Orientation:
    """Parses up direction and first view from JSON text; see `orientation_of`."""
    try:
        return orientation_of(path, json.loads(text))
    except (ValueError, TypeError, RecursionError):
        _log.warning("%s: its up and first view are damaged: not used", os.fspath(path))
        return UNSTATED


def orientation_of_comments(path: PathLike, comments: tuple[str, ...]) -> Orientation:
    """Parses up direction and first view from PLY comments.

    The last comment of each kind counts, and Lumisplat's own comments take precedence over nerfstudio's.
    """
    axes = [match for match in map(_VERTICAL_AXIS.fullmatch, comments) if match]
    ups = [match["numbers"] for match in map(_UP.fullmatch, comments) if match]
    views = [match["values"] for match in map(_FIRST_VIEW.fullmatch, comments) if match]
    stated: dict[str, Any] = {}
    if axes:
        stated["up"] = f"{axes[-1]['axis'].lower()}-{'down' if axes[-1]['sign'] == '-' else 'up'}"
    if ups:
        stated["up"] = ups[-1].split()
        try:
            stated["up"] = [float(number) for number in stated["up"]]
        except ValueError:
            pass  # reported by `orientation_of`
    if views:
        try:
            stated["first_view"] = json.loads(views[-1])
        except (ValueError, RecursionError):
            stated["first_view"] = views[-1]
    return orientation_of(path, stated)


def without_orientation(comments: tuple[str, ...]) -> tuple[str, ...]:
    """Removes PLY comments that state Lumisplat's up direction or first view; `Gaussians` has fields for both."""
    return tuple(line for line in comments if not (_UP.fullmatch(line) or _FIRST_VIEW.fullmatch(line)))


def origin_of_comments(path: PathLike, comments: tuple[str, ...]) -> Vector:
    """Returns the origin in the last comment ``lumisplat origin``; zero if there is none or it is not three numbers."""
    stated = [match["numbers"] for match in map(_ORIGIN.fullmatch, comments) if match]
    try:
        return vector("origin", [float(number) for number in stated[-1].split()]) if stated else (0.0, 0.0, 0.0)
    except (SceneError, ValueError):
        _log.warning("%s: its origin is not three numbers: not used", os.fspath(path))
        return 0.0, 0.0, 0.0


def without_origin(comments: tuple[str, ...]) -> tuple[str, ...]:
    """Removes comments that state an origin."""
    return tuple(line for line in comments if not _ORIGIN.fullmatch(line))


def origin_text(origin: Vector) -> str:
    """Formats an origin for comments and messages so that it reads back exactly."""
    return " ".join(f"{value:.17g}" if float(f"{value:.12g}") != value else f"{value:.12g}" for value in origin)


def comments_with_orientation(gaussians: Gaussians, comments: tuple[str, ...]) -> tuple[str, ...]:
    """Returns PLY comments that state the capture's origin, up direction and first view in place of any older values.

    Comments of other programs that state another up direction are removed.
    """
    comments = without_origin(without_orientation(comments))
    if any(gaussians.origin):
        comments += (f"lumisplat origin {origin_text(gaussians.origin)}",)
    if orientation_of_comments("", comments).up != gaussians.up:
        comments = tuple(line for line in comments if not _VERTICAL_AXIS.fullmatch(line))
        if gaussians.up is not None:
            comments += (f"lumisplat up {' '.join(f'{value:.{_DIGITS}g}' for value in gaussians.up)}",)
    if gaussians.first_view is not None:
        view = orientation_values(None, gaussians.first_view)
        comments += (f"lumisplat first_view {json.dumps(view['first_view'])}",)
    return comments


def _view_of(values: Any) -> Camera:
    """Creates the camera of a first view from its JSON values."""
    return Camera.look_at(
        values["eye"],
        values["target"],
        values["up"],
        fov_y=values["fov_y"],
        width=values["width"],
        height=values["height"],
    )


def _reason(error: Exception) -> str:
    return f"it has no {error}" if isinstance(error, KeyError) else str(error)[:120] or "it is invalid"


def _rounded(values: Any) -> list[float]:
    return [float(f"{value:.{_DIGITS}g}") + 0.0 for value in np.asarray(values, np.float64)]
