"""Filters the light of real-time frames in float64, image by image (docs/method/realtime.md#filters)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import numpy.typing as npt

from lumisplat.constants import LUMINANCE, STILL_PX
from lumisplat.device.gi.filter_weights import LUMINANCE_SIGMAS, WEIGHT_LEAST
from lumisplat.device.gi.surfaces import SAME_NORMAL_MESH, SAME_NORMAL_SPLATS, SAME_SURFACE_PX
from lumisplat.renderer.realtime.gbuffer_kernels import BORROWED_WEIGHT, SAME_PIXEL_PX
from lumisplat.renderer.realtime.light_filter_kernels import (
    CHANGE_LEAST,
    CHANGE_SIGMAS,
    GLOSSY_MEMORY,
    LOBE_FRAMES,
    MOMENT_FRAMES,
    YOUNG_FRAMES,
)
from lumisplat.renderer.scene.camera_table import CENTER
from lumisplat.renderer.scene.motion import OUTDATED_HISTORY_WEIGHT
from support.scenes.filter_sequence import LOBE_WIDTHS
from support.scenes.gi_surfaces import Doubles, VisibleSurfaces

Mask = npt.NDArray[np.bool_]
Whole = npt.NDArray[np.int64]


@dataclass(slots=True)
class Light:
    """Running means of diffuse and glossy light at each pixel."""

    frames: Doubles
    """Number of frames in the means, shape (pixels,)."""
    light: Doubles
    moments: Doubles
    """Mean luminance and mean squared luminance (last axis) of diffuse and glossy light, shape (pixels, 2, 2)."""


def luminance(light: Doubles) -> Doubles:
    """Returns the luminance of linear colours of shape (..., 3)."""
    return np.asarray(light) @ np.array(LUMINANCE)


def empty(count: int) -> Light:
    """Returns means without history."""
    return Light(np.zeros(count), np.zeros((count, 2, 3)), np.zeros((count, 2, 2)))


def tolerance(surfaces: VisibleSurfaces, distance: Doubles) -> Doubles:
    """Returns the largest distance of points of one surface from each other's tangent planes, scene units."""
    return np.maximum(SAME_SURFACE_PX * distance / surfaces.camera.fx, surfaces.extent)


def least_cosine(surfaces: VisibleSurfaces) -> Doubles:
    """Returns the smallest cosine between normals of one surface."""
    return np.where(surfaces.extent > 0.0, SAME_NORMAL_SPLATS, SAME_NORMAL_MESH)


def is_same(
    surfaces: VisibleSurfaces, points: Doubles, tolerated: Doubles, image: VisibleSurfaces, taps: Whole
) -> Mask:
    """Returns True where a pixel's point and normal belong to the same surface as another pixel of an image."""
    normals, offset = image.normal[taps], image.position[taps] - points
    cosine = (surfaces.normal * normals).sum(axis=1)
    across = np.abs([(offset * surfaces.normal).sum(axis=1), (offset * normals).sum(axis=1)]).max(axis=0)
    return (image.share[taps] > 0.0) & (cosine >= least_cosine(surfaces)) & (across <= tolerated)


def neighbours(surfaces: VisibleSurfaces, radius: int, step: int = 1) -> Iterator[tuple[int, int, Whole, Mask]]:
    """Yields each offset (row, column) in steps, the pixels at this offset, and which of them are in the image."""
    width, height = surfaces.camera.width, surfaces.camera.height
    y, x = np.divmod(np.arange(width * height), width)
    for row in range(-radius, radius + 1):
        for column in range(-radius, radius + 1):
            at_x, at_y = x + step * column, y + step * row
            inside = (at_x >= 0) & (at_x < width) & (at_y >= 0) & (at_y < height)
            yield row, column, np.where(inside, at_y * width + at_x, 0), inside


