"""Which way is up in a capture that is tilted, from its ground, from three points, or from its own axes."""

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
"""Gaussians of which planes are judged."""
_PLANES = 1_500
"""Planes that are tried, each through a Gaussian and the two that are nearest to it of `_DRAWN`."""
_DRAWN = 8
_THICKNESS = 0.012
"""Half the thickness of a ground, as a share of the size of the capture."""
_CLEAR = 0.2
"""Height above a ground that is free over most of it, as a share of the size of the capture."""
_OPEN_LEAST = 0.3
"""Least share of a ground's area with nothing right above it: the back of a guitar has its front there."""
_GROUND_LEAST = 0.06
"""Least share of what shows that a ground is."""
_FLAT_LEAST = 0.6
"""Least share of what lies within twice the thickness of a ground that lies within it; a slice of a wall has half."""
_BELOW_MOST = 0.12
"""Largest share of what shows that lies below a ground."""
_NEAR_STATED = math.cos(math.radians(50.0))
"""Cosine of the largest angle between the up of a ground and one that a file states."""
_CELLS = (4, 24)
"""Least and largest number of cells of a ground along its longer side, for its area, as `_CELL_POINTS` allows."""
_CELL_POINTS = 8
"""Points of a ground in a cell, about."""
_UPRIGHT = math.cos(math.radians(5.0))
"""Cosine of the tilt below which a capture without a ground is upright as it is: its own axes tell no better."""
_APART = 1.2
"""Least factor between the extent of a capture along an axis of its own and along the others, so that it has one."""
_LONG, _STANDS = 1.7, math.cos(math.radians(70.0))
"""Factor by which the longest axis is longer than the next in long things, which stand along it unless they lie: then
they are further from the guess than the angle of this cosine."""
_SIDE = 0.65
"""Share of what shows on one side of three points, above which that side is above them."""


@dataclass(frozen=True, slots=True)
class UpEstimate:
    """Which way is up in a scene, as `find_up` found it."""

    up: Vector
    """Unit vector that points up, world space."""
    source: Literal["ground", "points", "axes", "stated"]
    """What tells it: a ground, points that were given, the axes along which the scene is longest and shortest, or, as
    none of these is there, the scene or a capture, which states it."""
    height: float | None = None
    """Height of the ground or of the points along ``up``, scene units; None: there is none."""
    share: float | None = None
    """Share of what shows that lies in the ground, 0..1; None: none was looked for, or found."""


@dataclass(frozen=True, slots=True)
class _Cloud:
    """What shows of a scene: some of its Gaussians, with weights that sum to 1."""

    points: Doubles
    weights: Doubles
    size: float
    """Diagonal of the box that holds the middle 90 % along each axis, scene units."""


def find_up(scene: Scene, points: npt.ArrayLike | None = None) -> UpEstimate:
    """Finds which way is up in a scene of captures.

    The ground is the plane that holds most of what shows, with little below it, free space above most of it, and the
    rest on it (random sample consensus, Fischler and Bolles 1981, then least squares). An up that the scene or a
    capture states is at most 50 degrees off; a guessed one decides among equals. Without a ground, a stated up stays;
    else it is an axis of the scene's own, along which it is clearly longer or shorter than along the others: that
    along which a long thing stands, else the one that is nearest to the guess, which stays if it is less than 5
    degrees off.

    Args:
        scene: What is looked at: its captures.
        points: Three or more points of the ground, world space, shape (N, 3), in place of looking for it; up is on the
            side on which the scene is.

    Raises:
        SceneError: There is no capture, the points lie on a line, or nothing tells which way is up.
    """
    check_argument("find_up", scene, Scene, "a Scene", ": ls.Scene([gaussians]) makes one")
    if not scene.splats:
        raise SceneError("find_up looks at captures, and the scene has none")
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
    """Turns a capture about the origin so that its up is an axis, and states that.

    The axis is the one that is nearest to the up that the capture states; y down, as captures have it, if it states
    none. Its first view turns with it.

    Args:
        gaussians: The capture.
        up: Which way is up in it, a direction of any length; None: as `find_up` finds it.

    Raises:
        SceneError: ``up`` is no direction, or nothing tells it.
    """
    check_argument("level", gaussians, Gaussians, "Gaussians")
    scene = Scene([gaussians])
    now = np.array(find_up(scene).up if up is None else up_vector(up))
    before = np.array(scene.up_direction)
    axis = max(UP_AXES.values(), key=lambda one: float(before @ np.array(one)))
    turn = np.eye(4)
    turn[:3, :3] = rotation_between(now, np.array(axis))
    return replace(transform(gaussians, turn), up=axis)


def _cloud(scene: Scene) -> _Cloud:
    """Returns what shows of captures: each Gaussian counts by its opacity and outline, though no large one by much."""
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
    """Returns between which values the middle 90 % of the weight lies."""
    order = np.argsort(values)
    rows = np.searchsorted(np.cumsum(weights[order]), (0.05, 0.95)).clip(0, len(values) - 1)
    low, high = values[order][rows]
    return float(low), float(high)


