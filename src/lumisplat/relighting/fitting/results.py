"""The result of a light fit: the scene under the fitted lights, residuals and remarks."""

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
    """One fitted image and the model's render of it, both linear Rec.709 times exposure, at the fit's resolution."""

    camera: Camera
    """Camera at the resolution of the fit, with the fitted exposure."""
    image: Doubles
    """Linear light of the image, downscaled to the resolution of the fit, shape (H, W, 3)."""
    fitted: Doubles
    """Linear light that the fitted scene gives in this view: emission plus all lights' renders, shape (H, W, 3)."""
    weights: Doubles
    """Final weight of each channel of each pixel, 0..1, shape (H, W, 3). It is 0 if the pixel is clipped or masked,
    shows an unlit capture or background, or is not explained by the model."""
    residual: float
    """Weighted root mean square difference of display values between image and model, 0..1."""
    clipped: int
    """Number of the image's pixels that were not fitted because a channel is at an end of its range, black or white."""
    masked: int
    """Number of the image's pixels that were not fitted because the user's mask excludes them."""


@dataclass(frozen=True, slots=True, eq=False)
class LightFit:
    """Result of `fit_lights`: L fitted lights, base colours and exposures, with standard errors and residuals."""

    scene: Scene
    """The caller's scene with the fitted lights, and the fitted base colours of meshes and captures."""
    lights: tuple[Light, ...]
    """The L fitted lights in the scene's order. The last one is the SH environment, if the images show light from it.
    """
    shares: Doubles
    """Each light's fraction of the modelled luminance of the fitted pixels, shape (L,); the remainder is emission."""
    standard_errors: Doubles
    """Standard errors of the lights' powers (colour times intensity), shape (L, 3); in the row of an SH environment,
    of the environment's mean radiance."""
    position_errors: Doubles
    """Standard errors of the positions, scene units, shape (L, 3); NaN where positions were not fitted."""
    environment: EnvironmentProbe | None
    """The fitted SH environment; None if none was to be fitted, or the images show no light from it."""
    base_colors: dict[str, tuple[float, float, float]]
    """Fitted base colours, linear, by the name of the material or capture; for a capture, the mean over its Gaussians.
    """
    exposures: Doubles
    """Exposures of the V images after the fit, stops, shape (V,); exposures that are not fitted keep their given
    value."""
    views: tuple[FittedView, ...]
    """For each fitted image: the image, the model's render of it, weights and residual."""
    remarks: tuple[str, ...]
    """Sentences for the user on problems of the fit, such as lights that the images cannot distinguish or clipped
    pixels."""

    def __repr__(self) -> str:
        residuals = ", ".join(f"{view.residual:.4f}" for view in self.views)
        return f"LightFit(lights={len(self.lights)}, views={len(self.views)}, residuals=[{residuals}])"


def result_of(
    given: Scene, options: FitOptions, fitter: PowerFitter, candidate: Candidate, certainty: Certainty
) -> LightFit:
    """Converts the best candidate of a fit to the `LightFit` that the caller gets.

    Args:
        given: Scene that the caller passed to `fit_lights`.
        options: Options that the caller passed to `fit_lights`.
        fitter: Fitter with the images.
        candidate: Fitted lights, base colours and exposures.
        certainty: Standard errors, and unknowns that could not be estimated.
    """
    task, lit_scene = fitter.task, candidate.lit_scene
    lights_found = list(lit_scene.lights)
    for number in certainty.dark:  # the images do not show it
        lights_found[number] = task.scene.lights[number]
    shares = _shares(fitter, candidate)
    has_environment = _has_environment(candidate, shares, certainty)
    if candidate.sh_renders.shape[1] and not has_environment:  # a black environment would count as a light
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
    """Returns whether the fitted SH environment gives a relevant share of light, or significantly more than none."""
    if not candidate.sh_renders.shape[1]:
        return False
    mean = SH_C0 * np.abs(candidate.coefficients[0])
    return bool(shares[-1] >= ENVIRONMENT_SHARE_MIN or (mean > ENVIRONMENT_ERRORS_MIN * certainty.powers[-1]).any())


