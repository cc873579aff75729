"""Refits the SH of Gaussians so that their alpha blends match rendered frames (docs/method/relighting.md#baking)."""

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
from lumisplat.renderer.scene.materials import is_relit, material_of, shading_overrides, tint_of
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.lights import AreaLight, Light
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.ops.colors import base_colors
from lumisplat.scene.ops.neighbours import morton_order
from lumisplat.scene.scene import Scene, SplatInstance

RAYS_PER_DIRECTION = 2
"""Number of rays towards a Gaussian in the joint fit, per direction from which it is viewed in its separate fit."""

RAY_DRAWS = 8
"""Largest number of times that rays are drawn for a Gaussian that has too few usable ones. In closed rooms a quarter
to a half of the rays show backs or sets that are not baked; near corners, up to nine in ten."""

DIRECT_SLOPE = 2.0
"""Slope of `denoised_by_rays` for direct light. At 1, shadow edges are blurred, too, which costs 0.5 dB in a room."""

BOUNCED_DIVISOR = 2
"""Divisor of the samples per ray that gives the number of samples of indirect light. Denoising averages indirect light
over rays, so fewer paths suffice."""

BOUNCED_MIN = 2
"""Smallest number of paths with bounces in each half of a ray's samples, unless the half has fewer samples."""

CONTRIBUTION_MIN = 0.005
"""Blend weight below which a Gaussian is ignored on a ray. Half of the hits are below it, with 1 % of the colour."""

COVERED_MIN = 0.05
"""Total blend weight above which a ray's Gaussians cover it enough for the ray to enter the joint fit."""

OTHERS_MAX = 0.02
"""Blend weight that meshes and sets which are not baked may have together on a ray of the joint fit, which cannot
change their colours."""

SEGMENT_MARGIN = 1e-4
"""Distance by which a ray ends behind its last Gaussian, in front of a mesh, relative to the Gaussian's distance;
larger than the rounding errors of float32."""

RAYS_AT_ONCE = 2**17
"""Number of rays whose Gaussians are listed at once; the lists take about 200 MB of host memory."""

CHANGE_SPREAD = 0.15
"""Standard deviation by which the joint fit is expected to change SH coefficients of degree 0. For degree l it is
divided by l + 1, so that noise does not make diffuse surfaces view-dependent."""

MISFIT = 0.03
"""Standard deviation, display-referred, of the error of blended SH colours that is expected in addition to noise."""

JOINT_STEPS = 40
"""Largest number of conjugate gradient steps of the joint SH fit. With ten steps, images have 0.3 dB less PSNR in a
room, 0.3 on a statue and 0.6 on a rough metal ball."""

JOINT_ERROR = 1e-6
"""Relative residual at which the conjugate gradients of the joint fit end; float32 on the device resolves no less."""

JOINT_RAYS = 2**19
"""Number of rays in one joint fit, such as those to 8,192 Gaussians with 32 directions."""

_Rows = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Pixels:
    """Colours of a rendered frame on P rays, and the Gaussians that viewers blend on these rays.

    A contribution is a Gaussian on a ray; there are S contributions.
    """

    colors: Doubles
    """Display-referred colours of a rendered frame on P rays, shape (P, 3)."""
    noise: float
    """Variance of the noise in the rendered colours, a mean over all rays."""
    ray: _Rows
    """Index of the ray of each of S contributions (a Gaussian on a ray), ascending, shape (S,)."""
    gaussian: _Rows
    """Index of the Gaussian of each of S contributions (a Gaussian on a ray), shape (S,)."""
    weight: Doubles
    """Blend weight in the ray's colour of each of S contributions (a Gaussian on a ray), shape (S,)."""
    direction: FloatArray
    """Unit direction from the camera to the Gaussian's mean, object space, of each of S contributions (a Gaussian on a
    ray), shape (S, 3)."""

    def information(self, gaussians: int) -> Doubles:
        """Returns how much the rays determine the SH coefficients of each of N Gaussians, shape (N,).

        The value is the Fisher information times the noise variance: the diagonal of the normal equations for views
        from all directions. The mean square of an SH basis function over the sphere is 1 / (4 pi). All rays of a bake
        are assumed to be equally noisy.
        """
        return np.bincount(self.gaussian, np.square(self.weight), gaussians) / (4.0 * np.pi)