def _ground(cloud: _Cloud, guess: Doubles, *, stated: bool) -> UpEstimate | None:
    """Returns the up of the best ground; None: there is none."""
    thickness = _THICKNESS * cloud.size
    normals, offsets = _planes(cloud)
    normals, offsets = _facing_the_rest(cloud, normals, offsets, thickness)
    agreement = normals @ guess
    usable = agreement > _NEAR_STATED if stated else np.ones(len(normals), dtype=bool)
    if not usable.any():
        return None
    below = _share_beyond(cloud, -normals, -offsets + thickness)
    above, high = (_share_beyond(cloud, normals, offsets + reach) for reach in (thickness, _CLEAR * cloud.size))
    inside, standing = 1.0 - below - above, above - high  # of a floor and a ceiling, things stand on the floor
    scores = inside * (1.0 + standing) * np.maximum(1.0 - below / _BELOW_MOST, 0.0) * (3.0 + agreement) * usable
    for row in np.argsort(-scores, kind="stable")[:20]:
        if scores[row] <= 0.0:
            return None
        found = _checked(cloud, normals[row], float(offsets[row]), thickness)
        if found is not None:
            return found
    return None


def _planes(cloud: _Cloud) -> tuple[Doubles, Doubles]:
    """Returns planes through three points each that are near each other: unit normals (M, 3), and offsets (M,)."""
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
    """Returns the planes with their normals on the side on which more lies."""
    above = _share_beyond(cloud, normals, offsets + thickness)
    below = _share_beyond(cloud, -normals, -offsets + thickness)
    signs = np.where(above >= below, 1.0, -1.0)
    return normals * signs[:, None], offsets * signs


def _share_beyond(cloud: _Cloud, normals: Doubles, offsets: Doubles) -> Doubles:
    """Returns the share of the weight that lies beyond planes, (M,)."""
    shares = np.empty(len(normals))
    for start in range(0, len(normals), 64):
        rows = slice(start, start + 64)
        beyond = cloud.points @ normals[rows].T > offsets[rows]
        shares[rows] = np.einsum("n,nm->m", cloud.weights, beyond)
    return shares


def _checked(cloud: _Cloud, normal: Doubles, offset: float, thickness: float) -> UpEstimate | None:
    """Returns the up of a plane, fitted to what lies within it; None: it is no ground."""
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
    is_flat = share > _FLAT_LEAST * around  # else it is a slice of something else
    if (
        share < _GROUND_LEAST
        or below > _BELOW_MOST
        or not is_flat
        or not _is_open(cloud, normal, heights, inside, thickness)
    ):
        return None
    return UpEstimate(up_vector(np.round(normal, 9) + 0.0), "ground", offset, share)


def _is_open(cloud: _Cloud, normal: Doubles, heights: Doubles, inside: Flags, thickness: float) -> bool:
    """Returns whether a plane is wide in both directions, and has free space above most of it."""
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
    """Returns the up of the plane through points.

    Raises:
        SceneError: They are fewer than three, not finite, or lie on a line.
    """
    count = len(cast("Sized", given)) if isinstance(given, Sized) else 0
    points = finite_numbers(given, (count, 3))
    if points is None or count < 3:
        raise SceneError(f"points is {given}, expected at least three points of three finite numbers each")
    parted = points - points.mean(axis=0)
    _, extents, axes = np.linalg.svd(parted, full_matrices=False)
    if not extents[1] > 1e-6 * max(extents[0], 1e-300):
        raise SceneError("the points of the ground lie on a line: which way is up stays open")
    normal = axes[2] if len(axes) > 2 else np.cross(axes[0], axes[1])
    heights = (cloud.points - points.mean(axis=0)) @ normal
    above = float(cloud.weights[heights > 0.0].sum())
    if max(above, 1.0 - above) > _SIDE:
        normal = normal if above > 0.5 else -normal
    elif normal @ guess < 0.0:
        normal = -normal
    return UpEstimate(up_vector(np.round(normal, 9) + 0.0), "points", float(points.mean(axis=0) @ normal))


def _own_axis(cloud: _Cloud, guess: Doubles) -> Vector:
    """Returns the axis of a capture's own that is nearest to the guess, on its side.

    Raises:
        SceneError: The capture has no such axis.
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
            "no ground is found, and the capture is as long as it is wide: name three points of the ground, or turn it"
        )
    axis = max((axes[:, row] for row in clear), key=lambda one: abs(float(one @ guess)))
    if extents[2] > _LONG * extents[1] and abs(axes[:, 2] @ guess) > _STANDS:
        axis = axes[:, 2]
    axis = axis * math.copysign(1.0, float(axis @ guess))
    return up_vector(guess if axis @ guess > _UPRIGHT else np.round(unit_vector(axis), 9) + 0.0)
