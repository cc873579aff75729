"""Starts the rays of a camera's pixels."""

from __future__ import annotations

from lumisplat.constants import PACKET_RAYS, RAY_BLOCK_PX
from lumisplat.device.structs.camera import ListedRays
from lumisplat.device.structs.rays import RayData
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.trace import camera_ray_kernels as kernels
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import KernelModule, Launcher


class CameraRays:
    """Starts one ray per pixel.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers

    def modules(self) -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches."""
        return [kernels if self._launcher.is_parallel else kernels.BY_LANES]

    def start(self, scene: DeviceScene, listed: ListedRays | None = None, *, of_splats: bool = False) -> RayData:
        """Returns the rays of the scene's current sample, in square blocks of pixels.

        Args:
            scene: The device scene with the camera.
            listed: Rays to start; None: one ray for each pixel.
            of_splats: Whether the rays are for Gaussians. Such rays may pass through pixel centres although rays for
                meshes are jittered.
        """
        count = ray_count(*scene.image_size) if listed is None else len(listed.ray)
        rays = self._buffers.struct("camera.splat_rays" if of_splats else "camera.rays", RayData, count)
        inputs = scene.splat_camera if of_splats else scene.camera, scene.sample, listed or ListedRays()
        with self._launcher.stage("rays"):
            if self._launcher.is_parallel:
                self._launcher.run_banded(kernels.start_rays, count, *inputs, rays)
            else:
                self._launcher.run_banded(kernels.start_rays_lanes, -(-count // PACKET_RAYS), *inputs, rays)
        return rays


def ray_count(width: int, height: int) -> int:
    """Returns the number of rays of an image, rounded up to whole square blocks of pixels."""
    return PACKET_RAYS * (-(-width // RAY_BLOCK_PX)) * (-(-height // RAY_BLOCK_PX))
