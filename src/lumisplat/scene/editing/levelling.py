"""Levelling: estimates the up direction of a tilted capture from its ground, given points, or principal axes."""

from __future__ import annotations

import math
from collections.abc import Sized
from dataclasses import dataclass, replace
from typing import Literal, cast

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles, Flags, finite_numbers, unit_vector
from lumisplat.math.transforms import rotation_between
from lumisplat.scene.checks import check_argument
from lumisplat.scene.editing.transform import transform
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.placing import UP_AXES, Vector, up_vector
from lumisplat.scene.scene import Scene, SplatInstance

_SAMPLES = 8_000
"""Approximate number of a scene's Gaussians that the search for the ground uses: every n-th one."""
_PLANES = 1_500
"""Number of random planes tried as the ground. For each plane, a Gaussian and `_DRAWN` further ones are drawn; the
plane goes through the first one and through the second and third nearest to it."""
_DRAWN = 8
_THICKNESS = 0.012
"""Distance from a ground plane, relative to the size of the capture, up to which Gaussians belong to the ground."""
_CLEAR = 0.2
"""Height, relative to the capture's size, of the space above a ground plane that must be free over at least the
fraction `_OPEN_LEAST` of the plane."""
_OPEN_LEAST = 0.3
"""Smallest fraction of a ground plane's area with free space above. The limit rejects the back of a lying guitar,
because the guitar's front is above its back."""
_GROUND_LEAST = 0.06
"""A plane is a ground only if at least this fraction of the scene's visible weight (opacity times area) lies within
`_THICKNESS` of the plane."""
_FLAT_LEAST = 0.6
"""Smallest ratio, for a ground plane, of the visible weight within `_THICKNESS` to that within twice `_THICKNESS`. The
ratio is near 1 on a flat ground, and 0.5 in a slice of a wall."""
_BELOW_MOST = 0.12
"""Largest fraction of the scene's visible weight (opacity times area) below a ground plane."""
_NEAR_STATED = math.cos(math.radians(50.0))
"""Smallest cosine (50 degrees) between a ground's normal and an up direction that the scene or a capture states."""
_CELLS = (4, 24)
"""Smallest and largest number of cells along the longer side of a ground, for the test of free space above the ground;
`_CELL_POINTS` sets the number in between."""
_CELL_POINTS = 8
"""Wanted mean number of the ground's sampled Gaussians per cell of the test for free space."""
_UPRIGHT = math.cos(math.radians(5.0))
"""Without a ground, the guessed up direction is kept if its cosine to the principal axis is above this (less than 5
degrees off): principal axes are no more accurate."""
_APART = 1.2
"""A principal axis is distinct if its extent and each of the two other extents differ by at least this factor."""
_LONG, _STANDS = 1.7, math.cos(math.radians(70.0))
"""An object is long if its longest extent exceeds the second by the factor `_LONG`. It stands, and does not lie, if
the cosine between its long axis and the guessed up direction exceeds `_STANDS`."""
_SIDE = 0.65
"""If more than this fraction of the visible weight is on one side of the plane through given ground points, that side
is up; otherwise the guess decides."""


@dataclass(frozen=True, slots=True)
class UpEstimate:
    """Up direction of a scene, estimated by `find_up`."""

    up: Vector
    """Unit vector that points up, world space."""
    source: Literal["ground", "points", "axes", "stated"]
    """Evidence of ``up``: ``ground`` plane, given ``points``, principal ``axes`` of the capture, or ``stated``,
    the direction that the scene or a capture stores."""
    height: float | None = None
    """Coordinate along ``up`` of the ground, or of the given points' mean, scene units; None without a ground."""
    share: float | None = None
    """Fraction of the visible weight (opacity times area) within the ground plane, 0..1; None unless ``source`` is
    ground."""


@dataclass(frozen=True, slots=True)
class _Cloud:
    """Sample of a scene's Gaussians as points, with weights (opacity times area) that sum to 1."""

    points: Doubles
    weights: Doubles
    size: float
    """Diagonal of the box that holds the middle 90 % of the Gaussians' visible weight along each axis, scene units."""


