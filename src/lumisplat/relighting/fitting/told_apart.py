"""How well a fit is determined: standard errors, lights that cannot be told apart, and those that are not seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lumisplat.constants.light_fit import ALIKE_BELOW, DARK_SHARE
from lumisplat.math.arrays import Doubles
from lumisplat.relighting.fitting.columns import Columns, covariance, normal_equations, unknown_counts
from lumisplat.relighting.fitting.guess import Guess, Guesser
from lumisplat.relighting.fitting.harmonics import NAME
from lumisplat.relighting.fitting.search import anchor_of, joint_columns, slopes_of
from lumisplat.relighting.fitting.task import FitTask

_PART = 0.3
"""Of a unit vector: what has at least this share of an eigenvector is named."""


@dataclass(frozen=True, slots=True, eq=False)
class Certainty:
    """What is known about a fit, besides its numbers."""

    powers: Doubles
    """Standard errors of the lights' powers, the mean radiance of harmonics last, shape (L, 3); 0 where they were
    given."""
    positions: Doubles
    """Standard errors of the positions, scene units, shape (L, 3); NaN where they were not fitted."""
    dark: tuple[int, ...]
    """Lights of which nothing is in the photographs."""
    alike: tuple[tuple[str, ...], ...]
    """Names of what cannot be told apart, a group each."""


def certainty_of(guesser: Guesser, guess: Guess) -> Certainty:
    """What a guess knows."""
    task = guesser.task
    joint = joint_columns(guess, slopes_of(guesser, guess))
    gram, _ = normal_equations(guesser.observed, joint, guess.solution.weights)
    held = anchor_of(guess, task.paints, gram) if task.anchors else np.zeros_like(gram)
    gram = gram + held
    errors = np.sqrt(np.diag(covariance(guesser.observed, joint, guess.solution, held)).clip(0.0))
    names = _names(guess, task, joint)
    lengths = np.sqrt(np.diag(gram).clip(0.0))
    lamps = len(guess.lights) if task.scales else 0
    counts = np.cumsum([0, *unknown_counts(joint.tints)])
    powers = np.zeros((len(guess.lights) + bool(guess.harmonics.shape[1]), 3))
    channels = np.einsum("cku,u->kc", np.abs(joint.spread), errors)
    powers[:lamps] = channels[:lamps]
    if guess.harmonics.shape[1]:
        powers[-1] = channels[lamps] * 0.5 / np.sqrt(np.pi)
    positions = np.full((len(powers), 3), np.nan)
    first = len(guess.columns.tints)
    for row, move in enumerate(task.moves):
        if move.kind == "position":
            positions[list(guess.lights).index(move.light), move.axis] = errors[counts[first + row]]
    brightest = float(lengths[: counts[first]].max(initial=0.0))
    dark = tuple(
        number
        for row, number in enumerate(guess.lights)
        if row < lamps and lengths[counts[row] : counts[row + 1]].max() <= DARK_SHARE * brightest
    )
    seen = np.flatnonzero(lengths > DARK_SHARE * brightest)
    return Certainty(powers, positions, dark, _alike(gram[np.ix_(seen, seen)], [names[row] for row in seen]))


def _alike(gram: Doubles, names: Sequence[str]) -> tuple[tuple[str, ...], ...]:
    """Groups of names whose pictures depend on each other."""
    lengths = np.sqrt(np.diag(gram))
    values, vectors = np.linalg.eigh(gram / np.outer(lengths, lengths))
    groups: dict[tuple[str, ...], None] = {}
    for vector in vectors.T[values < ALIKE_BELOW]:
        rows: list[int] = np.flatnonzero(np.abs(vector) > _PART).tolist()
        groups[tuple(dict.fromkeys(names[row] for row in rows))] = None
    return tuple(groups)


def _names(guess: Guess, task: FitTask, joint: Columns) -> list[str]:
    """What the unknowns are of."""
    columns = [light_name(guess, number) for number in guess.lights if task.scales]
    columns += [NAME] * guess.harmonics.shape[1]
    columns += [light_name(guess, move.light) for move in task.moves]
    columns += ["exposure"] * sum(task.exposed) + [paint.name for paint in task.paints]
    return [name for name, count in zip(columns, unknown_counts(joint.tints), strict=True) for _ in range(count)]


def light_name(guess: Guess, number: int) -> str:
    """What messages call a light."""
    return guess.scene.lights[number].name or f"light{number}"
