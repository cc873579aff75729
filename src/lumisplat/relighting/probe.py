"""Environment probes: the radiance at a position as SH, and a cache of probes (docs/method/relighting.md#probes)."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lumisplat.config import RenderConfig
from lumisplat.config.checks import check_range, check_whole
from lumisplat.constants import NEAR_PLANE, PROBE_FACE_PX
from lumisplat.errors import ConfigError, FormatError, SceneError, check_instance, check_shapes
from lumisplat.io.images.radiance import write_radiance
from lumisplat.math.arrays import (
    Doubles,
    FloatArray,
    float_array,
    host_array,
    normalise_rows,
    read_only_view,
    refuse_rows,
    three_numbers,
)
from lumisplat.math.directions import panorama_directions, panorama_lookup, panorama_solid_angles
from lumisplat.math.sh import sh_basis
from lumisplat.math.transforms import matrices_from_quaternions
from lumisplat.progress import Progress
from lumisplat.renderer.cubemap import CubeSamples, render_cube
from lumisplat.renderer.renderer import Renderer, create_renderer
from lumisplat.scene.checks import check_kind
from lumisplat.scene.lights import LightEnvironment
from lumisplat.scene.scene import Scene

# Environment probes (docs/method/relighting.md#probes)

PROBE_DEGREE_MAX = 8
"""Largest SH degree of a probe: 81 coefficients, lobes of about 20 degrees. Finer detail is better stored as an image.
"""

PROBE_RIDGE = 1e-9
"""Weight of the squared coefficients in the SH fit; the sample weights sum to 4 pi. The ridge is below the rounding of
float32, so that radiance that SH can represent is exact. It is large enough to give a solution if there are too few
directions."""

PROBE_IMAGE_ROWS = 64
"""Height of a probe's latitude-longitude image, pixels: several pixels per shortest wavelength of degree 8."""

_UPRIGHT = (1.0, 0.0, 0.0, 0.0)
_ROWS_AT_ONCE = 2**16
"""Number of directions whose SH basis is in memory at once: 40 MB at degree 8."""


