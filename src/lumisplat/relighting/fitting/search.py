"""Searches light positions, sizes and directions, exposures and base colours by Gauss-Newton (Marquardt 1963).

A lattice of positions in the box of the scene gives further starting points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lumisplat.constants import DAMPING_MAX, DAMPING_START
from lumisplat.math.arrays import Doubles, Rows
from lumisplat.math.nonnegative import bounded_least_squares, nonnegative_least_squares
from lumisplat.relighting.fitting.light_layers import unit
from lumisplat.relighting.fitting.parameters import BaseColor, LightParameter, colors_of, with_base_colors
from lumisplat.relighting.fitting.power_fit import (
    Candidate,
    Columns,
    PowerFitter,
    huber_cost,
    lifted,
    normal_equations,
    spread_of,
)
from lumisplat.scene.lights import Light, PlacedLight
from lumisplat.scene.scene import Scene

COLOR_STEP = 0.04
"""Step to either side, linear colour, in central differences of renders with respect to base colours."""

STEP_LENGTH_MAX = 0.15
"""Longest displacement of a light in one Gauss-Newton step, relative to the size of the scene."""

STEP_MIN = 2e-4
"""The search ends at a step with all components below this; lengths count relative to the scene's size."""

SEARCH_STEPS = 25
"""Maximum number of Gauss-Newton steps at each resolution."""

_ANGLE_MAX, _STOPS_MAX = 0.3, 0.7
"""Largest change in one Gauss-Newton step of a direction or cone angle, radians (`_ANGLE_MAX`), and of the natural
logarithm of an exposure factor (`_STOPS_MAX`)."""
_ANCHOR = 1e3
"""Weight of the quadratic term that holds the product of the base colours; the largest weight of the images is 1."""
_GAIN_MIN = 1e-3
"""The search ends at a step that decreases the cost by less than this fraction."""


@dataclass(frozen=True, slots=True, eq=False)
class Slopes:
    """Derivatives of the modelled images by light parameters, exposures and base colours, for one candidate."""

    renders: Doubles
    """J derivatives of the N pixels' light, times exposure: with respect to light parameters, then exposures, then
    base colours. There are two of each, with independent noise; shape (2, J, N, 3)."""
    tints: tuple[Doubles | None, ...]
    """Tint of each derivative: (1, 1, 1) for light parameters and exposures, which have one unknown; None for base
    colours, which have one unknown per channel."""


def search(fitter: PowerFitter, candidate: Candidate) -> Candidate:
    """Returns a candidate at a local minimum of the Huber cost, by damped Gauss-Newton steps from ``candidate``."""
    task, damping = fitter.task, DAMPING_START
    if not (task.light_parameters or task.base_colors or any(task.exposed)):
        return candidate
    for _ in range(SEARCH_STEPS):
        slopes = slopes_of(fitter, candidate)
        cost = huber_cost(fitter.observed, candidate.solution.model, candidate.solution.deviation)
        while True:
            change = _change(fitter, candidate, slopes, damping)
            other = fitter.moved(candidate, *_applied(fitter, candidate, change))
            new_cost = huber_cost(fitter.observed, other.solution.model, candidate.solution.deviation)
            if new_cost < cost:
                break
            damping *= 6.0
            if damping > DAMPING_MAX:
                return candidate
        damping = max(damping / 6.0, 1e-7)
        candidate = other
        if new_cost > (1.0 - _GAIN_MIN) * cost or _is_short(fitter, change):
            break
    return candidate


