"""The result of a fit of lights: the scene in the light that was found, residuals, and remarks for people."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lumisplat.constants import ENVIRONMENT_ERRORS_MIN, ENVIRONMENT_SHARE_MIN, LUMINANCE, SH_C0
from lumisplat.math.arrays import Doubles
from lumisplat.math.color import encode_srgb
from lumisplat.relighting.fitting.parameters import FitOptions, FitTask, colors_of, share_at_white
from lumisplat.relighting.fitting.power_fit import (
    ENVIRONMENT_NAME,
    Candidate,
    Columns,
    PowerFitter,
    covariance,
    normal_equations,
    unknown_counts,
)
from lumisplat.relighting.fitting.search import anchor_of, joint_columns, slopes_of
from lumisplat.relighting.probe import EnvironmentProbe
from lumisplat.scene.camera import Camera
from lumisplat.scene.lights import Light, LightEnvironment
from lumisplat.scene.scene import Scene


@dataclass(frozen=True, slots=True, eq=False)
class FittedView:
    """A photograph and what explains it, at the resolution of the fit; both linear Rec.709, exposed."""

    camera: Camera
    """At that resolution, with the exposure that was found."""
    image: Doubles
    """Shape (H, W, 3)."""
    fitted: Doubles
    """Shape (H, W, 3)."""
    weights: Doubles
    """How much each channel of each pixel counted in the end, 0..1, shape (H, W, 3): 0 where it is clipped or masked,
    where a capture keeps its look or nothing is, and where nothing in the scene explains it."""
    residual: float
    """Root mean square difference of display values, 0..1, pixels counting by their weights."""
    clipped: int
    """Pixels of the photograph with a channel at an end of its range."""
    masked: int
    """Pixels of the photograph that the mask leaves out."""


@dataclass(frozen=True, slots=True, eq=False)
class LightFit:
    """What `fit_lights` has found."""

    scene: Scene
    """The scene with these lights, and base colours if they were asked for."""
    lights: tuple[Light, ...]
    """The L lights that were fitted, in the order of the scene; an environment of harmonics is the last one, if light
    of one was found."""
    shares: Doubles
    """Of the light that is explained, how much each light gives, shape (L,); the rest shines by itself."""
    standard_errors: Doubles
    """Of the lights' powers, colour times intensity, shape (L, 3); of harmonics, that of the mean radiance."""
    position_errors: Doubles
    """Standard errors of positions, scene units, shape (L, 3); NaN where they were not fitted."""
    environment: EnvironmentProbe | None
    """The harmonics that were found; None: none were asked for, or none of the light is theirs."""
    base_colors: dict[str, tuple[float, float, float]]
    """Those that were fitted, linear, by the names of materials; of captures, the mean over their Gaussians."""
    exposures: Doubles
    """Of the photographs, stops, shape (V,)."""
    views: tuple[FittedView, ...]
    """One a photograph."""
    remarks: tuple[str, ...]
    """What to know about the result, a line each."""

    def __repr__(self) -> str:
        residuals = ", ".join(f"{view.residual:.4f}" for view in self.views)
        return f"LightFit(lights={len(self.lights)}, views={len(self.views)}, residuals=[{residuals}])"


def result_of(
    given: Scene, options: FitOptions, fitter: PowerFitter, candidate: Candidate, certainty: Certainty
) -> LightFit:
    """What the last candidate means for the caller.

    Args:
        given: The caller's scene.
        options: What was asked for.
        fitter: Has the photographs.
        candidate: The last candidate.
        certainty: What it knows.
    """
    task, lit_scene = fitter.task, candidate.lit_scene
    lights_found = list(lit_scene.lights)
    for number in certainty.dark:  # nothing is known of it
        lights_found[number] = task.scene.lights[number]
    shares = _shares(fitter, candidate)
    has_environment = _has_environment(candidate, shares, certainty)
    if candidate.sh_renders.shape[1] and not has_environment:  # a scene with a black one would pass for lit by a sky
        del lights_found[-1]
    lights = tuple(lights_found[number] for number in task.lights) + ((lights_found[-1],) if has_environment else ())
    colors = colors_of(candidate.scene, task.base_colors)
    views = _views(fitter, candidate)
    return LightFit(
        scene=replace(lit_scene, lights=tuple(lights_found)),
        lights=lights,
        shares=shares[: len(lights)],
        standard_errors=certainty.powers[: len(lights)],
        position_errors=certainty.positions[: len(lights)],
        environment=EnvironmentProbe(candidate.coefficients) if has_environment else None,
        base_colors={
            base_color.name: (float(color[0]), float(color[1]), float(color[2]))
            for base_color, color in zip(task.base_colors, colors, strict=True)
        },
        exposures=np.log2(candidate.gains),
        views=views,
        remarks=_remarks_of(given, options, fitter, candidate, certainty, has_environment=has_environment),
    )


