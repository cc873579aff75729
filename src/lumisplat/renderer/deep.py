"""Renders deep frames: traced rays give each pixel a few depth samples, and the samples composite to the frame."""

from __future__ import annotations

import operator
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from lumisplat.config import Pipeline, RenderConfig, TraceStrategy
from lumisplat.constants import RAY_BLOCK_PX
from lumisplat.errors import SceneError
from lumisplat.frame.deep import DeepFrame
from lumisplat.frame.frame import Frame
from lumisplat.math.arrays import Doubles, Flags, FloatArray, IntArray, Rows
from lumisplat.math.color import decode_srgb
from lumisplat.math.directions import panorama_lookup
from lumisplat.math.transforms import matrices_from_quaternions
from lumisplat.renderer.checks import checked_config
from lumisplat.renderer.rays import PixelProfile
from lumisplat.renderer.renderer import create_renderer
from lumisplat.renderer.scene.camera_table import subpixel
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.scene.camera import Camera, CameraModel
from lumisplat.scene.lights import AreaLight, LightEnvironment
from lumisplat.scene.ops.colors import colors_along
from lumisplat.scene.ops.views import world_rays
from lumisplat.scene.scene import Scene

_STEPS = 16
"""Number of equal steps between transmittance 1 and 0. Gaussians of one pixel are merged into one depth sample if the
transmittances in front of them lie in the same step."""
_RAYS = 16
"""Largest number of rays per pixel. Coverage of a pixel by a mesh's edge is then a multiple of 1/16."""
_SURFACE_PX = 16.0
"""Two mesh hits of one pixel count as one surface if their depths differ by at most this many pixel widths (at that
depth). The value suffices for surfaces tilted up to 86 degrees from facing the camera."""
_ENVIRONMENT_DEPTH = 1e30
"""Depth of an environment, scene units: behind everything, but finite, so that compositors can compute with it."""
_TINY = float(np.finfo(np.float32).tiny)
"""Smallest normal float32, which replaces smaller divisors: transmittances, sums of radiance and sums of weights."""
_BAND_RAYS = 2**14
"""Number of rays that are traced at once, to bound memory. A frame's pixels are processed part by part; such a part is
called a band."""