@dataclass(frozen=True, slots=True, eq=False)
class _UsableRays:
    """P rays that show only front sides of relit sets, and their S contributions.

    A contribution is a Gaussian on a ray.
    """

    origins: FloatArray
    """Origins of P rays, world space, shape (P, 3)."""
    directions: FloatArray
    """Unit directions of P rays, world space, shape (P, 3)."""
    alpha: Doubles
    """Alpha of each of P rays, shape (P,)."""
    before_mesh: Flags
    """True for those of P rays that end at a mesh behind their Gaussians, shape (P,)."""
    ray: _Rows
    """Index of the ray of each of S contributions (a Gaussian on a ray), ascending, shape (S,)."""
    side: IntArray
    """Side of Gaussian i that each of S contributions (a Gaussian on a ray) shows: 2 i for its front, 2 i + 1 for its
    back, shape (S,)."""
    weight: Doubles
    """Blend weight of each of S contributions (a Gaussian on a ray), shape (S,); the weights on a ray sum to its
    alpha."""
    along: FloatArray
    """Unit direction from the camera to the Gaussian's mean, object space, of each of S contributions (a Gaussian on a
    ray), shape (S, 3)."""

    @classmethod
    def joined(cls, parts: list[_UsableRays]) -> _UsableRays:
        """Concatenates sets of rays into one; empties ``parts``, so that only one field is in memory twice."""
        firsts = np.cumsum([0, *(len(part.alpha) for part in parts)])
        fields = {name: [getattr(part, name) for part in parts] for name in cls.__slots__}
        fields["ray"] = [ray + first for ray, first in zip(fields["ray"], firsts, strict=False)]
        parts.clear()
        return cls(**{name: np.concatenate(fields.pop(name)) for name in cls.__slots__})