def _views(fitter: PowerFitter, candidate: Candidate) -> tuple[FittedView, ...]:
    """Returns for each image the `FittedView`: the image, the candidate's model of it, weights and residual."""
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
    """Returns each of L lights' fraction of the modelled luminance of the fitted pixels, shape (L,)."""
    counts = fitter.observed.counts

    def brightness(render: Doubles) -> float:
        return float(((fitter.exposed(render, candidate.gains) * counts) @ np.array(LUMINANCE)).sum())

    parts = [brightness(candidate.powers[number] * render.mean(axis=0)) for number, render in candidate.lights.items()]
    if candidate.sh_renders.shape[1]:
        parts.append(brightness(np.einsum("knc,kc->nc", candidate.sh_renders.mean(axis=0), candidate.coefficients)))
    whole = sum(parts) + brightness(candidate.fixed.mean(axis=0))
    return np.array(parts) / whole if whole > 0.0 else np.zeros(len(parts))


_CLIPPED = 0.2
"""A remark reports an image as clipped if more than this fraction of its pixels have a black or white channel."""
_UNEXPLAINED = 0.1
"""A remark says that the scene does not explain an image's pixels if more than this fraction of the fitted ones have a
weight below 0.05."""
_WHITE = 0.01
"""A remark reports a capture if the fit made more than this fraction of its Gaussians white."""
_OFF_BELOW = 1e-6
"""A remark reports that the fit turned a light off if the light's power, relative to the brightest light's, is at most
this."""


def _remarks_of(
    given: Scene,
    options: FitOptions,
    fitter: PowerFitter,
    candidate: Candidate,
    certainty: Certainty,
    *,
    has_environment: bool,
) -> tuple[str, ...]:
    """Collects the remarks on a fit; the first five arguments are those of `result_of`.

    ``has_environment`` is True if light of an SH environment was found.
    """
    return (
        *_fixed_remarks(given, options, fitter, has_environment=has_environment),
        *_base_color_remarks(fitter, candidate),
        *_light_remarks(fitter, candidate, certainty, has_environment=has_environment),
        *_image_remarks(fitter, candidate),
    )


def _fixed_remarks(given: Scene, options: FitOptions, fitter: PowerFitter, *, has_environment: bool) -> Iterator[str]:
    """Yields a sentence for each option without effect, and for each held quantity that images show in a product."""
    task = fitter.task
    if task.degree is not None and any(isinstance(light, LightEnvironment) and light.enabled for light in given.lights):
        instead = f"replaced by an SH environment of degree {task.degree}" if has_environment else "removed"
        yield f"the scene's environment was {instead}"
    sought = {"positions": ("position", "direction"), "radii": ("radius",), "angles": ("inner", "outer")}
    for name, kinds in sought.items():
        if getattr(options, name) and not any(parameter.kind in kinds for parameter in task.light_parameters):
            yield f"{name} is set, but no light has any: none were fitted"
    if isinstance(options.exposure, str) and not task.exposed[0]:
        others = "; the other exposures are relative to it" if len(task.exposed) > 1 else ""
        yield (
            f"the exposure of {fitter.images[0].label} stays {np.log2(task.gains[0]):g} stops: no surface of the "
            f"scene emits light, so images show only the product of light and exposure{others}"
        )
    if task.anchors:
        yield (
            "base colours and lights are determined up to one factor per channel: the product of the base colours "
            "stays as in the scene (name only the unknown ones in base_colors, and the others fix the factor)"
        )


def _base_color_remarks(fitter: PowerFitter, candidate: Candidate) -> Iterator[str]:
    """Yields a sentence for each capture if the fit made more than `_WHITE` of its Gaussians white."""
    for base_color in fitter.task.base_colors:
        share = share_at_white(candidate.scene, base_color)
        if share > _WHITE:
            yield f"{base_color.name}: {share:.0%} of its Gaussians are white and cannot become brighter"


def _light_remarks(
    fitter: PowerFitter, candidate: Candidate, certainty: Certainty, *, has_environment: bool
) -> Iterator[str]:
    """Yields a sentence for each light that is off, that no image shows, or that is indistinguishable from others."""
    for number in certainty.dark:
        yield f"{light_name(candidate, number)}: none of its light appears in the images, so it is unchanged"
    for number, power in candidate.powers.items():
        if (
            number not in certainty.dark
            and fitter.task.scales
            and not (power > _OFF_BELOW * _brightest(candidate)).any()
        ):
            yield f"{light_name(candidate, number)}: the fit turned it off"
    if candidate.sh_renders.shape[1] and not has_environment:
        yield f"{ENVIRONMENT_NAME}: none of its light was found in the images, so the scene has none"
    for names in certainty.confounded:
        if ENVIRONMENT_NAME in names and not has_environment:
            continue
        if names == (ENVIRONMENT_NAME,):
            yield f"{ENVIRONMENT_NAME}: the images do not determine all of its SH coefficients"
        elif len(names) == 1:
            yield f"{names[0]}: the images do not determine all of its parameters"
        else:
            yield f"{' and '.join(names)} cannot be distinguished in the images: only their sum is determined"


