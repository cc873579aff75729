"""View options of pages: AOV view, resolution, overlays and viewpoints; and the animation time."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Generator
from typing import TYPE_CHECKING, Any

import numpy as np

import lumisplat as ls
from lumisplat.viewer.frames.pose import move_page_to
from lumisplat.viewer.scene_extent import Extent, pose_of, world_corners
from lumisplat.viewer.server.event_queue import press_callback, value_callback
from lumisplat.viewer.session import Session
from lumisplat.viewer.thresholds import BUDGETS_MS, HEIGHTS, PLAY_STEPS_PER_S

if TYPE_CHECKING:
    import viser


class ViewPanel:
    """Controls of the view options, in viser's open GUI folder.

    Args:
        gui: Controls of the pages.
        session: Session whose options the controls set.
    """

    def __init__(self, gui: viser.GuiApi, session: Session) -> None:
        self._session = session
        options = session.options
        self._view = gui.add_dropdown("view", session.views, initial_value=options.view)
        hint = "Height of the image while the view is still."
        self._height = gui.add_slider("height (px)", *HEIGHTS, 10, options.height, hint=hint)
        self._budget = gui.add_slider(
            "frame time (ms)",
            *BUDGETS_MS,
            5.0,
            options.budget_ms,
            hint="Time budget of a frame while the view moves: first fewer Gaussians are drawn, then fewer pixels.",
        )
        hint = "Shows positions, sizes and ranges of lights, and the selected object."
        self._outlines = gui.add_checkbox("outlines", options.outlines, hint=hint)
        hint = "Shows a ground grid with a spacing of a power of ten."
        self._grid = gui.add_checkbox("grid", options.grid, hint=hint)
        self._insets = gui.add_checkbox("insets", options.insets, hint="Shows depth and normals in a corner.")
        self._splits = gui.add_checkbox(
            "compare", False, hint="Shows the scene as it was opened, or marked, on the left side."
        )
        self._share = gui.add_slider("compare at", 0.0, 1.0, 0.01, 0.5, visible=False)
        hint = "Makes the current scene the left side of the comparison."
        self._mark = gui.add_button("mark as before", visible=False, hint=hint)
        self._splits.on_update(lambda _: self._split())
        self._share.on_update(lambda _: self._split())
        self._mark.on_click(press_callback(lambda _: session.mark()))
        for handle, name in (
            (self._view, "view"),
            (self._height, "height"),
            (self._budget, "budget_ms"),
            (self._outlines, "outlines"),
            (self._grid, "grid"),
            (self._insets, "insets"),
        ):
            handle.on_update(value_callback(lambda value: (value,), self._putter(handle, name)))
        session.on_change(self._show)

    def _show(self) -> None:
        """Updates the dropdown of views after the render settings have changed which views exist."""
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


class RayPanel:
    """Checkbox in viser's open GUI folder, and below it a plot of the Gaussians on the ray of the last clicked point.

    Args:
        gui: Controls of the pages.
        session: Session with the scene.
        do: Queues a generator whose steps the render thread runs, `RenderLoop.run_in_background`.
        device: Device that traces the ray.
    """

    def __init__(self, gui: viser.GuiApi, session: Session, do: Callable[[Generator[None]], None], device: str) -> None:
        self._session, self._do, self._device = session, do, device
        hint = "Plots transmittance and alpha of the Gaussians on the ray of a clicked point."
        self._is_on = gui.add_checkbox("plot ray", False, hint=hint)
        self._plot = gui.add_image(np.zeros((_PLOT[1], _PLOT[0], 3), np.uint8), format="png", visible=False)
        self._is_on.on_update(lambda _: self._hide())

    def follow(self, frame: ls.Frame, across: float, down: float) -> None:
        """Plots the ray of a clicked point if the checkbox is on; arguments are as for `picked`."""
        if self._is_on.value:
            self._do(self._steps(frame.camera, across, down))

    def _hide(self) -> None:
        if not self._is_on.value:
            self._plot.visible = False

    def _steps(self, camera: ls.Camera, across: float, down: float) -> Generator[None]:
        yield
        width, height = camera.image_size
        try:
            ray = ls.rays.pixel_ray(camera, min(int(across * width), width - 1), min(int(down * height), height - 1))
            config = self._session.state.config
            hits = ls.trace_rays(self._session.scene, *ray, config, device=self._device, profile=True)
        except ls.LumisplatError as error:
            self._session.report(str(error))
            return
        self._plot.image = hits.plot(size=_PLOT)
        self._plot.visible = True


_PLOT = (400, 260)
"""Width and height of the plot of a ray, pixels."""
_ALL = "all"
_SELECTED = "selected"


class Viewpoints:
    """Dropdown of viewpoints, such as the scene file's cameras, and a button that moves the page to the chosen one.

    Args:
        gui: Controls of the pages.
        session: Session with the scene.
    """

    def __init__(self, gui: viser.GuiApi, session: Session) -> None:
        self._session = session
        hint = "Frames the whole scene or the selected object, or takes the view of a camera in the scene file."
        self._viewpoint = gui.add_dropdown("look at", [_ALL, _SELECTED], hint=hint)
        gui.add_button("go to view").on_click(press_callback(self._go))
        self._cameras: dict[str, ls.Camera] = {}
        self._shown: object = None
        session.on_change(self._show)

    def look_at_all(self, event: Any) -> None:
        """Moves the page that sent an event so that the whole scene fills its image; keeps the view direction."""
        if event.client is not None:
            extent = Extent.of(self._session.scene)  # includes objects added or moved since the scene was opened
            self._look_at(event.client, np.array(extent.center), 0.5 * extent.size)

    def look_at_selected(self, event: Any) -> None:
        """Moves the page that sent an event so that the selected object fills its image; keeps the view direction."""
        with self._session.changed:
            ball = selected_sphere(self._session)
        if ball is None:
            self._session.report("nothing with a position is selected: click an object in the image or in the list")
        elif event.client is not None:
            self._look_at(event.client, *ball)

    def _show(self) -> None:
        """Updates the cameras of the scene file in the dropdown of viewpoints."""
        document = self._session.state.document
        if self._shown is not document.top.get("cameras"):
            self._shown = document.top.get("cameras")
            self._cameras = {camera.name: camera for camera in document.cameras}
            self._viewpoint.options = [_ALL, _SELECTED, *self._cameras]

    def _go(self, event: Any) -> None:
        camera = self._cameras.get(str(self._viewpoint.value))
        if self._viewpoint.value == _ALL:
            self.look_at_all(event)
        elif self._viewpoint.value == _SELECTED:
            self.look_at_selected(event)
        elif camera is not None and event.client is not None:
            session = self._session
            move_page_to(event.client, camera, session.extent.page_from_scene, session.scene.up_direction)

    def _look_at(self, client: viser.ClientHandle, center: np.ndarray, radius: float) -> None:
        """Moves a page along its view direction until a sphere in world space fills the image."""
        scale, camera = self._session.extent.page_from_scene, client.camera
        backward = np.asarray(camera.position) - np.asarray(camera.look_at)
        backward = backward / max(float(np.linalg.norm(backward)), 1e-9)
        narrow = math.atan(math.tan(0.5 * camera.fov) * min(camera.aspect, 1.0))
        with client.atomic():
            camera.up_direction = self._session.scene.up_direction
            camera.position = scale * (center + backward * radius / math.sin(narrow))
            camera.look_at = scale * center  # last, because setting the position moves the target


def selected_sphere(session: Session) -> tuple[np.ndarray, float] | None:
    """Returns centre and radius, scene units, of a sphere around the selected object; None if it has no position."""
    entry, time = session.selected_entry, session.options.time
    if entry is None:
        return None
    if entry.kind == "lights" and (position := getattr(entry.lights_at(time)[0], "position", None)) is not None:
        return np.array(position, np.float64), 0.2 * session.extent.size
    box, pose = session.boxes.of(entry, time), pose_of(entry, time)
    if box is None or pose is None:
        return None
    corners = world_corners(box, pose)
    middle = corners.mean(axis=0)
    return middle, float(np.linalg.norm(corners[0] - middle))


class Timeline:
    """Time slider and play button of the animation, hidden without one, in viser's open GUI folder.

    Args:
        gui: Controls of the pages.
        session: Session whose time the controls set.
        fly: Moves all pages to a camera.
    """

    def __init__(self, gui: viser.GuiApi, session: Session, fly: Callable[[ls.Camera], None]) -> None:
        self._session, self._fly = session, fly
        self._time = gui.add_slider("time", 0.0, 1.0, 0.001, 0.0, visible=False, hint="Animation time, seconds.")
        self._plays = gui.add_checkbox("play", False, visible=False)
        hint = "Pages follow the camera path during playback."
        self._flies = gui.add_checkbox("follow camera path", False, visible=False, hint=hint)
        self._time.on_update(value_callback(float, self._go))
        self._plays.on_update(lambda _: self._wake.set())
        self._animation: ls.Animation | None = None
        self._shown: tuple[object, ...] = ()
        """Parts of the document that the current animation was built from; other objects need a new animation."""
        self._wake = threading.Event()
        self._is_open = True
        self._thread = threading.Thread(target=self._play, name="lumisplat play", daemon=True)
        self._thread.start()
        session.on_change(self._show)

    def toggle(self) -> None:
        """Starts the playback of the animation, or stops it."""
        self._plays.value = not self._plays.value
        self._wake.set()

    def close(self) -> None:
        """Ends the thread that advances the animation time."""
        self._is_open = False
        self._wake.set()
        self._thread.join()

    def _show(self) -> None:
        """Updates the range of the time slider after the document's animation has changed; hides it without one."""
        document = self._session.state.document
        entries = [entry for entry in document.entries if not entry.hidden]
        shown = document.top, *(entry.actor for entry in entries), *(entry.moving for entry in entries)
        if len(shown) == len(self._shown) and all(a is b for a, b in zip(shown, self._shown, strict=True)):
            return
        self._shown, self._animation = shown, document.animation
        self._time.visible = self._plays.visible = self._animation is not None
        self._flies.visible = self._animation is not None and self._animation.camera_path is not None
        if self._animation is not None:
            self._time.max = max(self._animation.duration, 1e-3)
        self._wake.set()

    def _go(self, seconds: float) -> None:
        path = None if self._animation is None else self._animation.camera_path
        self._session.set_options(time=seconds)
        if path is not None and self._flies.value:
            self._fly(path.at(seconds))

    def _play(self) -> None:
        """Loop of the playback thread: while playing, advances the animation time in real time, over and over."""
        while self._is_open:
            animation = self._animation
            if not self._plays.value or animation is None:
                self._wake.wait()
                self._wake.clear()
                continue
            started, first = time.monotonic(), self._session.options.time
            while self._is_open and self._plays.value and self._animation is animation:
                now = (first + time.monotonic() - started) % animation.duration
                self._time.value = now
                self._go(now)
                time.sleep(1.0 / PLAY_STEPS_PER_S)