def reprojected(surfaces: VisibleSurfaces, before: VisibleSurfaces, history: Light) -> Light:
    """Reprojects history to the current pixels, bilinearly over the pixels that showed the same surface.

    If no such pixel exists and the surface stands still, the first of the 3 x 3 pixels that matches is used, with
    `BORROWED_WEIGHT`, unless samples are at pixel centres. Frames count by the sum of weights.
    """
    camera, found = before.camera, empty(len(surfaces.share))
    known = np.where(np.isnan(surfaces.previous), camera.eye, surfaces.previous)
    offset = known - camera.eye
    local = offset @ camera.camera_from_world[:3, :3].T
    ahead = (surfaces.share > 0.0) & (local[:, 2] > camera.near)
    depth = np.where(ahead, local[:, 2], 1.0)
    x = camera.fx * local[:, 0] / depth + camera.cx - surfaces.offset[0]
    y = camera.fy * local[:, 1] / depth + camera.cy - surfaces.offset[1]
    x, y = (np.where(np.abs(u - np.round(u)) < STILL_PX, np.round(u), u) for u in (x, y))
    tolerated = np.maximum(SAME_PIXEL_PX * np.linalg.norm(offset, axis=1) / camera.fx, surfaces.extent)
    total, matched = np.zeros(len(offset)), np.zeros(len(offset), bool)
    near = np.stack([np.floor(x), np.floor(y)]), range(2), range(2)
    around = near[0], range(-1, 2), range(-1, 2)
    own_y, own_x = np.divmod(np.arange(len(offset)), camera.width)
    stands = (x == own_x) & (y == own_y) & (surfaces.offset != CENTER)
    for (left, top), rows, columns in (near, around):
        is_first = len(rows) == 2
        is_left = ahead & ~matched & (stands | is_first)
        for row, column in product(rows, columns):
            at_x, at_y = left + column, top + row
            weight = (
                (1.0 - np.abs(x - at_x)) * (1.0 - np.abs(y - at_y))
                if is_first
                else np.full(len(offset), BORROWED_WEIGHT)
            )
            inside = is_left & (at_x >= 0) & (at_x < camera.width) & (at_y >= 0) & (at_y < camera.height)
            taps = np.where(inside, at_y * camera.width + at_x, 0).astype(np.int64)
            shows = inside & (weight > 0.0) & is_same(surfaces, known, tolerated, before, taps)
            shows &= is_first | ~matched
            matched |= shows
            weight = np.where(shows & (history.frames[taps] > 0.0), weight, 0.0)
            total += weight
            found.frames += weight * history.frames[taps]
            found.light += weight[:, None, None] * history.light[taps]
            found.moments += weight[:, None, None] * history.moments[taps]
    scale = 1.0 / np.where(total > 0.0, total, 1.0)
    return Light(found.frames, scale[:, None, None] * found.light, scale[:, None, None] * found.moments)


def own_variances(history: Light) -> Doubles:
    """Returns the variance of each pixel's diffuse and glossy samples over frames, shape (pixels, 2)."""
    return np.maximum(history.moments[..., 1] - history.moments[..., 0] ** 2, 0.0)


def cached_frames(is_indirect: bool, history_weight: float) -> float:
    """Returns the number of frames that cached lighting covers while light changes; inf for direct light."""
    changes = is_indirect and OUTDATED_HISTORY_WEIGHT < history_weight < 1.0
    return 1.0 / (1.0 - history_weight) if changes else np.inf


def frames_in_means(frames: Doubles, cached: float) -> Doubles:
    """Returns the number of frames in the means of diffuse and glossy light, (pixels, 2)."""
    return np.minimum(frames[:, None], cached * np.array([1.0, GLOSSY_MEMORY]))


def glossy_deviation(history: Light, cached: float) -> Doubles:
    """Returns the standard deviation of each pixel's mean glossy luminance, (pixels,)."""
    some = history.frames >= 1.5
    counts = frames_in_means(np.where(some, history.frames - 1.0, 1.0), cached)[:, 1]
    return np.where(some, np.sqrt(own_variances(history)[:, 1] / counts), np.inf)


def retained_shares(surfaces: VisibleSurfaces, history: Light, samples: Doubles, sampled: Mask, shared: int) -> Doubles:
    """Returns the fraction of diffuse and glossy history that each pixel retains, from 5 x 5 samples; (pixels, 2)."""
    found, expected = luminance(samples), luminance(history.light)
    variance = own_variances(history)
    old = sampled & (history.frames >= YOUNG_FRAMES)
    sums = np.zeros((5, len(old), 2))
    for _, _, taps, inside in neighbours(surfaces, 2):
        counts = (
            inside
            & old[taps]
            & is_same(surfaces, surfaces.position, tolerance(surfaces, surfaces.distance), surfaces, taps)
        )
        values = found[taps], expected[taps], variance[taps], found[taps] > expected[taps], np.ones((len(old), 2))
        sums += np.where(counts[:, None], values, 0.0)
    sampled_sum, expected_sum, noise, brighter, count = sums
    difference = sampled_sum - expected_sum
    by_chance = CHANGE_SIGMAS * np.sqrt(np.minimum(shared, count) * noise + (CHANGE_LEAST * expected_sum) ** 2)
    is_change = (np.abs(difference) > by_chance) & ((difference <= 0.0) | (brighter >= 0.5 * count))
    ratio = by_chance / np.where(is_change, np.abs(difference), 1.0)
    return np.where(old[:, None] & is_change, ratio**4, 1.0)