def slopes_of(fitter: PowerFitter, candidate: Candidate) -> Slopes:
    """Computes a candidate's `Slopes`: central differences of renders; those of exposures need no renders."""
    task = fitter.task
    powers = candidate.powers
    renders = [
        powers[parameter.light] * _slope_of_parameter(fitter, candidate, parameter)
        for parameter in task.light_parameters
    ]
    columns = [fitter.exposed(render, candidate.gains) for render in renders]
    tints: list[Doubles | None] = [np.ones(3)] * len(columns)
    for view, is_unknown in enumerate(task.exposed):
        if is_unknown:
            pixels = (fitter.view == view)[:, None]
            columns.append(np.stack([pixels * candidate.solution.model] * 2))
            tints.append(np.ones(3))
    if task.base_colors:
        lit_scene = candidate.lit_scene
        columns += [
            fitter.exposed(_slope_of_base_color(fitter, lit_scene, base_color), candidate.gains)
            for base_color in task.base_colors
        ]
        tints += [None] * len(task.base_colors)
    empty = np.zeros((2, 0, *candidate.solution.model.shape))
    return Slopes(np.stack(columns, axis=1) if columns else empty, tuple(tints))


def _slope_of_parameter(fitter: PowerFitter, candidate: Candidate, parameter: LightParameter) -> Doubles:
    """Returns the derivative of a light's render at power 1 by its ``parameter``, a central difference, (2, N, 3)."""
    light = candidate.scene.lights[parameter.light]
    ends = [parameter.applied(light, sign * parameter.step) for sign in (-1.0, 1.0)]
    span = 2.0 * parameter.step
    if parameter.kind not in ("position", "direction"):  # the parameter may be at its bound
        span = _value(parameter, ends[1]) - _value(parameter, ends[0])
    scenes = [_with_light(candidate.scene, parameter.light, end) for end in ends]
    before, after = (fitter.render_of(candidate, parameter.light, scene) for scene in scenes)
    return (after - before) / span if span > 0.0 else np.zeros_like(after)


def _slope_of_base_color(fitter: PowerFitter, lit_scene: Scene, base_color: BaseColor) -> Doubles:
    """Returns the derivative of the render under all lights by ``base_color``, a central difference, (2, N, 3)."""
    color = colors_of(lit_scene, [base_color])[0]
    ends = [np.clip(color + sign * COLOR_STEP, 0.0, 1.0) for sign in (-1.0, 1.0)]
    lights = [light for light in lit_scene.lights if light.enabled]
    before, after = (
        fitter.layers.render(with_base_colors(lit_scene, {base_color: end}), lights, fitter.images) for end in ends
    )
    return (after - before) / (ends[1] - ends[0])


def joint_columns(candidate: Candidate, slopes: Slopes) -> Columns:
    """Returns the linear model with all unknowns: light powers, SH, and steps along the candidate's `Slopes`."""
    columns = candidate.columns
    added = spread_of(slopes.tints).shape[2]
    return Columns(
        renders=np.concatenate([columns.renders, slopes.renders], axis=1),
        fixed=columns.fixed,
        tints=(*columns.tints, *slopes.tints),
        bounded=np.pad(columns.bounded, ((0, 0), (0, added))),
        least=columns.least,
        ridge=np.pad(columns.ridge, (0, added)),
    )


def _change(fitter: PowerFitter, candidate: Candidate, slopes: Slopes, damping: float) -> Doubles:
    """Returns the damped Gauss-Newton step: one number per light parameter and exposure, three per base colour.

    The powers are solved for in the same system, so that the step accounts for their change.
    """
    task, joint = fitter.task, joint_columns(candidate, slopes)
    gram, moments = normal_equations(fitter.observed, joint, candidate.solution.weights)
    if task.anchors:
        gram = gram + anchor_of(candidate, task.base_colors, gram)
    first = candidate.columns.spread.shape[2]
    rows: Rows = np.arange(first, len(moments), dtype=np.int64)
    # Damping is relative to a column's part that powers do not explain: a radius also changes a light's power.
    by_powers = np.linalg.solve(gram[:first, :first], gram[:first, first:])
    left = np.diag(gram)[first:] - np.einsum("ij,ij->j", gram[:first, first:], by_powers)
    gram[rows, rows] += damping * np.maximum(left, 0.0)
    bounded, least = joint.bounded, joint.least
    if task.base_colors:  # base colours stay within 0..1
        color = colors_of(candidate.scene, task.base_colors).ravel()
        ends = np.zeros((color.size, len(moments)))
        ends[:, len(moments) - color.size :] = np.eye(color.size)
        bounded, least = np.vstack([bounded, ends, -ends]), np.concatenate([least, -color, color - 1.0])
    return bounded_least_squares(gram, moments, bounded, least)[first:]


