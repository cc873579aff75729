"""How much each Gaussian of a capture is like a light, by its colours from some viewpoints.

The scores are those of docs/method/relighting.md#light-estimation.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lumisplat.constants import LIGHT_SEARCH_CLIP, LUMINANCE, SH_C0
from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles, FloatArray, Rows
from lumisplat.math.color import decode_srgb
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.colors import colors_along
from lumisplat.scene.scene import SplatInstance

_TETRAHEDRON = np.array([(1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0)]) / np.sqrt(3.0)


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """The Gaussians of the search region, of all instances together."""

    instances: Rows
    """Splat instance of each, shape (N,)."""
    indices: Rows
    """Gaussian of that instance, shape (N,)."""
    means: Doubles
    """World space, shape (N, 3)."""
    distances: Doubles
    """To the character's centre, shape (N,)."""
    colors: FloatArray
    """Linear, towards the centre, shape (N, 3)."""
    scores: FloatArray
    """Base scores, shape (N,)."""


class _Luminance(NamedTuple):
    """Luminance of each Gaussian over the viewpoints, shape (M,) each."""

    mean: FloatArray
    maximum: FloatArray
    steadiness: FloatArray
    """How little it depends on the viewpoint, 0..1."""


def gathered_evidence(
    splats: tuple[SplatInstance, ...],
    worlds: list[Doubles],
    center: Doubles,
    viewpoint_distance: float,
    radius: float,
) -> Evidence:
    """Scores of all Gaussians around a character.

    Args:
        splats: The capture.
        worlds: Means of each instance in the world.
        center: Of the character, shape (3,): one of the viewpoints.
        viewpoint_distance: From the centre to the four others, scene units.
        radius: Gaussians farther from the centre are ignored, scene units.

    Raises:
        SceneError: No Gaussian is within the radius.
    """
    viewpoints = center + viewpoint_distance * np.concatenate([np.zeros((1, 3)), _TETRAHEDRON])
    parts: list[tuple[Rows, Rows, Doubles, Doubles, FloatArray]] = []
    luminances: list[_Luminance] = []
    trusts: list[FloatArray] = []
    nearest = np.inf
    for number, (instance, world) in enumerate(zip(splats, worlds, strict=True)):
        distances = np.linalg.norm(world - center, axis=1)
        nearest = min(nearest, float(distances.min()))
        near = np.flatnonzero(distances <= radius)
        if near.size == 0:
            continue
        gaussians = instance.gaussians.subset(near)
        colors, luminance = _colors_and_luminance(instance, gaussians, viewpoints)
        parts.append((np.full(near.size, number), near, world[near], distances[near], colors))
        luminances.append(luminance)
        trusts.append(luminance.steadiness * _constant_share(gaussians, instance.sh_degree) * gaussians.opacities)
    if not parts:
        place = ", ".join(f"{x:.3g}" for x in center)
        raise SceneError(
            f"no Gaussians within {radius:.3g} of ({place}): the nearest is {nearest:.3g} away, give a larger radius"
        )
    scores = np.concatenate(trusts) * _brightness(luminances)
    return Evidence(*(np.concatenate(column) for column in zip(*parts, strict=True)), scores=scores)


def _colors_and_luminance(
    instance: SplatInstance, gaussians: Gaussians, viewpoints: Doubles
) -> tuple[FloatArray, _Luminance]:
    """Linear colours towards the first viewpoint, shape (M, 3), and luminance over all."""
    first = _colors_from(viewpoints[0], instance, gaussians)
    others = (_colors_from(viewpoint, instance, gaussians) for viewpoint in viewpoints[1:])
    luminance = [colors @ np.array(LUMINANCE, dtype=np.float32) for colors in itertools.chain([first], others)]
    mean, maximum = np.mean(luminance, axis=0), np.max(luminance, axis=0)
    steadiness = mean / np.maximum(mean + np.std(luminance, axis=0), 1e-12)
    return first, _Luminance(mean, maximum, steadiness)


def _colors_from(viewpoint: Doubles, instance: SplatInstance, gaussians: Gaussians) -> FloatArray:
    """Linear colours as seen from a place in the world, shape (M, 3)."""
    object_from_world = np.linalg.inv(instance.transform)
    eye = (object_from_world[:3, :3] @ viewpoint + object_from_world[:3, 3]).astype(np.float32)
    directions = gaussians.means - eye
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
    return decode_srgb(colors_along(gaussians, directions, instance.sh_degree))


def _brightness(luminances: list[_Luminance]) -> FloatArray:
    """Mean of mean and maximum luminance of the Gaussians of all instances, clipped softly."""
    mean = np.concatenate([luminance.mean for luminance in luminances])
    maximum = np.concatenate([luminance.maximum for luminance in luminances])
    level = float(np.quantile(mean, LIGHT_SEARCH_CLIP))
    return 0.5 * (_softly_clipped(mean, level) + _softly_clipped(maximum, level))


def _constant_share(gaussians: Gaussians, degree: int) -> FloatArray:
    """Of a colour's mean square over all directions, the part of its mean colour (Parseval), 0..1, shape (M,)."""
    constant = np.sum(np.maximum(SH_C0 * gaussians.sh[:, 0] + 0.5, 0.0) ** 2, axis=1)
    bands = gaussians.sh[:, 1 : (degree + 1) ** 2]
    varying = np.einsum("nkc,nkc->n", bands, bands) / (4.0 * np.pi)
    return constant / np.maximum(constant + varying, 1e-12)


def _softly_clipped(values: FloatArray, level: float) -> FloatArray:
    """Values up to ``level``, beyond it their logarithm, with the same slope there."""
    if level <= 0.0:
        return values
    return np.where(values <= level, values, level * (1.0 + np.log(np.maximum(values, level) / level)))
