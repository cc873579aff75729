"""Computes the weighted mean surface of Gaussians in each pixel in float64 NumPy.

Within a Gaussian, the mean view depth of points that project to a pixel is linear in the pixel, with the slope of a
linear regression.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat.config import RasterConfig
from lumisplat.constants import ALPHA_MIN
from lumisplat.scene.camera import Camera
from lumisplat.scene.scene import Scene
from support.oracles import raster_oracle as raster

Doubles = npt.NDArray[np.float64]
Window = tuple[slice, slice]


@dataclass
class MeanSurface:
    """Mean surface of the Gaussians of some instances, at each pixel."""

    share: Doubles  # (H, W), coverage of the sets
    depth_z: Doubles  # (H, W), undefined where ``share`` is 0
    values: Doubles  # (H, W, C), means of the Gaussians' values


def mean_surface(
    scene: Scene,
    camera: Camera,
    config: RasterConfig,
    counted: Sequence[int],
    values: Sequence[Doubles] = (),
    *,
    linear: bool = True,
) -> MeanSurface:
    """Returns the mean surface of the splat instances ``counted``, occluded by other instances and meshes.

    Args:
        scene: The scene.
        camera: The camera.
        config: Settings of the rasteriser.
        counted: Indices of instances.
        values: C values of each of the N Gaussians of an instance, shape (N, C); empty for none.
        linear: True for depths that are linear in the image; False for the depth of the mean over the whole splat.
    """
    splats = raster.project(scene, camera, config)
    slopes = raster.depth_slopes(splats, camera) * linear
    shape = (camera.height, camera.width)
    share, depth = np.zeros(shape), np.zeros(shape)
    means = np.zeros((*shape, values[0].shape[1] if values else 0))
    of_splats = np.zeros((len(splats.depth_z), means.shape[-1]))
    for number, value in enumerate(values):
        of_it = splats.instance_index == number
        of_splats[of_it] = value[splats.gaussian_index[of_it]]
    for i, at, blended in weights(splats, raster.rasterize_meshes(scene, camera), camera, config):
        weight = np.where(np.isin(splats.instance_index[i], counted), blended, 0.0)
        share[at] += weight
        depth[at] += weight * (splats.depth_z[i] + (offsets(splats, i, at) * slopes[i]).sum(axis=-1))
        means[at] += weight[..., None] * of_splats[i]
    some = np.maximum(share, 1e-30)
    return MeanSurface(share, depth / some, means / some[..., None])


def offsets(splats: raster.Splats, i: npt.NDArray[np.int64], window: Window) -> Doubles:
    """Returns pixel centres of a window minus the projected mean of splat ``i``, shape (h, w, 2)."""
    x = np.arange(window[1].start, window[1].stop) + 0.5
    y = np.arange(window[0].start, window[0].stop) + 0.5
    return np.stack(np.meshgrid(x, y), axis=-1) - splats.mean_px[i]


def weights(
    splats: raster.Splats, fragments: raster.Fragments, camera: Camera, config: RasterConfig
) -> Iterator[tuple[npt.NDArray[np.int64], Window, Doubles]]:
    """Yields the splats of `raster_oracle.layers`, with their window of pixels and their blend weight there."""
    transmittance = np.ones((camera.height, camera.width))
    done = np.zeros(transmittance.shape, bool)
    for layer in raster.layers(splats, fragments, camera, merges=True):
        i, at, alpha, z = layer.i, layer.at, layer.alpha, splats.depth_z[layer.i]
        after = transmittance[at] * (1.0 - alpha)
        reached = ~done[at] & (alpha >= ALPHA_MIN) & (z < fragments.depth_z[at])
        done[at] |= reached & (after <= config.transmittance_min)
        accepted = reached & ~done[at]
        yield i, at, np.where(accepted, alpha * transmittance[at], 0.0)
        transmittance[at] = np.where(accepted, after, transmittance[at])
