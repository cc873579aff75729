"""Host pass: harmonics of Gaussians such that blends of them show what frames do (docs/method/relighting.md#baking).

Gaussians that are known one by one are blurred once more when they are blended, and show through each other at edges.
So rays from eyes in free space are shaded as pixels of frames are, and harmonics are changed by least squares, as far
as the noise of these rays lets them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.baking import seen_together_kernels as kernels
from lumisplat.baking.shared_light import SeenWeights, shared_light
from lumisplat.baking.sightlines import Sightlines
from lumisplat.baking.view_weights import plane_normals
from lumisplat.baking.visible_lights import meets_light
from lumisplat.config import Pipeline, RenderConfig
from lumisplat.constants.baking import (
    BOUNCED_MIN,
    BOUNCED_PART,
    CHANGE_SPREAD,
    COVERED_MIN,
    DIRECT_SLOPE,
    LINES_A_DIRECTION,
    MISFIT,
    OTHERS_MAX,
    RAYS_A_DIRECTION,
    SIGHT_MIN,
    TOGETHER_GAUSSIANS,
    TOGETHER_STEPS,
)
from lumisplat.math.arrays import Doubles, Flags, FloatArray, IntArray
from lumisplat.math.tone_map import lit_picture
from lumisplat.progress import Progress
from lumisplat.renderer.renderer import Renderer
from lumisplat.renderer.scene.materials import is_relit
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.editing.morton import morton_order
from lumisplat.scene.ops.recolor import base_colors
from lumisplat.scene.scene import Scene, SplatInstance

_Rows = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Pixels:
    """What frames show on P rays, and which Gaussians are blended there."""

    colors: Doubles
    """Display-referred, shape (P, 3)."""
    noise: float
    """Mean variance of these."""
    ray: _Rows
    """Of each of S sights, ascending, shape (S,)."""
    gaussian: _Rows
    """Shape (S,)."""
    weight: Doubles
    """Share of the Gaussian's colour in the ray's, shape (S,)."""
    direction: FloatArray
    """From the eye to the Gaussian's mean, its own space, unit, shape (S, 3)."""


