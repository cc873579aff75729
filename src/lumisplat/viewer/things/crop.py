"""The crop box of a capture: a slider with two ends for each axis of its file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.viewer.server.turns import chosen
from lumisplat.viewer.state.session import Session

if TYPE_CHECKING:
    import viser

_MARGIN = 0.25
"""How far sliders reach beyond the bulk of a capture, as a share of its size along the axis."""
_STEPS = 400

Ends = npt.NDArray[np.float64]
"""Lowest and highest values, shape (2, 3)."""


class Crop:
    """Controls of a capture's crop box, in the present folder.

    Args:
        gui: The pages' controls.
        session: Has the capture.
        number: Id of its entry.
    """

    def __init__(self, gui: viser.GuiApi, session: Session, number: int) -> None:
        self._session, self._number = session, number
        self._everything, self._reach = crop_reach(session.state.document, number, session)
        self.folder = gui.add_folder("crop", expand_by_default=False)
        with self.folder:
            self._sliders = [self._slider(gui, axis) for axis in range(3)]
            self._numbers = gui.add_markdown("")
        self.show()

    def show(self) -> None:
        """Shows the box that the capture has now."""
        ends = crop_ends(self._session.state.document.entry(self._number), self._reach)
        for axis, slider in enumerate(self._sliders):
            slider.value = (float(ends[0, axis]), float(ends[1, axis]))
        self._numbers.content = crop_table(ends)

    def _slider(self, gui: viser.GuiApi, axis: int) -> Any:
        low, high = (float(end) for end in self._reach[:, axis])
        hint = "In the file's own coordinates; at its ends a slider leaves out nothing."
        step = (high - low) / _STEPS
        slider = gui.add_multi_slider(f"crop {'xyz'[axis]}", low, high, step, (low, high), hint=hint)
        slider.on_update(chosen(lambda value: (axis, *value), self._change))
        return slider

    def _change(self, moved: tuple[Any, ...]) -> None:
        """Crops between the ends of all sliders; that which was moved says where its ends are."""
        ends = np.array([slider.value for slider in self._sliders], np.float64).T
        ends[:, moved[0]] = moved[1:3]
        number, reach, everything = self._number, self._reach, self._everything
        self._session.apply(lambda document: cropped(document, number, ends, reach, everything), merge=f"{number} crop")


def crop_reach(document: ls.SceneDocument, number: int, session: Session) -> tuple[Ends, Ends]:
    """The box around all Gaussians of a capture's file, and that which sliders reach: near its bulk."""
    entry = document.changed(number, crop_low=None, crop_high=None).entry(number)
    means = np.concatenate([np.asarray(instance.gaussians.means, np.float64) for instance in entry.splats])
    everything = np.array([means.min(axis=0), means.max(axis=0)])
    with session.changed:
        box = session.boxes.of(entry)
    assert box is not None
    margin = np.maximum(_MARGIN * (box[1] - box[0]), 1e-6)
    return everything, np.array([box[0] - margin, box[1] + margin])


def crop_ends(entry: ls.SceneEntry, reach: Ends) -> Ends:
    """Where the sliders of a capture stand."""
    low, high = entry.table.get("crop_low"), entry.table.get("crop_high")
    if low is None or high is None:
        return reach
    return np.clip([low, high], reach[0], reach[1])


def crop_table(ends: Ends) -> str:
    """Where sliders stand, in numbers."""
    rows = [f"| {'xyz'[axis]} | {ends[0, axis]:.4g} | {ends[1, axis]:.4g} |" for axis in range(3)]
    return "\n".join(["| | from | to |", "| --- | ---: | ---: |", *rows])


def cropped(document: ls.SceneDocument, number: int, ends: Ends, reach: Ends, everything: Ends) -> ls.SceneDocument:
    """The document with a capture cropped to what is between the ends of sliders.

    Args:
        document: The scene.
        number: Id of the capture's entry.
        ends: Where sliders stand.
        reach: How far they go; one that stands there leaves nothing out on its side.
        everything: The box around all Gaussians.

    Raises:
        FormatError: Nothing would be left.
    """
    tolerance = (reach[1] - reach[0]) / _STEPS
    is_open = np.abs(ends - reach) < tolerance
    if is_open.all():
        return document.changed(number, crop_low=None, crop_high=None)
    outside = np.array(
        [np.minimum(everything[0], reach[0]) - tolerance, np.maximum(everything[1], reach[1]) + tolerance]
    )
    low, high = np.where(is_open, outside, ends)
    return document.changed(number, crop_low=low, crop_high=high)
