"""From a scene and a camera to a frame, as a list of passes."""

from __future__ import annotations

from lumisplat.buffers import Buffers
from lumisplat.config import RenderConfig
from lumisplat.constants import IMAGE_PIXELS_MAX, ITEMS_MAX
from lumisplat.errors import SceneError
from lumisplat.launcher import Launcher, Progress
from lumisplat.render import mesh_kernels, order_kernels, raster_kernels
from lumisplat.render.device_scene import DeviceScene
from lumisplat.render.frame import Frame, FrameStats
from lumisplat.render.mesh import MeshRaster
from lumisplat.render.order import OrderChunked, OrderParallel
from lumisplat.render.raster import SplatRaster
from lumisplat.render.surface import Surface
from lumisplat.scene.camera import Camera
from lumisplat.scene.scene import Scene


class Renderer:
    """Keeps assets, buffers and compiled kernels warm between frames. Not safe to share between threads.

    Args:
        config: Settings; the defaults draw a capture as it was trained.
        launcher: The device to run on.
        progress: As for ``create_renderer``.
    """

    def __init__(self, config: RenderConfig, launcher: Launcher, progress: Progress | None = None) -> None:
        launcher.load([raster_kernels, order_kernels, mesh_kernels], progress)
        self.config = config
        self._launcher = launcher
        self._buffers = Buffers(launcher.device)
        self._scene = DeviceScene(launcher.device)
        self._order = (OrderParallel if launcher.is_parallel else OrderChunked)(launcher, self._buffers)
        self._meshes = MeshRaster(launcher, self._buffers, self._order)
        self._splats = SplatRaster(launcher, self._buffers, self._order)

    @property
    def device(self) -> str:
        """Warp name of the device, e.g. ``cpu`` or ``cuda:0``."""
        return self._launcher.device

    def render(self, scene: Scene, camera: Camera) -> Frame:
        """Renders one frame.

        Args:
            scene: What to draw. Assets already seen by this renderer are not uploaded again.
            camera: From where.

        Raises:
            DeviceError: The device is out of memory.
            SceneError: The scene is none, or it or the image is larger than 32-bit indices reach.
        """
        if not isinstance(scene, Scene):
            raise SceneError(f"render takes a Scene, got {type(scene).__name__}: ls.Scene(splats=[...], meshes=[...])")
        if max(scene.gaussian_count, scene.face_count) > ITEMS_MAX:
            raise SceneError(f"a scene holds at most {ITEMS_MAX:,} Gaussians and as many triangles")
        if camera.width * camera.height > IMAGE_PIXELS_MAX:
            raise SceneError(
                f"an image of {camera.width} x {camera.height} is too large: at most {IMAGE_PIXELS_MAX:,} pixels"
            )
        self._launcher.stage_ms = {}
        with self._launcher.stage("sync"):
            self._scene.sync(scene, camera, self.config)
        self._draw(camera)
        while not self._order.finish():
            self._draw(camera)
        with self._launcher.stage("download"):
            return self._frame(scene, camera)

    def _draw(self, camera: Camera) -> None:
        key = (camera.width, camera.height, self._scene.version, self._buffers.allocations, self._order.growth)
        self._launcher.replay("frame", key, lambda: self._passes(camera))

    def _passes(self, camera: Camera) -> None:
        stage = self._launcher.stage
        self._order.begin()
        with stage("mesh"):
            hits = self._meshes.draw(self._scene, camera)
        with stage("project"):
            splats, keys, rects = self._splats.project(self._scene)
        with stage("sort"):
            depth_order = self._order.sort(keys)
        with stage("bin"):
            lists = self._splats.bin(depth_order, rects, camera)
        with stage("composite"):
            self._splats.composite(self._scene, camera, splats, lists, hits)

    def _frame(self, scene: Scene, camera: Camera) -> Frame:
        images = Surface.of(self._buffers, camera).download()
        counts = self._order.counts
        return Frame(
            color=images["color"],
            alpha=images["alpha"],
            depth=images["depth"],
            normal=images["normal"],
            gaussian_index=images["gaussian"],
            instance_index=images["instance"],
            camera=camera,
            background=self.config.background,
            stats=FrameStats(
                stage_ms=self._launcher.stage_ms,
                gaussian_count=scene.gaussian_count,
                visible_count=counts.visible,
                nonfinite_count=counts.nonfinite,
                pair_count=counts.pairs,
                triangle_count=scene.face_count,
                memory_bytes=self._scene.bytes + self._buffers.bytes,
            ),
        )


def create_renderer(
    config: RenderConfig | None = None,
    device: str = "auto",
    *,
    threads: int | None = None,
    profile: bool = False,
    progress: Progress | None = None,
) -> Renderer:
    """A renderer whose kernels are compiled and loaded.

    Args:
        config: Settings; None: the defaults.
        device: ``auto`` (CUDA if there is one), ``cpu``, ``cuda`` or ``cuda:N``.
        threads: CPU threads; None: as many as this process may use.
        profile: Time every stage on CUDA too.
        progress: Called with a label and a fraction 0..1 while kernels compile, which takes seconds once a machine.

    Raises:
        ConfigError: ``threads`` is not positive.
        DeviceError: There is no such device.
    """
    return Renderer(config or RenderConfig(), Launcher(device, threads, profile), progress)


def render(scene: Scene, camera: Camera, config: RenderConfig | None = None, *, device: str = "auto") -> Frame:
    """Renders one frame with a renderer of its own; for several, ``create_renderer`` keeps what they share.

    Args:
        scene: What to draw.
        camera: From where.
        config: Settings; None: the defaults.
        device: As for ``create_renderer``.

    Raises:
        DeviceError: There is no such device, or it is out of memory.
    """
    return create_renderer(config, device).render(scene, camera)
