"""Evaluates Gaussians on rays in float64, as part of the ray tracing oracle.

The equations are those of Moenne-Loccoz et al. 2024, 3D Gaussian Ray Tracing; kernel degrees are those of Hamdi et al.
2024, GES.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from lumisplat.config import Antialiasing, HitDistance, NormalMethod, RenderConfig, ResponseConfig
from lumisplat.constants import ALPHA_MAX, ALPHA_MIN
from lumisplat.device.bvh.nodes import FOOTPRINT_LEAD, FOOTPRINT_MAX, FOOTPRINT_REACH
from lumisplat.renderer.scene.instance_tables import KERNEL_LINEAR_SLOPE
from lumisplat.scene.scene import Scene
from support.oracles.mirror_oracle import ROUNDING, Ray, Triangles, triangles_of
from support.oracles.raster_oracle import normalized, sh_basis, world_gaussians

BAND = 1e-5
"""Relative distance from a threshold, on top of each hit's error, within which float32 may decide differently."""


@dataclass(frozen=True)
class World:
    """A whole scene in world space, with its trace settings."""

    config: RenderConfig
    triangles: Triangles
    splat_count: int  # Number of splat instances; mesh instances are numbered after them.
    mean: np.ndarray  # (G, 3)
    whiten: np.ndarray  # (G, 3, 3), canonical from world: inverse scales times inverse axes
    opacity: np.ndarray  # (G,)
    degree: np.ndarray  # (G,), degree of the kernel
    threshold: np.ndarray  # (G,), response below which a Gaussian is ignored
    reach: np.ndarray  # (G,), canonical distance beyond which it is ignored; NaN if always
    sh: np.ndarray  # (G, K, 3)
    object_from_world: np.ndarray  # (G, 3, 3), rotation
    instance: np.ndarray  # (G,)
    gaussian: np.ndarray  # (G,), within the instance
    sharpest: np.ndarray  # (G,), inverse of the smallest scale
    widest: np.ndarray  # (G,), the largest scale
    dilation: np.ndarray  # (G,), variance added for rays, in squared widths of their pixel
    mean_size: np.ndarray  # (G,), largest coordinate of the mean


@dataclass(frozen=True)
class Hits:
    """Gaussians on a ray, sorted by (t, index in the scene), including those that only float32 may find."""

    t: np.ndarray  # (H,), sort key
    t_error: np.ndarray  # (H,), largest error of t in float32
    peak: np.ndarray  # (H,), distance of maximum response
    peak_error: np.ndarray  # (H,)
    surface: np.ndarray  # (H,), distance of the surface if this hit is the surface
    surface_error: np.ndarray  # (H,)
    d2: np.ndarray  # (H,), squared canonical distance
    alpha: np.ndarray  # (H,)
    alpha_error: np.ndarray  # (H,)
    color: np.ndarray  # (H, 3)
    normal: np.ndarray  # (H, 3), world, against the ray
    normal_error: np.ndarray  # (H,)
    index: np.ndarray  # (H,), among all Gaussians of the scene
    counts: np.ndarray  # (H,), True if the Gaussian is a hit in float64
    doubtful: np.ndarray  # (H,), True if float32 may decide otherwise
    canonical: np.ndarray  # (H, 6), the ray in canonical space, equal for copies of a Gaussian

    def __len__(self) -> int:
        return len(self.t)


NONE = Hits(
    *(np.zeros(shape) for shape in (0, 0, 0, 0, 0, 0, 0, 0, 0, (0, 3), (0, 3), 0)),
    index=np.zeros(0, int),
    counts=np.zeros(0, bool),
    doubtful=np.zeros(0, bool),
    canonical=np.zeros((0, 6)),
)


