"""Implements ``bake``: turns a lit scene into captures that every Gaussian splat viewer can show."""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from lumisplat.baking.bake_denoising import angularly_denoised
from lumisplat.baking.gaussian_views import GaussianViewer, ViewRadiance
from lumisplat.baking.joint_sh_fit import JointShFit
from lumisplat.baking.sample_rays import (
    SampleRays,
    on_visible_sides,
    plane_normals,
    random_rotations,
    rotated_directions,
    view_weights,
)
from lumisplat.config import Pipeline, RenderConfig
from lumisplat.config.checks import check_whole
from lumisplat.constants import RIDGE, SAMPLES_MAX, SH_DEGREE_MAX
from lumisplat.errors import ConfigError, SceneError
from lumisplat.math.arrays import Doubles, Flags, FloatArray, read_only_view
from lumisplat.math.color import decode_srgb
from lumisplat.math.sh import sh_basis
from lumisplat.math.tone_map import lit_picture
from lumisplat.progress import Progress
from lumisplat.renderer.checks import check_scene, checked_config
from lumisplat.renderer.scene.materials import emits_capture_only, is_relit
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.local_frame import LocalFrame, rendered_frame
from lumisplat.scene.ops.colors import scale_light_of
from lumisplat.scene.scene import Scene, SplatInstance

BAKE_DIRECTIONS = 32
"""Directions from which each Gaussian is viewed: twice the number of SH coefficients of degree 3, because half of the
views show the back of the Gaussian."""

BAKE_SAMPLES = 8
"""Paths per view of a Gaussian; even, because the noise is estimated from the difference of the two halves."""

VIEWS_AT_ONCE = 2**17
"""Number of views (a Gaussian from one direction) that are on the device at once; their arrays take about 60 MiB."""

PILOT_DIRECTIONS = 8
"""Number of directions of a Gaussian's pilot views, which find its visible side; each view traces two paths."""

SIGNAL_MIN = 1e-8
"""Lower bound of the variance, over directions, of a Gaussian's colours in 0..1: a standard deviation of 1e-4."""

BAKE_DIRECTIONS_MAX = 1024
"""Largest number of directions. A larger one is taken for a typing error, because SH of degree 3 has 16 coefficients.
"""

_log = logging.getLogger("lumisplat")


def bake(
    scene: Scene,
    config: RenderConfig | None = None,
    *,
    degree: int = SH_DEGREE_MAX,
    directions: int = BAKE_DIRECTIONS,
    exposure: float = 0.0,
    device: str = "auto",
    progress: Progress | None = None,
) -> Scene:
    """Bakes the light of a scene, with shadows, bounces and highlights, into the SH colours of its splat sets.

    Path tracing renders each Gaussian from directions all around it. The radiance is tone-mapped and fitted by the
    Gaussian's SH coefficients, which every viewer of captures shows. Meshes and lights act on the splats but are not in
    the result; `gaussians_from_mesh` converts a mesh to Gaussians. Unlit captures are returned unchanged, to the bit.
    Captures that are a ``shadow_catcher`` are darkened or brightened by what was added to the scene. Source:
    docs/method/relighting.md#baking.

    SH colours are display-referred and end at display white, so choose ``exposure`` and ``config.tone_map`` as for a
    rendered image.

    Args:
        scene: Scene with a material on the splat sets that are to be lit, and with at least one source of light.
        config: Settings; None: path tracing. ``Pipeline.TRACE`` bakes direct light without bounces. ``samples`` is the
            number of samples per ray, at least 2; None: 8. The time is proportional to it.
        degree: SH degree of the result, 0 to 3; higher degrees keep more view dependence.
        directions: Directions from which each Gaussian is viewed, 4 to 1024.
        exposure: Exposure in stops, as of a camera.
        device: As for `create_renderer`.
        progress: Called with a label and the fraction done, 0..1.

    Returns:
        The scene's splat instances with the same transforms, without materials, meshes and lights. Gaussians of lit
        sets keep everything but their SH, and lose albedo, roughness and metallic, so that they are not lit a second
        time.

    Raises:
        ConfigError: A number is out of range, or the pipeline does not trace rays.
        DeviceError: There is no such device, or it is out of memory.
        SceneError: There are no splat sets, none of them reflects light, or there is no light.
    """
    config = RenderConfig(pipeline=Pipeline.PATH) if config is None else checked_config(config)
    check_scene(scene)
    settings = _Settings(config, degree, directions, exposure)
    lit = [not emits_capture_only(instance) for instance in scene.splats]
    if not scene.splats:
        raise SceneError("bake takes a scene with splat sets: convert meshes with gaussians_from_mesh")
    if not any(lit):
        raise SceneError(
            "nothing to bake: no splat set has a material or an albedo, so all show their captured colours under any "
            "light: add a material, or estimate an albedo with delight"
        )
    viewer = GaussianViewer(config, Launcher(device), progress)
    frame, _ = rendered_frame(scene)
    scene = frame.scene(scene)
    viewer.upload(scene, _extent(scene), progress)
    if not viewer.is_lit:
        raise SceneError("nothing to bake: the scene has no lights, no environment and no emission")
    joint = sum(one.gaussians.count for one in scene.splats if is_relit(one))
    rays = SampleRays.allocated(joint, directions)
    baker = _Baker(viewer, settings, progress, scene.gaussian_count, rays)
    splats = [baker.baked(scene, k) if is_lit else scene.splats[k] for k, is_lit in enumerate(lit)]
    back = LocalFrame(-frame.origin)
    return back.scene(Scene(baker.joint_fitted(scene, splats), up=scene.up))


