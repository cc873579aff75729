"""The viewer: opens a page on a scene."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace

import lumisplat as ls
from lumisplat.viewer.frames.loop import RenderLoop
from lumisplat.viewer.frames.pace import Step
from lumisplat.viewer.frames.page import Page
from lumisplat.viewer.server.page_server import PageServer
from lumisplat.viewer.state.session import Options, Session, State

Progress = Callable[[str, float], None]
Load = Callable[[Progress], State]
"""Loads what is to be seen."""


class Viewer:
    """A page on which a scene is seen and edited, and the threads behind it. `lumisplat.view` makes one.

    Args:
        load: Makes what is seen at first, in a thread of its own: the page opens before.
        host: Address to listen on.
        port: Port; 0: a free one.
        device: Where to render.
        options: How it is shown at first.

    Raises:
        MissingExtraError: The extra ``view`` is not installed.
        DeviceError: The port cannot be opened.
    """

    def __init__(self, load: Load, *, host: str, port: int, device: str, options: Options) -> None:
        self._server = PageServer(host, port)
        self._session = Session(options)
        self._loop = RenderLoop(self._session, device, self._progress, self._on_frame)
        self._pages: dict[int, Page] = {}
        self._closed = threading.Event()
        self._server.viser.on_client_connect(self._open_page)
        self._server.viser.on_client_disconnect(self._close_page)
        self._loader = threading.Thread(target=self._load, args=(load,), name="lumisplat loading", daemon=True)
        self._loader.start()

    @property
    def url(self) -> str:
        """The address of the page, with the token that lets it in."""
        return self._server.guard.url

    @property
    def scene(self) -> ls.Scene:
        """What is seen; assigning another one shows that, which can be undone."""
        return self._session.state.scene

    @scene.setter
    def scene(self, scene: ls.Scene) -> None:
        self._session.edit(replace(self._session.state, scene=scene))

    def wait(self) -> None:
        """Waits until the viewer is closed."""
        self._closed.wait()

    def close(self) -> None:
        """Closes the page, its port and all threads; the second time does nothing."""
        if self._closed.is_set():
            return
        self._closed.set()
        self._loader.join()
        self._loop.close()
        self._server.close()

    def _load(self, load: Load) -> None:
        try:
            state = load(self._progress)
        except ls.LumisplatError as error:
            self._session.report(str(error))
            return
        self._place_camera(state.scene)
        self._session.open(state)
        self._loop.start()

    def _place_camera(self, scene: ls.Scene) -> None:
        """Where new pages look from: at all of the scene, from the front."""

    def _open_page(self, client: object) -> None:
        page = Page(client, self._session.changed)  # pyright: ignore[reportArgumentType]
        self._pages[page.client.client_id] = page
        page.client.camera.on_update(lambda camera: page.look(camera, self._session.units))
        page.look(page.client.camera, self._session.units)
        self._loop.add(page)

    def _close_page(self, client: object) -> None:
        page = self._pages.pop(client.client_id, None)  # pyright: ignore[reportAttributeAccessIssue]
        if page is not None:
            self._loop.remove(page)

    def _progress(self, label: str, fraction: float) -> None:
        pass

    def _on_frame(self, page: Page, step: Step | None, took: float) -> None:
        pass
