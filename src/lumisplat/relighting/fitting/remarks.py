"""What to know about a fit, in lines that people read: what was held, what cannot be told, what was left out."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lumisplat.relighting.fitting.guess import Guess, Guesser
from lumisplat.relighting.fitting.harmonics import NAME
from lumisplat.relighting.fitting.paints import share_at_white
from lumisplat.relighting.fitting.task import FitOptions
from lumisplat.relighting.fitting.told_apart import Certainty, light_name
from lumisplat.scene.lights import LightEnvironment
from lumisplat.scene.scene import Scene

_CLIPPED = 0.2
"""Share of a photograph's pixels from which on it is said that they are clipped: at an end of its range."""
_UNEXPLAINED = 0.1
"""Share of what counts from which on it is said that nothing explains it."""
_WHITE = 0.01
"""Share of a capture's Gaussians from which on it is said that they have become white."""
_OFF = 1e-6
"""Share of the light below which a light is off."""


def remarks_of(
    given: Scene, options: FitOptions, guesser: Guesser, guess: Guess, certainty: Certainty, *, has_sky: bool
) -> tuple[str, ...]:
    """The lines; arguments as of ``result_of``, and whether light of harmonics was found."""
    return (
        *_held(given, options, guesser, has_sky=has_sky),
        *_colors(guesser, guess),
        *_lights(guesser, guess, certainty, has_sky=has_sky),
        *_photographs(guesser, guess),
    )


def _held(given: Scene, options: FitOptions, guesser: Guesser, *, has_sky: bool) -> Iterator[str]:
    """What was fixed, as only products are seen."""
    task = guesser.task
    if task.degree is not None and any(isinstance(one, LightEnvironment) and one.enabled for one in given.lights):
        instead = f"replaced by harmonics of degree {task.degree}" if has_sky else "taken out"
        yield f"the scene's environment was {instead}"
    sought = {"positions": ("position", "direction"), "radii": ("radius",), "angles": ("inner", "outer")}
    for name, kinds in sought.items():
        if getattr(options, name) and not any(move.kind in kinds for move in task.moves):
            yield f"{name} were asked for, and no light has any: nothing was looked for"
    if isinstance(options.exposure, str) and not task.exposed[0]:
        others = "; those of the others follow from it" if len(task.exposed) > 1 else ""
        yield (
            f"the exposure of {guesser.photographs[0].label} stays {np.log2(task.gains[0]):g} stops: nothing in the "
            f"scene shines by itself, so that only the product of light and exposure is seen{others}"
        )
    if task.anchors:
        yield (
            "base colours and lights are known up to a factor in each channel: the product of the base colours stays "
            "as the scene has it (name those that are unknown, and the others fix it)"
        )


def _colors(guesser: Guesser, guess: Guess) -> Iterator[str]:
    """Captures that cannot be as bright as asked for."""
    for paint in guesser.task.paints:
        share = share_at_white(guess.scene, paint)
        if share > _WHITE:
            yield f"{paint.name}: {share:.0%} of its Gaussians have become white, and can be no brighter"


def _lights(guesser: Guesser, guess: Guess, certainty: Certainty, *, has_sky: bool) -> Iterator[str]:
    """What cannot be told of lights."""
    for number in certainty.dark:
        yield f"{light_name(guess, number)}: none of its light is in the photographs, it stays as it was"
    for number, power in guess.powers.items():
        if number not in certainty.dark and guesser.task.scales and not (power > _OFF * _brightest(guess)).any():
            yield f"{light_name(guess, number)}: it is off"
    if guess.harmonics.shape[1] and not has_sky:
        yield f"{NAME}: none of its light was found in the photographs, and the scene has none"
    for names in certainty.alike:
        if NAME in names and not has_sky:
            continue
        if names == (NAME,):
            yield f"{NAME}: some of its harmonics cannot be told from the photographs, and follow from the others"
        elif len(names) == 1:
            yield f"{names[0]}: its numbers cannot all be told from the photographs, as some changes look alike"
        else:
            yield f"{' and '.join(names)} cannot be told apart in the photographs: only their sum is known"


def _brightest(guess: Guess) -> float:
    return max(float(power.max()) for power in guess.powers.values())


def _photographs(guesser: Guesser, guess: Guess) -> Iterator[str]:
    """What was left out of photographs."""
    weights = guess.solution.weights * guesser.observed.noise**2
    for number, one in enumerate(guesser.photographs):
        own = guesser.view == number
        pixels = one.full_size
        if one.clipped > _CLIPPED * pixels:
            share = one.clipped / pixels
            yield f"{one.label}: {share:.0%} of its pixels are clipped (a channel is black or white), and left out"
        counts = guesser.observed.counts[own]
        if not counts.any():
            yield f"{one.label}: nothing of it counts"
            continue
        unexplained = float((weights[own][counts] < 0.05).mean())
        if unexplained > _UNEXPLAINED:
            yield f"{one.label}: nothing in the scene explains {unexplained:.0%} of it, which was left out"
