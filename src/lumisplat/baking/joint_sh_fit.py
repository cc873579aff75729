"""Host pass: fits SH of Gaussians so that their blends match frames (docs/method/relighting.md#baking)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import warp as wp
from scipy.sparse.linalg import LinearOperator, cg

from lumisplat.baking import joint_sh_fit_kernels as kernels
from lumisplat.baking.bake_denoising import RayWeights, denoised_by_rays
from lumisplat.baking.sample_rays import DrawnRays, SampleRays, plane_normals
from lumisplat.config import HitDistance, Pipeline, RenderConfig
from lumisplat.math.arrays import Doubles, Flags, FloatArray, IntArray
from lumisplat.math.tone_map import lit_picture
from lumisplat.progress import Progress
from lumisplat.renderer.rays import RayHits, RayProfile
from lumisplat.renderer.renderer import Renderer
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.scene.materials import is_relit, material_of, shading_overrides
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.lights import AreaLight, Light
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.ops.colors import base_colors
from lumisplat.scene.ops.neighbours import morton_order
from lumisplat.scene.scene import Scene, SplatInstance

RAYS_A_DIRECTION = 2
"""Rays to Gaussians that are seen together, for each direction from which they are seen alone."""

RAY_DRAWS = 8
"""Rounds of as many lines as a Gaussian is to have rays, to those that lack any: in closed rooms, a quarter
to a half of the lines show the back of something, or what is not baked, and near corners up to nine in ten."""

DIRECT_SLOPE = 2.0
"""How fast rays keep more of their own direct light as they differ from what is shared by more than their noise: by 1,
edges of shadows are drawn to the mean, too, which costs 0.5 dB in a room."""

BOUNCED_FRACTION = 2
"""One in so many paths of each ray bounces: what has bounced is shared among rays, so that fewer tell enough."""

BOUNCED_MIN = 2
"""Paths of each half of the samples that bounce at least, if there are as many."""

CONTRIBUTION_MIN = 0.005
"""Share of a ray below which a Gaussian is left out of it: half of those that it reaches, and 1 % of what it shows."""

COVERED_MIN = 0.05
"""Share of a ray that Gaussians must cover for it to tell of them."""

OTHERS_MAX = 0.02
"""Share of a ray up to which what is not baked may show on it; it is not shaded."""

SPAN_PAST = 1e-4
"""How far behind the last Gaussian rays end before meshes, of its distance: more than float32 leaves uncertain."""

RAYS_AT_ONCE = 2**17
"""Lines whose Gaussians are listed at once: some 200 MB of the host's memory."""

CHANGE_SPREAD = 0.15
"""Standard deviation of the changes that are expected of coefficients by what is seen together, of degree 0; of degree
l a part of 1 / (l + 1), so that noise of rays does not go into how matt surfaces change with the direction."""

MISFIT = 0.03
"""Error of blended harmonics that is expected besides noise, display-referred."""

JOINT_STEPS = 40
"""Most steps of conjugate gradients: with 10, a room has 0.3 dB less, a statue 0.3, a ball of rough metal 0.6."""

JOINT_ERROR = 1e-6
"""Relative residual at which these end: what single precision on the device resolves."""

JOINT_RAYS = 2**19
"""Rays to Gaussians that are changed together: to 8,192 of them with 32 directions."""

_Rows = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Pixels:
    """Holds what frames show on P rays, and which Gaussians are blended there."""

    colors: Doubles
    """Display-referred, shape (P, 3)."""
    noise: float
    """Mean variance of these."""
    ray: _Rows
    """Ray of each of S sights, ascending, shape (S,)."""
    gaussian: _Rows
    """Gaussian of each sight, shape (S,)."""
    weight: Doubles
    """Share of the Gaussian's colour in the ray's, shape (S,)."""
    direction: FloatArray
    """From the eye to the Gaussian's mean, its own space, unit, shape (S, 3)."""

    def information(self, gaussians: int) -> Doubles:
        """About each coefficient of a Gaussian, as if it was seen from all sides, in units of their noise, shape (N,).

        The diagonal of the normal equations; the mean square of a harmonic over all directions is 1 / (4 pi). Pixels of
        all parts of a bake are taken to be as noisy.
        """
        return np.bincount(self.gaussian, np.square(self.weight), gaussians) / (4.0 * np.pi)


