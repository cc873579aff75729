"""The outliner: a row for each scene object, to be clicked, hidden and locked, and below it the parts of files."""

from __future__ import annotations

import html

import lumisplat as ls
from lumisplat.viewer.panels.buttons import button, icon
from lumisplat.viewer.state.boxes import Boxes

KIND_NAMES = {"splats": "capture", "meshes": "mesh", "actors": "actor", "environment": "environment"}
_PARTS_MAX = 8
"""Parts of a file that are listed; of the others, how many there are."""


def tree_html(
    document: ls.SceneDocument,
    boxes: Boxes,
    selected: int | None = None,
    time: float = 0.0,
    *,
    locked: frozenset[int] = frozenset(),
    channel: str = "",
) -> str:
    """All entries of a document, with what could not be read, as HTML in which names are words alone.

    Args:
        document: The scene.
        boxes: Around its entries.
        selected: Id of the entry that stands out.
        time: Of the animation, seconds.
        locked: Ids of entries that cannot be edited.
        channel: Id of the text control that gets what is clicked: ``select``, ``hide`` or ``lock``, and the entry's id.
    """
    rows: list[str] = []
    for entry in document.entries:
        rows.append(_entry_row(entry, is_selected=entry.id == selected, is_locked=entry.id in locked))
        rows += [_detail(detail) for detail in _details(entry, boxes, time)]
        rows += [_detail(f"└ {part}") for part in _parts(document, entry)]
    if not rows:
        rows.append(_detail("nothing yet: add something below"))
    rows += [f'<div class="lumi-problem">left out: {html.escape(problem)}</div>' for problem in document.problems]
    return f'<div class="lumi-list" data-to="{html.escape(channel)}">{"".join(rows)}</div>'


def kind_name(entry: ls.SceneEntry) -> str:
    """What people call an object of its kind."""
    if entry.kind != "lights":
        return KIND_NAMES[entry.kind]
    return "sun" if entry.table["type"] == "directional" else f"{entry.table['type']} light"


def _entry_row(entry: ls.SceneEntry, *, is_selected: bool, is_locked: bool) -> str:
    """The row of an entry."""
    sun = entry.kind == "lights" and entry.table["type"] == "directional"
    states = " selected" * is_selected + " hidden" * entry.hidden
    eye, padlock = "hidden" if entry.hidden else "shown", "locked" if is_locked else "open"
    hide = button(f"hide {entry.id}", eye, "show" if entry.hidden else "hide", is_on=entry.hidden)
    lock = button(f"lock {entry.id}", padlock, "unlock" if is_locked else "lock", is_on=is_locked)
    kind = html.escape(kind_name(entry))
    return (
        f'<div class="lumi-row{states}" title="{kind}">{icon("directional" if sun else entry.kind)}'
        f'<span class="lumi-name" role="button" tabindex="0" data-say="select {entry.id}">{html.escape(entry.name)}'
        f"</span>{hide}{lock}</div>"
    )


def _detail(text: str) -> str:
    return f'<div class="lumi-detail">{html.escape(text)}</div>'


def _details(entry: ls.SceneEntry, boxes: Boxes, time: float) -> list[str]:
    """How much it is, and how large."""
    instances = entry.at(time)
    gaussians = sum(i.gaussians.count for i in instances if isinstance(i, ls.SplatInstance))
    faces = sum(i.mesh.face_count for i in instances if isinstance(i, ls.MeshInstance))
    parts = [kind_name(entry)]
    parts += [f"{gaussians:,} Gaussians"] * bool(gaussians) + [f"{faces:,} faces"] * bool(faces)
    size = boxes.size(entry, time)
    if size is not None:
        parts.append(" × ".join(f"{length:.3g}" for length in size))
    return [" · ".join(parts)]


def _parts(document: ls.SceneDocument, entry: ls.SceneEntry) -> list[str]:
    """The meshes of an entry's file, if there are several."""
    names = document.part_names(entry.id) if len(entry.meshes) > 1 else []
    listed = [name or f"part {number}" for number, name in enumerate(names[:_PARTS_MAX])]
    return [*listed, f"{len(names) - _PARTS_MAX} more"] if len(names) > _PARTS_MAX else listed