def shares_inside(surfaces: VisibleSurfaces, history: Light, samples: Doubles, sampled: Mask, cached: float) -> Doubles:
    """Returns the retained fractions for moving scenes, (pixels, 2), from the range of the 5 x 5 samples around."""
    found, held = luminance(samples), luminance(history.light)
    noise = np.zeros_like(held)
    if np.isfinite(cached):
        noise[:, 1] = glossy_deviation(history, cached)
    low, high = np.full_like(held, np.inf), np.zeros_like(held)
    for _, _, taps, inside in neighbours(surfaces, 2):
        counts = (
            inside
            & sampled[taps]
            & is_same(surfaces, surfaces.position, tolerance(surfaces, surfaces.distance), surfaces, taps)
        )
        low = np.where(counts[:, None], np.minimum(low, found[taps]), low)
        high = np.where(counts[:, None], np.maximum(high, found[taps]), high)
    outside, tolerated = np.maximum(low - held, held - high), np.maximum(CHANGE_LEAST * held, CHANGE_SIGMAS * noise)
    is_change = outside > tolerated
    return np.where(is_change, (tolerated / np.where(is_change, outside, 1.0)) ** 4, 1.0)


def accumulated(
    surfaces: VisibleSurfaces,
    history: Light,
    samples: Doubles,
    sampled: Mask,
    frames_max: int,
    shared: int,
    is_indirect: bool,
    history_weight: float,
) -> Light:
    """Adds the samples of one more frame to a history."""
    cached = cached_frames(is_indirect, history_weight)
    sampled = sampled & (surfaces.share > 0.0)
    samples = np.where(sampled[:, None, None], samples, 0.0)
    if not is_indirect or history_weight <= OUTDATED_HISTORY_WEIGHT:
        young = history.frames < YOUNG_FRAMES
        history = replace(history, frames=np.where(young & sampled, history_weight, 1.0) * history.frames)
    retained = retained_shares(surfaces, history, samples, sampled, shared)
    if history_weight < 1.0:
        retained = np.minimum(retained, shares_inside(surfaces, history, samples, sampled, cached))
    if not np.isfinite(cached):
        retained = retained.min(axis=1, keepdims=True).repeat(2, axis=1)
    of_diffuse, count = retained.T * history.frames + 1.0
    bright = luminance(samples)
    moments = np.stack([bright, bright * bright], axis=-1)
    counts = [frames_in_means(of_diffuse, cached)[:, 0], frames_in_means(count, cached)[:, 1]]
    add = np.where(sampled[:, None], 1.0 / np.stack(counts, axis=1), 0.0)[:, :, None]
    add_moments = np.where(sampled, 1.0 / np.minimum(count, MOMENT_FRAMES), 0.0)[:, None, None]
    return Light(
        np.where(sampled, np.minimum(count, frames_max), history.frames),
        history.light + add * (samples - history.light),
        history.moments + add_moments * (moments - history.moments),
    )


def variances(surfaces: VisibleSurfaces, history: Light, cached: float) -> Doubles:
    """Returns the variance of mean diffuse and mean glossy light at each pixel, (pixels, 2); 0 without history."""
    young = history.frames < YOUNG_FRAMES
    each = own_variances(history)
    moments, variance, count = np.zeros_like(history.moments), np.zeros_like(each), np.zeros(len(each))
    for row, column, taps, inside in neighbours(surfaces, 3):
        counts = inside & (young | (max(abs(row), abs(column)) <= 1)) & (history.frames[taps] > 0.0)
        counts &= is_same(surfaces, surfaces.position, tolerance(surfaces, surfaces.distance), surfaces, taps)
        moments += np.where(counts[:, None, None], history.moments[taps], 0.0)
        variance += np.where(counts[:, None], each[taps], 0.0)
        count += counts
    some = np.maximum(count, 1.0)
    moments /= some[:, None, None]
    around = some[:, None] * np.maximum(moments[..., 1] - moments[..., 0] ** 2, 0.0)
    some_frames = np.where(history.frames > 0.0, history.frames, 1.0)
    variance = np.where(young[:, None], around, variance) / (some[:, None] * frames_in_means(some_frames, cached))
    return np.where(history.frames[:, None] > 0.0, variance, 0.0)


def falloff(x: Doubles | float) -> Doubles:
    """Approximates exp(-x^2 / 3) by a function that is 0 from 3 on."""
    return np.maximum(1.0 - np.square(x) / 9.0, 0.0) ** 3


def half_turns(surfaces: VisibleSurfaces, taps: Whole) -> Doubles:
    """Returns how far each neighbour's normal turns from the half vector of a light at infinity, (pixels, 3).

    The light is where the pixel itself mirrors the eye. To first order, the half vector turns along the surface, by the
    change of the view over twice its cosine.
    """
    distance = np.where(surfaces.share > 0.0, surfaces.distance, 1.0)[:, None]
    view = (surfaces.camera.eye - surfaces.position) / distance
    cosine = np.maximum((view * surfaces.normal).sum(axis=1, keepdims=True), 1e-3)
    offset = surfaces.position[taps] - surfaces.position
    change = -(offset - (offset * view).sum(axis=1, keepdims=True) * view) / distance
    change -= (change * surfaces.normal).sum(axis=1, keepdims=True) * surfaces.normal
    return surfaces.normal[taps] - surfaces.normal - change / (2.0 * cosine)