def response(distance: np.ndarray, degree: np.ndarray | int) -> np.ndarray:
    """Returns the response at a canonical distance; all degrees give exp(-4.5) at 3."""
    distance, degree = np.asarray(distance, float), np.asarray(degree)
    linear = np.maximum(1.0 - KERNEL_LINEAR_SLOPE * distance, 0.0)
    return np.where(degree == 0, linear, np.exp(-4.5 / 3.0**degree * distance**degree))


def response_threshold(opacity: np.ndarray, config: ResponseConfig) -> np.ndarray:
    """Returns the response below which Gaussians are ignored, (N,); above one for those that are always ignored."""
    inverse = np.divide(1.0, opacity, out=np.full_like(opacity, np.inf), where=opacity > 0.0)
    least = config.min_response * (inverse if config.adaptive_clamping and config.min_response > 0.0 else 1.0)
    return np.maximum(ALPHA_MIN * inverse, least)


def reach_of(threshold: np.ndarray, degree: np.ndarray) -> np.ndarray:
    """Returns the canonical distance at which the response is ``threshold``; NaN if it never comes close to it."""
    least = np.where(threshold <= 1.0 + BAND, np.minimum(threshold, 1.0), np.nan)
    exponent = np.maximum(degree, 1)
    smooth = (-np.log(least) * 3.0**exponent / 4.5) ** (1.0 / exponent)
    return np.where(degree == 0, (1.0 - least) / KERNEL_LINEAR_SLOPE, smooth)


def world_of(scene: Scene, config: RenderConfig | None) -> World:
    """Prepares a scene for rays."""
    config = config or RenderConfig()
    rows: dict[str, list[np.ndarray]] = {}
    most = (config.trace.sh_degree + 1) ** 2
    for number, instance in enumerate(scene.splats):
        gaussians, count = instance.gaussians, instance.gaussians.count
        mean, axes, scales = world_gaussians(instance)
        opacity = gaussians.opacities.astype(np.float64)
        antialiasing = config.trace.antialiasing
        by_set = antialiasing is Antialiasing.AUTO and gaussians.antialiased
        antialiased = by_set or antialiasing is Antialiasing.ON
        kernel_degree, forced = gaussians.kernel_degree, config.response.kernel_degree
        degree = np.full(count, kernel_degree if forced is None else forced)
        threshold = response_threshold(opacity, config.response)
        sh = np.zeros((count, 16, 3))
        sh[:, : min(most, gaussians.sh.shape[1])] = gaussians.sh[:, :most]
        row = {
            "mean": mean,
            "whiten": np.linalg.inv(axes) / scales[:, :, None],
            "opacity": opacity,
            "degree": degree,
            "threshold": threshold,
            "reach": reach_of(threshold, degree),
            "sh": sh,
            "object_from_world": np.broadcast_to(instance.transform[:3, :3].T / instance.scale, (count, 3, 3)),
            "instance": np.full(count, number),
            "gaussian": np.arange(count),
            "sharpest": 1.0 / scales.min(axis=1),
            "widest": scales.max(axis=1),
            "dilation": np.full(count, 0.0 if antialiased else config.trace.dilation),
            "mean_size": np.abs(mean).max(axis=1),
        }
        for name, values in row.items():
            rows.setdefault(name, []).append(values)
    columns = {name: np.concatenate(parts) for name, parts in rows.items()}
    if not columns:
        shapes = {"mean": (0, 3), "whiten": (0, 3, 3), "sh": (0, 16, 3), "object_from_world": (0, 3, 3)}
        names = [one.name for one in fields(World) if one.name not in ("config", "triangles", "splat_count")]
        columns = {name: np.zeros(shapes.get(name, 0), int if name == "instance" else float) for name in names}
    return World(config, triangles_of(scene), len(scene.splats), **columns)


