"""The list of all things as people read it: names, kinds, counts, sizes, and the parts of files."""

from __future__ import annotations

import html

import lumisplat as ls
from lumisplat.viewer.state.boxes import Boxes

KIND_NAMES = {"splats": "capture", "meshes": "mesh", "actors": "actor", "environment": "sky"}
_PARTS_MAX = 8
"""Parts of a file that are listed; of the others, how many there are."""

_ROW = '<div style="display:flex;justify-content:space-between;{style}"><span>{left}</span><span>{right}</span></div>'
_DIM = "opacity:0.6;font-size:0.85em;"


def tree_html(document: ls.SceneDocument, boxes: Boxes, selected: int | None = None, time: float = 0.0) -> str:
    """All entries of a document, with what could not be read, as HTML in which names are words alone.

    Args:
        document: The scene.
        boxes: Around its entries.
        selected: Id of the entry that stands out.
        time: Of the animation, seconds.
    """
    rows: list[str] = []
    for entry in document.entries:
        style = "font-weight:600;" * (entry.id == selected) + "text-decoration:line-through;" * entry.hidden
        rows.append(_row(entry.name, kind_name(entry), f"margin-top:0.4em;{style}"))
        rows += [_row(detail, "", _DIM) for detail in _details(entry, boxes, time)]
        rows += [_row(f"└ {part}", "", _DIM) for part in _parts(document, entry)]
    if not rows:
        rows.append(_row("nothing yet: add something below", ""))
    rows += [_row(f"left out: {problem}", "", "color:#e5534b;margin-top:0.4em;") for problem in document.problems]
    return f'<div style="padding:0 0.75em;font-size:0.875em;overflow-wrap:anywhere">{"".join(rows)}</div>'


def kind_name(entry: ls.SceneEntry) -> str:
    """What people call a thing of its kind."""
    return f"{entry.table['type']} light" if entry.kind == "lights" else KIND_NAMES[entry.kind]


def _row(left: str, right: str, style: str = "") -> str:
    return _ROW.format(left=html.escape(left), right=html.escape(right), style=style)


def _details(entry: ls.SceneEntry, boxes: Boxes, time: float) -> list[str]:
    """How much it is, and how large."""
    instances = entry.at(time)
    gaussians = sum(i.gaussians.count for i in instances if isinstance(i, ls.SplatInstance))
    faces = sum(i.mesh.face_count for i in instances if isinstance(i, ls.MeshInstance))
    parts = [f"{gaussians:,} Gaussians"] * bool(gaussians) + [f"{faces:,} faces"] * bool(faces)
    size = boxes.size(entry, time)
    if size is not None:
        parts.append(" × ".join(f"{length:.3g}" for length in size))
    return [" · ".join(parts)] if parts else []


def _parts(document: ls.SceneDocument, entry: ls.SceneEntry) -> list[str]:
    """The meshes of an entry's file, if there are several."""
    names = document.part_names(entry.id) if len(entry.meshes) > 1 else []
    listed = [name or f"part {number}" for number, name in enumerate(names[:_PARTS_MAX])]
    return [*listed, f"{len(names) - _PARTS_MAX} more"] if len(names) > _PARTS_MAX else listed
