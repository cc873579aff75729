"""Reports how well a fit is determined: standard errors, lights that cannot be separated, and those out of view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lumisplat.math.arrays import Doubles
from lumisplat.relighting.fitting.normal_equations import Columns, covariance, normal_equations, unknown_counts
from lumisplat.relighting.fitting.parameters import FitTask
from lumisplat.relighting.fitting.power_fit import NAME, Candidate, PowerFitter
from lumisplat.relighting.fitting.search import anchor_of, joint_columns, slopes_of

ALIKE_BELOW = 1e-3
"""Eigenvalue of the columns' correlations below which those that its vector is made of cannot be told apart: two of
them correlate to 0.999."""

DARK_SHARE = 1e-5
"""Of the brightest column's length: a light of that little is not in the photographs."""

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


def certainty_of(fitter: PowerFitter, candidate: Candidate) -> Certainty:
    """A scene with candidate lights, their images, and the powers that explain the photographs best."""
    task = fitter.task
    joint = joint_columns(candidate, slopes_of(fitter, candidate))
    gram, _ = normal_equations(fitter.observed, joint, candidate.solution.weights)
    held = anchor_of(candidate, task.base_colors, gram) if task.anchors else np.zeros_like(gram)
    gram = gram + held
    errors = np.sqrt(np.diag(covariance(fitter.observed, joint, candidate.solution, held)).clip(0.0))
    names = _names(candidate, task, joint)
    lengths = np.sqrt(np.diag(gram).clip(0.0))
    lamps = len(candidate.lights) if task.scales else 0
    counts = np.cumsum([0, *unknown_counts(joint.tints)])
    powers = np.zeros((len(candidate.lights) + bool(candidate.harmonics.shape[1]), 3))
    channels = np.einsum("cku,u->kc", np.abs(joint.spread), errors)
    powers[:lamps] = channels[:lamps]
    if candidate.harmonics.shape[1]:
        powers[-1] = channels[lamps] * 0.5 / np.sqrt(np.pi)
    positions = np.full((len(powers), 3), np.nan)
    first = len(candidate.columns.tints)
    for row, move in enumerate(task.light_parameters):
        if move.kind == "position":
            positions[list(candidate.lights).index(move.light), move.axis] = errors[counts[first + row]]
    brightest = float(lengths[: counts[first]].max(initial=0.0))
    dark = tuple(
        number
        for row, number in enumerate(candidate.lights)
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


def _names(candidate: Candidate, task: FitTask, joint: Columns) -> list[str]:
    """What the unknowns are of."""
    columns = [light_name(candidate, number) for number in candidate.lights if task.scales]
    columns += [NAME] * candidate.harmonics.shape[1]
    columns += [light_name(candidate, move.light) for move in task.light_parameters]
    columns += ["exposure"] * sum(task.exposed) + [paint.name for paint in task.base_colors]
    return [name for name, count in zip(columns, unknown_counts(joint.tints), strict=True) for _ in range(count)]


def light_name(candidate: Candidate, number: int) -> str:
    """What messages call a light."""
    return candidate.scene.lights[number].name or f"light{number}"
