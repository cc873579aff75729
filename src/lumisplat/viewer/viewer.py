"""The viewer: connects page server, render loop and panels; `lumisplat.view` opens one."""

from __future__ import annotations

import logging
import os
import threading
import traceback
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.viewer.frames.loop import RenderLoop
from lumisplat.viewer.frames.page import BrowserScreen, Page, Picture
from lumisplat.viewer.frames.pose import ASPECT, FirstView, Pose, move_page_to
from lumisplat.viewer.frames.scene_builder import Progress
from lumisplat.viewer.gizmo import Gizmo
from lumisplat.viewer.notebook import Bundle, Notebook
from lumisplat.viewer.overlays import with_overlays
from lumisplat.viewer.panels.background_jobs import BackgroundJobs, JobContext, StillRenderer
from lumisplat.viewer.panels.buttons import add_buttons
from lumisplat.viewer.panels.files import FilesPanel, ImagesPanel
from lumisplat.viewer.panels.outliner import Outliner
from lumisplat.viewer.panels.rendering import RenderingPanel
from lumisplat.viewer.panels.status import QUIET_LOG, Notifications, StatusPanel
from lumisplat.viewer.panels.video import VideoPanel
from lumisplat.viewer.panels.viewing import RayPanel, Timeline, ViewPanel, Viewpoints
from lumisplat.viewer.picking import select
from lumisplat.viewer.server.event_queue import press_callback
from lumisplat.viewer.server.page_server import PageServer
from lumisplat.viewer.session import Options, Session, State
from lumisplat.viewer.thresholds import INTERRUPT_S

if TYPE_CHECKING:
    import viser


_log = logging.getLogger("lumisplat")

_STEEP_COSINE = 0.94
"""Cosine of the angle, about 20 degrees, between view direction and vertical. A camera that looks more steeply up or
down is moved to the first view when the up direction changes, as a roll cannot make it upright.
"""

Load = Callable[[Progress], State]
"""Function that loads a scene into a `State`: the document, render settings and exposure. It reports its progress."""


