"""A float64 NumPy twin of the weighted-mean surface of the Gaussians in each pixel.

Depths are those of a normal distribution: given a point's image, its mean view depth in a Gaussian is linear in the
pixel, with the slope that regression has.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat.config import RasterConfig
from lumisplat.constants import ALPHA_MAX, ALPHA_MIN
from lumisplat.scene.camera import Camera
from lumisplat.scene.scene import Scene
from support.oracles import raster_oracle as raster

Doubles = npt.NDArray[np.float64]
Window = tuple[slice, slice]


@dataclass
class MeanSurface:
    """What some sets show in each pixel."""

    share: Doubles  # (H, W), 0 where they are not
    depth_z: Doubles  # (H, W), undefined there
    values: Doubles  # (H, W, C), means of the values that the Gaussians have


def mean_surface(
    scene: Scene,
    camera: Camera,
    config: RasterConfig,
    counted: Sequence[int],
    values: Sequence[Doubles] = (),
    *,
    linear: bool = True,
) -> MeanSurface:
    """The surface of the splat instances ``counted``, behind and before all others and before meshes.

    Args:
        scene: What is there.
        camera: From where.
        config: Of the rasteriser.
        counted: Numbers of instances.
        values: For each instance the values of its Gaussians, shape (N, C); none: no values.
        linear: Whether depths are linear in the image; else all of a splat is as deep as the mean of its Gaussian.
    """
    splats = raster.project(scene, camera, config)
    slopes = depth_slopes(splats, camera) * linear
    shape = (camera.height, camera.width)
    share, depth = np.zeros(shape), np.zeros(shape)
    means = np.zeros((*shape, values[0].shape[1] if values else 0))
    for i, at, weight in weights(splats, raster.rasterize_meshes(scene, camera), camera, config):
        if splats.instance_index[i] not in counted:
            continue
        share[at] += weight
        depth[at] += weight * (splats.depth_z[i] + offsets(splats, i, at) @ slopes[i])
        if values:
            means[at] += weight[..., None] * values[splats.instance_index[i]][splats.gaussian_index[i]]
    some = np.maximum(share, 1e-30)
    return MeanSurface(share, depth / some, means / some[..., None])


def depth_slopes(splats: raster.Splats, camera: Camera) -> Doubles:
    """View depth per pixel, to the right and down, shape (N, 2): its covariance with the image over the image's own."""
    axes = np.linalg.inv(splats.canonical)
    in_image = raster.jacobian(splats.mean_camera, camera) @ axes
    shared = in_image @ axes[:, 2, :, None]
    return np.asarray(np.linalg.solve(splats.covariance_px, shared)[..., 0], np.float64)


def offsets(splats: raster.Splats, i: int, window: Window) -> Doubles:
    """Pixel centres of a window less the projected mean of splat ``i``, shape (h, w, 2)."""
    x = np.arange(window[1].start, window[1].stop) + 0.5 - splats.mean_px[i, 0]
    y = np.arange(window[0].start, window[0].stop) + 0.5 - splats.mean_px[i, 1]
    return np.stack(np.meshgrid(x, y), axis=-1)


def weights(
    splats: raster.Splats, fragments: raster.Fragments, camera: Camera, config: RasterConfig
) -> Iterator[tuple[int, Window, Doubles]]:
    """Each splat, front to back, with its window of pixels and its weight in the blend there."""
    transmittance = np.ones((camera.height, camera.width))
    done = np.zeros(transmittance.shape, bool)
    for i, z in enumerate(splats.depth_z):
        at = raster.footprint(splats, i, camera)
        alpha = np.minimum(splats.opacity[i] * raster.response(splats, i, at), ALPHA_MAX)
        after = transmittance[at] * (1.0 - alpha)
        reached = ~done[at] & (alpha >= ALPHA_MIN) & (z < fragments.depth_z[at])
        done[at] |= reached & (after <= config.transmittance_min)
        accepted = reached & ~done[at]
        yield i, at, np.where(accepted, alpha * transmittance[at], 0.0)
        transmittance[at] = np.where(accepted, after, transmittance[at])