@dataclass(frozen=True, slots=True, eq=False)
class _UsableRays:
    """P rays that show nothing but relit sets, from their front, and S sights of the Gaussians that they blend."""

    origins: FloatArray
    """World space, (P, 3)."""
    directions: FloatArray
    """Unit, (P, 3)."""
    share: Doubles
    """Share of each ray's pixel that Gaussians cover, (P,)."""
    before_mesh: Flags
    """Which end at a mesh behind them, (P,)."""
    ray: _Rows
    """Ascending, (S,)."""
    side: IntArray
    """Twice the number of the Gaussian, and one more where its back is seen, (S,)."""
    weight: Doubles
    """They add up to the share of each ray, (S,)."""
    along: FloatArray
    """From the eye to the Gaussian's mean, its own space, unit, (S, 3)."""

    @classmethod
    def joined(cls, parts: list[_UsableRays]) -> _UsableRays:
        """All of them, in order; the list is emptied, and one field at a time is held twice."""
        firsts = np.cumsum([0, *(len(part.share) for part in parts)])
        fields = {name: [getattr(part, name) for part in parts] for name in cls.__slots__}
        fields["ray"] = [ray + first for ray, first in zip(fields["ray"], firsts, strict=False)]
        parts.clear()
        return cls(**{name: np.concatenate(fields.pop(name)) for name in cls.__slots__})