class Viewer:
    """Web page that shows and edits a scene, with its server and render threads. Call `lumisplat.view` to create one.

    Args:
        load: Returns the first state. It runs in a thread of its own, so that the page opens before loading ends.
        host: Address to listen on.
        port: Port to listen on; 0 takes a free one.
        device: Device that renders, as in `lumisplat.create_renderer`.
        options: View options at the start.

    Raises:
        MissingExtraError: The extra ``view`` is not installed.
        DeviceError: The port cannot be opened.
    """

    def __init__(self, load: Load, *, host: str, port: int, device: str, options: Options) -> None:
        self._server = PageServer(host, port)
        threading.Thread(target=_preload_renderer, name="lumisplat imports", daemon=True).start()
        self._viser = self._server.viser
        self._session = Session(options)
        self._pages: dict[int, Page] = {}
        self._looking = threading.Lock()
        """Held while a camera is read and stored, so that no thread stores an older pose after a newer one."""
        self._is_closed = False
        self._closed_or_failed = threading.Event()
        self._failure: Exception | None = None
        """Error that ended loading; None if nothing failed."""
        self._first_view = FirstView()
        self._viser.initial_camera.position, self._viser.initial_camera.look_at = self._first_view.at(ASPECT)
        self._notifications = Notifications(self._viser)
        self._status = StatusPanel(self._viser.gui)
        self._loop = RenderLoop(
            self._session,
            device,
            self._status.progress,
            on_frame=self._status.frame,
            overlay=self._with_overlays,
            on_levels=self._status.levels,
        )
        self._notebook = Notebook(self._session, self._loop, self.url)
        self._build_panels(device)
        self._gizmo = Gizmo(self._viser.scene, self._session)
        self._session.error_listeners.append(self._notifications.problem)
        self._session.on_change(self._update_up)
        self._viser.on_client_connect(self._open_page)
        self._viser.on_client_disconnect(self._close_page)
        self._loader = threading.Thread(target=self._load, args=(load,), name="lumisplat loading", daemon=True)
        self._loader.start()

    def __repr__(self) -> str:
        return "Viewer(closed)" if self._is_closed else f"Viewer({self.url})"

    def _repr_mimebundle_(
        self, include: Collection[str] | None = None, exclude: Collection[str] | None = None
    ) -> Bundle:
        """Returns what a notebook displays for the viewer: live frames, else a still image, else text. Never raises."""
        self._loader.join()
        if self._is_closed:
            return {"text/plain": repr(self)}, {}
        try:
            if self._failure is not None:
                raise self._failure
            return self._notebook.bundle(repr(self), self._first_view, include, exclude)
        except Exception as error:  # a notebook would show a traceback instead of the result
            return {"text/plain": f"{self!r} (no image: {error})"}, {}

    @property
    def url(self) -> str:
        """Address of the page, including the access token."""
        return self._server.guard.url

    @property
    def scene(self) -> ls.Scene:
        """The scene with all edits, at the current animation time."""
        return self._session.scene

    @property
    def document(self) -> ls.io.SceneDocument:
        """The edited scene document; `lumisplat.io.SceneDocument.save` writes it to a file."""
        return self._session.state.document

    def show(self, scene: ls.Scene | ls.io.SceneDocument) -> None:
        """Replaces the scene on all pages, as an edit that users can undo.

        Args:
            scene: The scene or document to show.

        Raises:
            SceneError: The argument is not a scene.
        """
        self._loader.join()
        document = scene if isinstance(scene, ls.io.SceneDocument) else ls.io.SceneDocument.of(scene)
        with self._session.changed:
            self._session.edit(lambda state: replace(state, document=document))
            self._session.select(None)

    def wait(self) -> None:
        """Blocks until the viewer is closed.

        Raises:
            LumisplatError: Loading failed, so there is no scene to show.
        """
        # Waits in intervals, because an interrupt just before an endless wait would be lost.
        while not self._closed_or_failed.wait(INTERRUPT_S):
            pass
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """Closes all pages, the port and the threads. Closing again has no effect."""
        if self._is_closed:
            return
        self._is_closed = True
        self._loader.join()
        self._timeline.close()
        self._notebook.close()
        self._loop.close()
        self._server.close()
        self._notifications.close()
        self._closed_or_failed.set()

    def _build_panels(self, device: str) -> None:
        gui = self._viser.gui
        gui.set_panel_label("Lumisplat")
        still_renderer = StillRenderer(self._loop.scenes, device, self._loop.must_yield)
        context = JobContext(
            self._session,
            BackgroundJobs(gui, self._loop.run_in_background),
            still_renderer,
            self._loop.thumbnail,
        )
        add_buttons(gui, ["undo", "redo"], self._step)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Scene"):
            self._outliner = Outliner(gui, self._session, self._pages, self._notifications.notify)
        with tabs.add_tab("Light"):
            RenderingPanel(gui, self._session)
        with tabs.add_tab("View"):
            self._viewpoints = Viewpoints(gui, self._session)
            ViewPanel(gui, self._session)
            self._rays = RayPanel(gui, self._session, self._loop.run_in_background, device)
            self._add_theme()
            self._status.add_details(gui)
        with tabs.add_tab("Video"):
            self._timeline = Timeline(gui, self._session, self._fly)
            VideoPanel(gui, context)
        with tabs.add_tab("Save"):
            self._files = FilesPanel(gui, self._notifications, self._session)
            with gui.add_folder("images"):
                ImagesPanel(gui, context)
        self._add_keys()

    def _add_keys(self) -> None:
        """Adds the commands of the page's command palette, such as undo and save, with their hotkeys."""
        add = self._viser.gui.add_command
        add("Undo", hotkey="Z", modifier="cmd/ctrl").on_trigger(press_callback(lambda _: self._step("undo")))
        add("Redo", hotkey="Z", modifier="cmd/ctrl+shift").on_trigger(press_callback(lambda _: self._step("redo")))
        add("Save scene", hotkey="S", modifier="cmd/ctrl").on_trigger(press_callback(lambda _: self._save()))
        add("Hide selected", hotkey="H").on_trigger(press_callback(self._actor("hide")))
        add("Delete selected", hotkey="X").on_trigger(press_callback(self._actor("delete")))
        add("Place selected on ground", hotkey="G").on_trigger(press_callback(self._actor("place on ground")))
        add("Level the scene").on_trigger(press_callback(lambda _: self._outliner.level.fit()))
        add("Duplicate selected", hotkey="C").on_trigger(press_callback(self._actor("duplicate")))
        add("Frame all", hotkey="F").on_trigger(press_callback(self._viewpoints.look_at_all))
        add("Frame selected", hotkey="F", modifier="shift").on_trigger(
            press_callback(self._viewpoints.look_at_selected)
        )
        add("Play or stop", hotkey="P").on_trigger(press_callback(lambda _: self._timeline.toggle()))

    def _add_theme(self) -> None:
        dark = self._viser.gui.add_checkbox("dark theme", True)
        dark.on_update(lambda _: self._server.set_theme(dark=bool(dark.value)))

    def _actor(self, action: str) -> Callable[[Any], None]:
        return lambda _: self._outliner.act(action)

    def _save(self) -> None:
        self._files.save()

    def _step(self, direction: str) -> None:
        moved = self._session.undo() if direction == "undo" else self._session.redo()
        if not moved:
            self._notifications.notify(direction, f"there is nothing to {direction}")

    def _load(self, load: Load) -> None:
        try:
            self._open(load(self._status.progress))
        except Exception as error:  # `wait` must not block for ever
            if not isinstance(error, ls.LumisplatError):
                _log.error("the viewer could not open the scene:\n%s", traceback.format_exc())
            self._failure = error
            self._status.progress(" ".join(str(error).split()), 0.0)
            self._closed_or_failed.set()

    def _open(self, state: State) -> None:
        """Shows the loaded state on the pages, reports entries that could not be read, and starts rendering.

        Raises:
            LumisplatError: The cameras or the animation of the document are invalid.
        """
        _ = state.document.animation, state.document.cameras
        self._set_first_view(state.document.scene())
        self._session.open(state)
        self._files.suggest(state.document)
        self._outliner.list_files()
        for client in self._viser.get_clients().values():
            self._look(client)
        for problem in state.document.problems:
            QUIET_LOG.warning("%s", problem)
            self._session.report(problem)
        self._loop.start()

    def _set_first_view(self, scene: ls.Scene) -> None:
        """Computes the start camera of new pages, and moves open pages there whose users have not navigated yet.

        A page whose user has navigated keeps its position and is only rolled upright, unless it looks almost straight
        up or down; then it moves to the start camera, too.
        """
        up = scene.up_direction
        self._viser.scene.set_up_direction(up)
        if not (scene.splats or scene.meshes):
            return
        initial, before = self._viser.initial_camera, self._viser.initial_camera.position
        clients = list(self._viser.get_clients().values())
        waiting = [client for client in clients if _is_at(client, before) or self._is_at_first_view(client)]
        self._first_view = FirstView.of(scene)
        position, target = self._first_view.at(ASPECT)
        initial.fov, initial.up = self._first_view.fov_y, up
        initial.position, initial.look_at = position, target
        for client in clients:
            if client in waiting or _looks_along(client, up):
                self._fit_scene(client)
            else:
                client.camera.up_direction = up
                self._look(client)

    def _update_up(self) -> None:
        """Rolls the cameras of all pages upright if the scene's up direction has changed since the last call."""
        scene = self._session.scene
        if (scene.splats or scene.meshes) and scene.up_direction != self._first_view.up:
            self._set_first_view(scene)

    def _is_at_first_view(self, client: viser.ClientHandle) -> bool:
        """True if a page's camera is still where the viewer put it to frame the whole scene: no user has navigated."""
        page = self._pages.get(client.client_id)
        return page is not None and page.pose is not None and self._fits_scene(page, page.pose)

    def _fit_scene(self, client: viser.ClientHandle) -> None:
        """Moves a page's camera to the start view, at the distance from which the whole scene fits its aspect ratio."""
        aspect = min(client.camera.aspect, ASPECT)
        position, target = self._first_view.at(aspect)
        if (page := self._pages.get(client.client_id)) is not None:
            page.fitted_aspects.add(aspect)
        client.camera.up_direction, client.camera.fov = self._first_view.up, self._first_view.fov_y
        client.camera.position = position  # first, because setting the position moves the target
        client.camera.look_at = target
        self._look(client)  # renders no frame at the old position meanwhile

    def _fits_scene(self, page: Page, pose: Pose) -> bool:
        """True if a page's camera is where `_fit_scene` puts it, within 0.1 % of its distance from the origin."""
        at = self._session.extent.page_from_scene * np.array(pose.position)
        positions = [self._first_view.at(aspect)[0] for aspect in (ASPECT, *page.fitted_aspects)]
        return any(np.linalg.norm(at - position) < 1e-3 * np.linalg.norm(position) for position in positions)

    def _fly(self, camera: ls.Camera) -> None:
        """Moves the view of every open page to a scene camera."""
        for client in self._viser.get_clients().values():
            move_page_to(client, camera, self._session.extent.page_from_scene, self._session.scene.up_direction)

    def _with_overlays(self, picture: Picture, frame: ls.Frame) -> Picture:
        return with_overlays(picture, frame, self._session)

    # --- Pages ---

    def _open_page(self, client: viser.ClientHandle) -> None:
        page = Page(BrowserScreen(client), self._session.changed)
        self._pages[client.client_id] = page
        self._status.open(page, client.gui)
        self._notifications.open(client)
        if client.camera.aspect < ASPECT and _is_at(client, self._viser.initial_camera.position):
            self._fit_scene(client)
        client.camera.on_update(lambda _: self._look(client))
        self._server.on_camera_stopped(client, lambda: self._stop(client, page))
        client.scene.on_click()(lambda event: self._pick(page, event))
        self._look(client)
        self._loop.add(page)

    def _look(self, client: viser.ClientHandle) -> None:
        """Updates the page's stored camera from its browser. If only the window was resized, fits the scene again."""
        page = self._pages.get(client.client_id)
        if page is not None:
            with self._looking:
                before, now = page.pose, Pose.of(client.camera, self._session.extent.page_from_scene)
                page.set_pose(now)
            if before is not None and before.aspect != now.aspect and self._fits_scene(page, now):
                self._fit_scene(client)

    def _stop(self, client: viser.ClientHandle, page: Page) -> None:
        """Ends the motion of a page's camera, whose last pose may still wait for a thread."""
        self._look(client)
        page.stop()

    def _close_page(self, client: viser.ClientHandle) -> None:
        page = self._pages.pop(client.client_id, None)
        if page is not None:
            self._status.close(page)
            self._loop.remove(page)

    def _pick(self, page: Page, event: Any) -> None:
        """Selects the object at a clicked point of a page; in ground mode, uses the point for the ground plane."""
        if page.frame is None:
            return
        across, down = (float(share) for share in event.screen_pos)
        if self._outliner.level.take(page.frame, across, down):
            return
        seen = select(self._session, page.frame, across, down, is_level=not page.frames_at_rest)
        if seen is not None:
            self._notifications.notify(*seen)
        self._rays.follow(page.frame, across, down)


