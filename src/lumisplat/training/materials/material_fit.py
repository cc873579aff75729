"""Steps that refine materials and sky: Gaussians are lit, drawn and compared with a photograph; what they are moves."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from lumisplat.config import MaterialsConfig
from lumisplat.constants.delight import RADIANCE_LEAST
from lumisplat.constants.materials import (
    ALBEDO_RATE,
    ALBEDO_SMOOTHNESS,
    PHOTO_SSIM,
    ROUGHNESS_MIN,
    ROUGHNESS_RATE,
    ROUGHNESS_SMOOTHNESS,
    SKY_FINE_RATE,
)
from lumisplat.math.adam import Adam
from lumisplat.math.arrays import Doubles
from lumisplat.progress import Progress
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.gaussians import Gaussians
from lumisplat.training.materials import material_gradient_kernels, material_kernels
from lumisplat.training.materials.colored_gaussians import ColoredGaussians
from lumisplat.training.materials.incident import IncidentRadiance
from lumisplat.training.materials.lit_gaussians import LitGaussians, Materials
from lumisplat.training.materials.neighbours import near_pairs
from lumisplat.training.materials.sky_fit import nearest_directions, smoothness_gradient
from lumisplat.training.photo_loss import Loss, PhotoLoss
from lumisplat.training.views import TrainingView

_ROUGHNESS_RANGE = 1.0 - ROUGHNESS_MIN
_LOGIT_MAX = 7.0
_MOVED = ("albedo", "roughness", "sky")
"""Names of what moves."""


class MaterialFit:
    """Materials of Gaussians whose geometry stays.

    Args:
        gaussians: The capture.
        views: The photographs.
        incident: What was traced.
        start: Where materials and sky begin.
        config: Settings.
        device: As of `lumisplat.create_renderer`.
        threads: As of `lumisplat.create_renderer`.
        progress: As of `lumisplat.create_renderer`.
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
        self._shown = ColoredGaussians(
            launcher,
            buffers,
            gaussians,
            views[0].background,
            kernels=(material_kernels, material_gradient_kernels),
            progress=progress,
        )
        self._loss = PhotoLoss(launcher, buffers, ssim=PHOTO_SSIM, alpha=0.0)
        self._lit = LitGaussians(launcher, buffers, gaussians.means, incident)
        self._near, self._ring = near_pairs(gaussians.means), nearest_directions(incident.directions)
        self._normals = start.normals
        self._albedo: Doubles = _logits(start.albedo)
        self._roughness: Doubles = _logits((start.roughness - ROUGHNESS_MIN) / _ROUGHNESS_RANGE)
        self._sky: Doubles = np.log(np.maximum(start.sky, RADIANCE_LEAST))
        self._first = np.log(_sigmoid(self._albedo))
        self._moments = [Adam.still(array.shape) for array in (self._albedo, self._roughness, self._sky)]
        self.iteration = 0
        """Steps that were made."""

    @property
    def materials(self) -> Materials:
        """What has been found so far."""
        return materials_of({"albedo": self._albedo, "roughness": self._roughness, "sky": self._sky}, self._normals)

    @property
    def state(self) -> dict[str, Doubles]:
        """What moves, and its moments: with the number of steps, all that the next step depends on."""
        arrays: dict[str, Doubles] = {"albedo": self._albedo, "roughness": self._roughness, "sky": self._sky}
        for name, moments in zip(_MOVED, self._moments, strict=True):
            arrays |= {f"{name}.first": moments.first, f"{name}.second": moments.second}
        return arrays

    def restore(self, state: dict[str, Doubles], iteration: int) -> None:
        """Goes on from there.

        Args:
            state: As of ``state``, of a fit that began at the same materials.
            iteration: Steps that were made until then.
        """
        self._albedo, self._roughness, self._sky = (state[name].copy() for name in _MOVED)
        self._moments = [
            Adam(state[f"{name}.first"].copy(), state[f"{name}.second"].copy(), np.array(float(iteration)))
            for name in _MOVED
        ]
        self.iteration = iteration

    def step(self) -> Loss:
        """Makes a step with the next photograph: all in turn, in another order each time."""
        epoch, place = divmod(self.iteration, len(self._views))
        order = np.random.default_rng([self._config.seed, 7, epoch]).permutation(len(self._views))
        loss, gradient = self.differentiate(self._views[int(order[place])])
        self._move(gradient)
        self.iteration += 1
        return loss

    def differentiate(self, view: TrainingView) -> tuple[Loss, Materials]:
        """How far what the Gaussians show is from a photograph, and the derivatives by what they are made of."""
        picture, camera = view.read(), view.camera
        photograph = self._loss.load(picture.color, picture.weight, None)
        self._lit.shade(self.materials, camera.eye, self._shown.sh)
        pixels = self._shown.draw(camera, view.background)
        loss, by_pixels = self._loss.differentiate((camera.width, camera.height), pixels, photograph)
        by_splats = self._shown.by_splats(pixels, by_pixels)
        self._lit.decode(self._shown.rects, by_splats)
        return loss, self._lit.differentiate()

    def _move(self, gradient: Materials) -> None:
        """The chain rule to logits and logarithms, what neighbours say, and a step."""
        now = self.materials
        share = (now.roughness - ROUGHNESS_MIN) / _ROUGHNESS_RANGE
        changes = np.log(now.albedo) - self._first
        by_change = np.stack([self._near.square_term(changes[:, c])[1] for c in range(3)], axis=1)
        by_albedo = gradient.albedo * now.albedo + ALBEDO_SMOOTHNESS * by_change
        by_roughness = gradient.roughness + ROUGHNESS_SMOOTHNESS * self._near.square_term(now.roughness)[1]
        by_sky = gradient.sky * now.sky + smoothness_gradient(self._sky, self._ring)
        fall = 0.1 ** max(2.0 * self.iteration / self._config.iterations - 1.0, 0.0)
        albedo, roughness, sky = self._moments
        self._albedo += albedo.step(by_albedo * (1.0 - now.albedo), fall * ALBEDO_RATE)
        self._roughness += roughness.step(
            by_roughness * _ROUGHNESS_RANGE * share * (1.0 - share), fall * ROUGHNESS_RATE
        )
        self._sky += sky.step(by_sky, fall * SKY_FINE_RATE)
        for logits in (self._albedo, self._roughness):
            np.clip(logits, -_LOGIT_MAX, _LOGIT_MAX, out=logits)


def materials_of(state: Mapping[str, Doubles], normals: Doubles) -> Materials:
    """What the state of a fit says, with normals that stay."""
    roughness = ROUGHNESS_MIN + _ROUGHNESS_RANGE * _sigmoid(state["roughness"])
    return Materials(_sigmoid(state["albedo"]), roughness, normals, np.exp(state["sky"]))


def _sigmoid(logits: Doubles) -> Doubles:
    return 1.0 / (1.0 + np.exp(-logits))


def _logits(shares: Doubles) -> Doubles:
    least = 1.0 / (1.0 + math.exp(_LOGIT_MAX))
    inside = np.clip(shares, least, 1.0 - least)
    return np.log(inside / (1.0 - inside))
