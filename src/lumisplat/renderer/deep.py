"""Deep frames: the Gaussians on the ray of each pixel, joined to a few samples, and the mesh behind them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from lumisplat.config import Pipeline, RenderConfig, TraceStrategy
from lumisplat.errors import SceneError
from lumisplat.frame.deep import DeepFrame
from lumisplat.frame.frame import Frame
from lumisplat.math.arrays import Doubles, FloatArray, IntArray, Rows
from lumisplat.math.color import decode_srgb
from lumisplat.renderer.checks import checked_config
from lumisplat.renderer.ray_queries import RayHits
from lumisplat.renderer.renderer import create_renderer
from lumisplat.scene.camera import Camera
from lumisplat.scene.ops.pixel_rays import world_rays
from lumisplat.scene.ops.sh_colors import colors_along
from lumisplat.scene.scene import Scene

_STEPS = 16
"""Steps of a pixel's transmittance from 1 to 0: Gaussians within one of them are one sample."""
_THINNEST = 1e-3
"""Alpha and optical depth of rays below which nothing is scaled to the frame's."""
_LEAST_THROUGH = np.float32(1e-5)
"""Transmittance below which optical depths are all the same."""
_BAND_RAYS = 2**16
"""Rays that are followed at once."""


def render_deep(
    scene: Scene,
    camera: Camera,
    frame: Frame | None = None,
    config: RenderConfig | None = None,
    *,
    device: str = "auto",
) -> DeepFrame:
    """Renders what a pixel shows sample by sample in depth, so that compositors can put smoke or people in between.

    The Gaussians on the ray through each pixel's centre, in order. Those within a 16th of the pixel's transmittance are
    one sample, from the first one's depth to the last one's; a mesh is one that blocks all. All samples over each
    other are the frame: its colour is divided among them in proportion to the linear colours that Gaussians have by
    themselves, and their optical depths are scaled to the frame's alpha, in which Gaussians are as wide as pixels.

    Args:
        scene: What to draw.
        camera: From where. Its aperture is not used.
        frame: The same view as it is to look, such as a lit one of any pipeline; None: an unlit one of rays.
        config: Settings of the rays; None: the defaults.
        device: As for ``create_renderer``.

    Raises:
        ConfigError: ``config`` is no RenderConfig.
        DeviceError: There is no such device, or it is out of memory.
        SceneError: As for ``trace_rays``, or the frame has another size.
    """
    width, height = camera.image_size
    size = height, width
    if frame is not None and frame.alpha.shape != size:
        raise SceneError(f"the frame has {frame.alpha.shape} rows and columns, the camera {size}")
    trace = replace(checked_config(config).trace, strategy=TraceStrategy.SORTED)
    rays = RenderConfig(pipeline=Pipeline.TRACE, trace=trace, lighting=False)
    tracer = _DeepTracer(scene, camera, rays, device)
    frame = frame or tracer.frame(camera)
    wanted, alpha = _linear(frame).reshape(-1, 3), frame.alpha.ravel()
    origins, directions = (rays.reshape(-1, 3) for rays in world_rays(camera))
    bands = [
        tracer.band(origins[rows], directions[rows], wanted[rows], alpha[rows])
        for rows in (slice(begin, begin + _BAND_RAYS) for begin in range(0, len(origins), _BAND_RAYS))
    ]
    columns: Iterator[Any] = zip(*bands, strict=True)
    counts, *samples = (np.concatenate(parts) for parts in columns)
    return DeepFrame(size, np.concatenate([[0], np.cumsum(counts, dtype=np.int64)]), *samples)


class _Layers(NamedTuple):
    """What rays meet, ray by ray and from front to back, before it is joined to samples; M in all."""

    ray: Rows
    """Number of the ray, ascending, (M,)."""
    t: FloatArray
    """Distance, (M,)."""
    through: FloatArray
    """Transmittance in front of it, (M,)."""
    weight: FloatArray
    """Its share of the pixel, (M,)."""
    color: FloatArray
    """Linear, of itself, (M, 3)."""
    step: IntArray
    """Which step of the transmittance it is in; that of meshes is their own, (M,)."""


class _Samples(NamedTuple):
    """Samples of rays, as of `DeepFrame`."""

    counts: Rows
    """Of each ray, (N,)."""
    near: FloatArray
    far: FloatArray
    color: FloatArray
    alpha: FloatArray