def _preload_renderer() -> None:
    """Imports the renderer while the page starts and files load; the import takes half a second."""
    _ = ls.create_renderer


def _looks_along(client: viser.ClientHandle, up: tuple[float, float, float]) -> bool:
    """True if a page's camera looks within about 20 degrees of straight up or down, so that a roll cannot level it."""
    forward = np.asarray(client.camera.look_at) - np.asarray(client.camera.position)
    return bool(abs(forward @ np.array(up)) > _STEEP_COSINE * np.linalg.norm(forward))


def _is_at(client: viser.ClientHandle, position: np.ndarray) -> bool:
    """True if a page's camera is at the given position, page units, within 5 % of that position's length."""
    return bool(np.linalg.norm(np.asarray(client.camera.position) - position) < 0.05 * np.linalg.norm(position))


Viewable = ls.Scene | ls.Animation | ls.io.SceneDocument | ls.Gaussians | ls.Mesh | str | os.PathLike[str]
"""Types of the argument of `view`, which also accepts a list of files."""


def view(
    scene: Viewable | Sequence[str | os.PathLike[str]],
    *,
    config: ls.RenderConfig | Callable[[ls.RenderConfig], ls.RenderConfig] | None = None,
    port: int = 0,
    host: str = "127.0.0.1",
    device: str = "auto",
    height: int = 720,
    budget_ms: float = 40.0,
    up: str | npt.ArrayLike | None = None,
    drop_invalid: bool = False,
    lod: int | None = None,
    lod_budget: int | None = None,
    keep_coordinates: bool = False,
) -> Viewer:
    """Opens a web page to navigate, edit and relight a scene interactively.

    Returns at once; the page is served until the viewer is closed or the program ends::

        viewer = ls.view(scene)
        print(viewer.url)
        viewer.wait()

    Args:
        scene: A scene, an animation, a document, an asset, a file, or a list of files.
        config: Render settings, or a function that changes the default settings. None takes the settings of the scene
            file; without any, ``Pipeline.HYBRID`` if the scene has lights or meshes, else an unlit view as
            captured.
        port: Port to listen on; 0 takes a free one.
        host: Address to listen on. An address that is not loopback admits other machines that have the token.
        device: Device that renders, as in `lumisplat.create_renderer`.
        height: Image height in pixels while the view is still, 90 to 2160.
        budget_ms: Time budget of a frame while the view moves, milliseconds, 10 to 500. The viewer first draws fewer
            Gaussians, then fewer pixels.
        up: Up direction of files that do not specify one; None uses the default of `lumisplat.Scene`.
        drop_invalid: Drop invalid Gaussians of files, as in `lumisplat.load`.
        lod: Level of detail of streamed SOG files, as in `lumisplat.load`.
        lod_budget: Gaussian budget of streamed SOG files, ``budget`` in `lumisplat.load`.
        keep_coordinates: Keep the coordinates of files, as in `lumisplat.io.SceneDocument.open`.

    Returns:
        The viewer, which is loading the scene.

    Raises:
        ConfigError: ``height`` or ``budget_ms`` is out of its range.
        MissingFileError: None of the files exists. The page reports all other problems with files.
        MissingExtraError: The extra ``view`` is not installed.
        DeviceError: The port cannot be opened.
    """

    def load(progress: Progress) -> State:
        loading = partial(ls.load, drop_invalid=drop_invalid, lod=lod, budget=lod_budget)
        document = _document(scene, up, loading, progress, keep_coordinates=keep_coordinates)
        if isinstance(config, ls.RenderConfig):
            return State(document, config)
        settings = document.config
        if "render" not in document.top and document.scene().is_lit_by_default:
            settings = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID)
        return State(document, settings if config is None else config(settings))

    given = {"--drop-invalid": drop_invalid or None, "--lod ": lod, "--lod budget=": lod_budget}
    words = (name if value is True else f"{name}{value}" for name, value in given.items() if value is not None)
    options = Options(height=height, budget_ms=budget_ms, loading=tuple(words))
    _refuse_missing(scene)
    return Viewer(load, host=host, port=port, device=device, options=options)


def _refuse_missing(scene: Any) -> None:
    """Raises a MissingFileError if the argument of `view` is a file or a list of files, none of which exists."""
    files: list[Any] = list(cast("list[Any]", scene)) if isinstance(scene, list | tuple) else [scene]
    paths = [Path(os.fspath(file)) for file in files if isinstance(file, str | os.PathLike)]
    if paths and len(paths) == len(files) and not any(path.exists() for path in paths):
        raise ls.errors.MissingFileError(paths[0], "no such file")


def _document(
    scene: Any, up: Any, loading: Callable[..., Any], progress: Progress, *, keep_coordinates: bool
) -> ls.io.SceneDocument:
    """Converts the argument ``scene`` of `view`, such as an asset or a list of files, to a document; loads files."""
    if isinstance(scene, ls.io.SceneDocument):
        return scene
    if not isinstance(scene, str | os.PathLike | list | tuple):
        return ls.io.SceneDocument.of(scene)

    def load(path: Path, **levels: int | None) -> Any:
        return loading(path, progress=partial(progress, f"loading {path.name}"), **levels)

    return ls.io.SceneDocument.open(cast(Any, scene), load, up=up, keep_coordinates=keep_coordinates)
