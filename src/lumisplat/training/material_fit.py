"""Optimises materials and environment: shades the Gaussians, renders them, and compares the frame with an image.

Smoothness terms over pairs of neighbouring Gaussians keep their materials similar.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import ModuleType

import numpy as np
from scipy.spatial import cKDTree

from lumisplat.config import MaterialsConfig, TrainConfig
from lumisplat.config.checks import Color
from lumisplat.constants import RADIANCE_LEAST
from lumisplat.device.structs.camera import PixelData
from lumisplat.device.structs.gradients import PixelGradient
from lumisplat.math.adam import Adam
from lumisplat.math.arrays import Doubles, FloatArray, Rows
from lumisplat.math.directions import panorama_directions
from lumisplat.progress import Progress
from lumisplat.relighting.irradiance import Irradiance, chroma_similarity, constant_radiance, typical_albedo_factor
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.training import loss_kernels, material_gradient_kernels, material_kernels, optimizer_kernels
from lumisplat.training.backends import TrainingRaster
from lumisplat.training.lit_gaussians import IncidentRadiance, LitGaussians, Materials
from lumisplat.training.losses import ImageLoss, Loss
from lumisplat.training.material_parameters import (
    MaterialParameters,
    MaterialRates,
    nearest_directions,
    smoothness_gradient,
)
from lumisplat.training.parameters import DeviceParameters, TrainedParameters
from lumisplat.training.trainer import frame_settings
from lumisplat.training.views import TrainingView

LOGIT_MAX = 16.0
"""Largest magnitude of opacity logits: those of opacities 0 and 1, which would be infinite, are clamped to it."""


class ColoredGaussians:
    """Rasterises Gaussians of fixed geometry, whose colours in ``sh`` change between frames.

    Args:
        launcher: Runs the kernels.
        buffers: Owner of the device arrays.
        gaussians: The capture.
        background: Display-referred sRGB behind the capture.
        kernels: Further kernel modules to load.
        progress: Called while kernels compile.
    """

    def __init__(
        self,
        launcher: Launcher,
        buffers: Buffers,
        gaussians: Gaussians,
        background: Color,
        *,
        kernels: tuple[ModuleType, ...],
        progress: Progress | None,
    ) -> None:
        flat = TrainConfig(sh_degree=0, antialiased=gaussians.antialiased, cap=gaussians.count)
        settings = frame_settings(flat, background)
        modules = (optimizer_kernels, loss_kernels, *kernels)
        self._raster = TrainingRaster(launcher, buffers, settings)
        launcher.load([*self._raster.modules(), *modules], progress)
        self._drawn = DeviceParameters(buffers)
        parameters = _unlit(gaussians)
        self._drawn.upload(parameters)
        self._raster.bind(parameters.gaussians(flat), self._drawn.values)

    @property
    def sh(self) -> DeviceArray:
        """Display colours of N Gaussians that ``draw`` shows: SH coefficients of degree 0, ``wp.vec3``, shape (N,)."""
        return device_array(self._drawn.values.sh)

    @property
    def rects(self) -> DeviceArray:
        """Tile rectangle of each Gaussian's splat in the last frame, ``TileRect``; empty for Gaussians not drawn."""
        return self._raster.drawn.splats.rects

    def draw(self, camera: Camera, background: Color) -> PixelData:
        """Renders a pinhole camera's frame of the Gaussians with the colours in ``sh``, and returns its pixels."""
        return self._raster.draw(camera, 0, background)

    def by_splats(self, pixels: PixelData, gradient: PixelGradient) -> DeviceArray:
        """Returns the gradient of the loss with respect to the splats of the last frame, ``SplatGradient``.

        Elements of splats that were not drawn are undefined.
        """
        return self._raster.by_splats(pixels, gradient)


def _unlit(gaussians: Gaussians) -> TrainedParameters:
    """Returns a capture's Gaussians as training parameters, with one zero SH coefficient for each Gaussian."""
    with np.errstate(divide="ignore"):  # opacities 0 and 1 have infinite logits
        opacities = gaussians.opacities.astype(np.float64)
        logits = np.log(opacities) - np.log1p(-opacities)
    return TrainedParameters.new(
        {
            "means": gaussians.means,
            "rotations": gaussians.rotations_wxyz,
            "log_scales": np.log(gaussians.scales),
            "logits": np.clip(logits, -LOGIT_MAX, LOGIT_MAX).astype(np.float32),
            "sh": np.zeros((gaussians.count, 1, 3), np.float32),
        }
    )


