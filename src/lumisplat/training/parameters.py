"""Parameters of trained Gaussians on the host and on the device, and the initial Gaussians of a training."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp
from scipy.spatial import cKDTree

from lumisplat.config import TrainConfig
from lumisplat.constants import COINCIDENT_EXTENT, SH_C0
from lumisplat.device.training import SplatParameters
from lumisplat.io.training_images.loading import camera_target, count_poses, count_positions, is_curvilinear
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.runtime.buffers import Buffers, device_array
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.local_frame import camera_extent

Rows = npt.NDArray[np.intp] | npt.NDArray[np.bool_]

_ELEMENTS: dict[str, Any] = {
    "means": wp.vec3,
    "rotations": wp.vec4,
    "log_scales": wp.vec3,
    "logits": wp.float32,
    "sh": wp.vec3,
}
NAMES = tuple(_ELEMENTS)
"""Names of the trained arrays, such as ``means`` and ``logits``, the keys of `TrainedParameters`."""


@dataclass(frozen=True, slots=True, eq=False)
class TrainedParameters:
    """Unconstrained parameters of N Gaussians, with the two Adam moments of each parameter.

    Each dictionary has the keys `NAMES` and float32 arrays with one row per Gaussian.
    """

    values: dict[str, FloatArray]
    first: dict[str, FloatArray]
    second: dict[str, FloatArray]

    @classmethod
    def new(cls, values: dict[str, FloatArray]) -> TrainedParameters:
        """Returns parameters with the given values, and Adam moments of zero."""
        arrays = {name: np.ascontiguousarray(values[name], np.float32) for name in NAMES}
        return cls(arrays, _zeros_like(arrays), _zeros_like(arrays))

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self.values["means"])

    @property
    def opacities(self) -> npt.NDArray[np.float64]:
        """Opacity of each of N Gaussians, 0..1, shape (N,)."""
        return 1.0 / (1.0 + np.exp(-self.values["logits"].astype(np.float64)))

    @property
    def scales(self) -> npt.NDArray[np.float64]:
        """Standard deviations along the axes of each of N Gaussians, shape (N, 3)."""
        return np.exp(self.values["log_scales"].astype(np.float64))

    def rows(self, rows: Rows) -> TrainedParameters:
        """Returns the Gaussians at the given rows (indices or mask), with their Adam moments."""
        return TrainedParameters(*({name: part[name][rows] for name in NAMES} for part in self._parts))

    def copies(self, rows: Rows) -> TrainedParameters:
        """Returns copies of the Gaussians at the given rows (indices or mask), with Adam moments of zero."""
        return TrainedParameters.new({name: self.values[name][rows] for name in NAMES})

    def concatenated(self, other: TrainedParameters) -> TrainedParameters:
        """Returns this object's Gaussians followed by those of another."""
        pairs = zip(self._parts, other._parts, strict=True)
        return TrainedParameters(*({name: np.concatenate([a[name], b[name]]) for name in NAMES} for a, b in pairs))

    def zero_moments(self, rows: Rows) -> None:
        """Zeroes the Adam moments of the Gaussians at the given rows (indices or mask)."""
        for part in (self.first, self.second):
            for name in NAMES:
                part[name][rows] = 0.0

    def gaussians(self, config: TrainConfig) -> Gaussians:
        """Returns the Gaussians as a capture with the antialiasing and kernel degree of ``config``."""
        return Gaussians(
            means=self.values["means"].copy(),
            rotations_wxyz=self.values["rotations"].copy(),
            scales=self.scales.astype(np.float32),
            opacities=self.opacities.astype(np.float32),
            sh=self.values["sh"].copy(),
            antialiased=config.antialiased,
            kernel_degree=config.kernel_degree,
        )

    @property
    def _parts(self) -> tuple[dict[str, FloatArray], ...]:
        return self.values, self.first, self.second