@dataclass(frozen=True, slots=True, eq=False)
class EnvironmentProbe:
    """Radiance that arrives at one position, as SH of degree d with K = (d + 1)^2 coefficients per channel.

    Raises:
        SceneError: The coefficients are no finite array of shape (K, 3) for a degree of 0 to 8.
    """

    coefficients: Doubles
    """SH coefficients of linear Rec.709 radiance, in the order and with the signs that captures use, read-only
    float64, shape (K, 3)."""

    def __post_init__(self) -> None:
        float_array("coefficients", self.coefficients)
        array = np.array(host_array(self.coefficients), np.float64)
        sizes = [(degree + 1) ** 2 for degree in range(PROBE_DEGREE_MAX + 1)]
        if array.ndim != 2 or array.shape[1] != 3 or array.shape[0] not in sizes:
            listed = ", ".join(map(str, sizes))
            raise SceneError(f"coefficients has shape {array.shape}, expected (K, 3) with K one of {listed}")
        array.flags.writeable = False
        object.__setattr__(self, "coefficients", array)

    def __repr__(self) -> str:
        return f"EnvironmentProbe(degree={self.degree})"

    @property
    def degree(self) -> int:
        """Degree of the probe's SH, 0 to 8."""
        return math.isqrt(self.coefficients.shape[0]) - 1

    @classmethod
    def capture(
        cls,
        scene: Scene,
        position: npt.ArrayLike,
        degree: int = 3,
        *,
        face_px: int = PROBE_FACE_PX,
        ridge: float = PROBE_RIDGE,
        near: float = NEAR_PLANE,
        config: RenderConfig | None = None,
        device: str = "auto",
        renderer: Renderer | None = None,
    ) -> EnvironmentProbe:
        """Renders a cube map of a scene from a position, and fits the SH to its pixels.

        Captured colours are decoded to radiance, display white to 1; colours of a lit frame are radiance already.
        Uncovered directions have the background of the settings (black), or in a lit frame the scene's visible
        environment.

        An avatar at the position would hide everything else: leave it out of the scene, or make ``near`` larger than
        the avatar. A probe inside an object, such as a lampshade, captures the object's inside.

        Args:
            scene: The scene that gives the light.
            position: World position of the probe, shape (3,).
            degree: SH degree, 0 to 8. Degree 3 (16 coefficients) suffices for diffuse surfaces; glossy ones need more.
            face_px: Pixels along the edge of a cube face, 4 to 1024.
            ridge: As for `fit`.
            near: Half the side of a cube around the position that is clipped from the render, scene units.
            config: Settings of the render; None: the defaults, rasterised.
            device: As for ``create_renderer``.
            renderer: Renderer to use instead of creating one from ``config`` and ``device``, for example for a probe
                per frame.

        Raises:
            ConfigError: A setting is out of its range, or both ``renderer`` and ``config`` are given.
            DeviceError: There is no such device, or it is out of memory.
            SceneError: The scene is of another type, or the position or every pixel is not finite.
        """
        check_whole("degree", degree, 0, PROBE_DEGREE_MAX)
        check_whole("face_px", face_px, 4, 1024)
        check_range("near", near, 1e-9, 1e9)
        check_range("ridge", ridge, 0.0, 1e6)
        if renderer is not None and config is not None:
            raise ConfigError("a renderer has its own config: give one of the two")
        center = three_numbers("position", position)
        renderer = create_renderer(config, device) if renderer is None else renderer
        check_kind("scene", scene, Scene, "a Scene")
        samples = _samples(scene, center, renderer, int(face_px), float(near))
        return cls(_fit(samples.directions, samples.radiance, samples.weights, degree, ridge))

    @classmethod
    def fit(
        cls,
        directions: npt.ArrayLike,
        radiance: npt.ArrayLike,
        weights: npt.ArrayLike | None = None,
        degree: int = 3,
        ridge: float = PROBE_RIDGE,
    ) -> EnvironmentProbe:
        """Fits the SH to samples of radiance by weighted ridge least squares.

        Weights are first scaled to sum to 4 pi. ``B^T W B`` is then about the identity, for any number of samples and
        any unit of the weights; a ridge of 0.01 shrinks coefficients by about 1 %. Source:
        docs/method/relighting.md#probe-fit.

        Args:
            directions: Directions of any length, shape (N, 3).
            radiance: Linear Rec.709, shape (N, 3).
            weights: Solid angles, or numbers proportional to them, at least 0, shape (N,); None: all equal.
            degree: SH degree, 0 to 8.
            ridge: Weight of the squared coefficients, 0 to 1e6.

        Raises:
            ConfigError: ``degree`` or ``ridge`` is out of its range.
            SceneError: A shape does not fit, a value is not finite, a direction has length 0, a weight is negative or
                all are 0; or the ridge is 0 and there are too few directions for the degree.
        """
        check_whole("degree", degree, 0, PROBE_DEGREE_MAX)
        check_range("ridge", ridge, 0.0, 1e6)
        along, light = float_array("directions", directions), float_array("radiance", radiance)
        shares = np.ones(len(along), np.float32) if weights is None else float_array("weights", weights)
        check_shapes(directions=(along, "N 3"), radiance=(light, "N 3"), weights=(shares, "N"))
        refuse_rows("weights", "negative", shares < 0.0)
        if not shares.any():
            raise SceneError("weights are all 0: there is nothing to fit to")
        unit = normalise_rows("directions", along)
        return cls(_fit(unit.astype(np.float64), light, shares.astype(np.float64), degree, ridge))

    @classmethod
    def from_light(cls, light: LightEnvironment, degree: int = 3, ridge: float = PROBE_RIDGE) -> EnvironmentProbe:
        """Projects an environment light, for example from an .hdr or .exr image, onto the SH.

        Args:
            light: The environment, with its intensity, colour and rotation.
            degree: SH degree, 0 to 8.
            ridge: As for `fit`.

        Raises:
            ConfigError: ``degree`` or ``ridge`` is out of its range.
            SceneError: ``light`` is no environment.
        """
        check_whole("degree", degree, 0, PROBE_DEGREE_MAX)
        check_range("ridge", ridge, 0.0, 1e6)
        check_instance(light, LightEnvironment, "expected a LightEnvironment")
        image = np.ones((1, 1, 3), np.float32) if light.image is None else light.image
        # Renderers interpolate between pixels, so small images are sampled on a finer grid.
        rows = max(image.shape[0], PROBE_IMAGE_ROWS)
        columns = max(image.shape[1], 2 * rows)
        local = panorama_directions(rows, columns).reshape(-1, 3)
        power = np.multiply(light.color, light.intensity)
        radiance = panorama_lookup(image, local) * power
        weights = np.repeat(panorama_solid_angles(rows, columns), columns)
        return cls(_fit(local @ _matrix(light).T, radiance, weights, degree, ridge))

    def radiance(self, directions: npt.ArrayLike) -> FloatArray:
        """Returns the radiance that arrives from directions; SH ringing at strong contrasts can make it negative.

        Args:
            directions: World-space directions from the position towards the light, of any length, shape (..., 3).

        Returns:
            Linear Rec.709, shape (..., 3).

        Raises:
            SceneError: A direction is not finite or has length 0.
        """
        return self._evaluate(directions, np.ones(len(self.coefficients)))

    def irradiance(self, normals: npt.ArrayLike) -> FloatArray:
        """Returns the irradiance of surfaces: radiance times cosine, integrated over the hemisphere about each normal.

        The cosine multiplies each SH degree by a factor (Ramamoorthi and Hanrahan 2001): pi, 2 pi / 3, pi / 4, 0, ...
        Source: docs/method/relighting.md#probe-irradiance.

        Args:
            normals: World-space normals of any length, shape (..., 3).

        Returns:
            Linear Rec.709, shape (..., 3): pi for radiance 1 from all directions.

        Raises:
            SceneError: A normal is not finite or has length 0.
        """
        return self._evaluate(normals, cosine_factors(self.degree))

    def image(self, height: int = PROBE_IMAGE_ROWS, rotation_wxyz: npt.ArrayLike = _UPRIGHT) -> FloatArray:
        """Returns the radiance as a latitude-longitude image, in the axes of `LightEnvironment`.

        Negative radiance from SH ringing is set to 0 and the rest scaled down, so that the mean over the sphere stays.

        Args:
            height: Height of the image, pixels, 1 to 8192; the image is twice as wide.
            rotation_wxyz: Rotation from image to world; the image's +y is its upper edge. Scenes with y down are
                upright with (0, 1, 0, 0).

        Returns:
            Linear Rec.709, shape (H, 2 H, 3).

        Raises:
            ConfigError: ``height`` is out of its range.
            SceneError: The rotation is not a quaternion of non-zero length.
        """
        check_whole("height", height, 1, 8192)
        world_from_image = _matrix(LightEnvironment(rotation_wxyz=rotation_wxyz))
        radiance = self.radiance(panorama_directions(int(height), 2 * int(height)) @ world_from_image.T)
        return read_only_view(_without_ringing(radiance))

    def light(self, height: int = PROBE_IMAGE_ROWS, rotation_wxyz: npt.ArrayLike = _UPRIGHT) -> LightEnvironment:
        """Returns an environment light with the probe's radiance. Only reflections show it; it is no background.

        Args:
            height: Height of the light's image, pixels, 1 to 8192.
            rotation_wxyz: Rotation from image to world, as for `image`. It determines only the axes of the image; the
                light stays the same.

        Raises:
            ConfigError: ``height`` is out of its range.
            SceneError: The rotation is not a quaternion of non-zero length.
        """
        image = self.image(height, rotation_wxyz)
        return LightEnvironment(image=image, rotation_wxyz=rotation_wxyz, visible=False, name="probe")

    def save(
        self,
        path: str | os.PathLike[str],
        height: int = PROBE_IMAGE_ROWS,
        rotation_wxyz: npt.ArrayLike = _UPRIGHT,
    ) -> None:
        """Writes `image` as a linear latitude-longitude EXR file, which any renderer can read.

        Args:
            path: File to write, .exr.
            height: Height of the image, pixels, 1 to 8192.
            rotation_wxyz: Rotation from image to world, as for `image`.

        Raises:
            ConfigError: ``height`` is out of its range.
            FormatError: The extension is not .exr, or the file cannot be written.
        """
        if Path(path).suffix.lower() != ".exr":
            raise FormatError(path, f"unknown extension '{Path(path).suffix}' for a probe's image, expected .exr")
        write_radiance(path, self.image(height, rotation_wxyz))

    def _evaluate(self, directions: npt.ArrayLike, factors: Doubles) -> FloatArray:
        """Evaluates the SH in directions of any length; ``factors``, shape (K,), multiply the coefficients."""
        checked = float_array("directions", directions)
        if checked.ndim == 0 or checked.shape[-1] != 3:
            raise SceneError(f"directions has shape {checked.shape}, expected (..., 3)")
        unit = normalise_rows("directions", checked.reshape(-1, 3))
        scaled = sh_basis(unit, self.degree) @ (self.coefficients * factors[:, None])
        return scaled.astype(np.float32).reshape(checked.shape)