def smoothed(
    surfaces: VisibleSurfaces, frames: Doubles, light: Doubles, variance: Doubles, radius: int, step: int
) -> tuple[Doubles, Doubles]:
    """Runs one spatial pass: weighted means of light and variance over neighbours ``step`` pixels apart.

    A pixel without samples takes a normalised mean. Weights by luminance do not change the sum of weights, so that no
    light is lost.
    """
    own = np.repeat((frames > 0.0)[:, None] * 1.0, 2, axis=1)
    whole = np.ones_like(own)
    bright = luminance(light)
    shown = surfaces.share > 0.0
    per_distance = 1.0 / np.where(shown, tolerance(surfaces, surfaces.distance), 1.0)
    power = np.where(surfaces.extent > 0.0, 8, 64)
    alpha2 = np.where(frames > 0.0, surfaces.alpha**2 + surfaces.footprint, np.inf)
    weights, sums, squares = np.zeros_like(own), np.zeros_like(light), np.zeros_like(variance)
    for row, column, taps, inside in neighbours(surfaces, radius, step):
        if row == column == 0:
            continue
        counts = inside & shown & (frames[taps] > 0.0)
        cosine = np.where(counts, (surfaces.normal * surfaces.normal[taps]).sum(axis=1), 0.0)
        across = per_distance * ((surfaces.position[taps] - surfaces.position) * surfaces.normal).sum(axis=1)
        weight = counts * np.maximum(cosine, 0.0) ** power * falloff(np.where(counts, across, 3.0))
        weight = np.where(weight <= WEIGHT_LEAST, 0.0, weight)
        weight *= falloff(1.5 * (row * row + column * column) / (radius * radius + 1))
        chance = LUMINANCE_SIGMAS * np.sqrt(np.sqrt(variance * variance[taps])) + 1e-8
        of_each = weight[:, None] * falloff(own * (bright[taps] - bright) / chance)
        turned2 = np.where(counts, np.square(half_turns(surfaces, taps)).sum(axis=1), 0.0)
        widths = LOBE_WIDTHS * np.maximum(1.0, LOBE_FRAMES / np.maximum(frames, 1.0))
        of_turn = falloff(np.sqrt(turned2 / alpha2) / widths)
        of_each[:, 1] *= of_turn
        whole += np.stack([weight, of_turn * weight], axis=1)
        weights += of_each
        sums += of_each[..., None] * light[taps]
        squares += of_each * of_each * variance[taps]
    rest = own * (whole - weights)
    weights, sums, squares = weights + rest, sums + rest[..., None] * light, squares + rest * rest * variance
    some = (weights > 0.0) & shown[:, None]
    divisor = np.where(some, weights, 1.0)
    return (
        np.where(some[..., None], sums / divisor[..., None], light),
        np.where(some, squares / divisor**2, variance),
    )


class Filter:
    """Runs the whole filter frame by frame.

    Args:
        frames: History length, as in `FilterConfig`.
        passes: Number of spatial passes per frame.
        radius: Radius of each pass in steps.
        shared: Number of pixels that share a sample.
        is_indirect: Whether the light is indirect.
    """

    def __init__(
        self, frames: int = 32, passes: int = 4, *, radius: int = 1, shared: int = 1, is_indirect: bool = False
    ) -> None:
        self._frames, self._passes, self._radius, self._shared = frames, passes, radius, shared
        self._is_indirect = is_indirect
        self._before: VisibleSurfaces | None = None
        self.history = empty(0)

    def render(
        self, surfaces: VisibleSurfaces, diffuse: Doubles, glossy: Doubles, sampled: Mask, history_weight: float = 1.0
    ) -> Doubles:
        """Returns filtered diffuse and glossy light of the next frame, shape (pixels, 2, 3), from its samples."""
        history = empty(len(sampled))
        if self._before is not None:
            history = reprojected(surfaces, self._before, self.history)
        samples = np.stack([diffuse, glossy], axis=1)
        given = self._frames, self._shared, self._is_indirect, history_weight
        self.history = accumulated(surfaces, history, samples, sampled, *given)
        self._before = surfaces
        cached = cached_frames(self._is_indirect, history_weight)
        light, variance = self.history.light, variances(surfaces, self.history, cached)
        for number in range(self._passes):
            light, variance = smoothed(surfaces, self.history.frames, light, variance, self._radius, 2**number)
        return light
