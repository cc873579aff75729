"""Rays that a caller gives: checked, cut into batches, and loaded onto the device."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.constants import PACKET_RAYS
from lumisplat.device.structs.rays import RayData
from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles, FloatArray, host_array
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.trace import camera_ray_kernels
from lumisplat.runtime.buffers import Buffers, DeviceArray, grown_capacity
from lumisplat.runtime.launcher import KernelModule, Launcher

RAY_BATCH = 2**20
"""Rays of a query that are on the device at once: some 200 MiB."""

_INPUTS = {"origins": wp.vec3, "directions": wp.vec3, "ends": wp.float32, "starts": wp.float32}


class GivenRays:
    """Loads rays, up to a batch at a time.

    Args:
        launcher: Runs the kernel.
        buffers: Holds the arrays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers

    @staticmethod
    def modules() -> list[KernelModule]:
        """The kernel modules."""
        return [camera_ray_kernels]

    def allocate(self, count: int) -> RayData:
        """Room for so many rays; there are a few sizes instead of one a call."""
        return self._buffers.struct("rays.rays", RayData, whole_packets(grown_capacity(count)))

    def upload(self, batch: list[FloatArray]) -> list[DeviceArray]:
        """Origins, directions, distances of ends, and from where on Gaussians count if that is given, on the device."""
        if len(batch) < len(_INPUTS):
            batch = [*batch, np.zeros(len(batch[0]), np.float32)]
        arrays: list[DeviceArray] = []
        for (name, dtype), values in zip(_INPUTS.items(), batch, strict=True):
            array = self._buffers.get(f"rays.{name}", dtype, grown_capacity(len(values)))
            if len(values):
                array[: len(values)].assign(values)
            arrays.append(array)
        return arrays

    def load(self, scene: DeviceScene, first: int, count: int, inputs: list[DeviceArray], rays: RayData) -> None:
        """Starts ``count`` rays of the scene's current sample; ``first`` is the number of the first in its query."""
        self._launcher.run_banded(
            camera_ray_kernels.load_rays, len(rays.t_max), first, count, scene.sample, *inputs, rays
        )


def batches(*arrays: FloatArray) -> Iterator[tuple[int, list[FloatArray]]]:
    """Consecutive rows of all arrays, and the index of the first."""
    for first in range(0, max(len(arrays[0]), 1), RAY_BATCH):
        yield first, [array[first : first + RAY_BATCH] for array in arrays]


def whole_packets(count: int) -> int:
    """The next multiple of a packet's rays."""
    return -(-count // PACKET_RAYS) * PACKET_RAYS


def checked_rays(origins: npt.ArrayLike, directions: npt.ArrayLike) -> tuple[Doubles, FloatArray]:
    """Returns origins, float64, and unit directions, float32, shape (N, 3) each; one of shape (3,) is that of all rays.

    Raises:
        SceneError: A shape does not fit, an origin is not finite, or a direction is not finite or has no length.
    """
    start, along = _numbers("origins", origins), _rows("directions", directions)
    start = np.broadcast_to(start, along.shape) if start.shape == (3,) else _rows("origins", start)
    if start.shape != along.shape:
        raise SceneError(f"{len(start)} origins and {len(along)} directions: a ray has one of each")
    limit = float(np.finfo(np.float32).max)
    for name, values, largest in (("origins", start, limit), ("directions", along, np.inf)):
        bad = int(np.count_nonzero(~(np.isfinite(values) & (np.abs(values) <= largest)).all(axis=1)))
        if bad:
            raise SceneError(f"{bad} of {len(values)} ray {name} are not finite: leave these rays out")
    # In two steps, as the squares of large and small components overflow and underflow.
    largest = np.abs(along).max(axis=1, keepdims=True, initial=0.0)
    empty = int(np.count_nonzero(largest == 0.0))
    if empty:
        raise SceneError(f"{empty} of {len(along)} ray directions have no length: leave these rays out")
    along = along / largest
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return start, along.astype(np.float32)


def checked_distances(distances: npt.ArrayLike, count: int) -> FloatArray:
    """One distance a ray, float32, shape (N,).

    Raises:
        SceneError: They are not one number or one a ray, or some are NaN or negative.
    """
    values = _numbers("max_distance", distances)
    if values.shape not in ((), (count,)):
        raise SceneError(f"max_distance has shape {values.shape}, expected one number or ({count},), one a ray")
    bad = int(np.count_nonzero(~(values >= 0.0)))
    if bad:
        raise SceneError(f"{bad} of {values.size} values of max_distance are negative or NaN")
    return np.broadcast_to(values, (count,)).astype(np.float32)


def _rows(name: str, values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    rows = _numbers(name, values)
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise SceneError(f"ray {name} have shape {rows.shape}, expected (N, 3)")
    return rows


def _numbers(name: str, values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    try:
        read = host_array(values)
        if np.iscomplexobj(read):
            raise TypeError
        return np.asarray(read, dtype=np.float64)
    except (TypeError, ValueError):
        raise SceneError(f"{name} are not numbers: {type(values).__name__}") from None
