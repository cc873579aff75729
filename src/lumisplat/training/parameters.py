"""The parameters that training moves, on the host and on the device, and the Gaussians from which it starts."""

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
"""Of parameters."""


@dataclass(frozen=True, slots=True, eq=False)
class TrainedParameters:
    """TrainedParameters of Gaussians, unbounded, and their moments; by names of `NAMES`, a row a Gaussian, float32."""

    values: dict[str, FloatArray]
    first: dict[str, FloatArray]
    second: dict[str, FloatArray]

    @classmethod
    def new(cls, values: dict[str, FloatArray]) -> TrainedParameters:
        """TrainedParameters that have not moved yet."""
        arrays = {name: np.ascontiguousarray(values[name], np.float32) for name in NAMES}
        return cls(arrays, _zeros_like(arrays), _zeros_like(arrays))

    @property
    def count(self) -> int:
        """Gaussians."""
        return len(self.values["means"])

    @property
    def opacities(self) -> npt.NDArray[np.float64]:
        """0..1, shape (N,)."""
        return 1.0 / (1.0 + np.exp(-self.values["logits"].astype(np.float64)))

    @property
    def scales(self) -> npt.NDArray[np.float64]:
        """Standard deviations, shape (N, 3)."""
        return np.exp(self.values["log_scales"].astype(np.float64))

    def rows(self, rows: Rows) -> TrainedParameters:
        """Some of them."""
        return TrainedParameters(*({name: part[name][rows] for name in NAMES} for part in self._parts))

    def copies(self, rows: Rows) -> TrainedParameters:
        """Copies of some of them, which have not moved yet."""
        return TrainedParameters.new({name: self.values[name][rows] for name in NAMES})

    def concatenated(self, other: TrainedParameters) -> TrainedParameters:
        """These and others."""
        pairs = zip(self._parts, other._parts, strict=True)
        return TrainedParameters(*({name: np.concatenate([a[name], b[name]]) for name in NAMES} for a, b in pairs))

    def zero_moments(self, rows: Rows) -> None:
        """Forgets how some of them have moved."""
        for part in (self.first, self.second):
            for name in NAMES:
                part[name][rows] = 0.0

    def gaussians(self, config: TrainConfig) -> Gaussians:
        """What they are, as a capture of these settings has it."""
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
    """The same on the device.

    Args:
        buffers: Holds the arrays.
    """

    def __init__(self, buffers: Buffers) -> None:
        self._buffers = buffers
        self.values, self.first, self.second = SplatParameters(), SplatParameters(), SplatParameters()

    def upload(self, parameters: TrainedParameters) -> None:
        """Takes over what the host has."""
        for kind in ("values", "first", "second"):
            struct, arrays = getattr(self, kind), getattr(parameters, kind)
            struct.sh_count = arrays["sh"].shape[1]
            for name, element in _ELEMENTS.items():
                rows = arrays[name].reshape(-1, 3) if name == "sh" else arrays[name]
                setattr(struct, name, self._buffers.upload(f"parameters.{kind}.{name}", element, rows))

    def download(self) -> TrainedParameters:
        """What the device has."""
        return TrainedParameters(*(self._downloaded(kind) for kind in (self.values, self.first, self.second)))

    @staticmethod
    def _downloaded(struct: Any) -> dict[str, FloatArray]:
        arrays = {name: np.array(device_array(getattr(struct, name)).numpy(), np.float32) for name in NAMES}
        arrays["sh"] = arrays["sh"].reshape(len(arrays["means"]), struct.sh_count, 3)
        return arrays


def _zeros_like(arrays: dict[str, FloatArray]) -> dict[str, FloatArray]:
    return {name: np.zeros_like(array) for name, array in arrays.items()}


POSITIONS_MIN = 3
"""Places from which photographs are taken, below which a line says that this is few: two say nothing of what only one
of them sees."""

POINTS_FRACTION_MIN = 0.05
"""Known points, as a share of those that training begins with where none are known, below which random ones are added:
MCMC adds a twentieth of what there is, and never gets far from next to nothing."""

INITIAL_OPACITY = {"mcmc": 0.5, "adaptive": 0.1}

INITIAL_SCALE = {"mcmc": 0.3, "adaptive": 1.0}
"""Scale of the first Gaussians, as a share of the root mean square of the distances to their three nearest neighbours.
That of MCMC is between gsplat's 0.1 and 1."""

INITIAL_DEPTHS = (0.4, 1.8)
"""Depths of points at random, as shares of the distance to what the cameras look at."""

INITIAL_SCALE_MIN = 1e-6
"""Least scale of the first Gaussians, scene units: points may coincide."""