class JointShFit:
    """Refits the SH of all relit Gaussians of a scene jointly.

    Args:
        scene: Scene with its lights and meshes.
        config: Settings of the rendered frames; ``samples`` is the even number of paths per ray.
        exposure: Exposure, stops.
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
            # Equal random numbers: the direct light of both renderers is the same and cancels in the difference.
            indirect = replace(config, samples=min(max(half // BOUNCED_DIVISOR, BOUNCED_MIN), half))
            self._bounced = FrameRays(indirect, launcher), FrameRays(replace(indirect, max_bounces=0), launcher)
            self._paths = FrameRays(replace(self._paths.config, max_bounces=0), launcher)
        # Lit frames sort hits by their peak distance, which also decides what lies before the end of a segment.
        order = config.trace.hit_distance or HitDistance.PEAK
        unlit = replace(
            config, pipeline=Pipeline.TRACE, lighting=False, trace=replace(config.trace, hit_distance=order)
        )
        self._hit_rays = FrameRays(unlit, launcher)
        self._blends = Renderer(RenderConfig(pipeline=Pipeline.TRACE, lighting=False), launcher)

    def refitted(self, sh: Doubles, rays_of_gaussians: SampleRays, progress: Progress | None) -> Doubles:
        """Refits the K SH coefficients of all N Gaussians, shape (N, K, 3), to rendered frames.

        Afterwards, alpha blends of the SH colours along sampled rays match the frames. Some thousands of neighbouring
        Gaussians are fitted at a time. Their rays also show Gaussians of earlier fits. These change again, but less the
        more rays they were fitted to.
        """
        result, information = np.array(sh), np.zeros(len(sh))
        order = morton_order(self._means[rays_of_gaussians.gaussian])
        rays = RAYS_PER_DIRECTION * rays_of_gaussians.cumulative.shape[1]
        for rows in _ranges(len(order), max(JOINT_RAYS // rays, 1)):
            if progress:
                progress("baking", 0.5 + 0.5 * rows.start / len(order))
            pixels = self.pixels(rays_of_gaussians.of(order[rows]), rays)
            if not len(pixels.colors):
                continue
            indices, renamed = np.unique(pixels.gaussian, return_inverse=True)
            compact = replace(pixels, gaussian=renamed)
            blend = Blend(compact, len(indices), sh.shape[1], self._launcher)
            result[indices] = refitted_sh(blend, compact, result[indices], information[indices])
            information[indices] += compact.information(len(indices))
        return result

    def pixels(self, rays_of_gaussians: SampleRays, count: int) -> Pixels:
        """Draws ``count`` usable rays to each Gaussian, and renders the frame's colours on them.

        Usable rays show only front sides of relit sets, and no lights.
        """
        rays = self._rays(rays_of_gaussians, count)
        colors, noise = self._displayed(self._light(rays), rays.alpha[:, None])
        return Pixels(colors, noise, rays.ray, rays.side.astype(np.int64) // 2, rays.weight, rays.along)

    def _rays(self, rays_of_gaussians: SampleRays, count: int) -> _UsableRays:
        """Draws ``count`` usable rays to each Gaussian: rays that show only front sides of relit sets, and no lights.

        Rays are drawn up to `RAY_DRAWS` times for Gaussians that have too few usable rays; some may stay below
        ``count``.
        """
        parts: list[_UsableRays] = []
        missing = np.full(len(rays_of_gaussians.gaussian), count)
        for number in range(RAY_DRAWS):
            incomplete = np.flatnonzero(missing)
            if not len(incomplete):
                break
            for some in _ranges(len(incomplete), max(RAYS_AT_ONCE // count, 1)):
                rows = incomplete[some]
                usable, found = self._choose_usable(
                    rays_of_gaussians.of(rows).draw(number, count, self._config.seed), missing[rows]
                )
                parts.append(usable)
                missing[rows] -= found
        return _UsableRays.joined(parts)

    def _choose_usable(self, drawn: DrawnRays, wanted: _Rows) -> tuple[_UsableRays, _Rows]:
        """Returns the first usable rays to each Gaussian, at most as many as wanted, and how many there are.

        Args:
            drawn: Rays towards each Gaussian; usable ones show only front sides of relit sets, and no lights.
            wanted: Largest number of usable rays of each Gaussian.
        """
        origins, directions = (array.reshape(-1, 3) for array in (drawn.origins, drawn.directions))
        hits = self._blends.trace_rays(self._scene, origins, directions, profile=True)
        assert hits.profile is not None
        gaussian_hits = HitGaussians.of(hits.profile, self._firsts)
        share, relit = gaussian_hits.total(np.ones(len(gaussian_hits.ray))), self._relit[gaussian_hits.gaussian]
        usable = (share > COVERED_MIN) & (gaussian_hits.total(~relit) < OTHERS_MAX)
        usable &= 1.0 - hits.transmittance - share < OTHERS_MAX
        facing = self._facing(gaussian_hits.gaussian, directions[gaussian_hits.ray])
        # Rays that show more backs than fronts of Gaussians with normals come from inside an object.
        usable &= gaussian_hits.total(facing * self._has_front[gaussian_hits.gaussian]) <= 0.0
        if self._config.pipeline.traces_paths:  # path tracing shows lights as surfaces
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
        """Returns the cosine between each direction and its Gaussian's normal; above 0, the ray shows the back."""
        return (self._normals[gaussian] * directions).sum(axis=1)

    def _light(self, rays: _UsableRays) -> Doubles:
        """Renders the linear radiance of P rays from even and from odd samples, and denoises both, shape (2, P, 3)."""
        begins, ends, base = self._lit_segments(rays)
        starts = (rays.origins + begins[:, None] * rays.directions).astype(np.float32)
        segments_twice = (
            np.tile(starts, (2, 1)),
            np.tile(rays.directions, (2, 1)),
            np.tile((ends - begins).astype(np.float32), 2),
        )

        def rendered(paths: FrameRays) -> tuple[Doubles, Doubles]:
            hits = paths.radiance(self._scene, *segments_twice)
            hit_share = 1.0 - hits.transmittance.astype(np.float64)
            return hits.radiance.astype(np.float64).reshape(2, -1, 3), hit_share.reshape(2, -1, 1)

        # The two sides of a sheet are lit differently.
        sides, renamed = np.unique(rays.side, return_inverse=True)
        weights = RayWeights(rays.ray, renamed, rays.weight, len(rays.alpha), len(sides))
        light = denoised_by_rays(*rendered(self._paths), base, weights, DIRECT_SLOPE)
        if self._bounced is not None:
            (whole, hit_share), (first, _) = map(rendered, self._bounced)
            light += denoised_by_rays(whole - first, hit_share, base, weights, 1.0)
        return light

    def _lit_segments(self, rays: _UsableRays) -> tuple[Doubles, Doubles, Doubles]:
        """Finds the segment of each of P rays that contains only relit sets, and its colour in a constant environment.

        Lit frames sort Gaussians by their hit distance, viewers of captures by the distance of their means.

        Returns:
            Start and end of each segment, shape (P,) each, and colours, shape (P, 3).
        """
        parts: list[tuple[Doubles, Doubles, Doubles]] = []
        for rows in _ranges(len(rays.alpha), RAYS_AT_ONCE):
            profile = self._hit_rays.hits(self._scene, rays.origins[rows], rays.directions[rows])
            hits = HitGaussians.of(profile, self._firsts)
            begins, ends, within = wanted_segments(hits, self._relit[hits.gaussian], rays.before_mesh[rows])
            hits = hits.where(within)
            totals = [hits.total(channel[hits.gaussian]) for channel in (*self._colors.T, np.ones(len(self._colors)))]
            parts.append((begins, ends, np.stack(totals[:3], axis=1) / np.maximum(totals[3], 1e-12)[:, None]))
        begins, ends, base = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        return begins, ends, base

    def _displayed(self, light: Doubles, share: Doubles) -> tuple[Doubles, float]:
        """Tone-maps the radiance of rays to display-referred colours, and returns the mean variance of their noise.

        Args:
            light: Linear radiance of the rays, from even and from odd samples, shape (2, P, 3).
            share: Alpha of the rays, by which the colours are multiplied.
        """

        def displayed(light: Doubles) -> Doubles:
            nothing = np.zeros_like(light)
            values = lit_picture(nothing, nothing[..., 0], light, self._exposure, self._config.tone_map)
            return share * values.astype(np.float64)

        # The tone curve biases noisy values, the mean half as much as each half: extrapolation removes the bias.
        halves = displayed(light)
        colors = 2.0 * displayed(light.mean(axis=0)) - halves.mean(axis=0)
        return colors, float(0.25 * np.square(halves[0] - halves[1]).mean()) if len(colors) else 0.0

    def _directions(self, eyes: FloatArray, gaussian: _Rows) -> FloatArray:
        """Returns unit directions from camera positions, world space, to one Gaussian each, in its object space."""
        towards = self._means[gaussian] - eyes
        for number, one in enumerate(self._scene.splats):
            in_instance = self._instance[gaussian] == number
            towards[in_instance] = towards[in_instance] @ one.transform[:3, :3]
        length = np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
        return (towards / length).astype(np.float32)


