"""Captures as lights: sampled directions towards boxes around their Gaussians, and the pdf of such directions.

A point is sampled uniformly in one of the boxes. The pdf of its direction integrates over all points of the ray in all
boxes, so that the radiance of a ray counts fully whichever Gaussians it hits
(docs/method/realtime.md#captured-emitters).
"""

import warp as wp

from lumisplat.device.structs import struct


@struct
class EmitterBox:
    """Box around Gaussians of a capture that is sampled as a light, world space."""

    center: wp.vec3
    box_from_world: wp.mat33
    """Rotation from the world's axes to those of the box."""
    half: wp.vec3
    """Half edge lengths, scene units."""
    power: float
    """Approximate luminance times area of the Gaussians in the box; above 0."""


TINY = wp.constant(wp.float32(1e-30))


@wp.func
def box_weight(box: EmitterBox, point: wp.vec3) -> float:
    """Returns the approximate irradiance of a point by the Gaussians in a box, up to a common factor."""
    away = box.center - point
    return box.power / wp.max(wp.max(wp.dot(away, away), wp.dot(box.half, box.half)), TINY)


@wp.func
def total_weight(point: wp.vec3, boxes: wp.array[EmitterBox]) -> float:
    """Returns the sum of the weights of all boxes at a point."""
    total = float(0.0)
    for k in range(boxes.shape[0]):
        total += box_weight(boxes[k], point)
    return total


@wp.func
def chosen_box(u: float, total: float, point: wp.vec3, boxes: wp.array[EmitterBox]) -> int:
    """Chooses a box in proportion to its weight at a point.

    ``u`` is random, 0..1, and ``total`` the sum of all weights.
    """
    chosen = int(0)
    rest = u * total
    for k in range(boxes.shape[0]):
        weight = box_weight(boxes[k], point)
        if weight > 0.0 and rest >= 0.0:
            chosen = k
            rest -= weight
    return chosen


@wp.func
def point_in(box: EmitterBox, u: wp.vec2, v: float) -> wp.vec3:
    """Returns a point in a box, uniformly distributed for random numbers in 0..1."""
    local = wp.cw_mul(box.half, wp.vec3(2.0 * u[0] - 1.0, 2.0 * u[1] - 1.0, 2.0 * v - 1.0))
    return box.center + wp.transpose(box.box_from_world) * local


@wp.func
def crossing(box: EmitterBox, point: wp.vec3, direction: wp.vec3) -> wp.vec2:
    """Returns the distances at which a ray enters and leaves a box, at least 0.

    The ray misses if the second is not larger.
    """
    start = box.box_from_world * (point - box.center)
    along = box.box_from_world * direction
    near = float(0.0)
    far = float(wp.inf)
    for axis in range(3):
        step = along[axis]
        if wp.abs(step) < 1.0e-12:
            step = 1.0e-12
        first = (-box.half[axis] - start[axis]) / step
        second = (box.half[axis] - start[axis]) / step
        near = wp.max(near, wp.min(first, second))
        far = wp.min(far, wp.max(first, second))
    return wp.vec2(near, far)


@wp.func
def direction_pdf(point: wp.vec3, direction: wp.vec3, total: float, boxes: wp.array[EmitterBox]) -> wp.vec2:
    """Returns the pdf of a direction, per steradian, and the distance at which its ray leaves the last box.

    In a box of volume V, the points between distances a and b have the pdf (b^3 - a^3) / (3 V).
    """
    pdf = float(0.0)
    end = float(0.0)
    for k in range(boxes.shape[0]):
        box = boxes[k]
        ends = crossing(box, point, direction)
        if ends[1] > ends[0]:
            volume = 8.0 * box.half[0] * box.half[1] * box.half[2]
            squares = ends[0] * ends[0] + ends[0] * ends[1] + ends[1] * ends[1]
            share = box_weight(box, point) / total
            pdf += share * (ends[1] - ends[0]) * squares / (3.0 * volume)
            end = wp.max(end, ends[1])
    return wp.vec2(pdf, end)