def find_up(scene: Scene, points: npt.ArrayLike | None = None) -> UpEstimate:
    """Estimates the up direction of a scene of captures.

    The ground is the plane that contains the most visible weight (opacity times area). Little weight lies below the
    ground, much weight stands on it, and part of the space above it is free. The plane is found by random sample
    consensus (Fischler and Bolles 1981), then least squares. If the scene or a capture states an up direction, the
    ground's normal is at most 50 degrees off; a guessed up direction counts for less: it raises the score of a plane
    by up to a factor of two. Without a ground, a stated direction is returned.

    Without a ground and a stated direction, `Scene.up_direction` is a guess. Up is then the principal axis nearest to
    the guess. Only axes along which the scene is clearly longer or shorter than along the two others are considered; a
    long object that stands gets its long axis. If the guess is less than 5 degrees from the axis, the guess itself is
    returned.

    Args:
        scene: Scene with captures.
        points: Three or more points of the ground, world space, shape (N, 3), instead of a search; the scene lies above
            them.

    Raises:
        SceneError: There is no capture; the points are fewer than three, or collinear; or there are neither a ground
            nor a stated direction nor an axis along which the scene is clearly longer or shorter.
    """
    check_argument("find_up", scene, Scene, "a Scene", ": ls.Scene([gaussians]) makes one")
    if not scene.splats:
        raise SceneError("find_up needs a capture, and the scene has none")
    cloud, guess = _cloud(scene), np.array(scene.up_direction)
    if points is not None:
        return _up_of_points(cloud, guess, points)
    found = _ground(cloud, guess, stated=scene.up_source != "guess")
    if found is not None:
        return found
    if scene.up_source != "guess":
        return UpEstimate(scene.up_direction, "stated")
    return UpEstimate(_own_axis(cloud, guess), "axes")


def level(gaussians: Gaussians, up: str | npt.ArrayLike | None = None) -> Gaussians:
    """Rotates a capture about (0, 0, 0) so that its up direction becomes a coordinate axis, stored as its ``up``.

    The axis is the one nearest to the up direction that the capture states. If the capture states none, the axis is y
    down, as in most captures. The first view rotates with the capture.

    Args:
        gaussians: Capture.
        up: Current up direction, any length; None: as `find_up` estimates it.

    Raises:
        SceneError: ``up`` is no direction, or cannot be estimated.
    """
    check_argument("level", gaussians, Gaussians, "Gaussians")
    scene = Scene([gaussians])
    now = np.array(find_up(scene).up if up is None else up_vector(up))
    before = np.array(scene.up_direction)
    axis = max(UP_AXES.values(), key=lambda one: float(before @ np.array(one)))
    rotation = np.eye(4)
    rotation[:3, :3] = rotation_between(now, np.array(axis))
    return replace(transform(gaussians, rotation), up=axis)


