"""Where what paths bring is added: the light of a ray, its layers, and what shadow-only surfaces receive.

The layers are those of docs/method/paths.md#layers.
"""

import warp as wp

from lumisplat.device.structs.path import (
    PART_DIRECT_DIFFUSE,
    PART_DIRECT_GLOSSY,
    PART_EMISSION,
    PART_INDIRECT_DIFFUSE,
    PART_INDIRECT_GLOSSY,
    PathImages,
)

wp.set_module_options({"enable_backward": False})


@wp.func
def add_to_row(rows: wp.array[wp.vec3], row: int, count: int, root: int, value: wp.vec3):
    """Adds to the element of a ray in one of several rows of ``count`` elements each."""
    i = row * count + root
    rows[i] = rows[i] + value


@wp.func
def add_to_parts(root: int, value: wp.vec3, bounces: int, diffuse: wp.vec3, images: wp.array[PathImages]):
    """Adds light to the part that its first scattering decides: diffuse or glossy, direct or indirect."""
    count = images[0].light.shape[0]
    if bounces == 0:
        add_to_row(images[0].parts, PART_EMISSION, count, root, value)
        return
    scattered = wp.cw_mul(diffuse, value)
    if bounces == 1:
        add_to_row(images[0].parts, PART_DIRECT_DIFFUSE, count, root, scattered)
        add_to_row(images[0].parts, PART_DIRECT_GLOSSY, count, root, value - scattered)
    else:
        add_to_row(images[0].parts, PART_INDIRECT_DIFFUSE, count, root, scattered)
        add_to_row(images[0].parts, PART_INDIRECT_GLOSSY, count, root, value - scattered)


@wp.func
def add_light(
    root: int,
    receives: bool,
    value: wp.vec3,
    bounces: int,
    light: int,
    light_count: int,
    diffuse: wp.vec3,
    images: wp.array[PathImages],
):
    """Adds what a path brings of a light.

    Args:
        root: The ray that the path began with.
        receives: As of ``PathData``.
        value: Linear radiance, times the throughput.
        bounces: How often surfaces have scattered it.
        light: Number of the light; one more than that of the last one: it is none, but shines.
        light_count: How many lights there are.
        diffuse: Share that the first surface has scattered diffusely.
        images: Where it is added.
    """
    if receives:
        if light < light_count:
            images[0].arrived[root] += value
        else:
            images[0].own_arrived[root] += value
        return
    images[0].light[root] += value
    count = images[0].light.shape[0]
    if images[0].parts:
        add_to_parts(root, value, bounces, diffuse, images)
    if images[0].bounces:
        add_to_row(images[0].bounces, bounces, count, root, value)
    if images[0].lights_total:
        lights = images[0].lights_arrived.shape[0] // count
        add_to_row(images[0].lights_total, wp.min(light, lights), count, root, value)


@wp.func
def add_first_light(root: int, sent: wp.vec3, arrived: wp.vec3, light: int, images: wp.array[PathImages]):
    """Adds a sample of a light at the first surface of a path, if it is one of the lights and the frame asks for it.

    Args:
        root: The ray that the path began with.
        sent: What the surface would reflect of it unshadowed, linear.
        arrived: What it does reflect.
        light: Number of the light.
        images: Where both are added.
    """
    if images[0].lights_sent:
        count = images[0].light.shape[0]
        if light < images[0].lights_sent.shape[0] // count:
            add_to_row(images[0].lights_sent, light, count, root, sent)
            add_to_row(images[0].lights_arrived, light, count, root, arrived)


@wp.func
def add_sent_light(root: int, value: wp.vec3, images: wp.array[PathImages]):
    """Adds irradiance of a shadow catcher by lights, as it was captured."""
    images[0].sent[root] += value


@wp.func
def add_own_light(root: int, value: wp.vec3, images: wp.array[PathImages]):
    """Adds irradiance of a shadow catcher by the captures around it, as it was captured."""
    images[0].own_sent[root] += value