class _DeepTracer:
    """Follows the rays of a camera's pixels.

    Args:
        scene: What they meet.
        camera: Whose view depth samples have.
        config: How rays are traced.
        device: Where.
    """

    def __init__(self, scene: Scene, camera: Camera, config: RenderConfig, device: str) -> None:
        self._scene, self._behind = scene, Scene(meshes=scene.meshes)
        self._gaussians, self._meshes = (create_renderer(config, device) for _ in range(2))
        self._forward = camera.world_from_camera[:3, 2]
        self._firsts = np.cumsum([0, *(splat.gaussians.count for splat in scene.splats)])
        self._colors = _shown_colors(scene, camera)

    def frame(self, camera: Camera) -> Frame:
        """The frame of the rays, without a lens's blur."""
        return self._gaussians.render(self._scene, replace(camera, aperture=0.0))

    def band(self, origins: Doubles, directions: Doubles, wanted: FloatArray, alpha: FloatArray) -> _Samples:
        """Samples of some rays.

        Args:
            origins: World space, (N, 3).
            directions: Unit vectors, (N, 3); 0 where a pixel has no ray.
            wanted: Premultiplied linear colours that the samples of each ray are to add up to, (N, 3).
            alpha: Likewise alphas, (N,).
        """
        rays = np.flatnonzero(directions.any(axis=1))
        counts = np.zeros(len(origins), np.int64)
        if not len(rays):
            none = np.zeros(0, np.float32)
            return _Samples(counts, none, none, none.reshape(0, 3), none)
        hits = self._gaussians.trace_rays(self._scene, origins[rays], directions[rays], profile=True)
        layers = self._layers(hits, origins[rays], directions[rays], alpha[rays])
        color = _adding_up_to(layers, wanted[rays])
        starts = np.flatnonzero(np.diff(layers.ray, prepend=-1) | np.diff(layers.step, prepend=-1))
        ends = np.append(starts[1:], len(layers.ray)) - 1
        depth = layers.t * (directions[rays] @ self._forward).astype(np.float32)[layers.ray]
        in_front = layers.through[starts]
        counts[rays] = np.bincount(layers.ray[starts], minlength=len(rays))
        if not len(starts):
            return _Samples(counts, depth, depth, color, in_front)
        joined = np.add.reduceat(layers.weight[:, None] * color, starts) / in_front[:, None]
        blocked = np.minimum(np.add.reduceat(layers.weight, starts) / in_front, np.float32(1.0))
        return _Samples(counts, depth[starts], depth[ends], joined.astype(np.float32), blocked)

    def _layers(self, hits: RayHits, origins: Doubles, directions: Doubles, alpha: FloatArray) -> _Layers:
        """Gaussians, then the mesh that ends the ray; as dense as makes the alphas of rays that meet no mesh."""
        profile = hits.profile
        assert profile is not None
        ray = np.repeat(np.arange(len(profile)), np.diff(profile.first))
        meets_mesh = (hits.transmittance == 0.0) & bool(self._scene.meshes)
        traced = np.where(meets_mesh, alpha, np.float32(1.0) - hits.transmittance)
        density = (_optical_depth(alpha) / np.maximum(_optical_depth(traced), _THINNEST))[ray]
        density[(traced < _THINNEST)[ray]] = 1.0
        behind_it = (profile.transmittance**density).astype(np.float32)
        through = ((profile.transmittance / (1.0 - profile.alpha)) ** density).astype(np.float32)
        weight = through - behind_it
        color = self._colors[self._firsts[profile.instance_index] + profile.gaussian_index]
        step = np.minimum((1.0 - through) * _STEPS, _STEPS - 1).astype(np.int32)
        found = _Layers(ray, profile.t, through, weight, color, step)
        if not self._scene.meshes:
            return found
        behind = self._meshes.trace_rays(self._behind, origins, directions)
        left = np.float32(1.0) - np.bincount(ray, weight, len(profile)).astype(np.float32)
        end = np.flatnonzero(np.isfinite(behind.depth) & (hits.transmittance == 0.0) & (left > 0.0))
        color = decode_srgb(behind.radiance[end]).astype(np.float32)
        meshes = _Layers(end, behind.depth[end], left[end], left[end], color, np.full(len(end), _STEPS, np.int32))
        order = np.argsort(np.concatenate([found.ray, meshes.ray]), kind="stable")
        pairs: Iterator[Any] = zip(found, meshes, strict=True)
        return _Layers(*(np.concatenate(pair)[order] for pair in pairs))


def _adding_up_to(layers: _Layers, wanted: FloatArray) -> FloatArray:
    """Colours of layers, scaled ray by ray and channel by channel; where all are black, the same for all of the ray."""
    sums = np.stack([np.bincount(layers.ray, layers.weight * one, len(wanted)) for one in layers.color.T], axis=1)
    shares = np.bincount(layers.ray, layers.weight, len(wanted))[:, None]
    is_black = sums <= 0.0
    factor = wanted / np.where(is_black, np.maximum(shares, 1e-12), sums)
    return (np.where(is_black[layers.ray], 1.0, layers.color) * factor[layers.ray]).astype(np.float32)


def _shown_colors(scene: Scene, camera: Camera) -> FloatArray:
    """Linear colours of all Gaussians as the camera sees them, instance by instance, (N, 3)."""
    shown = [np.zeros((0, 3), np.float32)]
    for splat in scene.splats:
        object_from_world = np.linalg.inv(splat.transform)
        along = splat.gaussians.means - (object_from_world[:3, :3] @ camera.eye + object_from_world[:3, 3])
        along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
        shown.append(decode_srgb(colors_along(splat.gaussians, along, splat.sh_degree)).astype(np.float32))
    return np.concatenate(shown)


def _optical_depth(alpha: FloatArray) -> FloatArray:
    """Of what blocks so much light."""
    return -np.log(np.maximum(np.float32(1.0) - alpha, _LEAST_THROUGH))


def _linear(frame: Frame) -> FloatArray:
    """Premultiplied linear colours of a frame, as files hold them, (H, W, 3)."""
    channels = frame.layers([])
    return np.stack([channels[name] for name in "RGB"], axis=-1).astype(np.float32)