def _samples(scene: Scene, center: Doubles, renderer: Renderer, face_px: int, near: float) -> CubeSamples:
    """Renders the cube map of a probe; arguments as for `EnvironmentProbe.capture`."""
    bounces = bool(scene.splats) and renderer.config.pipeline.bounces_light
    if renderer.config.lighting is None and scene.is_lit_by_default and not scene.lights and not bounces:
        # Without lights, meshes get a headlight or captured light: the probe must not hold either.
        renderer = create_renderer(replace(renderer.config, lighting=False), renderer.device)
    return render_cube(scene, center, renderer.render, face_px, near)


def _without_ringing(image: FloatArray) -> FloatArray:
    """Returns a latitude-longitude image without negative values; the rest is scaled to keep the sphere's mean."""
    shares = panorama_solid_angles(*image.shape[:2])[:, None, None]
    cut = np.maximum(image, np.float32(0.0))
    before, after = (np.sum(shares * values, axis=(0, 1)) for values in (image, cut))
    factors = np.divide(np.maximum(before, 0.0), after, out=np.ones(3), where=after > 0.0)
    return cut * factors.astype(np.float32)


def _matrix(light: LightEnvironment) -> Doubles:
    """Returns the rotation from the axes of an environment's image to the world, shape (3, 3)."""
    return matrices_from_quaternions(np.array([light.rotation_wxyz]))[0]