ENVIRONMENT_PAIRS = 60_000
"""Number of random pairs of Gaussians whose albedos are compared to find the environment."""

ENVIRONMENT_RATE = 0.05
"""Initial learning rate of the logarithm of the environment's radiance; it falls linearly to 0."""

ENVIRONMENT_PRIOR = 1e-4
"""Weight of the squared change of log radiance from the initial environment. The albedo term, a mean over pairs of
Gaussians (`SimilarPairs.albedo_term`), has weight 1."""

ENVIRONMENT_VISIBLE_MIN = 0.02
"""Fraction of the environment that the median Gaussian must see. Below it, the scene counts as a closed room, whose
environment cannot be estimated."""

CHROMA_WIDTH = 0.15
"""Difference of log chromaticity within which two Gaussians are assumed to have the same albedo."""

EDGE_WIDTH = 0.3
"""Difference of log albedo above which the Cauchy loss treats a pair of Gaussians as lying across a texture edge."""

NEIGHBOURS = 6
"""Number of nearest Gaussians whose albedo and roughness the smoothness terms compare with those of each Gaussian."""

RATES = MaterialRates(albedo=0.01, roughness=0.02, environment=0.005)
"""Initial learning rates. In the second half of the iterations, they fall exponentially to a tenth."""

ALBEDO_SMOOTHNESS = 0.05
"""Weight of the squared difference, within pairs of neighbouring Gaussians, of how much log albedo has changed since
the start of the fit."""

ROUGHNESS_SMOOTHNESS = 0.05
"""Weight of squared differences of roughness between neighbouring Gaussians."""

SSIM_FRACTION = 0.2
"""Fraction of the SSIM term in the image loss, as in training; the rest is L1."""