def _cloud(scene: Scene) -> _Cloud:
    """Samples every n-th Gaussian of a scene, weighted by opacity times area; the largest 5 % of weights are cut."""
    points, weights = zip(*map(_weighted, scene.splats), strict=True)
    means, mass = np.concatenate(points), np.concatenate(weights)
    step = max(1, len(means) // _SAMPLES)
    means, mass = means[::step], mass[::step]
    mass = np.minimum(mass, np.quantile(mass, 0.95))
    mass /= mass.sum()
    ends = [_weighted_quantiles(axis, mass) for axis in means.T]
    size = float(np.linalg.norm([high - low for low, high in ends]))
    return _Cloud(means, mass, size or 1.0)


def _weighted(instance: SplatInstance) -> tuple[Doubles, Doubles]:
    gaussians = instance.gaussians
    scales = np.sort(gaussians.scales.astype(np.float64), axis=1)
    return instance.world_means, gaussians.opacities * scales[:, 1] * scales[:, 2] * instance.scale**2


def _weighted_quantiles(values: Doubles, weights: Doubles) -> tuple[float, float]:
    """Returns the values below and above which 5 % of the weight lie."""
    order = np.argsort(values)
    rows = np.searchsorted(np.cumsum(weights[order]), (0.05, 0.95)).clip(0, len(values) - 1)
    low, high = values[order][rows]
    return float(low), float(high)


def _ground(cloud: _Cloud, guess: Doubles, *, stated: bool) -> UpEstimate | None:
    """Returns the up direction of the best ground plane; None if no plane qualifies as ground.

    ``guess`` is `Scene.up_direction`. If ``stated``, the ground's normal must be near ``guess``; otherwise ``guess``
    only decides between similar planes.
    """
    thickness = _THICKNESS * cloud.size
    normals, offsets = _planes(cloud)
    normals, offsets = _facing_the_rest(cloud, normals, offsets, thickness)
    agreement = normals @ guess
    usable = agreement > _NEAR_STATED if stated else np.ones(len(normals), dtype=bool)
    if not usable.any():
        return None
    below = _share_beyond(cloud, -normals, -offsets + thickness)
    above, high = (_share_beyond(cloud, normals, offsets + reach) for reach in (thickness, _CLEAR * cloud.size))
    inside, standing = 1.0 - below - above, above - high  # prefers a floor to a ceiling, because objects stand on it
    scores = inside * (1.0 + standing) * np.maximum(1.0 - below / _BELOW_MOST, 0.0) * (3.0 + agreement) * usable
    for row in np.argsort(-scores, kind="stable")[:20]:
        if scores[row] <= 0.0:
            return None
        found = _checked(cloud, normals[row], float(offsets[row]), thickness)
        if found is not None:
            return found
    return None


def _planes(cloud: _Cloud) -> tuple[Doubles, Doubles]:
    """Returns M <= `_PLANES` planes ``normal . x = offset`` through random near points: (M, 3) and (M,)."""
    rng = np.random.default_rng(0)
    count = len(cloud.points)
    first = rng.choice(count, _PLANES, p=cloud.weights)
    others = rng.choice(count, (_PLANES, _DRAWN), p=cloud.weights)
    steps = cloud.points[others] - cloud.points[first][:, None]
    nearest = np.argsort(np.linalg.norm(steps, axis=2), axis=1, kind="stable")[:, [1, 2]]
    a, b = (np.take_along_axis(steps, nearest[:, [k], None], axis=1)[:, 0] for k in (0, 1))
    normals = np.cross(a, b)
    lengths = np.linalg.norm(normals, axis=1)
    proper = lengths > 0.1 * np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1) + 1e-300
    normals = normals[proper] / lengths[proper, None]
    return normals, (normals * cloud.points[first[proper]]).sum(axis=1)


def _facing_the_rest(cloud: _Cloud, normals: Doubles, offsets: Doubles, thickness: float) -> tuple[Doubles, Doubles]:
    """Flips M planes so that normals point to the side with more weight beyond ``thickness``; returns (M, 3), (M,)."""
    above = _share_beyond(cloud, normals, offsets + thickness)
    below = _share_beyond(cloud, -normals, -offsets + thickness)
    signs = np.where(above >= below, 1.0, -1.0)
    return normals * signs[:, None], offsets * signs


def _share_beyond(cloud: _Cloud, normals: Doubles, offsets: Doubles) -> Doubles:
    """Returns the fraction of the points' weight at ``normal . x > offset`` of each of M planes, shape (M,)."""
    shares = np.empty(len(normals))
    for start in range(0, len(normals), 64):
        rows = slice(start, start + 64)
        beyond = cloud.points @ normals[rows].T > offsets[rows]
        shares[rows] = np.einsum("n,nm->m", cloud.weights, beyond)
    return shares


def _checked(cloud: _Cloud, normal: Doubles, offset: float, thickness: float) -> UpEstimate | None:
    """Refits a candidate plane by least squares; returns it as the ground, or None if it does not qualify."""
    for width in (2.0, 1.5, 1.0, 1.0):
        heights = cloud.points @ normal - offset
        near = np.abs(heights) < width * thickness
        if near.sum() < 8:
            return None
        weights = cloud.weights[near] / cloud.weights[near].sum()
        middle = weights @ cloud.points[near]
        parted = cloud.points[near] - middle
        _, axes = np.linalg.eigh(np.einsum("n,ni,nj->ij", weights, parted, parted))
        fitted = axes[:, 0] * np.sign(axes[:, 0] @ normal)
        normal, offset = fitted, float(middle @ fitted)
    heights = cloud.points @ normal - offset
    inside = np.abs(heights) < thickness
    share, below = float(cloud.weights[inside].sum()), float(cloud.weights[heights < -thickness].sum())
    around = float(cloud.weights[np.abs(heights) < 2.0 * thickness].sum())
    is_flat = share > _FLAT_LEAST * around  # otherwise it is a slice through an object
    if (
        share < _GROUND_LEAST
        or below > _BELOW_MOST
        or not is_flat
        or not _is_open(cloud, normal, heights, inside, thickness)
    ):
        return None
    return UpEstimate(up_vector(np.round(normal, 9) + 0.0), "ground", offset, share)