class DeviceParameters:
    """Copy of `TrainedParameters` on the device.

    Args:
        buffers: Owner of the device arrays.
    """

    def __init__(self, buffers: Buffers) -> None:
        self._buffers = buffers
        self.values, self.first, self.second = SplatParameters(), SplatParameters(), SplatParameters()

    def upload(self, parameters: TrainedParameters) -> None:
        """Copies a training's parameters and their Adam moments from the host to the device."""
        for kind in ("values", "first", "second"):
            struct, arrays = getattr(self, kind), getattr(parameters, kind)
            struct.sh_count = arrays["sh"].shape[1]
            for name, element in _ELEMENTS.items():
                rows = arrays[name].reshape(-1, 3) if name == "sh" else arrays[name]
                setattr(struct, name, self._buffers.upload(f"parameters.{kind}.{name}", element, rows))

    def download(self) -> TrainedParameters:
        """Returns the device's parameters and their Adam moments as host arrays."""
        return TrainedParameters(*(self._downloaded(kind) for kind in (self.values, self.first, self.second)))

    @staticmethod
    def _downloaded(struct: Any) -> dict[str, FloatArray]:
        arrays = {name: np.array(device_array(getattr(struct, name)).numpy(), np.float32) for name in NAMES}
        arrays["sh"] = arrays["sh"].reshape(len(arrays["means"]), struct.sh_count, 3)
        return arrays


def _zeros_like(arrays: dict[str, FloatArray]) -> dict[str, FloatArray]:
    return {name: np.zeros_like(array) for name, array in arrays.items()}


POSITIONS_MIN = 3
"""Smallest number of camera positions without a warning.

Two positions do not constrain the depth of surfaces that only one camera sees."""

POINTS_FRACTION_MIN = 0.05
"""Number of the images' 3D points, relative to ``TrainConfig.initial``, below which random points are added.

MCMC adds a twentieth of the current number in each densification and cannot grow from nearly nothing."""

INITIAL_OPACITY = {"mcmc": 0.5, "adaptive": 0.1}

INITIAL_SCALE = {"mcmc": 0.3, "adaptive": 1.0}
"""Initial scale of a Gaussian, as a fraction of the root mean square distance to its three nearest neighbours.

The value for MCMC lies between gsplat's 0.1 and 1."""

INITIAL_DEPTHS = (0.4, 1.8)
"""Range of depths of random points, as fractions of the distance from the cameras to their common target."""

INITIAL_SCALE_MIN = 1e-6
"""Smallest initial scale, scene units; coinciding points have neighbours at distance 0."""

_log = logging.getLogger("lumisplat")

NEIGHBOURS = 3
PARALLEL = 1e-3
"""Spread of the cameras' viewing directions below which they count as parallel, so that they have no common target.

The spread is the mean squared sine of the angle between a camera's optical axis and the mean axis."""
PARALLEL_DISTANCE = 3.0


@dataclass(frozen=True, slots=True)
class SceneScale:
    """Length scales of a scene, estimated from its cameras."""

    extent: float
    """1.1 times the largest distance of a camera from the mean position, scene units (Kerbl et al. 2023).

    1 if all cameras are at one position."""
    distance: float
    """Median distance of the cameras from their common target, scene units.

    Three times the extent if all cameras look in the same direction; 1 if all cameras are at one position."""

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> SceneScale:
        """Estimates both length scales from a list of at least one camera."""
        target, extent = camera_target(cameras), camera_extent(cameras)
        farthest = max(float(np.linalg.norm(camera.eye)) for camera in cameras)
        if extent < COINCIDENT_EXTENT * max(farthest, 1.0):  # no parallax, so distances are unknown
            return cls(1.0, 1.0)
        distance = float(np.median([np.linalg.norm(camera.eye - target) for camera in cameras]))
        axes = np.array([camera.camera_from_world[2, :3] for camera in cameras])
        spread = 1.0 - float(np.linalg.eigvalsh(axes.T @ axes / len(axes))[-1])
        return cls(extent, distance if spread > PARALLEL else PARALLEL_DISTANCE * extent)


def random_points(cameras: Sequence[Camera], scale: SceneScale, count: int, rng: np.random.Generator) -> Doubles:
    """Returns ``count`` random points inside the views of the cameras, near the distance of the cameras' target."""
    chosen = rng.integers(0, len(cameras), count)
    low, high = INITIAL_DEPTHS
    depths = scale.distance * rng.uniform(low, high, count)
    fractions = rng.uniform(size=(count, 2))
    points = np.empty((count, 3))
    for number, camera in enumerate(cameras):
        rows = np.flatnonzero(chosen == number)
        local = depths[rows, None] * _camera_rays(camera, fractions[rows] * (camera.width, camera.height))
        points[rows] = local @ camera.camera_from_world[:3, :3] + camera.eye
    return points