class Blend:
    """Linear map, on the device, from SH coefficients of Gaussians to colours blended on rays, and its transpose."""

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
        """Returns the colours of P rays blended from N Gaussians with K SH coefficients: (N, K, 3) to (P, 3).

        The colour of a Gaussian is its SH series plus 0.5, clamped to at least 0, as viewers of captures show it.
        """
        return self._blended(sh, 0.5, 0.0)

    def blend(self, sh: Doubles) -> Doubles:
        """Returns ``pixel_colors`` without the constant 0.5 and without clamping: linear in the coefficients."""
        return self._blended(sh, 0.0, -float(np.finfo(np.float32).max))

    def gather(self, errors: Doubles) -> Doubles:
        """Applies the transpose of ``blend`` to errors of P rays: shape (P, 3) to K SH coefficients of N Gaussians.

        The result has the shape (N, K, 3).
        """
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
    """Changes SH of shape (N, K, 3) so that blended pixels match their colours, by ridge least squares.

    The ridge is the ratio of two variances: that of the pixels' noise, and that expected of the coefficients' change.
    Conjugate gradients solve the system.

    Args:
        blend: Blending of the pixels.
        pixels: Colours and Gaussians of the pixels.
        sh: Coefficients before the fit, N Gaussians with K each.
        information: Information of earlier fits about each Gaussian, as in `Pixels.information`, shape (N,).

    Returns:
        Coefficients after the fit.
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
    """Yields slices that divide 0..``count`` into ranges of at most ``at_once``; one empty slice if ``count`` is 0."""
    for begin in range(0, max(count, 1), at_once):
        yield slice(begin, min(begin + at_once, count))


def _world_normals(instance: SplatInstance) -> Doubles:
    """Returns the normals of an instance's N Gaussians, world space, shape (N, 3)."""
    return plane_normals(instance.gaussians) @ instance.transform[:3, :3].T / instance.scale


