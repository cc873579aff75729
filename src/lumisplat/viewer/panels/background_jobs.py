"""Runs long jobs for a page, one at a time: stills with all their samples, videos, and captures as an HTML page."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.viewer.frames.page import Page, Picture
from lumisplat.viewer.frames.pose import ASPECT, FirstView, Pose
from lumisplat.viewer.frames.scene_builder import SceneBuilder
from lumisplat.viewer.scene_extent import Extent
from lumisplat.viewer.server.event_queue import press_callback
from lumisplat.viewer.server.page_server import PageServer
from lumisplat.viewer.session import Session

if TYPE_CHECKING:
    import viser


Still = Generator[float, None, ls.Frame]
"""Gives the share that is done after each sample, and the frame at last."""


@dataclass(frozen=True)
class StillRenderer:
    """What stills are made with, in the thread of the frames."""

    scenes: SceneBuilder
    device: str
    """As of `lumisplat.create_renderer`."""
    stop: Callable[[], bool]
    """Whether stills have to give way."""

    def renderer(self, config: ls.RenderConfig) -> ls.Renderer:
        """A renderer for stills of `still_config`.

        Raises:
            DeviceError: There is no such device, or it is out of memory.
        """
        return ls.create_renderer(config, self.device, compiles=False)

    def scene(self, document: ls.io.SceneDocument, config: ls.RenderConfig, time: float) -> ls.Scene:
        """All of a document at a time, seconds, with its actors lit.

        Raises:
            LumisplatError: It cannot be made.
        """
        return self.scenes.of(document, config, time, 0, waits=True)

    def still(self, renderer: ls.Renderer, scene: ls.Scene, camera: ls.Camera, samples: int) -> Still:
        """Renders a picture; a sample that had to give way is made again.

        Args:
            renderer: With settings of `still_config`.
            scene: The scene.
            camera: The camera.
            samples: Samples a pixel; frames in real time follow each other that often. The sorted raster takes one.

        Raises:
            LumisplatError: It cannot be rendered.
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
    """Settings of one sample of a picture.

    Args:
        config: The settings of the scene.
        layers: Images to make besides those of every frame.

    Raises:
        ConfigError: There is no such image.
    """
    samples = None if config.pipeline.is_sequence else 1
    needed = [name for name in layers if name not in ls.Frame.LAYERS or name in ls.Frame.NEEDS]
    return replace(config, samples=samples, noise=None, time_limit=None, adaptive=None, aovs=(*config.aovs, *needed))


def captures_html(scene: ls.Scene) -> str:
    """The captures of a scene as a page, unlit, each Gaussian in its mean colour: viser's page has no harmonics.

    Args:
        scene: With at least one capture; all else is left out.

    Raises:
        MissingExtraError: viser is not installed.
    """
    captures = ls.Scene(scene.splats, up=scene.up_direction)
    units = Extent.of(captures).page_from_scene
    server = PageServer("127.0.0.1", 0)  # nobody has its token
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
"""Value of the constant spherical harmonic."""


def _world_gaussians(instance: ls.SplatInstance, units: float) -> tuple[npt.NDArray[np.float32], ...]:
    """Means, shape (N, 3), and covariances, shape (N, 3, 3), of an instance, in units of a page."""
    from viser import transforms

    matrix = units * instance.transform[:3, :4]
    gaussians = instance.gaussians
    axes = transforms.SO3(np.asarray(gaussians.rotations_wxyz, np.float64)).normalize().as_matrix()
    axes = matrix[:, :3] @ (axes * np.asarray(gaussians.scales, np.float64)[:, None, :])
    means = np.asarray(gaussians.means, np.float64) @ matrix[:, :3].T + matrix[:, 3]
    return means.astype(np.float32), (axes @ axes.transpose(0, 2, 1)).astype(np.float32)


Steps = Generator[float, None, None]
"""Work in steps: each gives the share that is done, 0..1."""


class BackgroundJobs:
    """Progress and a button to cancel, hidden while there is nothing to do, in the present folder.

    Args:
        gui: The pages' controls.
        do: Does the steps, in its own thread.
    """

    def __init__(self, gui: viser.GuiApi, do: Callable[[Generator[None]], None]) -> None:
        self._do = do
        self._line = gui.add_markdown("", visible=False)
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self._button = gui.add_button("cancel", visible=False, color="red")
        self._button.on_click(press_callback(self._cancel))
        self._is_busy = self._is_cancelled = False

    def start(self, label: str, steps: Steps) -> None:
        """Starts the work.

        Raises:
            ConfigError: Other work is not done yet.
        """
        if self._is_busy:
            steps.close()
            raise ls.ConfigError(f"{label}: wait for what is being made, or cancel it")
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
    """The session, the pages, and who does the work."""

    session: Session
    pages: Mapping[int, Page]
    """Open pages by the id of their connection."""
    jobs: BackgroundJobs
    still_renderer: StillRenderer
    thumbnail: Callable[[ls.Camera, Callable[[Picture], object]], None]
    """Renders a small image of the scene soon, and passes it on."""


def pose_of_page(pages: Mapping[int, Page], event: Any) -> Pose | None:
    """From where the page looks on which something was pressed; None: it has gone, or has not said it yet."""
    page = pages.get(event.client_id)
    return None if page is None else page.pose


def file_bytes(name: str, write: Callable[[Path], None]) -> bytes:
    """The bytes of a file that something writes.

    Args:
        name: Of the file; its extension says the format.
        write: Writes it to a path.
    """
    with TemporaryDirectory() as folder:
        path = Path(folder) / name
        write(path)
        return path.read_bytes()