def with_random_points(
    points: Doubles | None, colors: FloatArray | None, cameras: Sequence[Camera], config: TrainConfig
) -> tuple[Doubles | None, FloatArray | None]:
    """Returns the given points and colours, and adds random ones if there are too few.

    Args:
        points: N points that come with the images, world space, shape (N, 3). If None, the result is None, too.
        colors: Display-referred sRGB of ``points``, 0..1, shape (N, 3); None if unknown.
        cameras: Training cameras, in whose views the random points are placed.
        config: Training settings.
    """
    wanted = min(config.initial, config.cap)
    if points is None or len(points) >= POINTS_FRACTION_MIN * wanted:
        return points, colors
    rng = np.random.default_rng([config.seed, 4])
    added = random_points(cameras, SceneScale.of(cameras), wanted - len(points), rng)
    _log.warning(
        "the images come with only %d 3D points: adding %d random points, which training moves onto surfaces",
        len(points),
        len(added),
    )
    point_colors = np.full(points.shape, 0.5) if colors is None else colors
    both = np.concatenate([point_colors, rng.uniform(size=added.shape)])
    return np.concatenate([points, added]), both.astype(np.float32)


def warn_if_few_positions(cameras: Sequence[Camera]) -> None:
    """Logs a warning if the training cameras have too few positions, or if several have the same pose."""
    count, positions, poses = len(cameras), count_positions(cameras), count_poses(cameras)
    if positions < POSITIONS_MIN:
        _log.warning(
            "%s from %s: depth cannot be triangulated without several camera positions, so novel views will look "
            "poor: add 20 or more images from all around",
            "1 training image" if count == 1 else f"{count} training images",
            "1 camera position" if positions == 1 else f"{positions} camera positions",
        )
    elif poses < count:
        _log.warning(
            "%d of %d training images have the same pose as another image and add no parallax: remove them if they "
            "are duplicates",
            count - poses,
            count,
        )


def _camera_rays(camera: Camera, pixels: Doubles) -> Doubles:
    """Returns the ray through each of N pixel positions, in camera space, shape (N, 3).

    Rays of pinhole cameras have view depth 1, rays of distorted lenses length 1. Pixels outside the image circle of a
    lens get the optical axis.
    """
    if is_curvilinear(camera):
        columns, rows = np.minimum(pixels.astype(int), (camera.width - 1, camera.height - 1)).T
        rays = camera.ray_directions()[rows, columns]
        return np.where(rays.any(axis=1, keepdims=True), rays, (0.0, 0.0, 1.0))
    return np.column_stack([(pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones(len(pixels))])


def first_gaussians(
    points: npt.NDArray[np.floating], colors: FloatArray | None, config: TrainConfig, rng: np.random.Generator
) -> TrainedParameters:
    """Returns the initial Gaussians: one at each of N points, scaled by the distance of the nearest points.

    Args:
        points: Means of the Gaussians, world space, shape (N, 3).
        colors: Display-referred sRGB, 0..1, shape (N, 3); None for random colours.
        config: Training settings.
        rng: Random number generator.
    """
    kind, count = config.densification.value, len(points)
    spread = np.maximum(INITIAL_SCALE[kind] * neighbour_distances(points), INITIAL_SCALE_MIN)
    opacity = INITIAL_OPACITY[kind]
    sh = np.zeros((count, (config.sh_degree + 1) ** 2, 3))
    sh[:, 0] = ((rng.uniform(size=(count, 3)) if colors is None else colors) - 0.5) / SH_C0
    return TrainedParameters.new(
        {
            "means": points.astype(np.float32),
            "rotations": rng.normal(size=(count, 4)).astype(np.float32),
            "log_scales": np.repeat(np.log(spread)[:, None], 3, axis=1).astype(np.float32),
            "logits": np.full(count, math.log(opacity / (1.0 - opacity)), np.float32),
            "sh": sh.astype(np.float32),
        }
    )


def neighbour_distances(points: npt.NDArray[np.floating]) -> Doubles:
    """Returns the root mean square distance of each of N points to its `NEIGHBOURS` nearest points, shape (N,).

    A single point gets 1.
    """
    if len(points) < 2:
        return np.ones(len(points))
    nearest = min(NEIGHBOURS, len(points) - 1)
    distances, _ = cKDTree(points).query(points, k=range(2, nearest + 2), workers=-1)  # the first is the point itself
    return np.sqrt(np.square(distances).mean(axis=1))