def _has_environment(candidate: Candidate, shares: Doubles, certainty: Certainty) -> bool:
    """Whether harmonics are more than what noise is taken for."""
    if not candidate.sh_renders.shape[1]:
        return False
    mean = SH_C0 * np.abs(candidate.coefficients[0])
    return bool(shares[-1] >= ENVIRONMENT_SHARE_MIN or (mean > ENVIRONMENT_ERRORS_MIN * certainty.powers[-1]).any())


def _views(fitter: PowerFitter, candidate: Candidate) -> tuple[FittedView, ...]:
    """The photographs beside what explains them."""
    views: list[FittedView] = []
    solution, observed = candidate.solution, fitter.observed
    shares = solution.weights * observed.noise**2
    for number, image in enumerate(fitter.images):
        pixels = fitter.view == number
        weights, fitted = (values[pixels].reshape(image.light.shape) for values in (shares, solution.model))
        difference = encode_srgb(image.light) - encode_srgb(np.maximum(fitted, 0.0))
        square = float((weights * difference**2).sum() / max(float(weights.sum()), 1e-12))
        camera = replace(image.camera, exposure=float(np.log2(candidate.gains[number])))
        views.append(
            FittedView(camera, image.light, fitted, weights, float(np.sqrt(square)), image.clipped, image.masked)
        )
    return tuple(views)


def _shares(fitter: PowerFitter, candidate: Candidate) -> Doubles:
    """Luminance that each light gives to what counts, of all that is explained there."""
    counts = fitter.observed.counts

    def brightness(render: Doubles) -> float:
        return float(((fitter.exposed(render, candidate.gains) * counts) @ np.array(LUMINANCE)).sum())

    parts = [brightness(candidate.powers[number] * render.mean(axis=0)) for number, render in candidate.lights.items()]
    if candidate.sh_renders.shape[1]:
        parts.append(brightness(np.einsum("knc,kc->nc", candidate.sh_renders.mean(axis=0), candidate.coefficients)))
    whole = sum(parts) + brightness(candidate.fixed.mean(axis=0))
    return np.array(parts) / whole if whole > 0.0 else np.zeros(len(parts))


_CLIPPED = 0.2
"""Share of a photograph's pixels from which on it is said that they are clipped: at an end of its range."""
_UNEXPLAINED = 0.1
"""Share of what counts from which on it is said that nothing explains it."""
_WHITE = 0.01
"""Share of a capture's Gaussians from which on it is said that they have become white."""
_OFF_BELOW = 1e-6
"""Share of the light below which a light is off."""


def _remarks_of(
    given: Scene,
    options: FitOptions,
    fitter: PowerFitter,
    candidate: Candidate,
    certainty: Certainty,
    *,
    has_environment: bool,
) -> tuple[str, ...]:
    """The lines; arguments as of ``result_of``, and whether light of harmonics was found."""
    return (
        *_fixed_remarks(given, options, fitter, has_environment=has_environment),
        *_base_color_remarks(fitter, candidate),
        *_light_remarks(fitter, candidate, certainty, has_environment=has_environment),
        *_image_remarks(fitter, candidate),
    )


def _fixed_remarks(given: Scene, options: FitOptions, fitter: PowerFitter, *, has_environment: bool) -> Iterator[str]:
    """What was fixed, as only products are seen."""
    task = fitter.task
    if task.degree is not None and any(isinstance(light, LightEnvironment) and light.enabled for light in given.lights):
        instead = f"replaced by harmonics of degree {task.degree}" if has_environment else "taken out"
        yield f"the scene's environment was {instead}"
    sought = {"positions": ("position", "direction"), "radii": ("radius",), "angles": ("inner", "outer")}
    for name, kinds in sought.items():
        if getattr(options, name) and not any(parameter.kind in kinds for parameter in task.light_parameters):
            yield f"{name} were asked for, and no light has any: nothing was looked for"
    if isinstance(options.exposure, str) and not task.exposed[0]:
        others = "; those of the others follow from it" if len(task.exposed) > 1 else ""
        yield (
            f"the exposure of {fitter.images[0].label} stays {np.log2(task.gains[0]):g} stops: nothing in the "
            f"scene shines by itself, so that only the product of light and exposure is seen{others}"
        )
    if task.anchors:
        yield (
            "base colours and lights are known up to a factor in each channel: the product of the base colours stays "
            "as the scene has it (name those that are unknown, and the others fix it)"
        )


def _base_color_remarks(fitter: PowerFitter, candidate: Candidate) -> Iterator[str]:
    """Captures that cannot be as bright as asked for."""
    for base_color in fitter.task.base_colors:
        share = share_at_white(candidate.scene, base_color)
        if share > _WHITE:
            yield f"{base_color.name}: {share:.0%} of its Gaussians have become white, and can be no brighter"