def _first_of(numbers: _Rows, count: int) -> IntArray:
    """Returns where each number below ``count`` first occurs in sorted ``numbers``, and lastly their length."""
    return np.concatenate([[0], np.cumsum(np.bincount(numbers, minlength=count))]).astype(np.int32)


def _uploaded(buffers: Buffers, name: str, values: IntArray) -> DeviceArray:
    array = buffers.get(name, int, len(values))
    array.assign(values)
    return array


class FrameRays(Renderer):
    """Renders radiance along segments of rays, and lists the Gaussians that rays hit."""

    def radiance(self, scene: Scene, origins: FloatArray, directions: FloatArray, ends: FloatArray) -> RayHits:
        """Renders each of N rays, of unit direction, from its origin to its distance in ``ends``, shape (N,)."""
        return self._queries.query(self._scene, self._ready(scene), origins, directions, ends=ends)

    def hits(self, scene: Scene, origins: FloatArray, directions: FloatArray) -> RayProfile:
        """Lists the Gaussians on each ray in blending order. Directions are unit vectors."""
        self._ready(scene)
        return self._profiles.query(self._scene, scene, origins, directions)

    def _ready(self, scene: Scene) -> FramePlan:
        plan = self._sync_rays(scene)
        self._load(self._modules(plan))
        return plan