def _brightest(candidate: Candidate) -> float:
    return max(float(power.max()) for power in candidate.powers.values())


def _image_remarks(fitter: PowerFitter, candidate: Candidate) -> Iterator[str]:
    """Yields a sentence for each image that has many clipped or no fitted pixels, or that the fit does not explain."""
    weights = candidate.solution.weights * fitter.observed.noise**2
    for number, image in enumerate(fitter.images):
        in_image = fitter.view == number
        pixels = image.full_size
        if image.clipped > _CLIPPED * pixels:
            share = image.clipped / pixels
            yield f"{image.label}: {share:.0%} of its pixels are clipped (a channel is black or white), left out"
        counts = fitter.observed.counts[in_image]
        if not counts.any():
            yield f"{image.label}: none of its pixels can be fitted"
            continue
        unexplained = float((weights[in_image][counts] < 0.05).mean())
        if unexplained > _UNEXPLAINED:
            yield f"{image.label}: the scene does not explain {unexplained:.0%} of its pixels, which were left out"


CONFOUNDED_BELOW = 1e-3
"""Unknowns cannot be distinguished if the correlation matrix of their renders has an eigenvalue below this: two
renders then correlate to 0.999."""

DARK_SHARE = 1e-5
"""A light does not appear in the images if the norm of its render is at most this times the largest of all lights'
norms."""

_PART = 0.3
"""An eigenvector of a nearly singular correlation matrix stands for a group of unknowns that cannot be distinguished.
An unknown belongs to the group if its component of the unit eigenvector has a magnitude above this."""


@dataclass(frozen=True, slots=True, eq=False)
class Certainty:
    """Standard errors of L fitted lights, and the unknowns that the images do not determine."""

    powers: Doubles
    """Standard errors of the L lights' powers (colour times intensity), 0 for held ones. If an SH environment is
    fitted, one more row holds the standard error of its mean radiance. Shape (L, 3) or (L + 1, 3)."""
    positions: Doubles
    """Standard errors of the lights' positions, scene units, in the same rows as ``powers``; NaN where not fitted."""
    dark: tuple[int, ...]
    """Indices, in the scene, of lights that stay unchanged because their light reaches no fitted pixel."""
    confounded: tuple[tuple[str, ...], ...]
    """Groups of unknowns, by the name of the light or material or ``exposure``. The images determine only a
    combination of the unknowns of a group."""


def certainty_of(fitter: PowerFitter, candidate: Candidate) -> Certainty:
    """Computes the standard errors of the unknowns, and finds the unknowns that the images do not determine."""
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
    """Returns groups of names of unknowns whose effects on the images (derivatives) are nearly linearly dependent.

    Args:
        gram: Normal matrix of the unknowns, whose scaled eigenvectors are tested.
        names: Name of each unknown's light, material or exposure.
    """
    lengths = np.sqrt(np.diag(gram))
    values, vectors = np.linalg.eigh(gram / np.outer(lengths, lengths))
    groups: dict[tuple[str, ...], None] = {}
    for vector in vectors.T[values < CONFOUNDED_BELOW]:
        rows: list[int] = np.flatnonzero(np.abs(vector) > _PART).tolist()
        groups[tuple(dict.fromkeys(names[row] for row in rows))] = None
    return tuple(groups)


def _names(candidate: Candidate, task: FitTask, joint: Columns) -> list[str]:
    """Returns a name for each unknown of the joint problem, for messages: of its light, material or ``exposure``."""
    columns = [light_name(candidate, number) for number in candidate.lights if task.scales]
    columns += [ENVIRONMENT_NAME] * candidate.sh_renders.shape[1]
    columns += [light_name(candidate, parameter.light) for parameter in task.light_parameters]
    columns += ["exposure"] * sum(task.exposed) + [base_color.name for base_color in task.base_colors]
    return [name for name, count in zip(columns, unknown_counts(joint.tints), strict=True) for _ in range(count)]


def light_name(candidate: Candidate, number: int) -> str:
    """Returns the name of light number ``number`` of the scene for messages; a light without a name is ``lightN``."""
    return candidate.scene.lights[number].name or f"light{number}"