def sh_color(world: World, rows: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """Returns the colour of some Gaussians from a world ``eye``, (H, 3); SH directions are in object space."""
    direction = np.einsum("nij,nj->ni", world.object_from_world[rows], normalized(world.mean[rows] - eye))
    return np.maximum(np.einsum("nk,nkc->nc", sh_basis(direction), world.sh[rows]) + 0.5, 0.0)


def dilated(world: World, ray: Ray) -> np.ndarray:
    """Returns canonical-from-world matrices, (G, 3, 3), widened by the ray's footprint at each mean.

    The footprint is one pixel wide at the mean, and narrower for Gaussians whose ellipsoid begins long before.
    """
    path = np.maximum(ray.path_length + (world.mean - ray.origin) @ ray.direction, 0.0)
    begins = path - FOOTPRINT_REACH * world.widest
    path = np.clip(FOOTPRINT_LEAD * begins, 0.0, path)
    variance = (np.minimum(np.sqrt(world.dilation) * ray.spread, FOOTPRINT_MAX) * path) ** 2
    # The rows are axes over scales.
    narrower = 1.0 / np.sqrt(1.0 + variance[:, None] * (world.whiten**2).sum(axis=2))
    return world.whiten * narrower[:, :, None]


def hits(world: World, ray: Ray, begin: np.ndarray | float = np.inf) -> Hits:
    """Returns all Gaussians that peak on the ray beyond ``t_min`` (or their ``begin`` if that is smaller), sorted."""
    config = world.config.trace
    from_mean = ray.origin - world.mean
    distance = np.sqrt(np.einsum("ni,ni->n", from_mean, from_mean))
    off = ray.blur + ray.turn * distance + ROUNDING * world.mean_size
    whiten = dilated(world, ray)
    origin, direction = np.einsum("nij,nj->ni", whiten, from_mean), whiten @ ray.direction
    speed2 = np.einsum("ni,ni->n", direction, direction)
    peak = -np.einsum("ni,ni->n", origin, direction) / speed2
    closest = origin + peak[:, None] * direction
    d2 = np.einsum("ni,ni->n", closest, closest)
    # Gaussians that may count if float32 is ``off`` along the thinnest axis; NaN compares false.
    rows = np.flatnonzero(np.sqrt(d2) <= 1.01 * world.reach + off * world.sharpest + 0.01)
    if not len(rows):
        return NONE
    off, origin, direction, closest = off[rows], origin[rows], direction[rows], closest[rows]
    peak, speed2, d2, reach2, whiten = peak[rows], speed2[rows], d2[rows], world.reach[rows] ** 2, whiten[rows]
    opacity, degree = world.opacity[rows], world.degree[rows]
    t_min = np.minimum(ray.t_min, np.broadcast_to(begin, len(world.mean))[rows])

    # An offset ``off`` moves the ray in canonical space: first order, and second order near the centre.
    along = np.linalg.norm(np.einsum("nij,ni->nj", whiten, direction), axis=-1)
    slope = np.linalg.norm(np.einsum("nij,ni->nj", whiten, closest), axis=-1)
    spread = np.sqrt(np.maximum((whiten**2).sum(axis=(1, 2)) - along**2 / speed2, 0.0))
    d2_error = 2.0 * slope * off + (spread * off) ** 2 + ROUNDING * d2
    peak_error = (off * along + ray.turn * slope) / speed2

    def alpha_at(squared: np.ndarray) -> np.ndarray:
        return np.minimum(opacity * response(np.sqrt(np.maximum(squared, 0.0)), degree), ALPHA_MAX)

    counts = (response(np.sqrt(d2), degree) >= world.threshold[rows]) & (peak > t_min)
    inside2, inside2_error = reach2 - d2, d2_error + BAND * (1.0 + reach2)
    possible = (inside2 >= -inside2_error) & (peak >= t_min - peak_error)
    doubtful = possible & ((inside2 <= inside2_error) | (peak <= t_min + peak_error))

    # Half the chord through the ellipsoid outside of which the Gaussian is ignored, in canonical space.
    half, most, least = (np.sqrt(np.maximum(inside2 + e, 0.0)) for e in (0.0, inside2_error, -inside2_error))
    speed = np.sqrt(speed2)
    if config.normal_method is NormalMethod.ELLIPSOID:
        entry = closest - (half / speed)[:, None] * direction
        sharpest = np.sqrt((whiten**2).sum(axis=2)).max(axis=1)
        moved = sharpest * spread * (off + ray.turn * half / speed) + along / speed * (most - least)
        normal, normal_error = gradient_normal(whiten, entry, moved, ray)
    else:
        undilated = world.whiten[rows]  # without the footprint
        moved = np.linalg.norm(undilated.transpose(0, 2, 1) @ undilated, axis=(1, 2)) * off
        normal, normal_error = gradient_normal(
            undilated, np.einsum("nij,nj->ni", undilated, ray.eye - world.mean[rows]), moved, ray
        )
    t, t_error = peak, peak_error
    surface, surface_error = surfaces(world, ray, rows, off)
    if config.hit_distance is HitDistance.HULL:
        t, t_error = peak - half / speed, peak_error + (most - least) / speed
        surface, surface_error = t, t_error
    if config.hit_distance in (None, HitDistance.MEAN):  # None means MEAN, since nothing is relit
        t, t_error = -from_mean[rows] @ ray.direction, off
    found = Hits(
        t=t,
        t_error=t_error,
        peak=peak,
        peak_error=peak_error,
        surface=surface,
        surface_error=surface_error,
        d2=d2,
        alpha=alpha_at(d2),
        alpha_error=alpha_at(d2 - d2_error) - alpha_at(d2 + d2_error),
        color=sh_color(world, rows, ray.eye),
        normal=normal,
        normal_error=normal_error,
        index=rows,
        counts=counts,
        doubtful=doubtful,
        canonical=np.concatenate([origin, direction], axis=-1),
    )
    order = np.lexsort((rows, t))
    return picked(found, order[(counts | doubtful)[order]])


def surfaces(world: World, ray: Ray, rows: np.ndarray, off: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the distance of maximum response of undilated Gaussians on a ray, (H,), and its error, (H,).

    The distance is clamped to the ray's start, and to three scales around the projection of the mean onto the ray.
    """
    whiten = world.whiten[rows]
    from_mean = ray.origin - world.mean[rows]
    origin, direction = np.einsum("nij,nj->ni", whiten, from_mean), whiten @ ray.direction
    speed2 = np.einsum("ni,ni->n", direction, direction)
    peak = -np.einsum("ni,ni->n", origin, direction) / speed2
    closest = origin + peak[:, None] * direction
    along = np.linalg.norm(np.einsum("nij,ni->nj", whiten, direction), axis=-1)
    slope = np.linalg.norm(np.einsum("nij,ni->nj", whiten, closest), axis=-1)
    middle, reach = -from_mean @ ray.direction, 3.0 * world.widest[rows]
    surface = np.maximum(np.clip(peak, middle - reach, middle + reach), ray.t_min)
    return surface, np.minimum((off * along + ray.turn * slope) / speed2, 2.0 * reach) + off


def gradient_normal(
    whiten: np.ndarray, point: np.ndarray, moved: np.ndarray, ray: Ray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns unit world gradients of squared canonical distance at canonical points, (H, 3), and their error, (H,).

    ``moved`` bounds the error of the gradient in float32. At the eye and at the entry point, the gradient always
    opposes the ray if the peak lies ahead.
    """
    gradient = np.einsum("nij,ni->nj", whiten, point)
    normal = normalized(gradient)
    error = moved / np.maximum(np.linalg.norm(gradient, axis=-1), 1e-300)
    return normal, np.where(normal @ ray.direction >= -error - 1e-6, 2.0, error)


def picked(found: Hits, rows: np.ndarray | slice) -> Hits:
    """Returns the selected hits."""
    return Hits(**{name: values[rows] for name, values in vars(found).items()})
