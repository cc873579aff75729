"""Controls of the render settings: the most used ones first, all others in a folder below them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import lumisplat as ls
from lumisplat.viewer.panels.controls import SettingsPanel, set_unused
from lumisplat.viewer.server.event_queue import value_callback
from lumisplat.viewer.session import Session, unused_settings

if TYPE_CHECKING:
    import viser

_FIRST = ("pipeline", "shadows", "tone_map", "samples", "noise", "background")
_QUALITY = ("quality",)
_EXPOSURE_STOPS = 8.0
_EXPOSURE_HINT = "Exposure of lit images, in stops (EV)."


class RenderingPanel:
    """Controls of the render settings, in viser's open GUI folder.

    Args:
        gui: Controls of the pages.
        session: Session to edit.
    """

    def __init__(self, gui: viser.GuiApi, session: Session) -> None:
        self._session = session
        config = session.state.config
        self._first = SettingsPanel(gui, config, self._put, session.report, only=_FIRST)
        self._quality = SettingsPanel(gui, config.realtime, self._put_realtime, session.report, only=_QUALITY)
        stops = _EXPOSURE_STOPS
        self._exposure = gui.add_slider("exposure", -stops, stops, 0.1, 0.0, hint=_EXPOSURE_HINT)
        self._exposure.on_update(value_callback(float, self._put_exposure))
        with gui.add_folder("all settings", expand_by_default=False):
            self._rest = SettingsPanel(gui, config, self._put, session.report, without=(*_FIRST, "aovs"))
        self._actors = gui.add_folder("actor lighting", expand_by_default=False, visible=False)
        with self._actors:
            self._lighting = SettingsPanel(gui, ls.config.AvatarLightingConfig(), self._put_lighting, session.report)
        self._top: object = None
        session.on_change(self._show)

    def _put(self, change: Callable[[ls.RenderConfig], ls.RenderConfig], field: str | None) -> None:
        self._session.configure(change, merge=None if field is None else f"config {field}")

    def _put_realtime(self, change: Callable[[ls.RealtimeConfig], ls.RealtimeConfig], field: str | None) -> None:
        self._put(lambda config: replace(config, realtime=change(config.realtime)), field)

    def _put_lighting(self, change: Callable[[Any], ls.config.AvatarLightingConfig], field: str | None) -> None:
        self._session.apply(
            lambda document: document.with_animation(lighting=change(_lighting(document))),
            merge=None if field is None else f"lighting {field}",
        )

    def _put_exposure(self, exposure: float) -> None:
        self._session.edit(lambda state: replace(state, exposure=exposure), merge="exposure")

    def _show(self) -> None:
        state = self._session.state
        self._first.show(state.config)
        self._rest.show(state.config)
        self._quality.show(state.config.realtime)
        self._exposure.value = state.exposure
        unused = unused_settings(state.config, lit=self._session.is_lit)
        self._first.set_unused(unused)
        self._rest.set_unused(unused)
        self._quality.set_visible("realtime" not in unused)
        set_unused(self._exposure, _EXPOSURE_HINT, unused.get("exposure"))
        self._actors.visible = any(entry.actor is not None for entry in state.document.entries)
        if self._actors.visible and self._top is not state.document.top:
            self._top = state.document.top
            self._lighting.show(_lighting(state.document))


def _lighting(document: ls.io.SceneDocument) -> ls.config.AvatarLightingConfig:
    """Returns how the document's actors are lit; the default settings if the document does not say."""
    animation = document.animation
    return ls.config.AvatarLightingConfig() if animation is None else animation.lighting
