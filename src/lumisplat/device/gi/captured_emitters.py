"""Captured radiance as a light: directions sampled towards boxes around Gaussians, and the pdf of such directions.

A point is sampled uniformly in one of the boxes. The pdf of its direction integrates over all points of the ray in all
boxes, so that the radiance of a ray counts fully, whichever Gaussians the ray hits
(docs/method/realtime.md#captured-emitters).
"""

import warp as wp

from lumisplat.device.structs import struct


@struct
class EmitterBox:
    """World-space oriented box around Gaussians that show captured colours; boxes are sampled as lights."""

    center: wp.vec3
    box_from_world: wp.mat33
    """Rotation from the world's axes to those of the box."""
    half: wp.vec3
    """Half the length of the box along each of its axes, scene units."""
    power: float
    """Approximate sum of luminance times area over the Gaussians in the box; above 0."""


TINY = wp.constant(wp.float32(1e-30))


@wp.func
def box_weight(box: EmitterBox, point: wp.vec3) -> float:
    """Estimates the irradiance at ``point`` by the Gaussians in ``box``, up to a constant factor.

    It is the box's power / d^2, where d is the distance to the box's centre, but at least half the box's diagonal.
    """
    away = box.center - point
    return box.power / wp.max(wp.max(wp.dot(away, away), wp.dot(box.half, box.half)), TINY)


@wp.func
def total_weight(point: wp.vec3, boxes: wp.array[EmitterBox]) -> float:
    """Returns the sum over all boxes of ``box_weight``, the estimated irradiance at ``point``."""
    total = float(0.0)
    for k in range(boxes.shape[0]):
        total += box_weight(boxes[k], point)
    return total


@wp.func
def chosen_box(u: float, total: float, point: wp.vec3, boxes: wp.array[EmitterBox]) -> int:
    """Returns the index of a random box, with probability ``box_weight / total`` at ``point``.

    ``u`` is random, 0..1, and ``total`` the sum of ``box_weight`` over all boxes.
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
    """Returns a point of a box, uniformly distributed if ``u`` and ``v`` are random numbers in 0..1."""
    local = wp.cw_mul(box.half, wp.vec3(2.0 * u[0] - 1.0, 2.0 * u[1] - 1.0, 2.0 * v - 1.0))
    return box.center + wp.transpose(box.box_from_world) * local


@wp.func
def crossing(box: EmitterBox, point: wp.vec3, direction: wp.vec3) -> wp.vec2:
    """Returns the distances at which a ray enters and leaves a box; 0 where the ray starts inside.

    The ray misses the box if the second distance is not larger than the first.
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
    """Returns a direction's pdf, per steradian, under box sampling, and the distance where its ray leaves all boxes.

    ``total`` is the sum of ``box_weight`` over all boxes. The points of the ray between distances a and b in a box of
    volume V contribute the pdf (b^3 - a^3) / (3 V), times the box's probability.
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
