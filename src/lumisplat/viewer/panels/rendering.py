"""How the scene is rendered: the settings that people change most, and all others below."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import lumisplat as ls
from lumisplat.viewer.panels.settings import SettingsPanel
from lumisplat.viewer.state.session import Session

if TYPE_CHECKING:
    import viser

_FIRST = ("pipeline", "shadows", "tone_map", "samples", "noise", "background")
_QUALITY = ("quality",)
_EXPOSURE_STOPS = 8.0


class RenderingPanel:
    """Controls of the settings, in the present folder.

    Args:
        gui: The pages' controls.
        session: Has the settings.
    """

    def __init__(self, gui: viser.GuiApi, session: Session) -> None:
        self._session = session
        config = session.state.config
        self._first = SettingsPanel(gui, config, self._put, session.report, only=_FIRST)
        self._quality = SettingsPanel(gui, config.realtime, self._put_realtime, session.report, only=_QUALITY)
        self._exposure = gui.add_slider(
            "exposure", -_EXPOSURE_STOPS, _EXPOSURE_STOPS, 0.1, 0.0, hint="Stops by which lit pictures are brightened."
        )
        self._exposure.on_update(self._put_exposure)
        with gui.add_folder("all settings", expand_by_default=False):
            self._rest = SettingsPanel(gui, config, self._put, session.report, without=(*_FIRST, "aovs"))
        self._actors = gui.add_folder("light of actors", expand_by_default=False, visible=False)
        with self._actors:
            self._lighting = SettingsPanel(gui, ls.AvatarLightingConfig(), self._put_lighting, session.report)
        self._top: object = None
        session.on_change(self._show)

    def _put(self, config: ls.RenderConfig, field: str) -> None:
        self._session.configure(config, merge=f"config {field}")

    def _put_realtime(self, realtime: ls.RealtimeConfig, field: str) -> None:
        self._put(replace(self._session.state.config, realtime=realtime), f"realtime.{field}")

    def _put_lighting(self, lighting: ls.AvatarLightingConfig, field: str) -> None:
        self._session.apply(lambda document: document.with_animation(lighting=lighting), merge=f"lighting {field}")

    def _put_exposure(self, event: Any) -> None:
        if event.client_id is not None:
            self._session.edit(replace(self._session.state, exposure=float(self._exposure.value)), merge="exposure")

    def _show(self) -> None:
        state = self._session.state
        self._first.show(state.config)
        self._rest.show(state.config)
        self._quality.show(state.config.realtime)
        self._exposure.value = state.exposure
        self._quality.set_visible(state.config.pipeline is ls.Pipeline.REALTIME)
        self._actors.visible = any(entry.actor is not None for entry in state.document.entries)
        if self._actors.visible and self._top is not state.document.top:
            self._top = state.document.top
            animation = state.document.animation
            self._lighting.show(ls.AvatarLightingConfig() if animation is None else animation.lighting)
