"""Where lamps are, and other numbers that pictures are not proportional to: Gauss-Newton, damped (Marquardt 1963)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lumisplat.constants.light_fit import (
    COLOR_STEP,
    DAMPING_MAX,
    DAMPING_START,
    MOVE_MAX,
    MOVED_LEAST,
    SEARCH_STEPS,
)
from lumisplat.math.arrays import Doubles, Rows
from lumisplat.math.nonnegative import bounded_least_squares
from lumisplat.relighting.fitting.columns import Columns, huber_cost, normal_equations, spread_of
from lumisplat.relighting.fitting.guess import Guess, Guesser
from lumisplat.relighting.fitting.moves import Move
from lumisplat.relighting.fitting.paints import Paint, colors_of, painted
from lumisplat.scene.lights import Light, PlacedLight
from lumisplat.scene.scene import Scene

_ANGLE_MAX, _STOPS_MAX = 0.3, 0.7
"""Largest steps of angles, radians, and of the logarithm of an exposure's factor."""
_ANCHOR = 1e3
"""How much heavier the mean of base colours weighs than all that is seen."""
_BETTER = 1e-3
"""Share of the cost that a step has to save to be followed by another."""


@dataclass(frozen=True, slots=True, eq=False)
class Slopes:
    """How the photographs change with the numbers of a guess."""

    pictures: Doubles
    """Derivatives, exposed, (2, J, N, 3): of moves, of exposures, of paints."""
    tints: tuple[Doubles | None, ...]
    """Moves and exposures are one number for all channels, paints one a channel."""


def search(guesser: Guesser, guess: Guess) -> Guess:
    """The best guess near one."""
    task, damping = guesser.task, DAMPING_START
    if not (task.moves or task.paints or any(task.exposed)):
        return guess
    for _ in range(SEARCH_STEPS):
        slopes = slopes_of(guesser, guess)
        cost = huber_cost(guesser.observed, guess.solution.model, guess.solution.deviation)
        while True:
            change = _change(guesser, guess, slopes, damping)
            other = guesser.moved(guess, *_applied(guesser, guess, change))
            new_cost = huber_cost(guesser.observed, other.solution.model, guess.solution.deviation)
            if new_cost < cost:
                break
            damping *= 6.0
            if damping > DAMPING_MAX:
                return guess
        damping = max(damping / 6.0, 1e-7)
        guess = other
        if new_cost > (1.0 - _BETTER) * cost or _is_short(guesser, change):
            break
    return guess


def slopes_of(guesser: Guesser, guess: Guess) -> Slopes:
    """By central differences of pictures."""
    task = guesser.task
    powers = guess.powers
    pictures = [powers[move.light] * _slope_of_move(guesser, guess, move) for move in task.moves]
    columns = [guesser.exposed(picture, guess.gains) for picture in pictures]
    tints: list[Doubles | None] = [np.ones(3)] * len(columns)
    for view, is_unknown in enumerate(task.exposed):
        if is_unknown:
            own = (guesser.view == view)[:, None]
            columns.append(np.stack([own * guess.solution.model] * 2))
            tints.append(np.ones(3))
    if task.paints:
        lit = guess.lit
        columns += [guesser.exposed(_slope_of_paint(guesser, lit, paint), guess.gains) for paint in task.paints]
        tints += [None] * len(task.paints)
    empty = np.zeros((2, 0, *guess.solution.model.shape))
    return Slopes(np.stack(columns, axis=1) if columns else empty, tuple(tints))


def _slope_of_move(guesser: Guesser, guess: Guess, move: Move) -> Doubles:
    """Of a light of power 1."""
    light = guess.scene.lights[move.light]
    ends = [move.applied(light, sign * move.step) for sign in (-1.0, 1.0)]
    way = 2.0 * move.step
    if move.kind not in ("position", "direction"):  # it may be at its bound
        way = _value(move, ends[1]) - _value(move, ends[0])
    scenes = [_with_light(guess.scene, move.light, end) for end in ends]
    before, after = (guesser.picture_of(guess, move.light, scene) for scene in scenes)
    return (after - before) / way if way > 0.0 else np.zeros_like(after)


def _slope_of_paint(guesser: Guesser, lit: Scene, paint: Paint) -> Doubles:
    """Of all light."""
    color = colors_of(lit, [paint])[0]
    ends = [np.clip(color + sign * COLOR_STEP, 0.0, 1.0) for sign in (-1.0, 1.0)]
    lights = [light for light in lit.lights if light.enabled]
    before, after = (guesser.layers.picture(painted(lit, {paint: end}), lights, guesser.photographs) for end in ends)
    return (after - before) / (ends[1] - ends[0])


def joint_columns(guess: Guess, slopes: Slopes) -> Columns:
    """The pictures of a guess, and after them how they change."""
    columns = guess.columns
    added = spread_of(slopes.tints).shape[2]
    return Columns(
        pictures=np.concatenate([columns.pictures, slopes.pictures], axis=1),
        fixed=columns.fixed,
        tints=(*columns.tints, *slopes.tints),
        bounded=np.pad(columns.bounded, ((0, 0), (0, added))),
        least=columns.least,
        ridge=np.pad(columns.ridge, (0, added)),
    )


