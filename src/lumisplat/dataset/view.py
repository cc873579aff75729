"""One view of a data set."""

from __future__ import annotations

from dataclasses import dataclass

from lumisplat.dataset.things import DatasetThing
from lumisplat.scene.camera import Camera
from lumisplat.scene.scene import Scene


@dataclass(frozen=True, eq=False, kw_only=True)
class DatasetView:
    """A view: what is to be rendered, from where, and what of it is known."""

    index: int
    """Its number, from 0."""
    split: str
    """``train``, ``val`` or ``test``."""
    scene: Scene
    """With its lights and objects."""
    camera: Camera
    things: tuple[DatasetThing, ...]
    """What there is, in the order of ids, seen or not."""
    left_out: tuple[str, ...] = ()
    """Names of objects that found no room."""

    @property
    def name(self) -> str:
        """Stem of its files."""
        return self.camera.name
