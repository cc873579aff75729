"""Bakes lit scenes into captures that every viewer shows: ``bake``."""

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
"""From which each Gaussian is looked at: twice as many as the harmonics of degree 3, as half of them see its back."""

BAKE_SAMPLES = 8
"""Paths a ray; even, so that both halves tell the noise."""

VIEWS_AT_ONCE = 2**17
"""Views that are on the device at once: some 60 MiB."""

PILOT_DIRECTIONS = 8
"""From which each Gaussian is seen first, to know on which side it is seen; with two paths each."""

SIGNAL_MIN = 1e-8
"""Variance of colours over directions below which they are taken to be one, display-referred: 0.03 of 255."""

BAKE_DIRECTIONS_MAX = 1024
"""More directions of a Gaussian are a typing error: harmonics of degree 3 have 16 coefficients."""

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
    """The splat sets of a scene as captures of how they look in its light: with shadows, bounces and highlights.

    Each Gaussian is seen from directions all around it by paths of light. What it shows is tone-mapped, and fitted by
    its spherical harmonics, so that every viewer of captures shows it. Meshes and lights do their part, and are not in
    the result; `gaussians_from_mesh` makes Gaussians of a mesh. Sets that keep their captured light come out as they
    are, to the bit; ``shadow_catcher`` ones are darkened, or brightened, by what was added to them. Source:
    docs/method/relighting.md#baking.

    Captures hold what a display shows: what is brighter than its white is white, so choose ``exposure`` and
    ``config.tone_map`` as for a picture.

    Args:
        scene: Sets that are to be lit have a material. Something gives light.
        config: Settings; None: paths. ``Pipeline.TRACE`` is direct light without bounces. ``samples`` are those of
            each ray, from 2 on; None: 8. More are less noisy, and take as much longer.
        degree: Of the harmonics, 0 to 3: how much of what changes with the direction of view is kept.
        directions: From which each Gaussian is seen, 4 to 1024.
        exposure: Stops by which the light is brightened, as that of a camera.
        device: As for `create_renderer`.
        progress: Called with a label and the fraction done, 0..1.

    Returns:
        The same instances in the same places, without materials, meshes and lights. Of sets that were lit, the
        Gaussians keep everything but their harmonics, and lose albedo, roughness and metallic, which would be lit
        again.

    Raises:
        ConfigError: A number is out of range, or the pipeline does not follow rays.
        DeviceError: There is no such device, or it is out of memory.
        SceneError: There are no splat sets, or none that light changes, or no light.
    """
    config = RenderConfig(pipeline=Pipeline.PATH) if config is None else checked_config(config)
    check_scene(scene)
    settings = _Settings(config, degree, directions, exposure)
    lit = [not emits_capture_only(instance) for instance in scene.splats]
    if not scene.splats:
        raise SceneError("bake takes a scene with splat sets: gaussians_from_mesh makes one of a mesh")
    if not any(lit):
        raise SceneError(
            "nothing to bake: no splat set has a material or an albedo, so all show what was captured in any light; "
            "delight finds an albedo"
        )
    viewer = GaussianViewer(config, Launcher(device), progress)
    frame, _ = rendered_frame(scene)
    scene = frame.scene(scene)
    viewer.upload(scene, _extent(scene), progress)
    if not viewer.is_lit:
        raise SceneError("nothing to bake: the scene has no lights or environment, and nothing in it shines")
    joint = sum(one.gaussians.count for one in scene.splats if is_relit(one))
    rays = SampleRays.allocated(joint, directions)
    baker = _Baker(viewer, settings, progress, scene.gaussian_count, rays)
    splats = [baker.baked(scene, k) if is_lit else scene.splats[k] for k, is_lit in enumerate(lit)]
    back = LocalFrame(-frame.origin)
    return back.scene(Scene(baker.joint_fitted(scene, splats), up=scene.up))