def _change(guesser: Guesser, guess: Guess, slopes: Slopes, damping: float) -> Doubles:
    """The damped step of moves, exposures and paints, with the powers that go with it, shape (J',)."""
    task, joint = guesser.task, joint_columns(guess, slopes)
    gram, moments = normal_equations(guesser.observed, joint, guess.solution.weights)
    if task.anchors:
        gram = gram + anchor_of(guess, task.paints, gram)
    first = guess.columns.spread.shape[2]
    rows: Rows = np.arange(first, len(moments), dtype=np.int64)
    # Relative to what is left of a column once powers have taken their part: a radius changes a light's power, too.
    by_powers = np.linalg.solve(gram[:first, :first], gram[:first, first:])
    left = np.diag(gram)[first:] - np.einsum("ij,ij->j", gram[:first, first:], by_powers)
    gram[rows, rows] += damping * np.maximum(left, 0.0)
    bounded, least = joint.bounded, joint.least
    if task.paints:  # base colours stay within 0..1
        color = colors_of(guess.scene, task.paints).ravel()
        ends = np.zeros((color.size, len(moments)))
        ends[:, len(moments) - color.size :] = np.eye(color.size)
        bounded, least = np.vstack([bounded, ends, -ends]), np.concatenate([least, -color, color - 1.0])
    return bounded_least_squares(gram, moments, bounded, least)[first:]


def anchor_of(guess: Guess, paints: tuple[Paint, ...], gram: Doubles) -> Doubles:
    """Holds the product of all base colours, by channel: lights could else be stronger and surfaces darker."""
    colors = np.maximum(colors_of(guess.scene, paints), 1e-3)
    anchor = np.zeros_like(gram)
    first = len(gram) - 3 * len(paints)
    for channel in range(3):
        row = np.zeros(len(gram))
        row[first + channel :: 3] = 1.0 / colors[:, channel]
        anchor += _ANCHOR * float(np.diag(gram)[first:].max()) / float(row @ row) * np.outer(row, row)
    return anchor


def _applied(guesser: Guesser, guess: Guess, change: Doubles) -> tuple[Scene, Doubles]:
    """The scene and the exposures after a step, which is cut where it is too long."""
    task, scene, gains = guesser.task, guess.scene, guess.gains.copy()
    moves = _shortened(guesser, change[: len(task.moves)])
    lights: dict[int, Light] = {number: scene.lights[number] for number in task.lights}
    for move, amount in zip(task.moves, moves, strict=True):
        lights[move.light] = move.applied(lights[move.light], float(amount))
        if move.kind == "position":
            lights[move.light] = _inside(lights[move.light], task.low, task.high)
    for number, light in lights.items():
        scene = scene if light is scene.lights[number] else _with_light(scene, number, light)
    rest = change[len(task.moves) :]
    for view in np.flatnonzero(task.exposed):
        gains[view] *= np.exp(np.clip(rest[0], -_STOPS_MAX, _STOPS_MAX))
        rest = rest[1:]
    if task.paints:
        colors = colors_of(scene, task.paints) + rest.reshape(-1, 3)
        scene = painted(scene, dict(zip(task.paints, colors, strict=True)))
    return scene, gains


def _shortened(guesser: Guesser, amounts: Doubles) -> Doubles:
    """Amounts of the moves, none of which is too long."""
    task = guesser.task
    result = amounts.copy()
    for number in task.lights:
        rows = [row for row, move in enumerate(task.moves) if move.light == number and move.kind == "position"]
        length = float(np.linalg.norm(amounts[rows]))
        result[rows] *= min(1.0, MOVE_MAX * task.size / length) if length > 0.0 else 1.0
    for row, move in enumerate(task.moves):
        if move.kind in ("direction", "inner", "outer"):
            result[row] = np.clip(result[row], -_ANGLE_MAX, _ANGLE_MAX)
    return result


def _is_short(guesser: Guesser, change: Doubles) -> bool:
    """Whether a step hardly changed anything."""
    task = guesser.task
    units = [task.size if move.kind in ("position", "radius") else 1.0 for move in task.moves]
    scaled = np.abs(change) / np.concatenate([units, np.ones(len(change) - len(units))])
    return bool(scaled.max(initial=0.0) < MOVED_LEAST)


def _inside(light: Light, low: Doubles, high: Doubles) -> Light:
    """The light in the box for lamps."""
    assert isinstance(light, PlacedLight)
    place = np.array(light.position)
    held = np.clip(place, low, high)
    return light if (held == place).all() else replace(light, position=held)


def _with_light(scene: Scene, number: int, light: Light) -> Scene:
    lights = list(scene.lights)
    lights[number] = light
    return replace(scene, lights=tuple(lights))


def _value(move: Move, light: Light) -> float:
    """The number that a move of a radius or a cone changes."""
    return float(getattr(light, "radius" if move.kind == "radius" else f"{move.kind}_angle"))
