"""What is drawn on a picture besides the scene: lights, the selected thing, the ground, and insets."""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageOps

import lumisplat as ls
from lumisplat.viewer.frames.picture import Picture
from lumisplat.viewer.hands.outlines import (
    Outline,
    box_outline,
    draw_outlines,
    grid_outline,
    light_outline,
    points_outline,
    sun_outline,
)
from lumisplat.viewer.state.boxes import pose_of, world_corners
from lumisplat.viewer.state.session import Session

_LIGHT_SIZE = 0.03
"""Of marks of lights without a size, as a share of the scene's."""
_POINT_SIZE = 0.008
"""Of marks of points that were clicked, likewise."""
_INSETS = ("depth", "normal")
_INSET_SHARE = 0.22
"""Height of an inset, as a share of the picture's."""
_INSET_GAP = 8
_INSET_FRAME = (110, 110, 110)


def decorated(picture: Picture, frame: ls.Frame, session: Session) -> Picture:
    """A picture with what the options of the session ask for."""
    with session.changed:
        options = session.options
        outlines = _outlines(session) if options.outlines else []
        if session.ground_points:
            outlines.append(points_outline(session.ground_points, _POINT_SIZE * session.extent.size))
        if options.grid:
            outlines.append(_grid(session))
    if outlines and len(picture) < options.height:  # lines of a view that moves are as fine as those of one at rest
        size = round(picture.shape[1] * options.height / len(picture)), options.height
        picture = np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BILINEAR))
    picture = draw_outlines(picture, frame, outlines)
    return with_insets(picture, frame) if options.insets and options.view == "color" else picture


def _outlines(session: Session) -> list[Outline]:
    """Lines of all lights, and around what is selected."""
    document, size = session.state.document, _LIGHT_SIZE * session.extent.size
    lights = [entry for entry in document.entries if entry.kind == "lights" and not entry.hidden]
    found = [light_outline(entry.lights[0], size, is_selected=entry.id == session.selected) for entry in lights]
    selected = session.selected_entry
    if selected in lights and isinstance(sun := selected.lights[0], ls.LightDirectional):
        extent = session.extent
        found.append(sun_outline(sun, extent.center, extent.dome_radius, session.scene.up_direction))
    return [outline for outline in found if outline is not None] + _selection(session)


def _selection(session: Session) -> list[Outline]:
    """The box around the selected thing."""
    entry, time = session.selected_entry, session.options.time
    if entry is None or entry.hidden:
        return []
    box, pose = session.boxes.of(entry, time), pose_of(entry, time)
    return [] if box is None or pose is None else [box_outline(world_corners(box, pose))]


def _grid(session: Session) -> Outline:
    """The ground: at the bottom of what was opened, at right angles to up."""
    extent, up = session.extent, np.array(session.scene.up_direction)
    return grid_outline(np.array(extent.center) - extent.height_below * up, up, 1.5 * extent.size)


def with_insets(picture: Picture, frame: ls.Frame) -> Picture:
    """A picture with small framed ones of its depth and its normals in the lower left corner, away from panels."""
    height, width = picture.shape[:2]
    rows, columns = round(_INSET_SHARE * height), round(_INSET_SHARE * width)
    image = Image.fromarray(picture)
    for number, view in enumerate(_INSETS):
        inset = Image.fromarray((255.0 * frame.view(view) + 0.5).astype(np.uint8)).resize((columns, rows))
        framed = ImageOps.expand(inset, border=1, fill=_INSET_FRAME)
        image.paste(framed, (_INSET_GAP + number * (framed.width + _INSET_GAP), height - framed.height - _INSET_GAP))
    return np.asarray(image)