_log = logging.getLogger("lumisplat")

NEIGHBOURS = 3
PARALLEL = 1e-3
"""Mean squared sine between optical axes and their mean below which nothing says where they meet."""
PARALLEL_DISTANCE = 3.0


@dataclass(frozen=True, slots=True)
class SceneScale:
    """What cameras say of the place that they stand in."""

    extent: float
    """1.1 times the largest distance of a camera from their mean, scene units (Kerbl et al. 2023); 1 of one place."""
    distance: float
    """Median distance of a camera from what they look at, scene units; of cameras that look the same way, three times
    the extent."""

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> SceneScale:
        """Those of at least one camera."""
        target, extent = camera_target(cameras), camera_extent(cameras)
        farthest = max(float(np.linalg.norm(camera.eye)) for camera in cameras)
        if extent < COINCIDENT_EXTENT * max(farthest, 1.0):  # they turn on the spot: nothing says how far anything is
            return cls(1.0, 1.0)
        distance = float(np.median([np.linalg.norm(camera.eye - target) for camera in cameras]))
        axes = np.array([camera.camera_from_world[2, :3] for camera in cameras])
        spread = 1.0 - float(np.linalg.eigvalsh(axes.T @ axes / len(axes))[-1])
        return cls(extent, distance if spread > PARALLEL else PARALLEL_DISTANCE * extent)


def random_points(cameras: Sequence[Camera], scale: SceneScale, count: int, rng: np.random.Generator) -> Doubles:
    """Points in the cameras' views, about as far as what they look at, shape (N, 3)."""
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
    """Known points and their colours, with random ones if they are hardly any; None, if none are known.

    Args:
        points: World space, shape (N, 3); None: none are known.
        colors: Display-referred sRGB, 0..1, shape (N, 3); None: not known.
        cameras: Those that see them.
        config: Settings.
    """
    wanted = min(config.initial, config.cap)
    if points is None or len(points) >= POINTS_FRACTION_MIN * wanted:
        return points, colors
    rng = np.random.default_rng([config.seed, 4])
    added = random_points(cameras, SceneScale.of(cameras), wanted - len(points), rng)
    _log.warning(
        "the images come with only %d 3D points: %d random ones are added, which training moves where they belong",
        len(points),
        len(added),
    )
    known = np.full(points.shape, 0.5) if colors is None else colors
    both = np.concatenate([known, rng.uniform(size=added.shape)])
    return np.concatenate([points, added]), both.astype(np.float32)


def warn_if_few_positions(cameras: Sequence[Camera]) -> None:
    """Logs a line if photographs to learn from are too few, or some of them the same."""
    count, positions, poses = len(cameras), count_positions(cameras), count_poses(cameras)
    if positions < POSITIONS_MIN:
        _log.warning(
            "%s to learn from, taken from %s: depth follows from several positions only, so other views will look "
            "poor: add 20 or more images from all around",
            "1 photograph" if count == 1 else f"{count} photographs",
            "one place" if positions == 1 else f"{positions} places",
        )
    elif poses < count:
        _log.warning(
            "%d of %d photographs to learn from have the pose of another one: they show nothing new, leave them out "
            "if they are copies",
            count - poses,
            count,
        )


def _camera_rays(camera: Camera, pixels: Doubles) -> Doubles:
    """What a camera sees at places of its image, at a view depth of 1, or at that distance if its lens bends; (N, 3).

    Where a lens sees nothing it is on the axis.
    """
    if is_curvilinear(camera):
        columns, rows = np.minimum(pixels.astype(int), (camera.width - 1, camera.height - 1)).T
        rays = camera.ray_directions()[rows, columns]
        return np.where(rays.any(axis=1, keepdims=True), rays, (0.0, 0.0, 1.0))
    return np.column_stack([(pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones(len(pixels))])


def first_gaussians(
    points: npt.NDArray[np.floating], colors: FloatArray | None, config: TrainConfig, rng: np.random.Generator
) -> TrainedParameters:
    """A Gaussian at each point, as wide as its neighbours are far.

    Args:
        points: World space, shape (N, 3).
        colors: Display-referred sRGB, 0..1, shape (N, 3); None: at random.
        config: Settings.
        rng: Random numbers.
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
    """Returns the root mean square distance of each point to its `NEIGHBOURS` nearest others, shape (N,); 1 for one."""
    if len(points) < 2:
        return np.ones(len(points))
    nearest = min(NEIGHBOURS, len(points) - 1)
    distances, _ = cKDTree(points).query(points, k=range(2, nearest + 2), workers=-1)  # the first is the point itself
    return np.sqrt(np.square(distances).mean(axis=1))