def _light_remarks(
    fitter: PowerFitter, candidate: Candidate, certainty: Certainty, *, has_environment: bool
) -> Iterator[str]:
    """What cannot be told of lights."""
    for number in certainty.dark:
        yield f"{light_name(candidate, number)}: none of its light is in the photographs, it stays as it was"
    for number, power in candidate.powers.items():
        if (
            number not in certainty.dark
            and fitter.task.scales
            and not (power > _OFF_BELOW * _brightest(candidate)).any()
        ):
            yield f"{light_name(candidate, number)}: it is off"
    if candidate.sh_renders.shape[1] and not has_environment:
        yield f"{ENVIRONMENT_NAME}: none of its light was found in the photographs, and the scene has none"
    for names in certainty.confounded:
        if ENVIRONMENT_NAME in names and not has_environment:
            continue
        if names == (ENVIRONMENT_NAME,):
            yield (
                f"{ENVIRONMENT_NAME}: some of its harmonics cannot be told from the photographs, and follow from the "
                "others"
            )
        elif len(names) == 1:
            yield f"{names[0]}: its numbers cannot all be told from the photographs, as some changes look alike"
        else:
            yield f"{' and '.join(names)} cannot be told apart in the photographs: only their sum is known"


def _brightest(candidate: Candidate) -> float:
    return max(float(power.max()) for power in candidate.powers.values())


def _image_remarks(fitter: PowerFitter, candidate: Candidate) -> Iterator[str]:
    """What was left out of photographs."""
    weights = candidate.solution.weights * fitter.observed.noise**2
    for number, image in enumerate(fitter.images):
        in_image = fitter.view == number
        pixels = image.full_size
        if image.clipped > _CLIPPED * pixels:
            share = image.clipped / pixels
            yield f"{image.label}: {share:.0%} of its pixels are clipped (a channel is black or white), and left out"
        counts = fitter.observed.counts[in_image]
        if not counts.any():
            yield f"{image.label}: nothing of it counts"
            continue
        unexplained = float((weights[in_image][counts] < 0.05).mean())
        if unexplained > _UNEXPLAINED:
            yield f"{image.label}: nothing in the scene explains {unexplained:.0%} of it, which was left out"


CONFOUNDED_BELOW = 1e-3
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
    confounded: tuple[tuple[str, ...], ...]
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
    lights = len(candidate.lights) if task.scales else 0
    counts = np.cumsum([0, *unknown_counts(joint.tints)])
    powers = np.zeros((len(candidate.lights) + bool(candidate.sh_renders.shape[1]), 3))
    channels = np.einsum("cku,u->kc", np.abs(joint.spread), errors)
    powers[:lights] = channels[:lights]
    if candidate.sh_renders.shape[1]:
        powers[-1] = channels[lights] * 0.5 / np.sqrt(np.pi)
    positions = np.full((len(powers), 3), np.nan)
    first = len(candidate.columns.tints)
    for row, parameter in enumerate(task.light_parameters):
        if parameter.kind == "position":
            positions[list(candidate.lights).index(parameter.light), parameter.axis] = errors[counts[first + row]]
    brightest = float(lengths[: counts[first]].max(initial=0.0))
    dark = tuple(
        number
        for row, number in enumerate(candidate.lights)
        if row < lights and lengths[counts[row] : counts[row + 1]].max() <= DARK_SHARE * brightest
    )
    visible = np.flatnonzero(lengths > DARK_SHARE * brightest)
    return Certainty(
        powers, positions, dark, _confounded(gram[np.ix_(visible, visible)], [names[row] for row in visible])
    )


def _confounded(gram: Doubles, names: Sequence[str]) -> tuple[tuple[str, ...], ...]:
    """Groups of names whose pictures depend on each other."""
    lengths = np.sqrt(np.diag(gram))
    values, vectors = np.linalg.eigh(gram / np.outer(lengths, lengths))
    groups: dict[tuple[str, ...], None] = {}
    for vector in vectors.T[values < CONFOUNDED_BELOW]:
        rows: list[int] = np.flatnonzero(np.abs(vector) > _PART).tolist()
        groups[tuple(dict.fromkeys(names[row] for row in rows))] = None
    return tuple(groups)


def _names(candidate: Candidate, task: FitTask, joint: Columns) -> list[str]:
    """What the unknowns are of."""
    columns = [light_name(candidate, number) for number in candidate.lights if task.scales]
    columns += [ENVIRONMENT_NAME] * candidate.sh_renders.shape[1]
    columns += [light_name(candidate, parameter.light) for parameter in task.light_parameters]
    columns += ["exposure"] * sum(task.exposed) + [base_color.name for base_color in task.base_colors]
    return [name for name, count in zip(columns, unknown_counts(joint.tints), strict=True) for _ in range(count)]


def light_name(candidate: Candidate, number: int) -> str:
    """What messages call a light."""
    return candidate.scene.lights[number].name or f"light{number}"
