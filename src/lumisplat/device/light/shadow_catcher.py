"""What light that was added or blocked changes of a shadow catcher (docs/method/lighting.md#shadow-catchers)."""

import warp as wp

from lumisplat.device.structs.light import CatcherLight

wp.set_module_options({"enable_backward": False})


@wp.func
def catcher_received(light: CatcherLight) -> float:
    """Irradiance of a shadow catcher without anything that was added, in one channel."""
    rest = wp.where(light.ambient > 0.0, light.ambient, light.own_sent)
    return light.sent + wp.max(rest, light.least - light.sent)


@wp.func
def catcher_change(light: CatcherLight) -> float:
    """Relative change of the light on a shadow catcher by all that was added to its place, in one channel.

    `lumisplat.baking.gaussian_views.CatcherLight` is the same in NumPy.
    """
    change = light.change
    received = catcher_received(light)
    if light.ambient > 0.0:
        ambient = received - light.sent
        if light.own_sent > ambient:
            change += light.own_change * ambient / light.own_sent
        else:
            change += light.own_change - (ambient - light.own_sent) * light.blocked / light.ambient
    else:
        change += light.own_change
    if change == 0.0 or received <= 0.0:
        return 0.0
    return change / received


@wp.func
def weighted_factor(factor: float, weight: float) -> float:
    """The factor of a captured colour, as one of a pixel of which it has the share ``weight``."""
    return 1.0 + weight * (factor - 1.0)


@wp.func
def straight_factor(factor: wp.vec3, weight: float) -> wp.vec3:
    """The inverse of ``weighted_factor``, of three channels; 1 where nothing was captured."""
    if weight <= 0.0:
        return wp.vec3(1.0)
    return wp.max(wp.vec3(1.0) + (factor - wp.vec3(1.0)) / weight, wp.vec3(0.0))