@dataclass(frozen=True, slots=True)
class _Settings:
    """Settings of a bake; raises ConfigError if a value is out of range."""

    config: RenderConfig
    degree: int
    directions: int
    exposure: float

    def __post_init__(self) -> None:
        check_whole("degree", self.degree, 0, SH_DEGREE_MAX)
        check_whole("directions", self.directions, 4, BAKE_DIRECTIONS_MAX)
        if self.config.pipeline.rasterises:
            raise ConfigError(f"bake takes Pipeline.PATH, or TRACE for direct light, got {self.config.pipeline}")
        check_whole("samples", self.samples, 2, SAMPLES_MAX)
        if not math.isfinite(self.exposure):
            raise ConfigError(f"exposure is {self.exposure}, expected stops, such as 1.0")

    @property
    def samples(self) -> int:
        """Samples per view of a Gaussian: ``config.samples``, or `BAKE_SAMPLES` if that is None."""
        return self.config.samples or BAKE_SAMPLES

    @property
    def samples_separate(self) -> int:
        """Samples per view in the separate fit of each Gaussian, half of ``samples``, where a joint fit follows."""
        return max(self.samples // 2, 2)


@dataclass(slots=True)
class _Baker:
    """Bakes the splat sets of a scene, some thousands of Gaussians at a time."""

    viewer: GaussianViewer
    settings: _Settings
    progress: Progress | None
    total: int
    """Number of Gaussians in the scene."""
    rays: SampleRays
    """Distributions of camera rays towards the Gaussians of the relit sets, one row per Gaussian; rows stay
    uninitialised until their set is baked."""
    rays_stored: int = 0

    def baked(self, scene: Scene, number: int) -> SplatInstance:
        """Returns splat instance ``number`` of the scene with its light baked into the SH."""
        instance = scene.splats[number]
        first = sum(one.gaussians.count for one in scene.splats[:number])
        parts: list[FloatArray] = []
        nonfinite = 0
        samples = self.settings.samples_separate if is_relit(instance) else self.settings.samples
        for views in self._views(instance, first):
            viewed = self._rendered(views, samples)
            nonfinite += viewed.nonfinite
            if instance.shadow_catcher:
                parts.append(views.shadow(viewed))
                continue
            parts.append(views.fitted_sh(viewed, self.settings))
            if is_relit(instance):
                self.rays.put(self.rays_stored, views.rays(viewed, instance))
                self.rays_stored += views.gaussians.count
        if nonfinite:
            _log.warning(
                "%d samples of %s were not finite and were dropped: lights or materials are too bright for float32",
                nonfinite,
                instance.name or "a set",
            )
        joined = np.concatenate(parts)
        if instance.shadow_catcher:
            return replace(scale_light_of(instance, joined), material=None, shadow_catcher=False)
        bare = dict.fromkeys(("albedo", "roughness", "metallic", "albedo_error", "roughness_error"))
        baked = replace(instance.gaussians, sh=read_only_view(joined), **bare)
        return replace(instance, gaussians=baked, material=None, sh_degree=SH_DEGREE_MAX)

    def joint_fitted(self, scene: Scene, splats: list[SplatInstance]) -> list[SplatInstance]:
        """Refits the SH of all relit sets jointly, so that alpha blends of Gaussians match rendered frames."""
        if not self.rays_stored:
            return splats
        terms = (self.settings.degree + 1) ** 2
        config = replace(self.settings.config, samples=self.settings.samples)
        joint = JointShFit(scene, config, self.settings.exposure, self.viewer.launcher)
        separate = np.zeros((scene.gaussian_count, terms, 3))
        firsts = np.cumsum([0, *(one.gaussians.count for one in splats)])
        rows = [slice(*ends) for ends in itertools.pairwise(firsts)]
        relit = [is_relit(one) for one in scene.splats]
        for row, one in itertools.compress(zip(rows, splats, strict=True), relit):
            separate[row] = one.gaussians.sh
        changed = joint.refitted(separate, self.rays, self.progress).astype(np.float32)
        return [
            replace(one, gaussians=replace(one.gaussians, sh=read_only_view(changed[row]))) if is_relit_set else one
            for one, row, is_relit_set in zip(splats, rows, relit, strict=True)
        ]

    def _views(self, instance: SplatInstance, first: int) -> Iterator[_Views]:
        """Yields the views of a splat instance, in batches of consecutive Gaussians.

        ``first`` is the index of the instance's first Gaussian among all Gaussians of the scene.
        """
        count = instance.gaussians.count
        at_once = max(VIEWS_AT_ONCE // self.settings.directions, 1)
        rotation = instance.transform[:3, :3] / instance.scale
        rotations = random_rotations(count, np.random.default_rng((self.settings.config.seed, first)))
        for begin in range(0, count, at_once):
            rows = np.arange(begin, min(begin + at_once, count))
            if self.progress:
                self.progress("baking", 0.5 * (first + begin) / self.total)
            some = instance.gaussians.subset(rows)
            directions = rotated_directions(self.settings.directions, rotations[rows])
            pilot = _Views(some, rotated_directions(PILOT_DIRECTIONS, rotations[rows]), rotation, first + begin)
            yield replace(pilot, directions=pilot.on_visible_sides(self._rendered(pilot, 2), directions))

    def _rendered(self, views: _Views, samples: int) -> ViewRadiance:
        """Renders the given views with ``samples`` samples each."""
        count = views.directions.shape[1]
        gaussian = np.repeat(np.arange(views.first, views.first + views.gaussians.count), count)
        number = views.first * count % 2**30  # seeds 32-bit random numbers on the device
        return self.viewer.render_views(number, gaussian, views.along, samples)


@dataclass(frozen=True, slots=True)
class _Views:
    """Batch of N consecutive Gaussians of a splat instance, and the D directions from which each is viewed."""

    gaussians: Gaussians
    directions: Doubles
    """Unit directions from the camera to each of N Gaussians, D each, object space, shape (N, D, 3)."""
    rotation: Doubles
    """Rotation of the splat instance from object to world space, shape (3, 3)."""
    first: int
    """Index of the batch's first Gaussian among all Gaussians of the scene."""

    @property
    def along(self) -> FloatArray:
        """Unit directions from the camera to N Gaussians, D each, world space, shape (N * D, 3)."""
        return (self.directions.reshape(-1, 3) @ self.rotation.T).astype(np.float32)

    def on_visible_sides(self, viewed: ViewRadiance, directions: Doubles) -> Doubles:
        """Returns ``directions``, mirrored to the side of each Gaussian that pilot views found visible.

        Args:
            viewed: Radiance and visible distances of the pilot views.
            directions: E directions from the camera to each of the same N Gaussians, object space, shape (N, E, 3).
        """
        weights = self._weights(viewed)
        return on_visible_sides(directions, plane_normals(self.gaussians), weights, self._front)

    def fitted_sh(self, viewed: ViewRadiance, settings: _Settings) -> FloatArray:
        """Fits K SH coefficients to the radiance of the views of each of N Gaussians, shape (N, K, 3)."""
        shape = (*self.directions.shape[:2], 3)
        even, odd = viewed.even.reshape(shape), viewed.odd.reshape(shape)
        front = self._front
        captured, captured_weight = viewed.captured.reshape(shape), viewed.captured_weight.reshape(shape[:2])
        weights = self._weights(viewed)
        even, odd = angularly_denoised(even, odd, weights, front)

        def displayed(light: Doubles) -> Doubles:
            return lit_picture(captured, captured_weight, light, settings.exposure, settings.config.tone_map).astype(
                np.float64
            )

        # The tone curve biases noisy values, the mean half as much as each half: extrapolation removes the bias.
        halves = displayed(even), displayed(odd)
        noise = 0.25 * np.square(halves[0] - halves[1]).mean(axis=2)
        shares = weights / weights.sum(axis=1, keepdims=True)
        colors = 2.0 * displayed(0.5 * (even + odd)) - 0.5 * (halves[0] + halves[1])
        return fit_sh(self.directions, colors, (shares * noise).sum(axis=1), weights, settings.degree)

    def rays(self, viewed: ViewRadiance, instance: SplatInstance) -> SampleRays:
        """Returns the distribution of camera rays towards each Gaussian, with probabilities from the views' weights."""
        weights, distances = self._weights(viewed), viewed.distance.reshape(self.directions.shape[:2])
        some = replace(instance, gaussians=self.gaussians)
        return SampleRays.of_views(some, self.directions, weights, distances, self.first)

    def shadow(self, viewed: ViewRadiance) -> FloatArray:
        """Returns a factor for the captured colour of each of N Gaussians of a shadow catcher, shape (N, 3).

        The factor is irradiance with over irradiance without the objects added to the scene: 1 where they change
        nothing.
        """
        shape = (*self.directions.shape[:2], 3)
        weights = self._weights(viewed)[..., None]
        change = (weights * viewed.change.reshape(shape)).sum(axis=1)
        received = (weights * viewed.received.reshape(shape)).sum(axis=1)
        share = np.divide(change, received, out=np.zeros_like(change), where=received > 0.0)
        return np.maximum(1.0 + share, 0.0).astype(np.float32)

    @property
    def _front(self) -> Flags:
        normals = plane_normals(self.gaussians)
        return (self.directions @ normals[:, :, None])[..., 0] < 0.0

    def _weights(self, viewed: ViewRadiance) -> Doubles:
        """Returns the weight of each of D views of N Gaussians in SH fits and means (`view_weights`), shape (N, D)."""
        shape = self.directions.shape[:2]
        light = (0.5 * (viewed.even + viewed.odd) + decode_srgb(viewed.captured)).reshape(*shape, 3)
        has_front = self.gaussians.normals is not None
        return view_weights(self._front, light, viewed.distance.reshape(shape), has_front=has_front)


def _extent(scene: Scene) -> float:
    """Returns the largest distance from which cameras view a Gaussian: the diagonal of the scene without outliers."""
    low, high = scene.bulk_bounds()
    return max(float(np.linalg.norm(high - low)), 1e-6)


def fit_sh(directions: Doubles, colors: Doubles, noise: Doubles, weights: Doubles, degree: int) -> FloatArray:
    """Fits SH coefficients to the colours of N Gaussians in D views each, by weighted ridge least squares.

    The colour of a Gaussian is its SH series plus 0.5.

    Args:
        directions: Unit directions from the camera to the Gaussian, object space, shape (N, D, 3).
        colors: Display-referred colours, shape (N, D, 3).
        noise: Variance of the noise in each Gaussian's colours, shape (N,).
        weights: Weights of the views, at least 0, shape (N, D).
        degree: SH degree, 0 to 3.

    Returns:
        Coefficients, shape (N, K, 3), K = (degree + 1)^2.
    """
    basis = sh_basis(directions, degree)
    shares = weights / weights.sum(axis=1, keepdims=True)
    weighted = shares[..., None] * basis
    matrix = 4.0 * np.pi * np.swapaxes(weighted, 1, 2) @ basis
    right = 4.0 * np.pi * np.swapaxes(weighted, 1, 2) @ (colors - 0.5)
    matrix += _penalties(colors, noise, shares, degree)[:, :, None] * np.eye(basis.shape[2])
    sh = cast("Doubles", np.linalg.solve(matrix, right))
    return sh.astype(np.float32)


def _penalties(colors: Doubles, noise: Doubles, shares: Doubles, degree: int) -> Doubles:
    """Returns the ridge penalty of each of K SH coefficients of N Gaussians, shape (N, K).

    The penalty is the noise variance of a coefficient over its expected variance (Wiener filter). The expected variance
    is the variance of the colours over directions minus that of the noise, distributed over the degrees l as 1 / l^2. A
    small penalty of all degrees above 0 keeps the system regular. ``shares`` are the views' weights, scaled to a sum of
    1.
    """
    mean = (shares[..., None] * colors).sum(axis=1, keepdims=True)
    spread = (shares * np.square(colors - mean).mean(axis=2)).sum(axis=1)
    signal = np.maximum(spread - noise, SIGNAL_MIN)
    ratio = noise * np.square(shares).sum(axis=1) / signal
    level = np.floor(np.sqrt(np.arange((degree + 1) ** 2) + 0.5))
    even = sum((2 * one + 1) / one**2 for one in range(1, degree + 1))
    return ratio[:, None] * (even * level**2) + RIDGE * np.square(level * (level + 1.0))
