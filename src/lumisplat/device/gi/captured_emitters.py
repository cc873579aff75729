"""Captures as lights: directions towards the boxes around their Gaussians, and the density of such directions.

A point is sampled evenly in one of the boxes. Its direction has the density of all points on the ray in all boxes, so
that the light of a ray counts whole, whichever Gaussians it meets (docs/method/realtime.md#captured-emitters).
"""

import warp as wp

from lumisplat.device.structs import struct


@struct
class EmitterBox:
    """A box around Gaussians of a capture that is sampled as a light, world space."""

    center: wp.vec3
    box_from_world: wp.mat33
    """Rotation."""
    half: wp.vec3
    """Half its edges, scene units."""
    power: float
    """About the luminance times the area of what is in it; above 0."""


TINY = wp.constant(wp.float32(1e-30))


@wp.func
def box_weight(box: EmitterBox, point: wp.vec3) -> float:
    """Returns about the irradiance that what is in a box gives a point, without a common factor."""
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
    """Returns a box, chosen in proportion to its weight at a point; ``u``: random, 0..1; ``total``: of all weights."""
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
    """Returns a point of a box, evenly distributed by random numbers in 0..1."""
    local = wp.cw_mul(box.half, wp.vec3(2.0 * u[0] - 1.0, 2.0 * u[1] - 1.0, 2.0 * v - 1.0))
    return box.center + wp.transpose(box.box_from_world) * local


@wp.func
def crossing(box: EmitterBox, point: wp.vec3, direction: wp.vec3) -> wp.vec2:
    """Returns where a ray enters and leaves a box, not before it starts; the second is not above the first: nowhere."""
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
    """Returns the density of a direction, per steradian, and where its ray leaves the last box.

    In a box of volume V, the points between distances a and b have the density (b^3 - a^3) / (3 V).
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