@dataclass(frozen=True, slots=True, eq=False)
class HitGaussians:
    """Hits of Gaussians by P rays, S in number: sorted by ray and, for each ray, in blending order."""

    ray: _Rows
    """Index of the ray of each of S hits, shape (S,)."""
    gaussian: _Rows
    """Index of the Gaussian of each of S hits, among all Gaussians of the scene, shape (S,)."""
    weight: Doubles
    """Blend weight of the Gaussian on the ray, for each of S hits, shape (S,)."""
    t: Doubles
    """Distance along the ray of each of S hits, scene units, shape (S,)."""
    rays: int

    @classmethod
    def of(cls, profile: RayProfile, firsts: IntArray) -> HitGaussians:
        """Converts a ray profile; ``firsts`` holds the scene index of each instance's first Gaussian."""
        return cls(
            ray=np.repeat(np.arange(len(profile)), np.diff(profile.first)),
            gaussian=firsts[profile.instance_index] + profile.gaussian_index.astype(np.int64),
            weight=(profile.transmittance * profile.alpha / (1.0 - profile.alpha)).astype(np.float64),
            t=profile.t.astype(np.float64),
            rays=len(profile),
        )

    def where(self, rows: Flags) -> HitGaussians:
        """Returns the hits that the mask ``rows`` selects; the number of rays stays the same."""
        return HitGaussians(self.ray[rows], self.gaussian[rows], self.weight[rows], self.t[rows], self.rays)

    def total(self, values: Doubles | Flags) -> Doubles:
        """Returns, for each of P rays, the sum over its hits of value times blend weight, shape (P,).

        ``values`` has one value for each of the S hits of Gaussians, shape (S,).
        """
        return np.bincount(self.ray, self.weight * values, self.rays).astype(np.float64)


def wanted_segments(hits: HitGaussians, wanted: Flags, before_mesh: Flags) -> tuple[Doubles, Doubles, Flags]:
    """Returns the segment of each ray around its heaviest wanted Gaussian that contains only wanted Gaussians.

    Heaviest means the largest blend weight on the ray.

    Args:
        hits: The Gaussians on P rays, in S rows.
        wanted: True for rows of wanted Gaussians, shape (S,).
        before_mesh: True for rays that hit a mesh behind all Gaussians, shape (P,).

    Returns:
        Start and end of each segment, shape (P,) each, and the rows inside the segments, shape (S,). A segment ends
        half-way between a wanted and an unwanted Gaussian. Without unwanted Gaussians it goes from 0 to infinity, or to
        just behind the last Gaussian before a mesh. It is empty if the ray has no wanted Gaussian.
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
    end = np.where(np.isfinite(high), 0.5 * (high + last), np.where(before_mesh, (1.0 + SEGMENT_MARGIN) * last, np.inf))
    empty = np.isinf(first)
    return np.where(empty, 0.0, begin), np.where(empty, 0.0, end), within


def reflected_colors(instance: SplatInstance) -> Doubles:
    """Returns approximate linear colours of N Gaussians in a constant environment of radiance 1, shape (N, 3).

    The colour is the one with which the set is shaded: the captured colour if the set emits it, else the albedo. A
    white specular part is added, so that glossy black dielectrics are not black.
    """
    (by_albedo,) = shading_overrides(Scene([instance]), lit=True)["shows_albedo"]
    gaussians = instance.gaussians if by_albedo else replace(instance.gaussians, albedo=None)
    colors, material = base_colors(gaussians), material_of(instance)
    if not isinstance(material, MaterialPbr):
        return colors * np.add(np.add(material.emissive, material.ambient), material.diffuse) + material.specular
    colors, metal = colors * tint_of(instance), material.values_on(gaussians).metallic
    metallic = np.full(gaussians.count, metal) if gaussians.metallic is None else metal * gaussians.metallic
    mirrored = ((1.0 - metallic) * material.specular * ((material.ior - 1.0) / (material.ior + 1.0)) ** 2)[:, None]
    return mirrored + (1.0 - mirrored) * colors


def hits_light(lights: Iterable[Light], origins: FloatArray, directions: FloatArray) -> Flags:
    """Returns which of N rays would hit a visible light if nothing were in between, shape (N,).

    Args:
        lights: Lights of a scene.
        origins: Origins of the rays, world space, shape (N, 3).
        directions: Unit directions of the rays, shape (N, 3).
    """
    starts, along = origins.astype(np.float64), directions.astype(np.float64)
    reaches = np.zeros(len(origins), np.bool_)
    for light in lights:
        if isinstance(light, AreaLight) and light.enabled and light.visible:
            reaches |= np.isfinite(light.distances(starts, along))
    return reaches