def anchor_of(candidate: Candidate, base_colors: tuple[BaseColor, ...], gram: Doubles) -> Doubles:
    """Returns a matrix, (U, U), to be added to ``gram``; it holds the product of all base colours in each channel.

    Without the matrix, lights could become stronger and surfaces darker without a change of the images.
    """
    colors = np.maximum(colors_of(candidate.scene, base_colors), 1e-3)
    anchor = np.zeros_like(gram)
    first = len(gram) - 3 * len(base_colors)
    for channel in range(3):
        row = np.zeros(len(gram))
        row[first + channel :: 3] = 1.0 / colors[:, channel]
        anchor += _ANCHOR * float(np.diag(gram)[first:].max()) / float(row @ row) * np.outer(row, row)
    return anchor


def _applied(fitter: PowerFitter, candidate: Candidate, change: Doubles) -> tuple[Scene, Doubles]:
    """Returns scene and exposure factors after the step ``change``, with its components cut to their limits."""
    task, scene, gains = fitter.task, candidate.scene, candidate.gains.copy()
    light_parameters = _shortened(fitter, change[: len(task.light_parameters)])
    lights: dict[int, Light] = {number: scene.lights[number] for number in task.lights}
    for parameter, amount in zip(task.light_parameters, light_parameters, strict=True):
        lights[parameter.light] = parameter.applied(lights[parameter.light], float(amount))
        if parameter.kind == "position":
            lights[parameter.light] = _inside(lights[parameter.light], task.low, task.high)
    for number, light in lights.items():
        scene = scene if light is scene.lights[number] else _with_light(scene, number, light)
    rest = change[len(task.light_parameters) :]
    for view in np.flatnonzero(task.exposed):
        gains[view] *= np.exp(np.clip(rest[0], -_STOPS_MAX, _STOPS_MAX))
        rest = rest[1:]
    if task.base_colors:
        colors = colors_of(scene, task.base_colors) + rest.reshape(-1, 3)
        scene = with_base_colors(scene, dict(zip(task.base_colors, colors, strict=True)))
    return scene, gains


def _shortened(fitter: PowerFitter, amounts: Doubles) -> Doubles:
    """Limits a step of the light parameters: displacements to `STEP_LENGTH_MAX`, angles to `_ANGLE_MAX`."""
    task = fitter.task
    result = amounts.copy()
    for number in task.lights:
        rows = [
            row
            for row, parameter in enumerate(task.light_parameters)
            if parameter.light == number and parameter.kind == "position"
        ]
        length = float(np.linalg.norm(amounts[rows]))
        result[rows] *= min(1.0, STEP_LENGTH_MAX * task.size / length) if length > 0.0 else 1.0
    for row, parameter in enumerate(task.light_parameters):
        if parameter.kind in ("direction", "inner", "outer"):
            result[row] = np.clip(result[row], -_ANGLE_MAX, _ANGLE_MAX)
    return result


def _is_short(fitter: PowerFitter, change: Doubles) -> bool:
    """Returns whether all components of a step are below `STEP_MIN`; lengths count relative to the scene's size."""
    task = fitter.task
    units = [task.size if parameter.kind in ("position", "radius") else 1.0 for parameter in task.light_parameters]
    scaled = np.abs(change) / np.concatenate([units, np.ones(len(change) - len(units))])
    return bool(scaled.max(initial=0.0) < STEP_MIN)


def _inside(light: Light, low: Doubles, high: Doubles) -> Light:
    """Returns the light, moved into the box with corners ``low`` and ``high`` if it is outside."""
    assert isinstance(light, PlacedLight)
    position = np.array(light.position)
    clipped = np.clip(position, low, high)
    return light if (clipped == position).all() else replace(light, position=clipped)


def _with_light(scene: Scene, number: int, light: Light) -> Scene:
    lights = list(scene.lights)
    lights[number] = light
    return replace(scene, lights=tuple(lights))