def _is_open(cloud: _Cloud, normal: Doubles, heights: Doubles, inside: Flags, thickness: float) -> bool:
    """Returns whether a ground is wide in both directions and free of points above over at least `_OPEN_LEAST` of it.

    Args:
        cloud: Sampled points of the scene.
        normal: Unit normal of the ground.
        heights: Height of each point above the ground, shape (N,).
        inside: True for points of the ground, shape (N,).
        thickness: Half the thickness of the ground, scene units.
    """
    across = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    across /= np.linalg.norm(across)
    flat = cloud.points @ np.stack([across, np.cross(normal, across)], axis=1)
    low, high = (np.quantile(flat[inside], share, axis=0) for share in (0.02, 0.98))
    extent = high - low
    if extent.min() < 0.15 * cloud.size or extent.min() < 0.2 * extent.max():
        return False
    across_cells = np.clip(math.sqrt(inside.sum() / _CELL_POINTS), *_CELLS)
    cells = np.floor((flat - low) / extent.max() * across_cells).clip(-999, 999).astype(np.int64)
    keys = cells[:, 0] * 4096 + cells[:, 1]
    ground = np.unique(keys[inside])
    above = (heights > 2.0 * thickness) & (heights < _CLEAR * cloud.size)
    return float(np.isin(ground, np.unique(keys[above])).mean()) < 1.0 - _OPEN_LEAST


def _up_of_points(cloud: _Cloud, guess: Doubles, given: npt.ArrayLike) -> UpEstimate:
    """Returns the normal of the plane through N ground points, (N, 3), towards the side that holds most of the weight.

    If neither side holds clearly more, the normal points to the side of ``guess``.

    Raises:
        SceneError: The points are fewer than three, not finite, or collinear.
    """
    count = len(cast("Sized", given)) if isinstance(given, Sized) else 0
    points = finite_numbers(given, (count, 3))
    if points is None or count < 3:
        raise SceneError(f"points is {given}, expected at least three points of three finite numbers each")
    parted = points - points.mean(axis=0)
    _, extents, axes = np.linalg.svd(parted, full_matrices=False)
    if not extents[1] > 1e-6 * max(extents[0], 1e-300):
        raise SceneError("the points of the ground are collinear: give three that are not")
    normal = axes[2] if len(axes) > 2 else np.cross(axes[0], axes[1])
    heights = (cloud.points - points.mean(axis=0)) @ normal
    above = float(cloud.weights[heights > 0.0].sum())
    if max(above, 1.0 - above) > _SIDE:
        normal = normal if above > 0.5 else -normal
    elif normal @ guess < 0.0:
        normal = -normal
    return UpEstimate(up_vector(np.round(normal, 9) + 0.0), "points", float(points.mean(axis=0) @ normal))


def _own_axis(cloud: _Cloud, guess: Doubles) -> Vector:
    """Returns the principal axis taken as up: the distinct axis nearest to ``guess``, or a standing object's long one.

    The axis points to the side of ``guess``. If ``guess`` is less than 5 degrees from the axis, ``guess`` is returned.

    Raises:
        SceneError: The capture has no distinct axis.
    """
    parted = cloud.points - cloud.weights @ cloud.points
    variances, axes = np.linalg.eigh(np.einsum("n,ni,nj->ij", cloud.weights, parted, parted))
    extents = np.sqrt(np.maximum(variances, 0.0)) + 1e-300
    clear = [
        row
        for row in range(3)
        if all(max(extents[row], other) > _APART * min(extents[row], other) for other in np.delete(extents, row))
    ]
    if not clear:
        raise SceneError(
            "no ground is found, and the capture has no distinct axis: give three points of the ground (find_up, or "
            "clicks in the viewer), or up (level)"
        )
    axis = max((axes[:, row] for row in clear), key=lambda one: abs(float(one @ guess)))
    if extents[2] > _LONG * extents[1] and abs(axes[:, 2] @ guess) > _STANDS:
        axis = axes[:, 2]
    axis = axis * math.copysign(1.0, float(axis @ guess))
    return up_vector(guess if axis @ guess > _UPRIGHT else np.round(unit_vector(axis), 9) + 0.0)
