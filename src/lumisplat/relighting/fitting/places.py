"""Other places where lamps may be, from which the search begins anew: a lattice in the box that holds the scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lumisplat.math.arrays import Doubles
from lumisplat.math.nonnegative import nonnegative_least_squares
from lumisplat.relighting.fitting.columns import lifted
from lumisplat.relighting.fitting.guess import Guess, Guesser
from lumisplat.relighting.fitting.layers import unit
from lumisplat.scene.lights import Light
from lumisplat.scene.scene import Scene

_SWEEPS = 3
"""How often each lamp chooses among all places, the others being where they have chosen to be."""


def elsewhere(guesser: Guesser, guess: Guess, side: int) -> Scene:
    """The scene with its lamps at those places, of a lattice and where they are, that explain the photographs best.

    It is the same object if they are best where they are.

    Args:
        guesser: Of small pictures.
        guess: Where lamps are.
        side: Places along each side of the lattice.
    """
    task = guesser.task
    movable = [number for number in task.lights if any(m.light == number and m.kind == "position" for m in task.moves)]
    choices = {
        number: [guess.scene.lights[number], *_placed(guess.scene.lights[number], _lattice(guesser, side))]
        for number in movable
    }
    steady = [picture.mean(axis=0) for number, picture in guess.lights.items() if number not in movable]
    steady += list(guess.harmonics.mean(axis=0)[:1])
    pictures = list(steady)
    first: dict[int, int] = {}
    for number, lights in choices.items():
        first[number] = len(pictures)
        for light in lights:
            rows = guesser.layers.alone(guess.scene, unit(light), guesser.photographs, guess.fixed)
            pictures.append(rows.mean(axis=0))
    gram, moments = _products(guesser, guess, np.array(pictures))
    chosen = dict.fromkeys(movable, 0)
    for _ in range(_SWEEPS):
        before = dict(chosen)
        for number in movable:
            others = [first[other] + row for other, row in chosen.items() if other != number]
            gains = [
                _explained(gram, moments, [*range(len(steady)), *others, first[number] + row])
                for row in range(len(choices[number]))
            ]
            chosen[number] = int(np.argmax(gains))
        if chosen == before:
            break
    if not any(chosen.values()):
        return guess.scene
    lights = list(guess.scene.lights)
    for number, row in chosen.items():
        lights[number] = choices[number][row]
    return replace(guess.scene, lights=tuple(lights))


def _lattice(guesser: Guesser, side: int) -> Doubles:
    """Places in the box for lamps, shape (P, 3)."""
    shares = (np.arange(side) + 0.5) / side
    grid = np.stack(np.meshgrid(shares, shares, shares, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(guesser.task.low + grid * (guesser.task.high - guesser.task.low))


def _placed(light: Light, places: Doubles) -> list[Light]:
    return [replace(light, position=place) for place in places]  # pyright: ignore[reportCallIssue]


def _products(guesser: Guesser, guess: Guess, pictures: Doubles) -> tuple[Doubles, Doubles]:
    """Products of all pictures with each other and with the photographs, a matrix a channel."""
    observed = guesser.observed
    exposed = guesser.exposed(pictures, guess.gains)
    weights = observed.counts / observed.noise**2
    left = observed.target - guesser.exposed(guess.fixed.mean(axis=0), guess.gains)
    gram = np.einsum("inc,nc,jnc->cij", exposed, weights, exposed, optimize=True)
    return gram, np.einsum("inc,nc,nc->ci", exposed, weights, left, optimize=True)


def _explained(gram: Doubles, moments: Doubles, rows: list[int]) -> float:
    """How much of the squares some pictures explain, by channel with powers of its own."""
    total = 0.0
    for channel in range(3):
        part, toward = gram[channel][np.ix_(rows, rows)], moments[channel][rows]
        powers = nonnegative_least_squares(lifted(part, np.zeros(0)), toward)
        total += float(2.0 * toward @ powers - powers @ part @ powers)
    return total