def _value(parameter: LightParameter, light: Light) -> float:
    """Returns the light's present radius or cone angle, whichever ``parameter`` is."""
    return float(getattr(light, "radius" if parameter.kind == "radius" else f"{parameter.kind}_angle"))


_SWEEPS = 3
"""Maximum number of sweeps over the lights. In a sweep, one light after the other takes its best trial position while
all others stay.
"""


def lattice_search(fitter: PowerFitter, candidate: Candidate, side: int) -> Scene:
    """Moves each light to the point of a lattice at which the images' residual is smallest, or keeps its position.

    The same scene object is returned if all lights stay.

    Args:
        fitter: Fitter of small renders.
        candidate: Lights at their present positions, with renders.
        side: Lattice points along each side of the box.
    """
    task = fitter.task
    movable = [
        number
        for number in task.lights
        if any(parameter.light == number and parameter.kind == "position" for parameter in task.light_parameters)
    ]
    choices = {
        number: [candidate.scene.lights[number], *_placed(candidate.scene.lights[number], _lattice(fitter, side))]
        for number in movable
    }
    fixed_lights = [render.mean(axis=0) for number, render in candidate.lights.items() if number not in movable]
    fixed_lights += list(candidate.sh_renders.mean(axis=0)[:1])
    renders = list(fixed_lights)
    first: dict[int, int] = {}
    for number, lights in choices.items():
        first[number] = len(renders)
        for light in lights:
            rows = fitter.layers.render_light(candidate.scene, unit(light), fitter.images, candidate.fixed)
            renders.append(rows.mean(axis=0))
    gram, moments = _products(fitter, candidate, np.array(renders))
    chosen = dict.fromkeys(movable, 0)
    for _ in range(_SWEEPS):
        before = dict(chosen)
        for number in movable:
            others = [first[other] + row for other, row in chosen.items() if other != number]
            gains = [
                _explained(gram, moments, [*range(len(fixed_lights)), *others, first[number] + row])
                for row in range(len(choices[number]))
            ]
            chosen[number] = int(np.argmax(gains))
        if chosen == before:
            break
    if not any(chosen.values()):
        return candidate.scene
    lights = list(candidate.scene.lights)
    for number, row in chosen.items():
        lights[number] = choices[number][row]
    return replace(candidate.scene, lights=tuple(lights))


def _lattice(fitter: PowerFitter, side: int) -> Doubles:
    """Returns the ``side``^3 points of an even lattice in the box in which lights may move, shape (P, 3)."""
    shares = (np.arange(side) + 0.5) / side
    grid = np.stack(np.meshgrid(shares, shares, shares, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(fitter.task.low + grid * (fitter.task.high - fitter.task.low))


def _placed(light: Light, positions: Doubles) -> list[Light]:
    return [replace(light, position=position) for position in positions]  # pyright: ignore[reportCallIssue]


def _products(fitter: PowerFitter, candidate: Candidate, renders: Doubles) -> tuple[Doubles, Doubles]:
    """Returns weighted inner products per channel: of R renders with each other, and of R renders with the images.

    Emission is subtracted from the images first. The shapes are (3, R, R) and (3, R).
    """
    observed = fitter.observed
    exposed = fitter.exposed(renders, candidate.gains)
    weights = observed.counts / observed.noise**2
    left = observed.target - fitter.exposed(candidate.fixed.mean(axis=0), candidate.gains)
    gram = np.einsum("inc,nc,jnc->cij", exposed, weights, exposed, optimize=True)
    return gram, np.einsum("inc,nc,nc->ci", exposed, weights, left, optimize=True)


def _explained(gram: Doubles, moments: Doubles, rows: list[int]) -> float:
    """Returns by how much the renders ``rows``, with their best powers, decrease the images' squared residuals."""
    total = 0.0
    for channel in range(3):
        part, toward = gram[channel][np.ix_(rows, rows)], moments[channel][rows]
        powers = nonnegative_least_squares(lifted(part, np.zeros(0)), toward)
        total += float(2.0 * toward @ powers - powers @ part @ powers)
    return total