class JointShFit:
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
        self._colors = np.concatenate([reflected_colors(one) for one in scene.splats])
        self._normals = np.concatenate([_world_normals(one) for one in scene.splats])
        self._has_front = np.repeat([one.gaussians.normals is not None for one in scene.splats], counts)
        half = max((config.samples or 2) // 2, 1)
        self._paths = FrameRays(replace(config, samples=half), launcher)
        self._bounced: tuple[FrameRays, FrameRays] | None = None
        if config.pipeline.traces_paths and config.max_bounces != 0:
            # By the same random numbers: what paths bring without bouncing is a part of what they bring.
            few = replace(config, samples=min(max(half // BOUNCED_FRACTION, BOUNCED_MIN), half))
            self._bounced = FrameRays(few, launcher), FrameRays(replace(few, max_bounces=0), launcher)
            self._paths = FrameRays(replace(self._paths.config, max_bounces=0), launcher)
        # Where rays of lit frames meet Gaussians: by peaks, by which it is told, too, what lies before an end.
        order = config.trace.hit_distance or HitDistance.PEAK
        unlit = replace(
            config, pipeline=Pipeline.TRACE, lighting=False, trace=replace(config.trace, hit_distance=order)
        )
        self._hit_rays = FrameRays(unlit, launcher)
        self._blends = Renderer(RenderConfig(pipeline=Pipeline.TRACE, lighting=False), launcher)

    def refitted(self, sh: Doubles, rays_of_gaussians: SampleRays, progress: Progress | None) -> Doubles:
        """Harmonics of all Gaussians of the scene, (N, K, 3), such that rays along these ways show what frames do.

        Neighbours are changed together, some thousands at a time. What is around them follows, and the more rays it was
        fitted to before, the less.
        """
        result, information = np.array(sh), np.zeros(len(sh))
        order = morton_order(self._means[rays_of_gaussians.gaussian])
        rays = RAYS_A_DIRECTION * rays_of_gaussians.shares.shape[1]
        for rows in _ranges(len(order), max(JOINT_RAYS // rays, 1)):
            if progress:
                progress("baking", 0.5 + 0.5 * rows.start / len(order))
            pixels = self.pixels(rays_of_gaussians.of(order[rows]), rays)
            if not len(pixels.colors):
                continue
            here, renamed = np.unique(pixels.gaussian, return_inverse=True)
            some = replace(pixels, gaussian=renamed)
            blend = Blend(some, len(here), sh.shape[1], self._launcher)
            result[here] = refitted_sh(blend, some, result[here], information[here])
            information[here] += some.information(len(here))
        return result

    def pixels(self, rays_of_gaussians: SampleRays, count: int) -> Pixels:
        """What frames show on so many rays to each Gaussian, along these ways."""
        rays = self._rays(rays_of_gaussians, count)
        colors, noise = self._displayed(self._light(rays), rays.share[:, None])
        return Pixels(colors, noise, rays.ray, rays.side.astype(np.int64) // 2, rays.weight, rays.along)

    def _rays(self, rays_of_gaussians: SampleRays, count: int) -> _UsableRays:
        """Those that show nothing but relit sets, from their front; in place of others, more are drawn, some rounds."""
        parts: list[_UsableRays] = []
        lacking = np.full(len(rays_of_gaussians.gaussian), count)
        for number in range(RAY_DRAWS):
            wanting = np.flatnonzero(lacking)
            if not len(wanting):
                break
            for some in _ranges(len(wanting), max(RAYS_AT_ONCE // count, 1)):
                rows = wanting[some]
                usable, found = self._choose_usable(
                    rays_of_gaussians.of(rows).draw(number, count, self._config.seed), lacking[rows]
                )
                parts.append(usable)
                lacking[rows] -= found
        return _UsableRays.joined(parts)

    def _choose_usable(self, drawn: DrawnRays, wanted: _Rows) -> tuple[_UsableRays, _Rows]:
        """The first lines to each Gaussian that show relit sets as viewers of captures do, and how many these are."""
        origins, directions = (array.reshape(-1, 3) for array in (drawn.origins, drawn.directions))
        hits = self._blends.trace_rays(self._scene, origins, directions, profile=True)
        assert hits.profile is not None
        gaussian_hits = HitGaussians.of(hits.profile, self._firsts)
        share, relit = gaussian_hits.total(np.ones(len(gaussian_hits.ray))), self._relit[gaussian_hits.gaussian]
        usable = (share > COVERED_MIN) & (gaussian_hits.total(~relit) < OTHERS_MAX)
        usable &= 1.0 - hits.transmittance - share < OTHERS_MAX
        facing = self._facing(gaussian_hits.gaussian, directions[gaussian_hits.ray])
        # Rays that see more of the backs of Gaussians with normals than of their fronts: nobody is there.
        usable &= gaussian_hits.total(facing * self._has_front[gaussian_hits.gaussian]) <= 0.0
        if self._config.pipeline.traces_paths:  # which shows lights as bodies, in front of Gaussians and behind
            usable &= ~hits_light(self._scene.lights, origins, directions)
        usable = usable.reshape(drawn.origins.shape[:2])
        usable &= np.cumsum(usable, axis=1) <= wanted[:, None]
        found, usable = usable.sum(axis=1), usable.ravel()
        rows = usable[gaussian_hits.ray] & relit & (gaussian_hits.weight > CONTRIBUTION_MIN)
        gaussian_hits, back = gaussian_hits.where(rows), facing[rows] > 0.0
        scale = share / np.maximum(gaussian_hits.total(np.ones(len(gaussian_hits.ray))), 1e-12)
        rays = _UsableRays(
            origins[usable],
            directions[usable],
            share[usable],
            (hits.transmittance == 0.0)[usable],
            ray=(np.cumsum(usable) - 1)[gaussian_hits.ray],
            side=(2 * gaussian_hits.gaussian + back).astype(np.int32),
            weight=scale[gaussian_hits.ray] * gaussian_hits.weight,
            along=self._directions(origins[gaussian_hits.ray], gaussian_hits.gaussian),
        )
        return rays, found

    def _facing(self, gaussian: _Rows, directions: FloatArray) -> Doubles:
        """Cosines of directions to the normals of Gaussians: above 0 where they show their backs."""
        return (self._normals[gaussian] * directions).sum(axis=1)

    def _light(self, rays: _UsableRays) -> Doubles:
        """Linear light of what rays meet, by every other sample and by the others, with less noise, (2, P, 3)."""
        begins, ends, base = self._lit_segments(rays)
        starts = (rays.origins + begins[:, None] * rays.directions).astype(np.float32)
        twice = (
            np.tile(starts, (2, 1)),
            np.tile(rays.directions, (2, 1)),
            np.tile((ends - begins).astype(np.float32), 2),
        )

        def rendered(paths: FrameRays) -> tuple[Doubles, Doubles]:
            hits = paths.radiance(self._scene, *twice)
            hit_share = 1.0 - hits.transmittance.astype(np.float64)
            return hits.radiance.astype(np.float64).reshape(2, -1, 3), hit_share.reshape(2, -1, 1)

        # Both sides of a sheet have light of their own.
        sides, renamed = np.unique(rays.side, return_inverse=True)
        weights = RayWeights(rays.ray, renamed, rays.weight, len(rays.share), len(sides))
        light = denoised_by_rays(*rendered(self._paths), base, weights, DIRECT_SLOPE)
        if self._bounced is not None:
            (whole, hit_share), (first, _) = map(rendered, self._bounced)
            light += denoised_by_rays(whole - first, hit_share, base, weights, 1.0)
        return light

    def _lit_segments(self, rays: _UsableRays) -> tuple[Doubles, Doubles, Doubles]:
        """Where the parts of rays begin and end on which nothing but relit sets is, and what these show of even light.

        As lit frames sort them, by where rays meet them: viewers of captures sort them by their means. Shapes (P,),
        (P,), (P, 3).
        """
        parts: list[tuple[Doubles, Doubles, Doubles]] = []
        for rows in _ranges(len(rays.share), RAYS_AT_ONCE):
            profile = self._hit_rays.hits(self._scene, rays.origins[rows], rays.directions[rows])
            hits = HitGaussians.of(profile, self._firsts)
            begins, ends, within = clear_spans(hits, self._relit[hits.gaussian], rays.before_mesh[rows])
            hits = hits.where(within)
            totals = [hits.total(channel[hits.gaussian]) for channel in (*self._colors.T, np.ones(len(self._colors)))]
            parts.append((begins, ends, np.stack(totals[:3], axis=1) / np.maximum(totals[3], 1e-12)[:, None]))
        begins, ends, base = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        return begins, ends, base

    def _displayed(self, light: Doubles, share: Doubles) -> tuple[Doubles, float]:
        """Display-referred colours of rays of this light, and the mean variance of their noise."""

        def displayed(light: Doubles) -> Doubles:
            nothing = np.zeros_like(light)
            values = lit_picture(nothing, nothing[..., 0], light, self._exposure, self._config.tone_map)
            return share * values.astype(np.float64)

        # The curve bends noise: that of the mean by half as much as that of the halves, which is taken out.
        halves = displayed(light)
        colors = 2.0 * displayed(light.mean(axis=0)) - halves.mean(axis=0)
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
        self._contributions = buffers.struct("contributions", kernels.Contributions, len(pixels.ray))
        for name in ("ray", "gaussian"):
            device_array(getattr(self._contributions, name)).assign(getattr(pixels, name).astype(np.int32))
        device_array(self._contributions.weight).assign(pixels.weight.astype(np.float32))
        device_array(self._contributions.direction).assign(pixels.direction)
        order = np.argsort(pixels.gaussian, kind="stable").astype(np.int32)
        self._by_ray = _uploaded(buffers, "by_ray", _first_of(pixels.ray, self._pixels))
        self._by_gaussian = _uploaded(buffers, "by_gaussian", _first_of(pixels.gaussian, gaussians))
        self._order = _uploaded(buffers, "order", order)
        self._colors = buffers.get("colors", wp.vec3, self._pixels)
        self._sh = buffers.get("sh", wp.vec3, (gaussians, terms))

    def pixel_colors(self, sh: Doubles) -> Doubles:
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
            *(self._terms, self._contributions, self._order, self._by_gaussian, self._colors, self._sh),
        )
        return self._sh.numpy().astype(np.float64)

    def _blended(self, sh: Doubles, shift: float, least: float) -> Doubles:
        self._sh.assign(sh.astype(np.float32))
        self._launcher.run_banded(
            kernels.blend_sh,
            self._pixels,
            *(self._terms, shift, least, self._contributions, self._by_ray, self._sh, self._colors),
        )
        return self._colors.numpy().astype(np.float64)


def refitted_sh(blend: Blend, pixels: Pixels, sh: Doubles, information: Doubles) -> Doubles:
    """Harmonics (N, K, 3) changed so that pixels show their colours, by least squares.

    Coefficients are expected to change by some hundredths, and pixels tell as much of it as their noise lets them: the
    ridge is the ratio of the two variances. Solved by conjugate gradients.

    Args:
        blend: Of the pixels.
        pixels: What they show, and of which Gaussians.
        sh: What is to be changed.
        information: Of the pixels to which it was fitted before, as of `Pixels.information`, shape (N,).
    """
    level: Doubles = np.floor(np.sqrt(np.arange(sh.shape[1], dtype=np.float64) + 0.5))[:, None]
    ridge = (pixels.noise + MISFIT**2) / CHANGE_SPREAD**2 * (level + 1.0) ** 2 + information[:, None, None]
    residual = blend.gather(pixels.colors - blend.pixel_colors(sh))

    def normal_equations(change: Doubles) -> Doubles:
        change = change.reshape(sh.shape)
        return (blend.gather(blend.blend(change)) + ridge * change).ravel()

    operator = LinearOperator((sh.size, sh.size), normal_equations, dtype=np.float64)
    change, _ = cg(operator, residual.ravel(), rtol=JOINT_ERROR, maxiter=JOINT_STEPS)
    return sh + change.reshape(sh.shape)


def _ranges(count: int, at_once: int) -> Iterator[slice]:
    """Ranges of so many numbers at once; at least an empty one."""
    for begin in range(0, max(count, 1), at_once):
        yield slice(begin, min(begin + at_once, count))


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


class FrameRays(Renderer):
    """A renderer that shows rays up to where they end, and lists what they meet in the order of its settings."""

    def radiance(self, scene: Scene, origins: FloatArray, directions: FloatArray, ends: FloatArray) -> RayHits:
        """What rays show before these distances, shape (N,); directions are unit vectors."""
        return self._queries.query(self._scene, self._ready(scene), origins, directions, ends=ends)

    def hits(self, scene: Scene, origins: FloatArray, directions: FloatArray) -> RayProfile:
        """The Gaussians on rays, one by one; directions are unit vectors."""
        self._ready(scene)
        return self._profiles.query(self._scene, scene, origins, directions)

    def _ready(self, scene: Scene) -> FramePlan:
        plan = self._sync_rays(scene)
        self._load(self._modules(plan))
        return plan


@dataclass(frozen=True, slots=True, eq=False)
class HitGaussians:
    """The Gaussians on P rays, S rows sorted by ray, each ray's in the order in which they are blended."""

    ray: _Rows
    """Shape (S,)."""
    gaussian: _Rows
    """Among all of the scene's, shape (S,)."""
    weight: Doubles
    """Share of it in what the ray shows, shape (S,)."""
    t: Doubles
    """Distance, scene units, shape (S,)."""
    rays: int

    @classmethod
    def of(cls, profile: RayProfile, firsts: IntArray) -> HitGaussians:
        """Those of a profile; ``firsts`` are the numbers of the first Gaussian of each instance."""
        return cls(
            ray=np.repeat(np.arange(len(profile)), np.diff(profile.first)),
            gaussian=firsts[profile.instance_index] + profile.gaussian_index.astype(np.int64),
            weight=(profile.transmittance * profile.alpha / (1.0 - profile.alpha)).astype(np.float64),
            t=profile.t.astype(np.float64),
            rays=len(profile),
        )

    def where(self, rows: Flags) -> HitGaussians:
        """Some of them, on the same rays."""
        return HitGaussians(self.ray[rows], self.gaussian[rows], self.weight[rows], self.t[rows], self.rays)

    def total(self, values: Doubles | Flags) -> Doubles:
        """Weighted sums of values of the rows over each ray, shape (P,)."""
        return np.bincount(self.ray, self.weight * values, self.rays).astype(np.float64)


def clear_spans(hits: HitGaussians, wanted: Flags, before_mesh: Flags) -> tuple[Doubles, Doubles, Flags]:
    """The part of each ray around what it shows most of, on which nothing but wanted Gaussians is.

    Args:
        hits: The Gaussians on the rays.
        wanted: Which rows are of these, shape (S,).
        before_mesh: Which rays meet a mesh behind all of them, shape (P,).

    Returns:
        Where it begins and where it ends, shape (P,) each: 0 and infinity where the ray reaches nothing else, else half
        way between what is wanted and what is not; and which rows are within, shape (S,). A ray that nothing is left
        of ends where it begins.
    """
    ray, t = hits.ray, hits.t
    most, middle = np.zeros(hits.rays), np.zeros(hits.rays)
    np.maximum.at(most, ray[wanted], hits.weight[wanted])
    heaviest = wanted & (hits.weight == most[ray])
    middle[ray[heaviest]] = t[heaviest]
    before, behind = ~wanted & (t < middle[ray]), ~wanted & (t >= middle[ray])
    low, high = np.zeros(hits.rays), np.full(hits.rays, np.inf)
    np.maximum.at(low, ray[before], t[before])
    np.minimum.at(high, ray[behind], t[behind])
    within = wanted & (t > low[ray]) & (t < high[ray])
    first, last = np.full(hits.rays, np.inf), np.zeros(hits.rays)
    np.minimum.at(first, ray[within], t[within])
    np.maximum.at(last, ray[within], t[within])
    begin = np.where(low > 0.0, 0.5 * (low + first), 0.0)
    end = np.where(np.isfinite(high), 0.5 * (high + last), np.where(before_mesh, (1.0 + SPAN_PAST) * last, np.inf))
    empty = np.isinf(first)
    return np.where(empty, 0.0, begin), np.where(empty, 0.0, end), within


def reflected_colors(instance: SplatInstance) -> Doubles:
    """About what the Gaussians of a set show in even light of radiance 1, linear, shape (N, 3).

    By the colours that they are shaded with: those that were captured, of sets that shine by them, whatever their
    albedo. What the surface of a dielectric mirrors is white, so that black ones that are glossy are not black.
    """
    (by_albedo,) = shading_overrides(Scene([instance]), lit=True)["shows_albedo"]
    gaussians = instance.gaussians if by_albedo else replace(instance.gaussians, albedo=None)
    colors, material = base_colors(gaussians), material_of(instance)
    if not isinstance(material, MaterialPbr):
        return colors * np.add(np.add(material.emissive, material.ambient), material.diffuse) + material.specular
    metallic = np.full(gaussians.count, material.metallic) if gaussians.metallic is None else gaussians.metallic
    mirrored = ((1.0 - metallic) * material.specular * ((material.ior - 1.0) / (material.ior + 1.0)) ** 2)[:, None]
    return mirrored + (1.0 - mirrored) * colors


def hits_light(lights: Iterable[Light], origins: FloatArray, directions: FloatArray) -> Flags:
    """Returns which rays reach a light that is visible, whatever hides it, shape (N,).

    Args:
        lights: Of a scene.
        origins: World space, shape (N, 3).
        directions: Unit, shape (N, 3).
    """
    starts, along = origins.astype(np.float64), directions.astype(np.float64)
    reaches = np.zeros(len(origins), np.bool_)
    for light in lights:
        if isinstance(light, AreaLight) and light.enabled and light.visible:
            reaches |= np.isfinite(light.distances(starts, along))
    return reaches