def cosine_factors(degree: int) -> Doubles:
    """Returns the factors by which convolution with the clamped cosine multiplies SH coefficients, shape (K,)."""
    levels = range(degree + 1)
    return np.repeat([_cosine_factor(level) for level in levels], [2 * level + 1 for level in levels])


def _cosine_factor(level: int) -> float:
    """Returns the factor by which convolution with the clamped cosine multiplies SH degree ``level``."""
    if level == 1:
        return 2.0 * math.pi / 3.0
    if level % 2:
        return 0.0
    half = level // 2
    sign = -1.0 if half % 2 == 0 else 1.0
    ratio = math.factorial(level) / (2.0**level * math.factorial(half) ** 2)
    return sign * 2.0 * math.pi / ((level + 2.0) * (level - 1.0)) * ratio


def _fit(
    directions: Doubles, radiance: npt.NDArray[np.floating], weights: Doubles, degree: int, ridge: float
) -> Doubles:
    """Solves ``(B^T W B + lambda I) A = B^T W Y`` for the SH coefficients A, shape (K, 3).

    Args:
        directions: N directions, at which the SH basis B is evaluated, shape (N, 3).
        radiance: Samples Y, shape (N, 3).
        weights: Weights W, shape (N,).
        degree: SH degree.
        ridge: Ridge lambda.
    """
    size = (degree + 1) ** 2
    gram, moments = np.zeros((size, size)), np.zeros((size, 3))
    scaled = weights * (4.0 * np.pi / weights.sum())
    for first in range(0, len(directions), _ROWS_AT_ONCE):
        rows = slice(first, first + _ROWS_AT_ONCE)
        basis = sh_basis(directions[rows], degree)
        weighted = basis * scaled[rows, None]
        gram += weighted.T @ basis
        moments += weighted.T @ radiance[rows]
    gram += ridge * np.eye(size)
    rank = int(np.linalg.matrix_rank(gram))
    if rank < size:
        raise SceneError(
            f"the directions determine only {rank} of the {size} SH coefficients of degree {degree}: lower the degree, "
            "or give a ridge"
        )
    return np.asarray(np.linalg.solve(gram, moments), np.float64)


