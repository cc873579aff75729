"""What a fit of lights returns: the scene in the light that was found, and how well that explains the photographs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lumisplat.constants import LUMINANCE, SH_C0
from lumisplat.constants.light_fit import SKY_ERRORS_MIN, SKY_SHARE_MIN
from lumisplat.math.arrays import Doubles
from lumisplat.math.color import encode_srgb
from lumisplat.relighting.fitting.guess import Guess, Guesser
from lumisplat.relighting.fitting.paints import colors_of
from lumisplat.relighting.fitting.remarks import remarks_of
from lumisplat.relighting.fitting.task import FitOptions
from lumisplat.relighting.fitting.told_apart import Certainty
from lumisplat.relighting.probe import EnvironmentProbe
from lumisplat.scene.camera import Camera
from lumisplat.scene.lights import Light
from lumisplat.scene.scene import Scene


@dataclass(frozen=True, slots=True, eq=False)
class FittedView:
    """A photograph and what explains it, at the resolution of the fit; both linear Rec.709, exposed."""

    camera: Camera
    """At that resolution, with the exposure that was found."""
    photograph: Doubles
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


def result_of(given: Scene, options: FitOptions, guesser: Guesser, guess: Guess, certainty: Certainty) -> LightFit:
    """What the last guess means for the caller.

    Args:
        given: The caller's scene.
        options: What was asked for.
        guesser: Has the photographs.
        guess: The last guess.
        certainty: What it knows.
    """
    task, lit = guesser.task, guess.lit
    kept = list(lit.lights)
    for number in certainty.dark:  # nothing is known of it
        kept[number] = task.scene.lights[number]
    shares = _shares(guesser, guess)
    has_sky = _has_sky(guess, shares, certainty)
    if guess.harmonics.shape[1] and not has_sky:  # a scene with a black one would pass for lit by a sky
        del kept[-1]
    lights = tuple(kept[number] for number in task.lights) + ((kept[-1],) if has_sky else ())
    colors = colors_of(guess.scene, task.paints)
    views = _views(guesser, guess)
    return LightFit(
        scene=replace(lit, lights=tuple(kept)),
        lights=lights,
        shares=shares[: len(lights)],
        standard_errors=certainty.powers[: len(lights)],
        position_errors=certainty.positions[: len(lights)],
        environment=EnvironmentProbe(guess.coefficients) if has_sky else None,
        base_colors={
            paint.name: (float(color[0]), float(color[1]), float(color[2]))
            for paint, color in zip(task.paints, colors, strict=True)
        },
        exposures=np.log2(guess.gains),
        views=views,
        remarks=remarks_of(given, options, guesser, guess, certainty, has_sky=has_sky),
    )


def _has_sky(guess: Guess, shares: Doubles, certainty: Certainty) -> bool:
    """Whether harmonics are more than what noise is taken for."""
    if not guess.harmonics.shape[1]:
        return False
    mean = SH_C0 * np.abs(guess.coefficients[0])
    return bool(shares[-1] >= SKY_SHARE_MIN or (mean > SKY_ERRORS_MIN * certainty.powers[-1]).any())


def _views(guesser: Guesser, guess: Guess) -> tuple[FittedView, ...]:
    """The photographs beside what explains them."""
    views: list[FittedView] = []
    solution, observed = guess.solution, guesser.observed
    shares = solution.weights * observed.noise**2
    for number, one in enumerate(guesser.photographs):
        own = guesser.view == number
        weights, fitted = (values[own].reshape(one.light.shape) for values in (shares, solution.model))
        difference = encode_srgb(one.light) - encode_srgb(np.maximum(fitted, 0.0))
        square = float((weights * difference**2).sum() / max(float(weights.sum()), 1e-12))
        camera = replace(one.camera, exposure=float(np.log2(guess.gains[number])))
        views.append(FittedView(camera, one.light, fitted, weights, float(np.sqrt(square)), one.clipped, one.masked))
    return tuple(views)


def _shares(guesser: Guesser, guess: Guess) -> Doubles:
    """Luminance that each light gives to what counts, of all that is explained there."""
    counts = guesser.observed.counts

    def brightness(picture: Doubles) -> float:
        return float(((guesser.exposed(picture, guess.gains) * counts) @ np.array(LUMINANCE)).sum())

    parts = [brightness(guess.powers[number] * picture.mean(axis=0)) for number, picture in guess.lights.items()]
    if guess.harmonics.shape[1]:
        parts.append(brightness(np.einsum("knc,kc->nc", guess.harmonics.mean(axis=0), guess.coefficients)))
    whole = sum(parts) + brightness(guess.fixed.mean(axis=0))
    return np.array(parts) / whole if whole > 0.0 else np.zeros(len(parts))
