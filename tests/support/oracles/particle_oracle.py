"""The float64 twin's Gaussians: where they respond to a ray, how much, and what they show there.

Moenne-Loccoz et al. 2024, 3D Gaussian Ray Tracing; the degrees of the response are those of Hamdi et al. 2024, GES.
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
"""Relative distance from a threshold within which float32 may decide differently, on top of the hits' own errors."""


@dataclass(frozen=True)
class World:
    """All of a scene in world space, and how it is traced."""

    config: RenderConfig
    triangles: Triangles
    splat_count: int  # Instances of Gaussians; those of meshes are numbered after them.
    mean: np.ndarray  # (G, 3)
    whiten: np.ndarray  # (G, 3, 3), canonical from world: inverse scales times inverse axes
    opacity: np.ndarray  # (G,)
    degree: np.ndarray  # (G,), of the kernel
    threshold: np.ndarray  # (G,), response below which a Gaussian is ignored
    reach: np.ndarray  # (G,), canonical distance beyond which it is; NaN: it always is
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
    """Gaussians on a ray, by (t, index in the scene), those included that only float32 may find."""

    t: np.ndarray  # (H,), by which they are ordered
    t_error: np.ndarray  # (H,), how far float32 may have it from here
    peak: np.ndarray  # (H,), where the response is largest
    peak_error: np.ndarray  # (H,)
    surface: np.ndarray  # (H,), where the surface lies if it is this one's
    surface_error: np.ndarray  # (H,)
    d2: np.ndarray  # (H,), squared canonical distance
    alpha: np.ndarray  # (H,)
    alpha_error: np.ndarray  # (H,)
    color: np.ndarray  # (H, 3)
    normal: np.ndarray  # (H, 3), world, against the ray
    normal_error: np.ndarray  # (H,)
    index: np.ndarray  # (H,), among all Gaussians of the scene
    counts: np.ndarray  # (H,), whether it is a hit here
    doubtful: np.ndarray  # (H,), whether float32 may think otherwise
    canonical: np.ndarray  # (H, 6), the ray in canonical space: equal for Gaussians that are each other's copies

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
    """Response at a canonical distance; all degrees are exp(-4.5) at 3."""
    distance, degree = np.asarray(distance, float), np.asarray(degree)
    linear = np.maximum(1.0 - KERNEL_LINEAR_SLOPE * distance, 0.0)
    return np.where(degree == 0, linear, np.exp(-4.5 / 3.0**degree * distance**degree))


def response_threshold(opacity: np.ndarray, config: ResponseConfig) -> np.ndarray:
    """Response below which Gaussians are ignored, (N,); above one for those that never count."""
    inverse = np.divide(1.0, opacity, out=np.full_like(opacity, np.inf), where=opacity > 0.0)
    least = config.min_response * (inverse if config.adaptive_clamping and config.min_response > 0.0 else 1.0)
    return np.maximum(ALPHA_MIN * inverse, least)


def reach_of(threshold: np.ndarray, degree: np.ndarray) -> np.ndarray:
    """Canonical distance at which the response is ``threshold``; NaN where it never nearly is that large."""
    least = np.where(threshold <= 1.0 + BAND, np.minimum(threshold, 1.0), np.nan)
    exponent = np.maximum(degree, 1)
    smooth = (-np.log(least) * 3.0**exponent / 4.5) ** (1.0 / exponent)
    return np.where(degree == 0, (1.0 - least) / KERNEL_LINEAR_SLOPE, smooth)


def world_of(scene: Scene, config: RenderConfig | None) -> World:
    """A scene made ready for rays."""
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
    """Colour of some Gaussians seen from a world ``eye``; directions are taken in the object's frame, (H, 3)."""
    direction = np.einsum("nij,nj->ni", world.object_from_world[rows], normalized(world.mean[rows] - eye))
    return np.maximum(np.einsum("nk,nkc->nc", sh_basis(direction), world.sh[rows]) + 0.5, 0.0)