def fit_gradient(directions: Doubles, weights: Doubles, by_coefficients: Doubles, ridge: float) -> Doubles:
    """Returns the gradient of a loss by the radiance that a probe is fitted to, from that by the coefficients.

    Args:
        directions: N unit directions of the samples, shape (N, 3).
        weights: Weights of the samples, shape (N,).
        by_coefficients: Gradient by the probe's K coefficients, shape (K, 3).
        ridge: As for `EnvironmentProbe.fit`.

    Returns:
        Shape (N, 3).
    """
    basis = sh_basis(directions, math.isqrt(len(by_coefficients)) - 1)
    weighted: Doubles = basis * (weights * (4.0 * np.pi / weights.sum()))[:, None]
    gram = weighted.T @ basis + ridge * np.eye(len(by_coefficients))
    return weighted @ np.linalg.solve(gram, by_coefficients)


_DEGREE = 3
"""SH degree of the probes of `ProbeCache`, which suffices for diffuse surfaces."""

_PROBES_CACHED = 64
"""Maximum number of probes that `ProbeCache` keeps; a scene has fewer actors. A full cache drops all probes."""


class ProbeCache:
    """Captures probes of a scene, and caches up to `_PROBES_CACHED` of them by position, for actors that do not move.

    Args:
        scene: The scene without actors.
        background: Background of uncovered directions, display-referred sRGB, 0..1 each.
        device: As for `create_renderer`.
        progress: Called with a label and a fraction 0..1, while kernels compile.
    """

    def __init__(
        self, scene: Scene, background: tuple[float, float, float], device: str, progress: Progress | None
    ) -> None:
        self._scene, self._config = scene, RenderConfig(background=background)
        self._device, self._progress = device, progress
        self._renderer: Renderer | None = None
        """Renderer of the probes, created for the first probe, so that scenes without probes load no kernels."""
        self._probes: dict[bytes, tuple[EnvironmentProbe, EnvironmentProbe]] = {}

    def take_scene(self, scene: Scene) -> None:
        """Takes another scene for the next probes, which the same renderer captures."""
        self._scene = scene
        self._probes.clear()

    def at(self, center: npt.NDArray[np.float64]) -> EnvironmentProbe:
        """Returns the probe at a world position, shape (3,): rendered now, or kept from an earlier call."""
        return self._pair(center)[0]

    def open_at(self, center: npt.NDArray[np.float64]) -> EnvironmentProbe:
        """Returns a probe with radiance 1 in the directions that the scene leaves open at a position, shape (3,)."""
        return self._pair(center)[1]

    def _pair(self, center: npt.NDArray[np.float64]) -> tuple[EnvironmentProbe, EnvironmentProbe]:
        """Returns the probes of `at` and `open_at`, which share a cube map."""
        key = center.tobytes()
        if key not in self._probes:
            if self._renderer is None:
                self._renderer = create_renderer(self._config, self._device, progress=self._progress)
            if len(self._probes) >= _PROBES_CACHED:
                self._probes.clear()
            samples = _samples(self._scene, center, self._renderer, PROBE_FACE_PX, NEAR_PLANE)
            uncovered = np.repeat(1.0 - samples.alpha.astype(np.float64)[:, None], 3, axis=1)
            light, open_directions = (
                EnvironmentProbe(_fit(samples.directions, values, samples.weights, _DEGREE, PROBE_RIDGE))
                for values in (samples.radiance, uncovered)
            )
            self._probes[key] = light, open_directions
        return self._probes[key]
