"""Long jobs that pages start, one at a time: still images, videos, and captures exported as HTML."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.viewer.frames.page import Picture
from lumisplat.viewer.frames.pose import ASPECT, FirstView, Pose
from lumisplat.viewer.frames.scene_builder import SceneBuilder
from lumisplat.viewer.scene_extent import Extent
from lumisplat.viewer.server.event_queue import press_callback, queued_callback
from lumisplat.viewer.server.page_server import PageServer
from lumisplat.viewer.session import Session

if TYPE_CHECKING:
    import viser


Still = Generator[float, None, ls.Frame]
"""Generator that renders a still image: yields the completed fraction after each sample, and returns the frame."""


@dataclass(frozen=True)
class StillRenderer:
    """Renders still images at full detail, sample by sample, in the render thread."""

    scenes: SceneBuilder
    device: str
    """Name of the device that renders, such as ``cuda:0``, as in `lumisplat.create_renderer`."""
    stop: Callable[[], bool]
    """Function that returns True when a still image must pause, because a view moves or the viewer closes."""

    def renderer(self, config: ls.RenderConfig) -> ls.Renderer:
        """Creates a renderer for the settings that `still_config` returns.

        Raises:
            DeviceError: The device does not exist or is out of memory.
        """
        return ls.create_renderer(config, self.device, compiles=False)

    def scene(self, document: ls.io.SceneDocument, config: ls.RenderConfig, time: float) -> ls.Scene:
        """Returns a document's scene at an animation time in seconds, at full detail and with lit actors.

        Raises:
            LumisplatError: The scene is invalid.
        """
        return self.scenes.of(document, config, time, 0, waits=True)

    def still(self, renderer: ls.Renderer, scene: ls.Scene, camera: ls.Camera, samples: int) -> Still:
        """Returns a generator that renders a still image, one sample per step.

        A sample that a moving view interrupts is rendered again from its start.

        Args:
            renderer: Renderer with settings of `still_config`.
            scene: The scene.
            camera: The camera.
            samples: Samples per pixel, or the number of frames of a realtime pipeline. The sorted raster pipeline needs
                only one sample.

        Raises:
            LumisplatError: Rendering failed.
        """
        follows = renderer.config.pipeline.is_sequence
        frame: ls.Frame | None = None
        done = 0
        while frame is None or (done < samples and frame.samples > 0):
            with contextlib.suppress(ls.errors.StoppedError):
                resume = None if follows else frame
                frame = renderer.render(scene, camera, resume=resume, stop=self.stop)
                done += 1
            yield done / samples
        return frame


def still_config(config: ls.RenderConfig, layers: tuple[str, ...] = ()) -> ls.RenderConfig:
    """Returns render settings for one sample per pixel of a still image, which is rendered sample by sample.

    Args:
        config: Render settings of the scene.
        layers: AOVs to render in addition to those of every frame.

    Raises:
        ConfigError: A layer does not exist.
    """
    samples = None if config.pipeline.is_sequence else 1
    needed = [name for name in layers if name not in ls.Frame.LAYERS or name in ls.Frame.NEEDS]
    return replace(config, samples=samples, noise=None, time_limit=None, adaptive=None, aovs=(*config.aovs, *needed))


def captures_html(scene: ls.Scene) -> str:
    """Returns an HTML page that shows the captures of a scene, as captured, with one colour per Gaussian.

    viser does not support SH, so each Gaussian has the colour of its degree-0 coefficient.

    Args:
        scene: Scene with at least one capture; other objects are left out.

    Raises:
        MissingExtraError: viser is not installed.
    """
    captures = ls.Scene(scene.splats, up=scene.up_direction)
    units = Extent.of(captures).page_from_scene
    server = PageServer("127.0.0.1", 0)  # its token is never given out
    try:
        api = server.viser.scene
        api.set_up_direction(captures.up_direction)
        view = FirstView.of(captures)
        camera = server.viser.initial_camera
        camera.fov, camera.up = view.fov_y, captures.up_direction
        camera.position, camera.look_at = view.at(ASPECT)
        for number, instance in enumerate(captures.splats):
            means, covariances = _world_gaussians(instance, units)
            gaussians = instance.gaussians
            api.add_gaussian_splats(
                f"/capture {number}",
                means,
                covariances,
                np.clip(_SH_C0 * gaussians.sh[:, 0] + 0.5, 0.0, 1.0),
                gaussians.opacities[:, None],
            )
        return api.as_html(dark_mode=True).replace("<title>Viser</title>", "<title>Lumisplat</title>", 1)
    finally:
        server.close()


_SH_C0 = 0.28209479177387814
"""Value of the SH basis function of degree 0, ``1 / (2 sqrt(pi))``."""


def _world_gaussians(instance: ls.SplatInstance, units: float) -> tuple[npt.NDArray[np.float32], ...]:
    """Returns the N Gaussians of an instance in page units: means, shape (N, 3), and covariances, shape (N, 3, 3).

    Args:
        instance: Capture in the scene.
        units: Page units per scene unit.
    """
    from viser import transforms

    matrix = units * instance.transform[:3, :4]
    gaussians = instance.gaussians
    axes = transforms.SO3(np.asarray(gaussians.rotations_wxyz, np.float64)).normalize().as_matrix()
    axes = matrix[:, :3] @ (axes * np.asarray(gaussians.scales, np.float64)[:, None, :])
    means = np.asarray(gaussians.means, np.float64) @ matrix[:, :3].T + matrix[:, 3]
    return means.astype(np.float32), (axes @ axes.transpose(0, 2, 1)).astype(np.float32)


Steps = Generator[float, None, None]
"""Generator that runs a job step by step, and yields the completed fraction, 0 to 1, after each step."""


class BackgroundJobs:
    """Runs one background job at a time; shows its progress bar and a cancel button in viser's open GUI folder.

    Args:
        gui: Controls of the pages.
        do: Queues a generator whose steps the render thread runs, `RenderLoop.run_in_background`.
    """

    def __init__(self, gui: viser.GuiApi, do: Callable[[Generator[None]], None]) -> None:
        self._do = do
        self._line = gui.add_markdown("", visible=False)
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self._button = gui.add_button("cancel", visible=False, color="red")
        self._button.on_click(press_callback(self._cancel))
        self._is_busy = self._is_cancelled = False

    def start(self, label: str, steps: Steps) -> None:
        """Starts a job in the background, and shows its progress.

        Args:
            label: Name of the job to show.
            steps: Steps of the job.

        Raises:
            ConfigError: Another job is running.
        """
        if self._is_busy:
            steps.close()
            raise ls.ConfigError(f"{label}: another job is running; wait for it, or cancel it")
        self._is_busy, self._is_cancelled = True, False
        self._line.content = label
        self._show(0.0)
        self._do(self._steps(steps))

    def _steps(self, steps: Steps) -> Generator[None]:
        try:
            for share in steps:
                if self._is_cancelled:
                    return
                self._show(share)
                yield
        finally:
            steps.close()
            self._is_busy = False
            self._line.visible = self._bar.visible = self._button.visible = False

    def _show(self, share: float) -> None:
        self._bar.value = 100.0 * share
        self._line.visible = self._bar.visible = self._button.visible = True

    def _cancel(self, _: Any) -> None:
        self._is_cancelled = True


@dataclass(frozen=True)
class JobContext:
    """Context of background jobs: the session, the job runner and the still renderer."""

    session: Session
    jobs: BackgroundJobs
    still_renderer: StillRenderer
    thumbnail: Callable[[ls.Camera, Callable[[Picture], object]], None]
    """Function that renders a small image from a camera once no view moves, and passes the image to a function."""


def view_callback(session: Session, act: Callable[..., object], controls: Callable[[], tuple[Any, ...]] = tuple) -> Any:
    """Returns a callback for a button that uses the page's camera as it was when the button was pressed.

    Args:
        session: Session of the pages.
        act: Handles the press, in a thread; called with the event, the camera's `Pose` and the values of ``controls``.
        controls: Reads values of other controls at the time of the press.
    """

    def read(event: Any) -> tuple[Any, ...] | None:
        if event.client is None:  # the page has closed, or has reported no camera yet
            return None
        return event, Pose.of(event.client.camera, session.extent.page_from_scene), *controls()

    return queued_callback(read, lambda values: act(*values))


def file_bytes(name: str, write: Callable[[Path], None]) -> bytes:
    """Calls a function that writes a temporary file, and returns the content of that file.

    Args:
        name: File name; its extension selects the format.
        write: Writes the file to a path.
    """
    with TemporaryDirectory() as folder:
        path = Path(folder) / name
        write(path)
        return path.read_bytes()
