"""Draws overlays on frames: outlines of lights and of the selected object, a ground grid, and insets."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

import lumisplat as ls
from lumisplat.viewer.frames.page import Picture
from lumisplat.viewer.scene_extent import pose_of, world_corners
from lumisplat.viewer.session import Session

_LIGHT_SIZE = 0.03
"""Size of the symbol drawn for a point or spot light, as a fraction of the scene size."""
_POINT_SIZE = 0.008
"""Radius of the mark at each clicked ground point, as a fraction of the scene size."""
_INSETS = ("depth", "normal")


def with_overlays(picture: Picture, frame: ls.Frame, session: Session) -> Picture:
    """Returns an image of a frame with the outlines, grid and insets that the session's view options switch on."""
    with session.changed:
        options = session.options
        outlines = _outlines(session) if options.outlines else []
        if session.ground_points:
            outlines.append(points_outline(session.ground_points, _POINT_SIZE * session.extent.size))
        if options.grid:
            outlines.append(_grid(session))
    if outlines and len(picture) < options.height:  # draws lines of a moving view at full resolution
        size = round(picture.shape[1] * options.height / len(picture)), options.height
        picture = np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BILINEAR))
    picture = draw_outlines(picture, frame, outlines)
    return frame.with_insets(_INSETS, picture) if options.insets and options.view == "color" else picture


def _outlines(session: Session) -> list[Outline]:
    """Returns the outlines of visible lights, the dome of a selected sun, and the selected object's bounding box."""
    document, size = session.state.document, _LIGHT_SIZE * session.extent.size
    lights = [entry for entry in document.entries if entry.kind == "lights" and not entry.hidden]
    time = session.options.time
    found = [light_outline(one.lights_at(time)[0], size, is_selected=one.id == session.selected) for one in lights]
    selected = session.selected_entry
    if selected in lights and isinstance(sun := selected.lights_at(time)[0], ls.LightDirectional):
        extent = session.extent
        found.append(sun_outline(sun, extent.center, extent.dome_radius, session.scene.up_direction))
    return [outline for outline in found if outline is not None] + _selection(session)


def _selection(session: Session) -> list[Outline]:
    """Returns the selected object's bounding box as a list of one outline; an empty list if there is no box."""
    entry, time = session.selected_entry, session.options.time
    if entry is None or entry.hidden:
        return []
    box, pose = session.boxes.of(entry, time), pose_of(entry, time)
    return [] if box is None or pose is None else [box_outline(world_corners(box, pose))]


def _grid(session: Session) -> Outline:
    """Returns a grid on the ground plane: perpendicular to the up direction, through the scene's lowest point."""
    extent, up = session.extent, np.array(session.scene.up_direction)
    return grid_outline(np.array(extent.center) - extent.height_below * up, up, 1.5 * extent.size)


Points = npt.NDArray[np.float64]
"""World positions of the corners of a polyline, shape (N, 3)."""

_CIRCLE = 48
_PIECES = 24
"""Number of segments into which a straight line is divided; each is drawn as visible or as hidden."""
_HIDDEN_STRENGTH = 0.3
"""Opacity of outline segments that lie behind a surface of the frame."""
_FARTHEST_PX = 1e5
"""Largest absolute pixel coordinate of a segment's ends; a segment with an end farther outside is not drawn."""
_SELECTED = (255, 176, 32)
_OTHERS = (150, 150, 150)
_GRID = (90, 110, 130)


@dataclass(frozen=True)
class Outline:
    """Polylines in world space that outline one object, and their colour."""

    lines: tuple[Points, ...]
    color: tuple[int, int, int]


def light_outline(light: Any, size: float, *, is_selected: bool) -> Outline | None:
    """Returns the outline of a light; None for lights without a position: directional lights and environments.

    Args:
        light: The light.
        size: Size of the symbol of a light without an area, scene units.
        is_selected: True also draws the spot cone and the range; False draws only position and area.
    """
    color = _SELECTED if is_selected else _OTHERS
    match light:
        case ls.LightDirectional() | ls.LightEnvironment():
            return None
        case ls.LightSpot():
            lines = _wire_sphere(light.position, light.radius or 0.35 * size) + (
                _cone_lines(light, size) if is_selected else ()
            )
        case ls.LightPoint() | ls.LightSphere():
            lines = _wire_sphere(light.position, light.radius or 0.5 * size)
            if is_selected and isinstance(light, ls.LightPoint) and math.isfinite(light.range):
                lines += _wire_sphere(light.position, light.range)
        case _:
            lines = _area_light_lines(light)
    return Outline(lines, color)