def render_deep(
    scene: Scene,
    camera: Camera,
    frame: Frame | None = None,
    config: RenderConfig | None = None,
    *,
    device: str = "auto",
) -> DeepFrame:
    """Renders depth samples of each pixel. Compositors can insert smoke or people between the samples.

    Traces the rays of the frame's samples, up to 16 per pixel with equal weights; Gaussians are widened by the
    pixel's footprint. Hits are sorted by depth. Gaussians within a 16th of the pixel's transmittance form one sample,
    from the first one's depth to the last one's. Mesh hits on one surface form one sample, too.

    Composited over each other, a pixel's samples give the frame: their weights are scaled to the frame's alpha, and the
    frame's colour is divided among them in proportion to the linear colours of their Gaussians and meshes. A covered
    pixel whose rays hit nothing gets one sample, at the depth of the frame's surface or first Gaussian. Such pixels lie
    at edges of Gaussians, which a rasteriser draws a little wider. A visible light is a sample with colour and alpha 0.
    A visible environment is a sample at depth 1e30.

    Args:
        scene: The scene to render.
        camera: The camera.
        frame: A frame of the same view whose look the samples add up to, such as a lit frame of any pipeline. None: an
            unlit traced frame.
        config: Settings of the rays; None: the defaults.
        device: As for ``create_renderer``.

    Raises:
        ConfigError: ``config`` is no RenderConfig.
        DeviceError: The device does not exist or is out of memory.
        SceneError: As for ``trace_rays``, or the frame has another size.
    """
    width, height = camera.image_size
    size = height, width
    if frame is not None and frame.alpha.shape != size:
        raise SceneError(f"the frame has {frame.alpha.shape} rows and columns, expected the camera's {size}")
    config = checked_config(config)
    if frame is not None and frame.config is not None:
        config = replace(config, seed=frame.config.seed)  # the seed determines where rays pass the lens
    tracer = _DeepTracer(scene, camera, config, device)
    frame = frame or tracer.frame()
    tracer.show_lights(frame)
    offsets = _offsets(frame, scene, camera)
    target = _Target(
        _linear(frame).reshape(-1, 3), frame.alpha.ravel().astype(np.float64), _depths(frame, scene, camera)
    )
    step = max(_BAND_RAYS // len(offsets), 1)
    bands = [tracer.band(slice(begin, begin + step), target, offsets) for begin in range(0, width * height, step)]
    columns: Iterator[Any] = zip(*bands, strict=True)
    counts, *samples = (np.concatenate(parts) for parts in columns)
    return DeepFrame(size, np.concatenate([[0], np.cumsum(counts, dtype=np.int64)]), *samples)


class _Target(NamedTuple):
    """Target of the samples of N pixels: the colour and alpha that each pixel's samples add up to; a fallback depth."""

    color: FloatArray
    """Premultiplied linear colour of each of N pixels, (N, 3)."""
    alpha: Doubles
    """Alpha of each pixel, 0..1."""
    depth: FloatArray
    """View depth (fisheye: distance) of the only sample that a pixel gets if no ray hits anything."""

    def of(self, pixels: slice) -> _Target:
        """Returns the target colours, alphas and depths of a slice of pixels."""
        return _Target(self.color[pixels], self.alpha[pixels], self.depth[pixels])


class _Layers(NamedTuple):
    """Ray hits of a band (pixels traced at once), before they are merged into depth samples; one row per hit."""

    pixel: Rows
    """Index of each hit's pixel among the pixels that are traced at once (a band)."""
    depth: FloatArray
    """View depth of each hit (fisheye cameras: distance from the camera), scene units."""
    weight: FloatArray
    """Compositing weight of each hit on its ray, 0..1."""
    light: FloatArray
    """Linear radiance that each hit's colour adds to its ray, (hits, 3). Once the hits of all rays are joined, the
    radiance is divided by the number of rays per pixel."""
    is_mesh: Flags
    """True for hits on a mesh, a light or the environment; False for Gaussians."""

    @classmethod
    def of(cls, parts: Sequence[_Layers]) -> _Layers:
        """Concatenates the hits of several lists, one list after another."""
        columns: Iterator[Any] = zip(*parts, strict=True)
        return cls(*(np.concatenate(column) for column in columns))

    def chosen(self, rows: Rows) -> _Layers:
        """Returns the hits with the given row indices, in that order."""
        columns: Iterator[Any] = iter(self)
        return _Layers(*(values[rows] for values in columns))


class _Samples(NamedTuple):
    """Depth samples of pixels, pixel by pixel and from front to back, with the fields of `DeepFrame`."""

    counts: Rows
    """Number of depth samples of each pixel."""
    near: FloatArray
    far: FloatArray
    color: FloatArray
    alpha: FloatArray


class _DeepTracer:
    """Traces the rays of a camera's pixels and merges their hits into depth samples.

    Args:
        scene: The scene to trace.
        camera: The camera of the rays.
        config: Settings of the rays.
        device: Device name, as for ``create_renderer``.
    """

    def __init__(self, scene: Scene, camera: Camera, config: RenderConfig, device: str) -> None:
        self._scene, self._camera, self._behind = scene, camera, Scene(meshes=scene.meshes)
        trace = replace(config.trace, strategy=TraceStrategy.SORTED)
        rays = RenderConfig(pipeline=Pipeline.TRACE, trace=trace, lighting=False, seed=config.seed)
        self._gaussians, self._meshes = (create_renderer(rays, device) for _ in range(2))
        self._firsts = np.cumsum([0, *(splat.gaussians.count for splat in scene.splats)])
        self._colors = _view_colors(scene, camera)
        self._ray_indices = _pixel_ray_indices(*camera.image_size)
        self._environment: LightEnvironment | None = None
        self._area_lights: list[AreaLight] = []

    def frame(self) -> Frame:
        """Renders the unlit traced frame of the scene."""
        return self._gaussians.render(self._scene, self._camera)

    def show_lights(self, frame: Frame) -> None:
        """Makes the frame's visible area lights and visible environment count as objects that rays hit."""
        config = frame.config
        if config is None or not FramePlan.of(config, self._scene).is_lit:
            return
        for light in filter(operator.attrgetter("enabled"), self._scene.lights):
            if isinstance(light, LightEnvironment) and light.visible and config.background is not None:
                self._environment = light
            elif isinstance(light, AreaLight) and light.visible and config.pipeline.traces_paths:
                self._area_lights.append(light)

    def band(self, pixels: slice, target: _Target, offsets: list[tuple[float, float]]) -> _Samples:
        """Returns the depth samples of a slice of pixels. Each pixel has one ray through each of ``offsets``, 0..1."""
        ray_indices = self._ray_indices[pixels]
        target = target.of(pixels)
        found = [self._layers(ray_indices, sample, offset) for sample, offset in enumerate(offsets)]
        layers = _Layers.of(found)
        layers = layers._replace(light=layers.light / np.float32(len(offsets)))
        has_any = np.bincount(layers.pixel, minlength=len(ray_indices)) > 0
        covers = np.bincount(layers.pixel, layers.weight, len(ray_indices)) > 0.0  # hits on lights have weight 0
        missed = np.flatnonzero((~covers & (target.alpha > 0.0)) | (~has_any & target.color.any(axis=1)))
        ones, white = np.ones(len(missed), np.float32), np.ones((len(missed), 3), np.float32)
        layers = _Layers.of([layers, _Layers(missed, target.depth[missed], ones, white, np.zeros(len(missed), bool))])
        return self._samples_of(layers.chosen(np.lexsort((layers.depth, layers.pixel))), target)

    def _layers(self, ray_indices: IntArray, sample: int, offset: tuple[float, float]) -> _Layers:
        """Traces one ray per pixel, and returns its hits on Gaussians, meshes, lights and the environment."""
        traced = self._gaussians.profile_pixels(self._scene, self._camera, ray_indices, sample, offset)
        profile = traced.gaussians
        pixel = np.repeat(np.arange(len(profile)), np.diff(profile.first))
        in_front = profile.transmittance / (np.float32(1.0) - profile.alpha)
        color = self._colors[self._firsts[profile.instance_index] + profile.gaussian_index]
        depth = self._depths(traced, pixel, profile.t)
        weight = (in_front - profile.transmittance).astype(np.float32)
        gaussians = _Layers(pixel, depth, weight, weight[:, None] * color, np.zeros(len(pixel), bool))
        transmittance = np.ones(len(ray_indices), np.float32)
        ends = np.flatnonzero(np.diff(profile.first))
        transmittance[ends] = profile.transmittance[profile.first[ends + 1] - 1]
        transmittance[transmittance <= self._gaussians.config.trace.transmittance_min] = (
            0.0  # the ray ended in front of the mesh
        )
        layers = [gaussians, *(self._light_layers(light, traced, pixel) for light in self._area_lights)]
        if self._scene.meshes:
            layers.append(self._mesh_layers(traced, transmittance))
        if self._environment is not None:
            hit = np.flatnonzero(np.isinf(traced.mesh_distance) & traced.directions.any(axis=1) & (transmittance > 0.0))
            far, shown = (
                np.full(len(hit), _ENVIRONMENT_DEPTH, np.float32),
                _environment_radiance(self._environment, traced.directions[hit]),
            )
            layers.append(
                _Layers(hit, far, transmittance[hit], transmittance[hit, None] * shown, np.ones(len(hit), bool))
            )
        return _Layers.of(layers)

    def _light_layers(self, light: AreaLight, traced: PixelProfile, pixel: Rows) -> _Layers:
        """Returns the hits of rays on a visible area light: they add radiance to a pixel, but their alpha is 0.

        ``pixel`` holds the pixel index of each Gaussian hit in ``traced``.
        """
        distance = light.distances(traced.origins, traced.directions.astype(np.float64))
        transmittance = np.ones(len(distance), np.float32)
        in_front = traced.gaussians.t < distance[pixel]
        np.minimum.at(transmittance, pixel[in_front], traced.gaussians.transmittance[in_front])
        reaches = transmittance > self._gaussians.config.trace.transmittance_min
        hit = np.flatnonzero((distance < traced.mesh_distance) & traced.directions.any(axis=1) & reaches)
        depth = self._depths(traced, hit, distance[hit].astype(np.float32))
        radiance = transmittance[hit, None] * (np.array(light.color) * light.intensity).astype(np.float32)
        return _Layers(hit, depth, np.zeros(len(hit), np.float32), radiance, np.ones(len(hit), bool))

    def _mesh_layers(self, traced: PixelProfile, transmittance: FloatArray) -> _Layers:
        """Returns the hits of rays on meshes, where the rays end, with ``transmittance`` as their weights.

        ``transmittance`` holds the transmittance of each ray in front of the mesh.
        """
        end = np.flatnonzero(np.isfinite(traced.mesh_distance) & (transmittance > 0.0))
        if not len(end):
            return _Layers(end, transmittance[end], transmittance[end], np.zeros((0, 3), np.float32), np.zeros(0, bool))
        shown = self._meshes.trace_rays(self._behind, traced.origins[end], traced.directions[end]).radiance
        depth = self._depths(traced, end, traced.mesh_distance[end])
        light = transmittance[end, None] * decode_srgb(shown).astype(np.float32)
        return _Layers(end, depth, transmittance[end], light, np.ones(len(end), bool))

    def _depths(self, traced: PixelProfile, pixel: Rows, distance: FloatArray) -> FloatArray:
        """Converts distances along the rays of ``pixel`` to view depth; fisheye cameras use the distance itself."""
        if self._camera.model is CameraModel.FISHEYE:
            return distance
        forward = self._camera.world_from_camera[:3, 2]
        from_eye = (traced.origins - self._camera.eye) @ forward
        return (from_eye[pixel] + distance * (traced.directions @ forward)[pixel]).astype(np.float32)

    def _samples_of(self, layers: _Layers, target: _Target) -> _Samples:
        """Merges hits, sorted by pixel and depth, into samples that composite to the target's colour and alpha."""
        count = len(target.alpha)
        total = np.bincount(layers.pixel, layers.weight, count)
        scale = np.divide(target.alpha, total, out=np.zeros(count), where=total > 0.0)
        weight = layers.weight * scale[layers.pixel]
        before = np.cumsum(weight) - weight
        firsts = np.searchsorted(layers.pixel, layers.pixel)
        through = np.maximum(1.0 - (before - before[firsts]), weight)
        starts = self._starts(layers, through)
        ends = np.append(starts[1:], len(layers.pixel))[: len(starts)] - 1
        contribution = _contributions(layers, target.color)
        if len(starts):
            weight, contribution = np.add.reduceat(weight, starts), np.add.reduceat(contribution, starts)
        in_front = through[starts]
        is_visible = (weight > 0.0) | contribution.any(axis=1)
        starts, ends, in_front = starts[is_visible], ends[is_visible], np.maximum(in_front[is_visible], _TINY)
        color, alpha = contribution[is_visible] / in_front[:, None], np.minimum(weight[is_visible] / in_front, 1.0)
        counts = np.bincount(layers.pixel[starts], minlength=count)
        near, far = layers.depth[starts], layers.depth[ends]
        return _Samples(counts, near, far, color.astype(np.float32), alpha.astype(np.float32))

    def _starts(self, layers: _Layers, through: Doubles) -> Rows:
        """Returns the row of the first hit of each depth sample, from hits sorted by pixel and depth.

        ``through`` is the transmittance in front of each hit. A new sample starts at the pixel's first hit, where
        Gaussians change to a mesh or back, where transmittance enters the next of `_STEPS` steps, and where a new mesh
        surface begins.
        """
        is_other = np.diff(layers.pixel, prepend=-1) != 0
        farther = np.diff(layers.depth, prepend=np.float32(0.0))
        begins_depth = is_other | (farther > 0.0)
        first = np.maximum.accumulate(
            np.where(begins_depth, np.arange(len(begins_depth)), 0)
        )  # first layer of each depth
        step = np.minimum((1.0 - through[first]) * _STEPS, _STEPS - 1).astype(np.int32)
        changes = np.diff(layers.is_mesh, prepend=False) | (np.diff(step, prepend=-1) != 0)
        continues = layers.is_mesh & ~np.diff(layers.is_mesh, prepend=False)
        ends_surface = farther > _SURFACE_PX * self._pixel_widths(layers.depth)
        return np.flatnonzero(is_other | (begins_depth & np.where(continues, ends_surface, changes)))

    def _pixel_widths(self, depth: FloatArray) -> FloatArray:
        """Returns the width of a pixel at each view depth, scene units."""
        distance = np.ones_like(depth) if self._camera.model is CameraModel.ORTHOGRAPHIC else np.abs(depth)
        return distance / np.float32(min(self._camera.fx, self._camera.fy))


def _contributions(layers: _Layers, target: FloatArray) -> Doubles:
    """Returns the radiance that each hit adds to its pixel, shape (hits, 3); each pixel's sum is the target's colour.

    Area lights, whose hits have weight 0, add their emitted radiance. The other hits share what remains of the target's
    colour, channel by channel, in proportion to their radiance. If all their radiance is 0, they share in proportion to
    their weights.
    """

    def summed(values: Doubles) -> Doubles:
        """Sums a value per hit over the hits of each pixel, shape (pixels, 1 or 3)."""
        columns = [np.bincount(layers.pixel, one, len(target)) for one in values.T]
        return np.stack(columns, axis=1, dtype=np.float64)

    radiance, weight = layers.light.astype(np.float64), layers.weight[:, None].astype(np.float64)
    area_lights = np.where(weight > 0.0, 0.0, radiance)
    others, from_lights, weights = radiance - area_lights, summed(area_lights), summed(weight)
    factor = target / np.maximum(from_lights, _TINY)
    area_lights *= np.where(weights > 0.0, np.minimum(factor, 1.0), factor)[layers.pixel]
    sums = summed(others)
    is_black = sums <= 0.0
    factor = np.maximum(target - summed(area_lights), 0.0) / np.where(is_black, np.maximum(weights, _TINY), sums)
    return area_lights + np.where(is_black[layers.pixel], weight, others) * factor[layers.pixel]


def _environment_radiance(environment: LightEnvironment, directions: FloatArray) -> FloatArray:
    """Returns an environment's radiance in each of N unit directions of world space, (N, 3)."""
    image = np.ones((1, 1, 3)) if environment.image is None else environment.image
    world_from_environment = matrices_from_quaternions(np.array([environment.rotation_wxyz]))[0]
    radiance = panorama_lookup(image, directions.astype(np.float64) @ world_from_environment)
    return (radiance * environment.color * environment.intensity).astype(np.float32)


def _offsets(frame: Frame, scene: Scene, camera: Camera) -> list[tuple[float, float]]:
    """Returns sub-pixel offsets (x, y), 0..1, of the frame's first samples; one ray per pixel goes through each."""
    config = frame.config or RenderConfig(samples=max(frame.samples, 1))
    plan = FramePlan.of(config, scene)
    count = _RAYS if plan.has_history else min(max(frame.samples, 1), _RAYS)
    if not plan.jitters:
        return [subpixel(0)] * (count if camera.aperture > 0.0 else 1)
    return [subpixel(sample) for sample in range(count)]


def _pixel_ray_indices(width: int, height: int) -> IntArray:
    """Returns each pixel's index in the renderer's ray arrays, pixels row by row, shape (H W,).

    The renderer orders rays in square blocks of pixels.
    """
    side = RAY_BLOCK_PX
    down, right = (numbers.ravel() for numbers in np.divmod(np.arange(width * height), width))
    block = down // side * (-(-width // side)) + right // side
    return (block * side**2 + down % side * side + right % side).astype(np.int32)


def _depths(frame: Frame, scene: Scene, camera: Camera) -> FloatArray:
    """Returns the view depth (fisheye: distance) of each pixel of a frame, row by row.

    A pixel with a surface has the depth of the surface. A pixel with Gaussians but no surface has the depth of the mean
    of its first Gaussian. An empty pixel has a depth interpolated between the nearest other pixels before and after it
    in row order.
    """
    forward, is_fisheye = camera.world_from_camera[:3, 2], camera.model is CameraModel.FISHEYE
    distance = np.where(np.isfinite(frame.depth), frame.depth, np.float32(np.nan))
    along = 1.0 if is_fisheye else world_rays(camera)[1] @ forward
    depth = (distance * along).astype(np.float32)
    instances, gaussians = np.asarray(frame.instance_index), np.asarray(frame.gaussian_index)
    for number, splat in enumerate(scene.splats):
        unknown = np.isnan(depth) & (instances == number) & (gaussians >= 0)
        means = splat.gaussians.means[gaussians[unknown]] @ splat.transform[:3, :3].T + splat.transform[:3, 3]
        from_eye = means - camera.eye
        depth[unknown] = np.linalg.norm(from_eye, axis=1) if is_fisheye else from_eye @ forward
    flat = depth.ravel()
    filled = np.flatnonzero(~np.isnan(flat))
    if not len(filled):
        return np.zeros(flat.size, np.float32)
    return np.interp(np.arange(flat.size), filled, flat[filled]).astype(np.float32)


def _view_colors(scene: Scene, camera: Camera) -> FloatArray:
    """Returns the linear colour of each of N Gaussians seen from the camera, instance by instance, (N, 3)."""
    shown = [np.zeros((0, 3), np.float32)]
    for splat in scene.splats:
        object_from_world = np.linalg.inv(splat.transform)
        along = splat.gaussians.means - (object_from_world[:3, :3] @ camera.eye + object_from_world[:3, 3])
        along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
        shown.append(decode_srgb(colors_along(splat.gaussians, along, splat.sh_degree)).astype(np.float32))
    return np.concatenate(shown)


def _linear(frame: Frame) -> FloatArray:
    """Returns the frame's linear premultiplied colours without background, as in an EXR's ``R G B``, (H, W, 3)."""
    channels = frame.layers([])
    return np.stack([channels[name] for name in "RGB"], axis=-1).astype(np.float32)