class SeenTogether:
    """Looks at the Gaussians of a scene together.

    Args:
        scene: With its lights and meshes.
        config: Settings of what frames show; ``samples`` are paths a ray, even.
        exposure: Stops.
        launcher: The device.
    """

    def __init__(self, scene: Scene, config: RenderConfig, exposure: float, launcher: Launcher) -> None:
        self._scene, self._config, self._exposure, self._launcher = scene, config, exposure, launcher
        counts = [one.gaussians.count for one in scene.splats]
        self._firsts = np.cumsum([0, *counts])
        self._instance = np.repeat(np.arange(len(counts)), counts)
        self._relit = np.repeat([is_relit(one) for one in scene.splats], counts)
        self._means = np.concatenate([one.world_means for one in scene.splats])
        self._colors = np.concatenate([base_colors(one.gaussians) for one in scene.splats])
        self._normals = np.concatenate([_world_normals(one) for one in scene.splats])
        self._knows_front = np.repeat([one.gaussians.normals is not None for one in scene.splats], counts)
        half = max((config.samples or 2) // 2, 1)
        self._paths = Renderer(replace(config, samples=half), launcher)
        self._bounced: tuple[Renderer, Renderer] | None = None
        if config.pipeline is Pipeline.PATH and config.max_bounces != 0:
            # By the same random numbers: what paths bring without bouncing is a part of what they bring.
            few = replace(config, samples=min(max(half // BOUNCED_PART, BOUNCED_MIN), half))
            self._bounced = Renderer(few, launcher), Renderer(replace(few, max_bounces=0), launcher)
            self._paths = Renderer(replace(self._paths.config, max_bounces=0), launcher)
        self._blends = Renderer(RenderConfig(pipeline=Pipeline.TRACE, lighting=False), launcher)

    def changed(self, sh: Doubles, lines: Sightlines, progress: Progress | None) -> Doubles:
        """Harmonics of all Gaussians of the scene, (N, K, 3), such that these rays show what frames do.

        Neighbours are changed together, some thousands at a time; what is around them stays, or follows.
        """
        result = np.array(sh)
        order = morton_order(self._means[lines.gaussian])
        for begin in range(0, len(order), TOGETHER_GAUSSIANS):
            if progress:
                progress("baking", 0.5 + 0.5 * begin / len(order))
            pixels = self.pixels(lines.of(order[begin : begin + TOGETHER_GAUSSIANS]))
            if not len(pixels.colors):
                continue
            here, renamed = np.unique(pixels.gaussian, return_inverse=True)
            some = replace(pixels, gaussian=renamed)
            blend = Blend(some, len(here), sh.shape[1], self._launcher)
            result[here] = changed_to_fit(blend, some, result[here])
        return result

    def pixels(self, lines: Sightlines) -> Pixels:
        """What frames show on these rays: those of them that show nothing but relit sets, from their front."""
        origins, directions = (rays.reshape(-1, 3) for rays in (lines.origins, lines.directions))
        hits = self._blends.trace_rays(self._scene, origins, directions, profile=True)
        profile = hits.profile
        assert profile is not None
        count = len(profile)
        ray = np.repeat(np.arange(count), np.diff(profile.first))
        gaussian = self._firsts[profile.instance_index] + profile.gaussian_index.astype(np.int64)
        weight = (profile.transmittance * profile.alpha / (1.0 - profile.alpha)).astype(np.float64)
        share: Doubles = np.bincount(ray, weight, count).astype(np.float64)
        kept = (share > COVERED_MIN) & (1.0 - hits.transmittance - share < OTHERS_MAX)
        kept &= np.bincount(ray, weight * ~self._relit[gaussian], count) < OTHERS_MAX
        facing = self._facing(gaussian, directions[ray])
        # Rays that see more of the backs of Gaussians with normals than of their fronts: nobody is there.
        kept &= np.bincount(ray, weight * facing * self._knows_front[gaussian], count) <= 0.0
        if self._config.pipeline is Pipeline.PATH:  # which shows lights as bodies, in front of Gaussians and behind
            kept &= ~meets_light(self._scene.lights, origins, directions)
        kept = _first_kept(kept.reshape(lines.origins.shape[:2]))
        number = np.cumsum(kept) - 1
        seen = kept[ray] & self._relit[gaussian] & (weight > SIGHT_MIN)
        ray, gaussian, weight = ray[seen], gaussian[seen], weight[seen]
        weight *= (share / np.maximum(np.bincount(ray, weight, count), 1e-12))[ray]
        along = self._directions(origins[ray], gaussian)
        # Both sides of a sheet have light of their own.
        sides, rows = np.unique(2 * gaussian + (facing[seen] > 0.0), return_inverse=True)
        weights = SeenWeights(number[ray], rows, weight, int(kept.sum()), len(sides))
        light = self._light(origins[kept], directions[kept], self._colors[sides // 2], weights)
        colors, noise = self._shown(light, share[kept, None])
        return Pixels(colors, noise, number[ray], gaussian, weight, along)

    def _facing(self, gaussian: _Rows, directions: FloatArray) -> Doubles:
        """Cosines of directions to the normals of Gaussians: above 0 where they show their backs."""
        return (self._normals[gaussian] * directions).sum(axis=1)

    def _light(self, origins: FloatArray, directions: FloatArray, colors: Doubles, weights: SeenWeights) -> Doubles:
        """Linear light of what rays meet, by every other sample and by the others, with less noise, (2, P, 3)."""
        twice = np.tile(origins, (2, 1)), np.tile(directions, (2, 1))

        def seen(paths: Renderer) -> tuple[Doubles, Doubles]:
            hits = paths.trace_rays(self._scene, *twice)
            found = 1.0 - hits.transmittance.astype(np.float64)
            return hits.radiance.astype(np.float64).reshape(2, -1, 3), found.reshape(2, -1, 1)

        light = shared_light(*seen(self._paths), colors, weights, DIRECT_SLOPE)
        if self._bounced is not None:
            (whole, found), (first, _) = map(seen, self._bounced)
            light += shared_light(whole - first, found, colors, weights, 1.0)
        return light

    def _shown(self, light: Doubles, share: Doubles) -> tuple[Doubles, float]:
        """Display-referred colours of rays of this light, and the mean variance of their noise."""

        def seen(light: Doubles) -> Doubles:
            nothing = np.zeros_like(light)
            shown = lit_picture(nothing, nothing[..., 0], light, self._exposure, self._config.tone_map)
            return share * shown.astype(np.float64)

        # The curve bends noise: that of the mean by half as much as that of the halves, which is taken out.
        halves = seen(light)
        colors = 2.0 * seen(light.mean(axis=0)) - halves.mean(axis=0)
        return colors, float(0.25 * np.square(halves[0] - halves[1]).mean()) if len(colors) else 0.0

    def _directions(self, eyes: FloatArray, gaussian: _Rows) -> FloatArray:
        """From eyes, world space, to Gaussians, in their own space."""
        towards = self._means[gaussian] - eyes
        for number, one in enumerate(self._scene.splats):
            here = self._instance[gaussian] == number
            towards[here] = towards[here] @ one.transform[:3, :3]
        length = np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
        return (towards / length).astype(np.float32)


class Blend:
    """Blends harmonics of Gaussians into pixels, and gathers errors of pixels, on the device."""

    def __init__(self, pixels: Pixels, gaussians: int, terms: int, launcher: Launcher) -> None:
        buffers = Buffers(launcher.device)
        self._launcher, self._terms, self._gaussians = launcher, terms, gaussians
        self._pixels = len(pixels.colors)
        self._sights = buffers.struct("sights", kernels.Sights, len(pixels.ray))
        for name in ("ray", "gaussian"):
            device_array(getattr(self._sights, name)).assign(getattr(pixels, name).astype(np.int32))
        device_array(self._sights.weight).assign(pixels.weight.astype(np.float32))
        device_array(self._sights.direction).assign(pixels.direction)
        order = np.argsort(pixels.gaussian, kind="stable").astype(np.int32)
        self._by_ray = _uploaded(buffers, "by_ray", _first_of(pixels.ray, self._pixels))
        self._by_gaussian = _uploaded(buffers, "by_gaussian", _first_of(pixels.gaussian, gaussians))
        self._order = _uploaded(buffers, "order", order)
        self._colors = buffers.get("colors", wp.vec3, self._pixels)
        self._sh = buffers.get("sh", wp.vec3, (gaussians, terms))

    def show(self, sh: Doubles) -> Doubles:
        """What pixels show, (N, K, 3) to (P, 3)."""
        return self._blended(sh, 0.5, 0.0)

    def blend(self, sh: Doubles) -> Doubles:
        """The linear part of that."""
        return self._blended(sh, 0.0, -float(np.finfo(np.float32).max))

    def gather(self, errors: Doubles) -> Doubles:
        """The transpose of ``blend``, (P, 3) to (N, K, 3)."""
        self._colors.assign(errors.astype(np.float32))
        self._sh.fill_(0.0)
        self._launcher.run_banded(
            kernels.gather_errors,
            self._gaussians,
            *(self._terms, self._sights, self._order, self._by_gaussian, self._colors, self._sh),
        )
        return self._sh.numpy().astype(np.float64)

    def _blended(self, sh: Doubles, shift: float, least: float) -> Doubles:
        self._sh.assign(sh.astype(np.float32))
        self._launcher.run_banded(
            kernels.blend_harmonics,
            self._pixels,
            *(self._terms, shift, least, self._sights, self._by_ray, self._sh, self._colors),
        )
        return self._colors.numpy().astype(np.float64)


def changed_to_fit(blend: Blend, pixels: Pixels, sh: Doubles) -> Doubles:
    """Harmonics (N, K, 3) changed so that pixels show their colours, by least squares.

    Coefficients are expected to change by some hundredths, and pixels tell as much of it as their noise lets them: the
    ridge is the ratio of the two variances. By conjugate gradients, a fixed number of steps.
    """
    level: Doubles = np.floor(np.sqrt(np.arange(sh.shape[1], dtype=np.float64) + 0.5))[:, None]
    ridge = (pixels.noise + MISFIT**2) / CHANGE_SPREAD**2 * (level + 1.0) ** 2
    residual = blend.gather(pixels.colors - blend.show(sh))
    change = np.zeros_like(sh)
    along, before = residual.copy(), np.square(residual).sum(axis=(0, 1))
    for _ in range(TOGETHER_STEPS):
        product = blend.gather(blend.blend(along)) + ridge * along
        step = before / np.maximum((along * product).sum(axis=(0, 1)), 1e-30)
        change += step * along
        residual -= step * product
        after = np.square(residual).sum(axis=(0, 1))
        along, before = residual + after / np.maximum(before, 1e-30) * along, after
    return sh + change


def _first_kept(kept: Flags) -> Flags:
    """The first of the lines of each Gaussian that tell of it, (N, L) to (N * L,): as many as it has rays."""
    rays = kept.shape[1] * RAYS_A_DIRECTION // LINES_A_DIRECTION
    return (kept & (np.cumsum(kept, axis=1) <= rays)).ravel()


def _world_normals(instance: SplatInstance) -> Doubles:
    """Normals of the planes of Gaussians, world space, shape (N, 3)."""
    return plane_normals(instance.gaussians) @ instance.transform[:3, :3].T / instance.scale


def _first_of(numbers: _Rows, count: int) -> IntArray:
    """Where each number from 0 on begins once all are sorted, and how many there are at the end."""
    return np.concatenate([[0], np.cumsum(np.bincount(numbers, minlength=count))]).astype(np.int32)


def _uploaded(buffers: Buffers, name: str, values: IntArray) -> DeviceArray:
    array = buffers.get(name, int, len(values))
    array.assign(values)
    return array
