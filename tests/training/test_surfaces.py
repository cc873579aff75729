"""Surface terms of the loss flatten Gaussians onto surfaces, with exact gradients."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.constants import SURFACE_ALPHA
from lumisplat.device.structs.gradients import PixelGradient
from lumisplat.training.backends import TrainingRaster
from lumisplat.training.parameters import TrainedParameters
from lumisplat.training.surface_kernels import SURFACE_SPREAD, SURFACE_VARIANCE_MIN
from lumisplat.training.trainer import Trainer
from lumisplat.training.views import TargetPixels, TrainingView
from support.oracles.gradient_oracle import Loss, Parameters, differences, surfaces
from support.oracles.smoothness_oracle import smoothness
from support.scenes import known_surfaces

SIZE = 22, 16
NORMALS, DEPTH, SMOOTH, FLATNESS = 0.7, 1.3, 0.9, 2.0


def wall(count: int = 14) -> ls.Gaussians:
    """Returns large Gaussians, some thin, on an uneven wall."""
    rng = np.random.default_rng(1)
    positions = rng.uniform(-1.0, 1.0, (count, 2))
    rotations = np.column_stack([np.full(count, 2.0), rng.normal(size=(count, 3))])
    return ls.Gaussians(
        means=np.column_stack([positions, 0.2 * np.sin(3.0 * positions[:, 0]) + 0.1 * rng.normal(size=count)]),
        rotations_wxyz=rotations / np.linalg.norm(rotations, axis=1, keepdims=True),
        scales=rng.uniform(0.25, 0.6, (count, 3)) * (1.0, 1.0, 0.5),
        opacities=rng.uniform(0.5, 0.9, count),
        sh=rng.normal(size=(count, 1, 3)),
    )


def started(**settings: Any) -> Trainer:
    """Returns a trainer with the Gaussians of the wall."""
    size = {"width": SIZE[0], "height": SIZE[1], "fov_y": 0.5}
    camera = ls.Camera.look_at((0.4, 0.2, -3.0), (0.0, 0.0, 0.0), (0.0, -1.0, 0.0), **size)
    other = ls.Camera.look_at((-0.6, 0.2, -3.0), (0.0, 0.0, 0.0), (0.0, -1.0, 0.0), **size)
    rng = np.random.default_rng(2)
    weight = rng.uniform(0.2, 1.0, (SIZE[1], SIZE[0])).astype(np.float32)
    picture = TargetPixels(rng.uniform(size=(SIZE[1], SIZE[0], 3)).astype(np.float32), weight)
    views = [TrainingView(str(k), one, lambda: picture) for k, one in enumerate((camera, other))]
    gaussians = wall()
    config = ls.TrainConfig(iterations=10, cap=gaussians.count, sh_degree=0, **settings)
    one = Trainer(views, config, points=gaussians.means, device="cpu")
    logits = np.log(gaussians.opacities / (1.0 - gaussians.opacities))
    values = {"means": gaussians.means, "rotations": gaussians.rotations_wxyz, "sh": gaussians.sh}
    one._upload(TrainedParameters.new({**values, "log_scales": np.log(gaussians.scales), "logits": logits}))
    return one


def found_by(one: Trainer) -> tuple[float, dict[str, np.ndarray]]:
    """Returns the sum of the surface terms for the first view, and its gradient with respect to the Gaussians."""
    camera, picture = one._views[0].camera, one._views[0].read()
    target = one._loss.load(picture.color, picture.weight, None)
    pixels = one._backend.draw(camera, 0, (0.0, 0.0, 0.0))
    count = SIZE[0] * SIZE[1]
    nothing = PixelGradient()
    nothing.color = one._buffers.upload("nothing.color", wp.vec3, np.zeros((count, 3), np.float32))
    nothing.alpha = one._buffers.upload("nothing.alpha", wp.float32, np.zeros(count, np.float32))
    total, raster = 0.0, one._backend
    assert isinstance(raster, TrainingRaster)
    if one._surfaces is not None:
        one._surfaces.begin(one._loss.weight_sum)
        maps = raster.compare_surfaces(one._surfaces, pixels, target, nothing)
        total = float(np.asarray(maps.terms.numpy(), np.float64).sum())  # pyright: ignore[reportUnknownMemberType, reportUnknownArgumentType]
        if one._surfaces.smoothness is not None:
            terms: Any = one._surfaces.smoothness.terms
            total += float(np.asarray(terms.numpy(), np.float64).sum())
    gradient = raster.backward(pixels, nothing, one._surfaces, one._record)
    if one.config.flatness:
        raster.flatten(one.config.flatness / one.scene_scale.extent, gradient)
    arrays = {name: np.array(getattr(gradient, name).numpy()) for name in ("means", "rotations", "scales", "opacities")}
    return total, {**arrays, "rotations": np.roll(arrays["rotations"], 1, axis=1)}


@dataclass(frozen=True)
class Sums(Loss):
    """Float64 renderer of depth, squared depth and normals in place of colours."""

    middle: float = 0.0
    extent: float = 1.0

    def _color(self, p: Parameters) -> np.ndarray:  # pyright: ignore[reportIncompatibleMethodOverride]
        depth = (p.means @ p.camera_from_world[2, :3] + p.camera_from_world[2, 3] - self.middle) / self.extent
        return np.column_stack([depth, depth**2, np.zeros(len(depth))])


def expected(p: Parameters, one: Trainer, normals: int = 4) -> float:
    """Returns the surface terms in float64: equation 13 of Huang et al. 2024, and two terms as in Gao et al. 2024.

    Args:
        p: The Gaussians.
        one: Trainer with the settings, the image and its camera.
        normals: Index of the first normal channel.
    """
    camera, picture = one._views[0].camera, one._views[0].read()
    none = np.zeros((SIZE[1], SIZE[0], 3))
    scene_scale = {"middle": one.scene_scale.distance, "extent": one.scene_scale.extent}
    sums, clear = Sums(camera, none, none[..., 0], False, by_features=np.zeros((1, 1, 4)), **scene_scale).sums(p)
    alpha, weight = 1.0 - clear, np.asarray(picture.weight, np.float64)
    has = alpha > SURFACE_ALPHA
    mean = sums[..., 0] / np.where(has, alpha, 1.0)
    variance = np.maximum(sums[..., 1] / np.where(has, alpha, 1.0) - mean**2, SURFACE_VARIANCE_MIN)
    spread = SURFACE_SPREAD * -np.expm1(-np.sqrt(variance) / SURFACE_SPREAD)
    total = one.config.depth_spread * (weight * spread)[has].sum()
    z = one.scene_scale.distance + one.scene_scale.extent * mean
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    points = z[..., None] * np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1)
    right, below = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    area = np.cross(right, below)
    towards = -area / np.linalg.norm(area, axis=-1, keepdims=True) @ p.camera_from_world[:3, :3]
    inside = np.s_[1:-1, 1:-1]
    whole = has[inside] & has[1:-1, 2:] & has[1:-1, :-2] & has[2:, 1:-1] & has[:-2, 1:-1]
    missed = alpha[inside] - (sums[inside][..., normals : normals + 3] * towards).sum(axis=-1)
    total += one.config.normal_smoothness * smoothness(
        sums[..., normals : normals + 3], picture.color.astype(np.float64), weight
    )
    return float((total + one.config.normals * (weight[inside] * missed)[whole].sum()) / weight.sum())


@pytest.mark.parametrize(
    ("normals", "depth", "smooth"),
    [(NORMALS, 0.0, 0.0), (0.0, DEPTH, 0.0), (0.0, 0.0, SMOOTH), (NORMALS, DEPTH, SMOOTH)],
)
def test_surface_loss_gradients_match_central_differences(normals: float, depth: float, smooth: float) -> None:
    """The reference differentiates by all parameters of the Gaussians, in float64."""
    one = started(normals=normals, depth_spread=depth, normal_smoothness=smooth)
    total, found = found_by(one)
    p = Parameters.of(one.gaussians(), (0.0, 0.0, 0.0), one._views[0].camera)
    p = replace(p, features=np.zeros((len(p.means), 0)))
    assert total == pytest.approx(expected(p, one), rel=2e-4) and total > 0.01
    for name, by in found.items():
        field = {"rotations": "rotations_wxyz"}.get(name, name)
        slopes, agree = differences(lambda q: expected(q, one), p, field)
        assert agree.mean() > 0.8
        scale = np.abs(slopes).mean()
        error = np.abs(by - slopes)[agree] / scale
        assert np.median(error) < 1e-3 and error.max() < 2e-2, (name, np.median(error), error.max())


def test_densification_statistics_of_normals_match_central_differences() -> None:
    """The statistic is the length of the loss gradient perpendicular to each normal, summed over pixels."""
    one = started(normals=NORMALS, normal_smoothness=SMOOTH, densification="adaptive", grow_turn=1.0)
    found_by(one)
    statistics: Any = one._record.turns
    p = Parameters.of(one.gaussians(), (0.0, 0.0, 0.0), one._views[0].camera)
    p = replace(p, features=surfaces(p)[:, 1:])
    slopes, agree = differences(lambda q: expected(q, one, normals=7), p, "features")
    weight_sum = np.asarray(one._views[0].read().weight, np.float64).sum()
    expected_statistics = weight_sum * np.linalg.norm(np.cross(p.features, slopes), axis=1)
    whole = agree.all(axis=1)
    assert whole.mean() > 0.5
    np.testing.assert_allclose(
        statistics.numpy()[whole], expected_statistics[whole], rtol=2e-2, atol=1e-3 * float(expected_statistics.max())
    )


def test_flatness_loss_has_a_gradient_for_the_smallest_scale_of_each_drawn_gaussian() -> None:
    """A Gaussian behind the camera is not drawn and gets no gradient."""
    one = started(flatness=FLATNESS)
    _, found = found_by(one)
    scales = one.gaussians().scales
    expected = np.zeros_like(scales)
    expected[np.arange(len(scales)), scales.argmin(axis=1)] = FLATNESS / (len(scales) * one.scene_scale.extent)
    np.testing.assert_allclose(found["scales"], expected, rtol=1e-5)
    one._upload(one._parameters().rows(np.arange(len(scales))))
    means = one._parameters().values
    means["means"][3] = (0.0, 0.0, -9.0)  # behind the camera
    one._upload(TrainedParameters.new(means))
    _, found = found_by(one)
    assert not found["scales"][3].any() and found["scales"][2].any()


@pytest.mark.deep
def test_surface_loss_terms_lower_errors_of_normals_and_depths_by_30_percent() -> None:
    """The scene is a ball over a disc; PSNR drops by less than 0.5 dB."""
    plain = known_surfaces.score(known_surfaces.fitted(known_surfaces.CONFIG))
    weights = {"flatness": 0.3, "normals": 0.05}
    flat = known_surfaces.score(known_surfaces.fitted(replace(known_surfaces.CONFIG, **weights)))
    assert flat.normals < 0.7 * plain.normals and flat.depth < 0.7 * plain.depth, (plain, flat)
    assert flat.psnr > plain.psnr - 0.5, (plain, flat)