class MaterialFit:
    """Optimises the materials of Gaussians of fixed geometry, and the environment.

    Args:
        gaussians: The capture.
        views: Its training views.
        incident: Traced incident radiance.
        start: Initial materials and environment.
        config: Settings.
        device: As in `lumisplat.create_renderer`.
        threads: As in `lumisplat.create_renderer`.
        progress: As in `lumisplat.create_renderer`.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        views: Sequence[TrainingView],
        incident: IncidentRadiance,
        start: Materials,
        config: MaterialsConfig,
        *,
        device: str,
        threads: int | None,
        progress: Progress | None,
    ) -> None:
        self._views, self._config = views, config
        launcher = Launcher(device, threads)
        buffers = Buffers(launcher.device)
        self._gaussians = ColoredGaussians(
            launcher,
            buffers,
            gaussians,
            views[0].background,
            kernels=(material_kernels, material_gradient_kernels),
            progress=progress,
        )
        self._loss = ImageLoss(launcher, buffers, ssim=SSIM_FRACTION, alpha=0.0)
        self._lit = LitGaussians(launcher, buffers, gaussians.means, incident, metal=config.metal)
        self._near = neighbour_pairs(gaussians.means)
        self._parameters = MaterialParameters(start, incident.directions)
        self._first = np.log(self.materials.albedo)
        self.iteration = 0
        """Number of iterations completed."""

    @property
    def materials(self) -> Materials:
        """Current materials and environment."""
        return self._parameters.materials

    @property
    def state(self) -> dict[str, Doubles]:
        """State of the parameters by name; the next step depends on it and on ``iteration`` only."""
        return self._parameters.state

    def restore(self, state: dict[str, Doubles], iteration: int) -> None:
        """Continues from a stored state.

        Args:
            state: The ``state`` of a fit with the same initial materials.
            iteration: Number of iterations that the stored fit had completed.
        """
        self._parameters.restore(state, iteration)
        self.iteration = iteration

    def step(self) -> Loss:
        """Runs one iteration; each epoch visits all images in a new random order."""
        epoch, index = divmod(self.iteration, len(self._views))
        order = np.random.default_rng([self._config.seed, 7, epoch]).permutation(len(self._views))
        loss, gradient = self.differentiate(self._views[int(order[index])])
        self._update(gradient)
        self.iteration += 1
        return loss

    def differentiate(self, view: TrainingView) -> tuple[Loss, Materials]:
        """Returns the loss between the shaded Gaussians and an image, and its gradient in the form of `Materials`."""
        image, camera = view.read(), view.camera
        target = self._loss.load(image.color, image.weight, None)
        self._lit.shade(self.materials, camera.eye, self._gaussians.sh)
        pixels = self._gaussians.draw(camera, view.background)
        by_pixels = self._loss.differentiate(camera.image_size, pixels, target)
        by_splats = self._gaussians.by_splats(pixels, by_pixels)
        self._lit.decode(self._gaussians.rects, by_splats)
        return self._loss.read(camera.image_size), self._lit.differentiate()

    def _update(self, gradient: Materials) -> None:
        """Makes a step of all materials and the environment, after adding the gradients of the smoothness terms."""
        now, near = self.materials, self._near
        changes = np.log(now.albedo) - self._first
        by_change = np.stack([near.square_term(changes[:, c])[1] for c in range(3)], axis=1)
        smoothed = replace(
            gradient,
            albedo=gradient.albedo + ALBEDO_SMOOTHNESS * by_change / now.albedo,
            roughness=gradient.roughness + ROUGHNESS_SMOOTHNESS * near.square_term(now.roughness)[1],
        )
        fall = 0.1 ** max(2.0 * self.iteration / self._config.iterations - 1.0, 0.0)
        self._parameters.step(smoothed, RATES.scaled(fall))


def white_radiance(white: Irradiance, environment: Doubles) -> Doubles:
    """Returns the radiance of N white diffuse Gaussians, shape (N, 3), under an environment of K directions, (K, 3)."""
    return np.maximum(white.total(environment.astype(np.float32), np.zeros((0, 3))), RADIANCE_LEAST)


def sees_environment(white: Irradiance) -> bool:
    """Returns whether the median Gaussian sees at least `ENVIRONMENT_VISIBLE_MIN` of the environment."""
    return float(np.median(white.environment.sum(axis=1))) > ENVIRONMENT_VISIBLE_MIN


def fit_environment(
    outgoing: Doubles,
    white: Irradiance,
    weights: Doubles,
    directions: Doubles,
    *,
    steps: int,
    rng: np.random.Generator,
    report: Progress,
) -> Doubles:
    """Estimates the radiance of the environment in K directions, shape (K, 3).

    The albedo of a diffuse surface is its radiance divided by that of a white surface in its place. Captured radiance
    varies with normal and visibility; albedo does not. The estimate therefore minimises differences of albedo over
    random pairs of Gaussians with similar chromaticity. A brighter environment over darker surfaces would look the
    same, so the scale is chosen such that the lightest surfaces have a typical albedo.

    Args:
        outgoing: Captured radiance of N Gaussians, linear, shape (N, 3).
        white: Irradiance over pi of the Gaussians: the radiance of white surfaces in their place.
        weights: Sampling weight of each Gaussian in the pairs, shape (N,).
        directions: Directions of the environment, shape (K, 3).
        steps: Number of optimiser steps.
        rng: Generator that chooses the pairs.
        report: Called with a description of the current work and the fraction done, 0..1.

    Returns:
        Radiances; all 1 if the Gaussians see too little of the environment.
    """
    if not sees_environment(white):
        return np.ones((len(directions), 3))
    start = np.full((len(directions), 3), np.log(constant_radiance(outgoing, white, weights)))
    chosen = rng.choice(len(outgoing), (2, ENVIRONMENT_PAIRS), p=weights / weights.sum())
    rows, compact = np.unique(chosen, return_inverse=True)
    first, second = compact.reshape(2, ENVIRONMENT_PAIRS)
    pairs, part = (
        SimilarPairs(first, second),
        Irradiance(white.observed[rows], white.environment[rows], white.emitters[rows]),
    )
    shown = np.log(np.maximum(outgoing[rows], RADIANCE_LEAST))
    neighbours = nearest_directions(directions)
    moved, adam = start.copy(), Adam.still(start.shape)
    for step in range(steps):
        report("finding the environment", step / steps)
        environment = np.exp(moved)
        light = white_radiance(part, environment)
        _, by_log_albedo = pairs.albedo_term(shown - np.log(light))
        by_environment = (
            -(part.environment.T @ (by_log_albedo / light).astype(np.float32)).astype(np.float64) * environment
        )
        by_environment += smoothness_gradient(moved, neighbours) + ENVIRONMENT_PRIOR / len(directions) * (moved - start)
        moved += adam.step(by_environment, ENVIRONMENT_RATE * (1.0 - step / steps))
        moved += start.mean(axis=0) - moved.mean(axis=0)
    environment = np.exp(moved)
    lit = (white.environment @ environment.astype(np.float32)).astype(np.float64)
    return typical_albedo_factor(outgoing, white.observed, lit, weights) * environment


HEIGHT, WIDTH = 16, 32


def environment_image(directions: Doubles, environment: Doubles) -> FloatArray:
    """Returns the environment as image of a `LightEnvironment`, shape (16, 32, 3).

    Each pixel is a Gaussian-weighted mean over the K directions around it. The Gaussian's width is half the angle
    between neighbouring directions.

    Args:
        directions: Evenly spread unit vectors, shape (K, 3).
        environment: Radiance in each direction, shape (K, 3).
    """
    pixel_directions = panorama_directions(HEIGHT, WIDTH).reshape(-1, 3)
    sharpness = len(directions) / np.pi  # 1 / (half of the angle)^2
    weights = np.exp(sharpness * (pixel_directions @ directions.T - 1.0))
    image = weights @ environment / weights.sum(axis=1, keepdims=True)
    return image.reshape(HEIGHT, WIDTH, 3).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class SimilarPairs:
    """P pairs of Gaussians whose materials should be similar, so that differences within a pair are penalised."""

    first: Rows
    """Index of the first Gaussian of each of P pairs, shape (P,); ``second`` holds that of the second."""
    second: Rows

    def albedo_term(self, log_albedo: Doubles) -> tuple[float, Doubles]:
        """Returns the penalty on albedo differences within pairs, and its gradient by N log albedos, shape (N, 3).

        A pair whose log albedos differ by ``d`` costs ``w^2 log(1 + (d / w)^2) / 2``, w being `EDGE_WIDTH`, so that
        texture edges count little. The cost is weighted by the pair's similarity of chromaticity, which is held fixed.
        """
        difference = log_albedo[self.first] - log_albedo[self.second]
        similarity = chroma_similarity(difference, CHROMA_WIDTH)
        ratio = np.square(difference / EDGE_WIDTH)
        share = 1.0 / max(len(self.first), 1)
        term = float((similarity * np.log1p(ratio)).sum() * 0.5 * EDGE_WIDTH**2 * share)
        return term, self._scattered(similarity * difference / (1.0 + ratio) * share, len(log_albedo))

    def square_term(self, values: Doubles) -> tuple[float, Doubles]:
        """Returns half the mean squared difference of N values within pairs, and its gradient, shape (N,)."""
        difference = values[self.first] - values[self.second]
        share = 1.0 / max(len(self.first), 1)
        return 0.5 * share * float(difference @ difference), self._scattered(difference[:, None] * share, len(values))[
            :, 0
        ]

    def _scattered(self, by_difference: Doubles, count: int) -> Doubles:
        """Sums the gradient with respect to each pair's difference into a gradient for each of ``count`` Gaussians."""
        columns = [
            np.bincount(self.first, column, count) - np.bincount(self.second, column, count)
            for column in by_difference.T
        ]
        return np.stack(columns, axis=1).astype(np.float64)


def neighbour_pairs(means: FloatArray) -> SimilarPairs:
    """Pairs each Gaussian with its `NEIGHBOURS` nearest Gaussians, or with all others if there are fewer."""
    count = len(means)
    most = min(NEIGHBOURS, count - 1)
    if most < 1:
        return SimilarPairs(np.empty(0, np.int64), np.empty(0, np.int64))
    _, near = cKDTree(means).query(means, k=most + 1, workers=-1)
    index = np.arange(count)[:, None]
    # If means coincide, the Gaussian itself may come later in the list, or not at all.
    is_itself = near == index
    is_itself[:, -1] |= ~is_itself.any(axis=1)
    return SimilarPairs(np.repeat(index, most), near[~is_itself].astype(np.int64))