@dataclass(frozen=True, slots=True)
class _Settings:
    """How sets are baked; raises ConfigError if a value is out of range."""

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
        """Number of samples of each ray."""
        return self.config.samples or BAKE_SAMPLES

    @property
    def samples_separate(self) -> int:
        """Number of samples of each direction, for sets that are fitted together afterwards."""
        return max(self.samples // 2, 2)


@dataclass(slots=True)
class _Baker:
    """Bakes the sets of a scene, some Gaussians at a time."""

    viewer: GaussianViewer
    settings: _Settings
    progress: Progress | None
    total: int
    """Gaussians of the scene."""
    rays: SampleRays
    """Along which eyes see the Gaussians of relit sets; of as many of them as are baked."""
    rays_stored: int = 0

    def baked(self, scene: Scene, number: int) -> SplatInstance:
        """The instance of this number, as it looks in the light of the scene."""
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
                "%d samples of %s were not finite and left out: lights or materials are too bright for float32",
                nonfinite,
                instance.name or "a set",
            )
        joined = np.concatenate(parts)
        if instance.shadow_catcher:
            return replace(scale_light_of(instance, joined), material=None, shadow_catcher=False)
        baked = replace(instance.gaussians, sh=read_only_view(joined), albedo=None, roughness=None, metallic=None)
        return replace(instance, gaussians=baked, material=None, sh_degree=SH_DEGREE_MAX)

    def joint_fitted(self, scene: Scene, splats: list[SplatInstance]) -> list[SplatInstance]:
        """The sets, with harmonics of relit ones changed such that blends of them show what frames do."""
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
        """The views of a set, of some Gaussians at a time."""
        count = instance.gaussians.count
        at_once = max(VIEWS_AT_ONCE // self.settings.directions, 1)
        rotation = instance.transform[:3, :3] / instance.scale
        rotations = random_rotations(count, np.random.default_rng((self.settings.config.seed, first)))
        for begin in range(0, count, at_once):
            rows = np.arange(begin, min(begin + at_once, count))
            if self.progress:
                self.progress("baking", 0.5 * (first + begin) / self.total)
            some = instance.gaussians.subset(rows)
            turned = rotated_directions(self.settings.directions, rotations[rows])
            pilot = _Views(some, rotated_directions(PILOT_DIRECTIONS, rotations[rows]), rotation, first + begin)
            yield replace(pilot, directions=pilot.on_visible_sides(self._rendered(pilot, 2), turned))

    def _rendered(self, views: _Views, samples: int) -> ViewRadiance:
        """Renders views of Gaussians; returns what they show."""
        count = views.directions.shape[1]
        gaussian = np.repeat(np.arange(views.first, views.first + views.gaussians.count), count)
        number = views.first * count % 2**30  # of random numbers: 32 bits on the device
        return self.viewer.render_views(number, gaussian, views.along, samples)


@dataclass(frozen=True, slots=True)
class _Views:
    """Gaussians of a set, and the directions from which they are seen."""

    gaussians: Gaussians
    directions: Doubles
    """From the eye, object space, (N, D, 3)."""
    rotation: Doubles
    """World from object, (3, 3)."""
    first: int
    """Number of the first Gaussian among all of the scene's."""

    @property
    def along(self) -> FloatArray:
        """The directions in world space, a view each, (N * D, 3)."""
        return (self.directions.reshape(-1, 3) @ self.rotation.T).astype(np.float32)

    def on_visible_sides(self, viewed: ViewRadiance, directions: Doubles) -> Doubles:
        """Other directions of these Gaussians, on the sides that count by what these views show."""
        weights = self._weights(viewed)
        return on_visible_sides(directions, plane_normals(self.gaussians), weights, self._front)

    def fitted_sh(self, viewed: ViewRadiance, settings: _Settings) -> FloatArray:
        """Harmonics of what views show, (N, K, 3)."""
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

        # The curve bends noise: that of the mean by half as much as that of the halves, which is taken out.
        halves = displayed(even), displayed(odd)
        noise = 0.25 * np.square(halves[0] - halves[1]).mean(axis=2)
        shares = weights / weights.sum(axis=1, keepdims=True)
        colors = 2.0 * displayed(0.5 * (even + odd)) - 0.5 * (halves[0] + halves[1])
        return fit_sh(self.directions, colors, (shares * noise).sum(axis=1), weights, settings.degree)

    def rays(self, viewed: ViewRadiance, instance: SplatInstance) -> SampleRays:
        """Along which eyes see these Gaussians of the instance, by what views show."""
        weights, distances = self._weights(viewed), viewed.distance.reshape(self.directions.shape[:2])
        some = replace(instance, gaussians=self.gaussians)
        return SampleRays.of_views(some, self.directions, weights, distances, self.first)

    def shadow(self, viewed: ViewRadiance) -> FloatArray:
        """Factors of the light of captured colours, (N, 3); exactly 1 where nothing has changed."""
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
        """How much views count, (N, D)."""
        shape = self.directions.shape[:2]
        light = (0.5 * (viewed.even + viewed.odd) + decode_srgb(viewed.captured)).reshape(*shape, 3)
        has_front = self.gaussians.normals is not None
        return view_weights(self._front, light, viewed.distance.reshape(shape), has_front=has_front)


def _extent(scene: Scene) -> float:
    """How far away eyes may be: the diagonal of a box around the bulk of the scene."""
    low, high = scene.bulk_bounds()
    return max(float(np.linalg.norm(high - low)), 1e-6)


def fit_sh(directions: Doubles, colors: Doubles, noise: Doubles, weights: Doubles, degree: int) -> FloatArray:
    """The harmonics whose colours ``SH + 0.5`` are nearest to those that were seen.

    Args:
        directions: From the eye to the Gaussian, in its own space, unit, shape (N, D, 3).
        colors: Display-referred, shape (N, D, 3).
        noise: Variance of these, shape (N,).
        weights: Of the views, at least 0, shape (N, D).
        degree: 0 to 3.

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
    """Returns what is added to the diagonal of each system, shape (N, K).

    As much as the noise of a coefficient is of the variance that is to be expected of it (Wiener): what colours vary
    with the direction but for noise, shared among the degrees as 1 / l^2. And a little, so that all is determined.
    """
    mean = (shares[..., None] * colors).sum(axis=1, keepdims=True)
    spread = (shares * np.square(colors - mean).mean(axis=2)).sum(axis=1)
    signal = np.maximum(spread - noise, SIGNAL_MIN)
    ratio = noise * np.square(shares).sum(axis=1) / signal
    level = np.floor(np.sqrt(np.arange((degree + 1) ** 2) + 0.5))
    even = sum((2 * one + 1) / one**2 for one in range(1, degree + 1))
    return ratio[:, None] * (even * level**2) + RIDGE * np.square(level * (level + 1.0))