def dilated(world: World, ray: Ray) -> np.ndarray:
    """Canonical from world, (G, 3, 3), of the Gaussians as a ray finds them: widened by its footprint at their means.

    A pixel's width there, but for those whose ellipsoid begins long before.
    """
    path = np.maximum(ray.path_length + (world.mean - ray.origin) @ ray.direction, 0.0)
    begins = path - FOOTPRINT_REACH * world.widest
    path = np.clip(FOOTPRINT_LEAD * begins, 0.0, path)
    variance = (np.minimum(np.sqrt(world.dilation) * ray.spread, FOOTPRINT_MAX) * path) ** 2
    # The rows are axes over scales.
    narrower = 1.0 / np.sqrt(1.0 + variance[:, None] * (world.whiten**2).sum(axis=2))
    return world.whiten * narrower[:, :, None]


def hits(world: World, ray: Ray, begin: np.ndarray | float = np.inf) -> Hits:
    """All Gaussians whose response peaks on the ray beyond ``t_min``, or their ``begin`` if that is nearer, sorted."""
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
    # Those that may count even if float32 is ``off`` across the thinnest axis; NaN compares false.
    rows = np.flatnonzero(np.sqrt(d2) <= 1.01 * world.reach + off * world.sharpest + 0.01)
    if not len(rows):
        return NONE
    off, origin, direction, closest = off[rows], origin[rows], direction[rows], closest[rows]
    peak, speed2, d2, reach2, whiten = peak[rows], speed2[rows], d2[rows], world.reach[rows] ** 2, whiten[rows]
    opacity, degree = world.opacity[rows], world.degree[rows]
    t_min = np.minimum(ray.t_min, np.broadcast_to(begin, len(world.mean))[rows])

    # What is ``off`` moves the ray in canonical space; first order, and second order for what it hits in the middle.
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

    # Half the chord through the ellipsoid beyond which the Gaussian is ignored, in canonical space.
    half, most, least = (np.sqrt(np.maximum(inside2 + e, 0.0)) for e in (0.0, inside2_error, -inside2_error))
    speed = np.sqrt(speed2)
    if config.normal_method is NormalMethod.ELLIPSOID:
        entry = closest - (half / speed)[:, None] * direction
        sharpest = np.sqrt((whiten**2).sum(axis=2)).max(axis=1)
        moved = sharpest * spread * (off + ray.turn * half / speed) + along / speed * (most - least)
        normal, normal_error = gradient_normal(whiten, entry, moved, ray)
    else:
        undilated = world.whiten[rows]  # no footprint widens it
        moved = np.linalg.norm(undilated.transpose(0, 2, 1) @ undilated, axis=(1, 2)) * off
        normal, normal_error = gradient_normal(
            undilated, np.einsum("nij,nj->ni", undilated, ray.eye - world.mean[rows]), moved, ray
        )
    t, t_error = peak, peak_error
    surface, surface_error = surfaces(world, ray, rows, off)
    if config.hit_distance is HitDistance.HULL:
        t, t_error = peak - half / speed, peak_error + (most - least) / speed
        surface, surface_error = t, t_error
    if config.hit_distance in (None, HitDistance.MEAN):  # nothing is relit here
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
    """Where some Gaussians, which no footprint widens, respond most on a ray, (H,), and its error, (H,).

    Not before the ray begins, and no farther from where their means project onto it than three of their scales.
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
    """Unit world gradients of the squared canonical distance at canonical points, (H, 3), and their error, (H,).

    ``moved`` is how far float32 may have the gradient. From the eye, and from where the ray enters, it is always
    against the ray, if the peak lies ahead.
    """
    gradient = np.einsum("nij,ni->nj", whiten, point)
    normal = normalized(gradient)
    error = moved / np.maximum(np.linalg.norm(gradient, axis=-1), 1e-300)
    return normal, np.where(normal @ ray.direction >= -error - 1e-6, 2.0, error)


def picked(found: Hits, rows: np.ndarray | slice) -> Hits:
    """Some of the hits."""
    return Hits(**{name: values[rows] for name, values in vars(found).items()})
