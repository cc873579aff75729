"""How the scene is looked at: which image of the frame, how many pixels, what lines."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import lumisplat as ls
from lumisplat.viewer.server.turns import chosen, pressed
from lumisplat.viewer.state.session import Session
from lumisplat.viewer.thresholds import BUDGETS_MS, HEIGHTS

if TYPE_CHECKING:
    import viser


class ViewPanel:
    """Controls of the options, in the present folder.

    Args:
        gui: The pages' controls.
        session: Has the options.
    """

    def __init__(self, gui: viser.GuiApi, session: Session) -> None:
        self._session = session
        options = session.options
        self._view = gui.add_dropdown("view", session.views, initial_value=options.view)
        self._height = gui.add_slider("height (px)", *HEIGHTS, 10, options.height, hint="Of images at rest.")
        self._budget = gui.add_slider(
            "frame time (ms)",
            *BUDGETS_MS,
            5.0,
            options.budget_ms,
            hint="What a frame may take while the view moves: fewer Gaussians are drawn first, then fewer pixels.",
        )
        hint = "Lines where lights are, and how far they reach."
        self._outlines = gui.add_checkbox("outlines", options.outlines, hint=hint)
        self._grid = gui.add_checkbox("grid", options.grid, hint="Lines on the ground, a power of ten apart.")
        self._insets = gui.add_checkbox("insets", options.insets, hint="Depth and normals in the corner.")
        self._splits = gui.add_checkbox(
            "compare", False, hint="The left part shows the scene as it was opened, or marked."
        )
        self._share = gui.add_slider("compare at", 0.0, 1.0, 0.01, 0.5, visible=False)
        self._mark = gui.add_button("mark as before", visible=False, hint="Compare with the scene as it is now.")
        self._splits.on_update(lambda _: self._split())
        self._share.on_update(lambda _: self._split())
        self._mark.on_click(pressed(lambda _: session.mark()))
        for handle, name in (
            (self._view, "view"),
            (self._height, "height"),
            (self._budget, "budget_ms"),
            (self._outlines, "outlines"),
            (self._grid, "grid"),
            (self._insets, "insets"),
        ):
            handle.on_update(chosen(lambda value: (value,), self._putter(handle, name)))
        session.on_change(self._show)

    def _show(self) -> None:
        """Lists the views that there are, and shows the present one."""
        views = self._session.views
        if tuple(self._view.options) != views:
            self._view.options = views
        if self._view.value != self._session.options.view:
            self._view.value = self._session.options.view

    def _split(self) -> None:
        splits = bool(self._splits.value)
        self._share.visible = self._mark.visible = splits
        self._session.set_options(split=float(self._share.value) if splits else None)

    def _putter(self, handle: Any, name: str) -> Callable[[tuple[Any]], None]:
        def put(shown: tuple[Any]) -> None:
            try:
                self._session.set_options(**{name: shown[0]})
            except ls.LumisplatError as error:
                self._session.report(str(error))
                handle.value = getattr(self._session.options, name)

        return put
