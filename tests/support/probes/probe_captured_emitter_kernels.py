"""Runs the device functions of captured emitters on rows of points, one row per thread."""

import warp as wp

from lumisplat.device.gi.captured_emitters import EmitterBox, chosen_box, direction_pdf, point_in, total_weight

wp.set_module_options({"enable_backward": False})


@wp.kernel
def sample_boxes(
    start: int,
    boxes: wp.array[EmitterBox],
    points: wp.array[wp.vec3],
    random: wp.array[wp.vec4],
    directions_out: wp.array[wp.vec3],
    densities_out: wp.array[wp.vec2],
):
    """Samples a direction from four random numbers, and evaluates its pdf."""
    i = start + wp.tid()
    point = points[i]
    total = total_weight(point, boxes)
    box = boxes[chosen_box(random[i][0], total, point, boxes)]
    place = point_in(box, wp.vec2(random[i][1], random[i][2]), random[i][3])
    directions_out[i] = wp.normalize(place - point)
    densities_out[i] = direction_pdf(point, directions_out[i], total, boxes)