def sun_outline(light: ls.LightDirectional, center: npt.ArrayLike, radius: float, up: npt.ArrayLike) -> Outline:
    """Returns the dome on which a sun is dragged: horizon, arc through the zenith, and the ray to the centre.

    Args:
        light: The sun.
        center: Centre of the dome, world space.
        radius: Radius of the dome, scene units.
        up: Up direction, a unit vector.
    """
    middle, vertical, towards = np.asarray(center, np.float64), np.asarray(up, np.float64), -np.array(light.direction)
    level = towards - (towards @ vertical) * vertical
    length = float(np.linalg.norm(level))
    level = level / length if length > 1e-6 else _perpendicular_axes(vertical)[0]
    angles = np.linspace(0.0, math.pi, _CIRCLE + 1)[:, None]
    arc = middle + radius * (np.cos(angles) * level + np.sin(angles) * vertical)
    sun = middle + radius * towards
    ray = _line_points(sun, middle)
    lines = (_circle(middle, radius, vertical), arc, ray, *_wire_sphere(sun, 0.05 * radius))
    return Outline(lines, _SELECTED)


def points_outline(points: Sequence[npt.ArrayLike], size: float) -> Outline:
    """Returns marks at the clicked ground points and lines between them.

    Args:
        points: World positions.
        size: Radius of the marks, scene units.
    """
    marks = [circle for point in points for circle in _wire_sphere(point, size)]
    return Outline((*marks, *(_line_points(a, b) for a, b in itertools.pairwise(points))), _SELECTED)


def box_outline(corners: npt.ArrayLike) -> Outline:
    """Returns the twelve edges of a box as an outline.

    Args:
        corners: Corners in world space, in the order of `world_corners`, shape (8, 3).
    """
    at = np.asarray(corners, np.float64)
    pairs = [(a, a | 1 << axis) for a in range(8) for axis in range(3) if not a >> axis & 1]
    return Outline(tuple(_line_points(at[a], at[b]) for a, b in pairs), _SELECTED)


def grid_outline(center: npt.ArrayLike, up: npt.ArrayLike, size: float) -> Outline:
    """Returns a square grid on the ground; the distance between its lines is a power of ten, scene units.

    Args:
        center: Point on the ground, world space.
        up: Unit normal of the ground.
        size: Side length of the grid, scene units.
    """
    step = 10.0 ** math.floor(math.log10(size / 4.0))
    count = round(0.5 * size / step)
    u, v = _perpendicular_axes(up)
    middle, reach = np.asarray(center, np.float64), count * step
    lines = [
        _line_points(middle + offset * step * a - reach * b, middle + offset * step * a + reach * b, 4 * _PIECES)
        for a, b in ((u, v), (v, u))
        for offset in range(-count, count + 1)
    ]
    return Outline(tuple(lines), _GRID)


def draw_outlines(
    picture: npt.NDArray[np.uint8], frame: ls.Frame, outlines: Sequence[Outline]
) -> npt.NDArray[np.uint8]:
    """Returns an image of a frame with outlines drawn on it, fainter behind surfaces; the image may be enlarged."""
    if not outlines:
        return picture
    image, scale = Image.fromarray(picture), len(picture) / frame.camera.height
    for outline in outlines:
        mask = Image.new("L", image.size)  # a mask, so that crossing lines are not brighter
        draw = ImageDraw.Draw(mask)
        hidden, seen = (scale * pieces for pieces in _split_by_visibility(frame, outline.lines))
        for strength, pieces in ((_HIDDEN_STRENGTH, hidden), (1.0, seen)):
            for ends in pieces.tolist():
                draw.line(ends, fill=round(255 * strength))
        image.paste(outline.color, mask=mask)
    return np.asarray(image)


