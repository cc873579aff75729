"""From where Gaussians are seen, and how much that counts (docs/method/relighting.md#baking)."""

from __future__ import annotations

import numpy as np

from lumisplat.constants import LUMINANCE
from lumisplat.constants.baking import BACK_SHARE, DARK_SIDE_MIN, SIDE_MIN
from lumisplat.math.arrays import Doubles, Flags
from lumisplat.math.sh import even_directions
from lumisplat.math.transforms import matrices_from_quaternions
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.normals import shortest_axes


def random_turns(count: int, rng: np.random.Generator) -> Doubles:
    """Rotations, uniform, as unit quaternions, wxyz, shape (count, 4)."""
    turns = rng.standard_normal((count, 4))
    return turns / np.linalg.norm(turns, axis=1, keepdims=True)


def turned_directions(count: int, turns: Doubles) -> Doubles:
    """Even directions, turned for each Gaussian, so that neighbours are seen from others: shape (N, count, 3)."""
    return even_directions(count) @ np.swapaxes(matrices_from_quaternions(turns), 1, 2)


def plane_normals(gaussians: Gaussians) -> Doubles:
    """Normals, object space, shape (N, 3): those that are stored, else the smallest axes, of either sign."""
    if gaussians.normals is not None:
        return gaussians.normals.astype(np.float64)
    return shortest_axes(gaussians)


def on_seen_sides(directions: Doubles, normals: Doubles, weights: Doubles, front: Flags) -> Doubles:
    """Directions, mirrored at the planes of the Gaussians onto the side that alone counts, where one does.

    Args:
        directions: To be looked along, shape (N, D, 3).
        normals: Of the planes, shape (N, 3).
        weights: Of views that have been looked at already, shape (N, E).
        front: Which of those show the front, shape (N, E).
    """
    share = side_means(weights, front.astype(np.float64))[:, None]
    across = (directions * normals[:, None]).sum(axis=2)
    unseen = ((share < SIDE_MIN) & (across < 0.0)) | ((share > 1.0 - SIDE_MIN) & (across > 0.0))
    mirrored = directions - 2.0 * across[..., None] * normals[:, None]
    return np.where(unseen[..., None], mirrored, directions)


def view_weights(front: Flags, light: Doubles, distance: Doubles, *, knows_front: bool) -> Doubles:
    """How much views count, shape (N, D).

    The share of all pixels that show a Gaussian from a direction, if eyes are anywhere in free space, is as the
    distance up to which they see it: there are more of them farther away, by its square, but it is smaller to them by
    as much. Harmonics cannot show two sides of a sheet that are lit differently. So the side counts that is lit: the
    other one is the inside of something closed, or the outside of a room. And of Gaussians with normals, their front.

    Args:
        front: Whether the front is seen, shape (N, D).
        light: Linear radiance, shape (N, D, 3).
        distance: Up to which it is seen, shape (N, D).
        knows_front: Whether the front is the outside.
    """
    weights = np.maximum(distance, 1e-6 * distance.max(initial=1e-30))
    luminance = light @ np.array(LUMINANCE)
    front_light, back_light = (side_means(weights * side, luminance) for side in (front, ~front))
    brighter = np.maximum(np.maximum(front_light, back_light), 1e-30)
    of_front = np.maximum(np.square(front_light / brighter), DARK_SIDE_MIN)
    of_back = np.maximum(np.square(back_light / brighter), DARK_SIDE_MIN)
    if knows_front:
        of_back *= BACK_SHARE
    return weights * np.where(front, of_front[:, None], of_back[:, None])


def side_means(weights: Doubles, values: Doubles) -> Doubles:
    """Weighted means over directions, shape (N, D) to (N,); 0 where nothing counts."""
    total = weights.sum(axis=1)
    return np.divide((weights * values).sum(axis=1), total, out=np.zeros(len(total)), where=total > 0.0)
