"""Which light a path samples at a surface: in proportion to what each would send there, unshadowed.

The triangles that shine are one light more, after all others. The equations are in docs/method/paths.md#lights.
"""

import warp as wp

from lumisplat.constants import LIGHT_COSINE_MIN, LUMINANCE
from lumisplat.device.light.light import sample_light
from lumisplat.device.material.rough_glass import transmits
from lumisplat.device.math.directions import PI
from lumisplat.device.structs.light import LIGHT_ENVIRONMENT
from lumisplat.device.structs.path import LightChoice, PathVertex
from lumisplat.device.structs.shading import Interaction, ShadingScene

wp.set_module_options({"enable_backward": False})

WEIGHTS = wp.constant(wp.vec3(*LUMINANCE))
COSINE_MIN = wp.constant(wp.float32(LIGHT_COSINE_MIN))
TINY = wp.constant(wp.float32(1e-30))


@wp.func
def choice_count(scene: wp.array[ShadingScene]) -> int:
    """Lights among which paths choose."""
    return scene[0].settings[0].light_count + wp.where(scene[0].emitters.ends.shape[0] > 0, 1, 0)


@wp.func
def meets_rays(number: int, no_shadows: bool, scene: wp.array[ShadingScene]) -> bool:
    """Whether rays that surfaces scatter show light ``number``, and its samples are weighted against them.

    Not those whose samples pass what would block the rays, or are shadowed otherwise, and those that have no extent.
    """
    if no_shadows or scene[0].settings[0].changes_shadows != 0:
        return False
    if number == scene[0].settings[0].light_count:
        return True
    light = scene[0].lights[number]
    if light.casts_shadow == 0:
        return False
    if light.kind == LIGHT_ENVIRONMENT:
        return light.range == wp.inf
    return light.visible != 0


@wp.func
def light_importance(number: int, position: wp.vec3, normal: wp.vec3, scene: wp.array[ShadingScene]) -> float:
    """About the irradiance that light ``number`` gives a surface; above 0 wherever it gives any."""
    if number == scene[0].settings[0].light_count:
        emitters = scene[0].emitters
        away = emitters.center - position
        return emitters.power / wp.max(wp.max(wp.dot(away, away), emitters.radius * emitters.radius), TINY)
    light = scene[0].lights[number]
    if light.kind == LIGHT_ENVIRONMENT:
        return PI * scene[0].environment.mean
    sample = sample_light(light, position, 0, wp.vec2(0.5))
    cosine = wp.max(wp.dot(normal, sample.direction), COSINE_MIN)  # soft lights reach above the horizon
    return cosine * wp.dot(WEIGHTS, sample.irradiance)


@wp.func
def total_importance(position: wp.vec3, normal: wp.vec3, scene: wp.array[ShadingScene]) -> float:
    """About the irradiance that all lights give a surface."""
    total = float(0.0)
    for number in range(choice_count(scene)):
        total += light_importance(number, position, normal, scene)
    return total


@wp.func
def casts_shadow(number: int, scene: wp.array[ShadingScene]) -> bool:
    """Whether what is in the way of light ``number`` blocks it: always, if it is that of meshes."""
    if number == scene[0].settings[0].light_count:
        return True
    return scene[0].lights[number].casts_shadow != 0


@wp.func
def place_of(interaction: Interaction) -> PathVertex:
    """An interaction as the choice of a light reads it, but for what the lights send there."""
    vertex = PathVertex()
    vertex.position = interaction.position
    vertex.normal = interaction.normal
    if transmits(interaction.bsdf):
        vertex.normal = wp.vec3(0.0)  # light counts from both sides
    return vertex


@wp.func
def vertex_at(interaction: Interaction, scene: wp.array[ShadingScene]) -> PathVertex:
    """An interaction as the choice of a light reads it."""
    vertex = place_of(interaction)
    vertex.importance = total_importance(vertex.position, vertex.normal, scene)
    return vertex


@wp.func
def chosen_light(u: float, vertex: PathVertex, scene: wp.array[ShadingScene]) -> LightChoice:
    """The light to be sampled at a surface.

    Args:
        u: Random, 0..1.
        vertex: The surface.
        scene: With the lights.
    """
    choice = LightChoice()
    choice.number = -1
    if not (vertex.importance > 0.0 and vertex.importance < wp.inf):
        return choice
    rest = u * vertex.importance
    for number in range(choice_count(scene)):
        importance = light_importance(number, vertex.position, vertex.normal, scene)
        if importance > 0.0 and rest >= 0.0:
            choice.number = number
            choice.probability = importance / vertex.importance
            rest -= importance
    return choice


@wp.func
def choice_probability(number: int, vertex: PathVertex, scene: wp.array[ShadingScene]) -> float:
    """Probability with which ``chosen_light`` chooses light ``number`` at a surface."""
    if not (vertex.importance > 0.0 and vertex.importance < wp.inf):
        return 0.0
    return light_importance(number, vertex.position, vertex.normal, scene) / vertex.importance