def _split_by_visibility(frame: ls.Frame, lines: Sequence[Points]) -> tuple[Points, Points]:
    """Projects polylines to the image, and divides their segments into hidden and visible ones.

    Returns the hidden, then the visible segments: end points in pixels (x0, y0, x1, y1), shape (N, 4) for N segments.
    """
    camera, points = frame.camera, np.concatenate(lines)
    local = points @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
    depth = np.maximum(local[:, 2], camera.near)
    pixels = local[:, :2] / depth[:, None] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    is_drawn = (local[:, 2] > camera.near) & (np.abs(pixels).max(axis=1) < _FARTHEST_PX)
    is_seen = _is_visible(frame, pixels, np.linalg.norm(local, axis=1))
    joined = is_drawn[:-1] & is_drawn[1:]
    joined[np.cumsum([len(line) for line in lines])[:-1] - 1] = False  # the end of a line does not join the next line
    seen, ends = is_seen[:-1] & is_seen[1:], np.hstack([pixels[:-1], pixels[1:]])
    return ends[joined & ~seen], ends[joined & seen]


def _is_visible(frame: ls.Frame, pixels: Points, distances: Points) -> npt.NDArray[np.bool_]:
    """True for each point that is no farther from the camera than the frame's surface in its pixel.

    Args:
        frame: The frame, with its distance image ``depth``.
        pixels: Image coordinates of N points, shape (N, 2).
        distances: Distances of the points from the camera, scene units, shape (N,).
    """
    height, width = frame.alpha.shape
    x = np.clip(pixels[:, 0], 0, width - 1).astype(int)
    y = np.clip(pixels[:, 1], 0, height - 1).astype(int)
    return distances <= frame.depth[y, x]


def _line_points(start: npt.ArrayLike, end: npt.ArrayLike, pieces: int = _PIECES) -> Points:
    return np.linspace(np.asarray(start, np.float64), np.asarray(end, np.float64), pieces + 1)


def _circle(center: npt.ArrayLike, radius: float, axis: npt.ArrayLike) -> Points:
    u, v = _perpendicular_axes(axis)
    angles = np.linspace(0.0, 2.0 * math.pi, _CIRCLE + 1)[:, None]
    return np.asarray(center) + radius * (np.cos(angles) * u + np.sin(angles) * v)


def _perpendicular_axes(axis: npt.ArrayLike) -> tuple[Points, Points]:
    """Returns two unit vectors perpendicular to an axis and to each other."""
    along = np.asarray(axis, np.float64)
    along = along / np.linalg.norm(along)
    other = np.eye(3)[int(np.argmin(np.abs(along)))]
    u: Any = np.cross(along, other)
    u /= np.linalg.norm(u)
    v: Any = np.cross(along, u)
    return u, v


_UNIT_CIRCLES = tuple(_circle(np.zeros(3), 1.0, axis) for axis in np.eye(3))
"""Unit circles about the x, y and z axis."""


def _wire_sphere(center: npt.ArrayLike, radius: float) -> tuple[Points, ...]:
    return tuple(np.asarray(center) + radius * circle for circle in _UNIT_CIRCLES)


def _cone_lines(light: ls.LightSpot, size: float) -> tuple[Points, ...]:
    """Returns a spot light's outline: four edges and end circle of the outer cone, end circle of the inner cone.

    The cone is as long as the light's range; without a range, six times ``size``, the symbol size of lights.
    """
    length = light.range if math.isfinite(light.range) else 6.0 * size
    position, along = np.array(light.position), np.array(light.direction)
    lines: list[Points] = []
    for angle in (light.outer_angle, light.inner_angle):
        if angle > 0.0:
            reach = length * math.cos(angle)
            lines.append(_circle(position + reach * along, length * math.sin(angle), along))
    u, v = _perpendicular_axes(along)
    for side in (u, -u, v, -v):
        edge = math.cos(light.outer_angle) * along + math.sin(light.outer_angle) * side
        lines.append(_line_points(position, position + length * edge))
    return tuple(lines)


def _area_light_lines(light: Any) -> tuple[Points, ...]:
    """Returns an area light's boundary and a line from its centre along the emission direction."""
    corners, normal, center = light.boundary(), light.area_vector, np.array(light.position)
    normal = 0.25 * normal / math.sqrt(np.linalg.norm(normal))
    pieces = max(1, 4 * _PIECES // len(corners))
    sides = (_line_points(a, b, pieces) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True))
    return (*sides, _line_points(center, center + normal))
