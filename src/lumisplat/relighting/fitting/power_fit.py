"""Fits the powers of lights at given positions, and an environment in SH, to images: a linear problem."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np

from lumisplat.math.arrays import Doubles, Flags, Rows
from lumisplat.math.color import encode_srgb
from lumisplat.math.directions import panorama_directions
from lumisplat.math.nonnegative import bounded_least_squares
from lumisplat.math.sh import even_directions, sh_basis
from lumisplat.relighting.fitting.light_layers import FitImage, LightLayers, power_of, unit, with_power
from lumisplat.relighting.fitting.parameters import FitTask
from lumisplat.relighting.probe import EnvironmentProbe
from lumisplat.scene.lights import Light, LightEnvironment
from lumisplat.scene.scene import Scene

HUBER_WIDTH = 1.345
"""Deviations up to which residuals count as squares: 95 % efficient if they are normal (Huber 1981)."""

TUKEY_WIDTH = 4.685
"""Deviations from which on a residual does not count at all: as efficient (Beaton and Tukey 1974)."""

DEVIATION_MIN = 1e-4
"""Of residuals, in units of the expected noise: perfect photographs have none, and weights divide by it."""

ROBUST_STEPS = 40
"""Steps of reweighting, at most."""

ROBUST_CHANGE = 1e-7
"""Change of the unknowns, relative, at which reweighting ends."""

NORMAL_RIDGE = 1e-9
"""Relative to the diagonal of the normal equations: lights that cannot be told apart share evenly."""

NOISE_SHARE_MAX = 0.5
"""Of the square of a sum of pictures, at most so much is taken for noise and left out: of more, nothing is known."""

_MAD_TO_DEVIATION = 1.4826
"""Standard deviation of normal numbers over the median of their magnitudes."""


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """What is to be explained: N pixels of all photographs."""

    target: Doubles
    """Linear light, shape (N, 3)."""
    counts: Flags
    """What of it counts, shape (N, 3)."""
    noise: Doubles
    """Error that is expected of it, shape (N, 3)."""
    blocks: Rows
    """Which pixels' residuals go together, numbered from 0, shape (N,)."""
    sizes: tuple[tuple[int, int], ...]
    """Rows and columns of each photograph."""


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """K pictures of which the photographs are a sum."""

    renders: Doubles
    """Each rendered twice, shape (2, K, N, 3)."""
    fixed: Doubles
    """What is there in any case, shape (2, N, 3)."""
    tints: tuple[Doubles | None, ...]
    """Of each column, its unknown's factors in the channels, shape (3,); None: each channel has an unknown of its
    own."""
    bounded: Doubles
    """Inequalities of the unknowns, ``bounded @ x >= least``, shape (R, U)."""
    least: Doubles
    """Shape (R,)."""
    ridge: Doubles = field(default_factory=lambda: np.zeros(0))
    """Added to the diagonal of the normal equations, relative to it, shape (U,); empty: nothing."""

    @property
    def spread(self) -> Doubles:
        """Factors of the pictures' channels from unknowns, shape (3, K, U)."""
        return spread_of(self.tints)

    def channels(self, unknowns: Doubles) -> Doubles:
        """Factor of each picture's channels, shape (K, 3)."""
        return np.asarray(np.einsum("cku,u->kc", self.spread, unknowns))

    def model(self, unknowns: Doubles) -> Doubles:
        """What is explained, shape (N, 3)."""
        factors = self.channels(unknowns)
        return self.fixed.mean(axis=0) + np.einsum("knc,kc->nc", self.renders.mean(axis=0), factors)


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """What explains the photographs best."""

    unknowns: Doubles
    """Shape (U,)."""
    model: Doubles
    """Shape (N, 3)."""
    weights: Doubles
    """Of pixels, in one over squares of light, shape (N, 3)."""
    deviation: Doubles
    """Of the residuals, in units of the expected noise; a number, as an array of no axes."""


def unknown_counts(tints: Sequence[Doubles | None]) -> list[int]:
    """How many unknowns each column has."""
    return [3 if tint is None else 1 for tint in tints]


def spread_of(tints: Sequence[Doubles | None]) -> Doubles:
    """As `Columns.spread`."""
    spread = np.zeros((3, len(tints), sum(unknown_counts(tints))))
    first = 0
    for column, tint in enumerate(tints):
        if tint is None:
            spread[range(3), column, range(first, first + 3)] = 1.0
        else:
            spread[:, column, first] = tint
        first += 3 if tint is None else 1
    return spread


def normal_equations(observed: Observed, columns: Columns, weights: Doubles) -> tuple[Doubles, Doubles]:
    """``(G, m)`` of the weighted least squares: products of one rendering with the other, positive definite.

    Where noise is more than `NOISE_SHARE_MAX` of what a sum of pictures is, no more than that is taken for noise.
    """
    spread = columns.spread
    first, second = columns.renders
    size = spread.shape[2]
    gram, noise, moments = np.zeros((size, size)), np.zeros((size, size)), np.zeros(size)
    for channel in range(3):
        a, b, w = first[..., channel], second[..., channel], weights[:, channel]
        own = spread[channel]
        mean, difference = own.T @ (0.5 * (a + b)), own.T @ (0.5 * (a - b))
        gram += (mean * w) @ mean.T
        noise += (difference * w) @ difference.T
        left = [observed.target[:, channel] - fixed[:, channel] for fixed in columns.fixed]
        moments += own.T @ (0.5 * (a @ (w * left[1]) + b @ (w * left[0])))
    return _without(lifted(gram, columns.ridge), noise), moments


def lifted(gram: Doubles, ridge: Doubles) -> Doubles:
    """The matrix with a ridge, relative to its diagonal, that makes it positive definite.

    Args:
        gram: Positive semidefinite, shape (U, U).
        ridge: Beside `NORMAL_RIDGE`, shape (U,); empty: none.
    """
    diagonal = np.diag(gram)
    largest = float(diagonal.max(initial=0.0)) or 1.0
    extra = ridge if ridge.size else np.zeros(len(gram))
    return gram + np.diag((NORMAL_RIDGE + extra) * np.maximum(diagonal, 1e-6 * largest))


def _without(gram: Doubles, noise: Doubles) -> Doubles:
    """Products of pictures with themselves, without those of their noise: at least a share of them stays."""
    if not noise.any():
        return gram
    root = np.linalg.cholesky(gram)
    inverse = np.linalg.inv(root)
    shares, vectors = np.linalg.eigh(inverse @ noise @ inverse.T)
    whitened = root @ vectors
    return np.asarray((whitened * (1.0 - np.minimum(shares, NOISE_SHARE_MAX))) @ whitened.T)


def robust_solve(observed: Observed, columns: Columns, *, redescends: bool = False) -> Solution:
    """The unknowns that explain the photographs best, by Huber's loss.

    Args:
        observed: The photographs.
        columns: Of what they are a sum.
        redescends: Whether Tukey's loss ends it, for which what does not fit at all does not count: things that the
            scene lacks.
    """
    base = observed.counts / observed.noise**2
    weights, unknowns, deviation = base, np.zeros(columns.spread.shape[2]), 1.0
    model, around = columns.model(unknowns), np.zeros_like(base)
    for loss in (huber_weights, tukey_weights) if redescends else (huber_weights,):
        weights = base * loss(around / deviation)
        for _ in range(ROBUST_STEPS):
            last = unknowns
            gram, moments = normal_equations(observed, columns, weights)
            unknowns = bounded_least_squares(gram, moments, columns.bounded, columns.least)
            model = columns.model(unknowns)
            around = mean_around(observed, (observed.target - model) / observed.noise)
            if loss is huber_weights:
                deviation = deviation_of(around[observed.counts])
            weights = base * loss(around / deviation)
            if np.abs(unknowns - last).max(initial=0.0) <= ROBUST_CHANGE * np.abs(unknowns).max(initial=0.0):
                break
    residuals = ((observed.target - model) / observed.noise)[observed.counts]
    return Solution(unknowns, model, weights, np.asarray(deviation_of(residuals)))


def mean_around(observed: Observed, residuals: Doubles) -> Doubles:
    """The mean of residuals over the pixels around each that count, shape (N, 3).

    Weights go by it: what the scene lacks is larger than a pixel, and noise, of pictures above all, must not choose.
    """
    result = np.zeros_like(residuals)
    first = 0
    for height, width in observed.sizes:
        rows = slice(first, first + height * width)
        counts = observed.counts[rows].reshape(height, width, 3).astype(np.float64)
        total, number = (sum_around(image) for image in (counts * residuals[rows].reshape(counts.shape), counts))
        result[rows] = (total / np.maximum(number, 1.0)).reshape(-1, 3)
        first = rows.stop
    return result


def sum_around(image: Doubles) -> Doubles:
    """The sum over each pixel and its eight neighbours, (H, W, C)."""
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)))
    down = padded[:-2] + padded[1:-1] + padded[2:]
    return np.asarray(down[:, :-2] + down[:, 1:-1] + down[:, 2:])


def huber_cost(observed: Observed, model: Doubles, deviation: Doubles) -> float:
    """Mean loss of the residuals, in squares of a deviation."""
    size = np.abs((observed.target - model) / (observed.noise * deviation))[observed.counts]
    return float(np.where(size <= HUBER_WIDTH, 0.5 * size**2, HUBER_WIDTH * (size - 0.5 * HUBER_WIDTH)).mean())


def huber_weights(residuals: Doubles) -> Doubles:
    """1 up to Huber's width, then falling as one over the residual."""
    return HUBER_WIDTH / np.maximum(np.abs(residuals), HUBER_WIDTH)


def tukey_weights(residuals: Doubles) -> Doubles:
    """Falling to 0 at Tukey's width."""
    return np.maximum(1.0 - (residuals / TUKEY_WIDTH) ** 2, 0.0) ** 2


def deviation_of(residuals: Doubles) -> float:
    """Of most residuals, whatever the others are."""
    return max(_MAD_TO_DEVIATION * float(np.median(np.abs(residuals))), DEVIATION_MIN)


def covariance(observed: Observed, columns: Columns, solution: Solution, held: Doubles) -> Doubles:
    """Of the unknowns, shape (U, U): by how residuals of neighbouring pixels go together (White 1980, in blocks).

    Args:
        observed: The photographs.
        columns: Of what they are a sum.
        solution: What explains them.
        held: What is added to the normal equations, (U, U).
    """
    gram, _ = normal_equations(observed, columns, solution.weights)
    spread, renders = columns.spread, columns.renders.mean(axis=0)
    count = int(observed.blocks.max()) + 1
    scores = np.zeros((count, spread.shape[2]))
    weighted = solution.weights * (observed.target - solution.model)
    for channel in range(3):
        rows = [np.bincount(observed.blocks, column * weighted[:, channel], count) for column in renders[..., channel]]
        scores += np.array(rows).reshape(len(rows), count).T @ spread[channel]
    normal = gram + held
    # What is known up to a factor alone leaves a direction without curvature: its variance is huge, not infinite.
    least = np.finfo(np.float64).eps * float(np.trace(normal)) * np.eye(len(normal))
    inverse = np.linalg.inv(normal + least)
    return np.asarray(inverse @ (scores.T @ scores) @ inverse)


RELATIVE_NOISE = 0.02
"""Error of a photograph's light that is expected of it, relative to the pixel and to the mean: no model is better."""

NOISE_BLUR = 2
"""Pixels to each side over which a photograph is averaged to say what error is expected: by noisy pixels
themselves, those that noise has made dark would weigh more."""

ENVIRONMENT_ROWS = 32
"""Rows of the images of harmonics as environments, and of the environment that is found."""

ENVIRONMENT_DIRECTIONS = 96
"""Directions in which the radiance of harmonics must not be negative, spread evenly."""

BLOCK_PX = 8
"""Side of the squares of pixels whose residuals are taken to go together, where errors are estimated."""

_SH_RIDGE = 1e-7
"""Of an environment's coefficients beyond the constant: directions that no surface faces stay even."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """Lights, materials and exposures, and what follows from them."""

    scene: Scene
    """With the lights as they are guessed; their powers are those of the candidate before."""
    gains: Doubles
    """Factors of exposure, shape (V,)."""
    lights: Mapping[int, Doubles]
    """The picture of each fitted light alone, of power 1, (2, N, 3)."""
    sh_renders: Doubles
    """Pictures under harmonics, (2, K, N, 3); K is 0 if there are none."""
    fixed: Doubles
    """The picture of what is not fitted, (2, N, 3)."""
    columns: Columns
    solution: Solution

    @property
    def powers(self) -> dict[int, Doubles]:
        """Colour times intensity of each fitted light, shape (3,)."""
        factors = self.columns.channels(self.solution.unknowns)
        numbers = list(self.lights)
        if len(factors) < len(numbers):  # powers are given
            return {number: power_of(self.scene.lights[number]) for number in numbers}
        return {number: np.maximum(factors[row], 0.0) for row, number in enumerate(numbers)}

    @property
    def coefficients(self) -> Doubles:
        """Of the environment's harmonics, shape (K, 3)."""
        count = self.sh_renders.shape[1]
        factors = self.columns.channels(self.solution.unknowns)
        return factors[len(factors) - count :]

    @property
    def lit_scene(self) -> Scene:
        """The scene with the lights as strong as they were found, the harmonics as its last light."""
        lights = list(self.scene.lights)
        for number, power in self.powers.items():
            lights[number] = with_power(lights[number], power)
        if self.sh_renders.shape[1]:
            lights.append(environment_of(self.coefficients, self.scene))
        return replace(self.scene, lights=tuple(lights))


class PowerFitter:
    """Makes guesses for photographs of one resolution.

    Args:
        task: What is unknown.
        images: At this resolution.
        layers: Renders.
    """

    def __init__(self, task: FitTask, images: Sequence[FitImage], layers: LightLayers) -> None:
        self.task, self.images, self.layers = task, images, layers
        sizes = [image.light.shape[0] * image.light.shape[1] for image in images]
        self.view: Rows = np.repeat(np.arange(len(sizes)), sizes)
        """Which photograph each pixel is of, shape (N,)."""
        counts = np.concatenate([image.counts.reshape(-1, 3) for image in images])
        self.observed = Observed(
            target=np.concatenate([image.light.reshape(-1, 3) for image in images]),
            counts=counts & layers.lit_pixels(task.scene, images)[:, None],
            noise=np.concatenate([_expected_noise(image).reshape(-1, 3) for image in images]),
            blocks=_blocks(images),
            sizes=tuple((image.camera.height, image.camera.width) for image in images),
        )

    def begin(self, scene: Scene, gains: Doubles) -> Candidate:
        """The first candidate."""
        return self._guess(scene, gains, None)

    def moved(self, candidate: Candidate, scene: Scene, gains: Doubles) -> Candidate:
        """A candidate with other lights, materials or exposures; what is as it was is not rendered again."""
        return self._guess(scene, gains, candidate)

    def settled(self, candidate: Candidate) -> Candidate:
        """The candidate, with what does not fit at all left out."""
        return replace(candidate, solution=robust_solve(self.observed, candidate.columns, redescends=True))

    def render_of(self, candidate: Candidate, number: int, scene: Scene) -> Doubles:
        """The picture of a light of a scene alone, of power 1, shape (2, N, 3)."""
        return self.layers.render_light(candidate.scene, unit(scene.lights[number]), self.images, candidate.fixed)

    def exposed(self, renders: Doubles, gains: Doubles) -> Doubles:
        """Pictures (..., N, 3), as the photographs are exposed."""
        return renders * gains[self.view][:, None]

    def _guess(self, scene: Scene, gains: Doubles, before: Candidate | None) -> Candidate:
        task = self.task
        held = before if before is not None and _differs_only_in_lights(before.scene, scene) else None
        fixed = self.layers.render(scene, (), self.images) if held is None else held.fixed
        lights: dict[int, Doubles] = {}
        for number in task.lights:
            light = scene.lights[number]
            if held is not None and held.scene.lights[number] is light:
                lights[number] = held.lights[number]
            else:
                lights[number] = self.layers.render_light(scene, unit(light), self.images, fixed)
        if held is not None:
            sh_renders = held.sh_renders
        elif task.degree is None:
            sh_renders = np.zeros((2, 0, *fixed.shape[1:]))
        else:
            sh_renders = render_sh_lights(
                task.degree, lambda light: self.layers.render_light(scene, light, self.images, fixed)
            )
        columns = self._columns(scene, gains, lights, sh_renders, fixed)
        return Candidate(scene, gains, lights, sh_renders, fixed, columns, robust_solve(self.observed, columns))

    def _columns(
        self, scene: Scene, gains: Doubles, lights: Mapping[int, Doubles], sh_renders: Doubles, fixed: Doubles
    ) -> Columns:
        """Of the lights, then of the harmonics; lights of a given power are a part of what is fixed."""
        renders, tints = list(lights.values()), [self._tint(scene, number) for number in lights]
        if not self.task.scales:
            shining = (power_of(scene.lights[number]) * render for number, render in lights.items())
            fixed, renders, tints = fixed + sum(shining), [], []
        powers = sum(unknown_counts(tints))
        count = sh_renders.shape[1]
        total = powers + 3 * count
        radiances = radiance_rows(self.task.degree or 0) if count else np.zeros((0, 0))
        bounded = np.zeros((powers + 3 * len(radiances), total))
        bounded[:powers, :powers] = np.eye(powers)
        for channel in range(3 if count else 0):
            bounded[powers + channel * len(radiances) :][: len(radiances), powers + channel :: 3] = radiances
        ridge = np.zeros(total)
        ridge[powers + 3 :] = _SH_RIDGE
        stacked = np.stack(renders, axis=1) if renders else np.zeros((2, 0, *fixed.shape[1:]))
        return Columns(
            renders=self.exposed(np.concatenate([stacked, sh_renders], axis=1), gains),
            fixed=self.exposed(fixed, gains),
            tints=(*tints, *[None] * count),
            bounded=bounded,
            least=np.zeros(len(bounded)),
            ridge=ridge,
        )

    def _tint(self, scene: Scene, number: int) -> Doubles | None:
        """The colour of a light, if it is kept."""
        if not self.task.keeps_hues:
            return None
        color = np.array(scene.lights[number].color, np.float64)
        return color / color.max() if color.any() else np.ones(3)


def _differs_only_in_lights(scene: Scene, other: Scene) -> bool:
    """Whether nothing but their lights is different."""
    return scene.meshes == other.meshes and scene.splats == other.splats


def _expected_noise(image: FitImage) -> Doubles:
    """Errors that are expected of a photograph, (H, W, 3), by what is around pixels: noise must not weigh itself."""
    light = _blurred(image.light)
    step = 1.0 / (255.0 * _encoding_slope(light))
    return RELATIVE_NOISE * (light + light.mean()) + step


def _blurred(image: Doubles) -> Doubles:
    """The mean over the pixels around each, within the image."""
    height, width = image.shape[:2]
    padded = np.pad(image, ((NOISE_BLUR, NOISE_BLUR), (NOISE_BLUR, NOISE_BLUR), (0, 0)), mode="edge")
    reach = range(2 * NOISE_BLUR + 1)
    shifted = np.array([padded[y : y + height, x : x + width] for y in reach for x in reach])
    return np.asarray(shifted.mean(axis=0), np.float64)


def _encoding_slope(light: Doubles) -> Doubles:
    """By how much display values grow with linear light."""
    bright = np.clip(light, 1e-4, 1.0)
    return np.asarray((encode_srgb(1.01 * bright) - encode_srgb(0.99 * bright)) / (0.02 * bright))


def _blocks(images: Sequence[FitImage]) -> Rows:
    """Numbers of the squares that pixels are in, shape (N,)."""
    blocks: list[Rows] = []
    first = 0
    for image in images:
        height, width = image.light.shape[:2]
        across = -(-width // BLOCK_PX)
        down: Rows = np.arange(height, dtype=np.int64)[:, None] // BLOCK_PX
        cells: Rows = down * across + np.arange(width, dtype=np.int64) // BLOCK_PX
        blocks.append(first + cells.ravel())
        first = int(blocks[-1].max()) + 1
    return np.concatenate(blocks)


ENVIRONMENT_NAME = "environment"
"""Of the light that is found."""


def render_sh_lights(degree: int, render_light: Callable[[Light], Doubles]) -> Doubles:
    """Pictures under each harmonic as an environment.

    Args:
        degree: Of the harmonics.
        render_light: The picture of a light alone, (2, N, 3).

    Returns:
        Shape (2, K, N, 3), K = (degree + 1)^2; all 0 if no light of an environment arrives anywhere.
    """
    basis = sh_basis(panorama_directions(ENVIRONMENT_ROWS, 2 * ENVIRONMENT_ROWS), degree)
    constant = render_light(LightEnvironment(visible=False))
    renders = np.zeros((len(constant), basis.shape[-1], *constant.shape[1:]))
    if not constant.any():
        return renders
    renders[:, 0] = basis[0, 0, 0] * constant
    for number in range(1, basis.shape[-1]):
        values = basis[..., number]
        largest = float(np.abs(values).max())
        image = np.repeat((1.0 + values / largest)[..., None], 3, axis=2).clip(0.0)
        renders[:, number] = largest * (render_light(LightEnvironment(image, visible=False)) - constant)
    return renders


@cache
def radiance_rows(degree: int) -> Doubles:
    """Radiance in directions all around, of coefficients, shape (D, K): none of them may be negative."""
    return np.asarray(sh_basis(even_directions(ENVIRONMENT_DIRECTIONS), degree), np.float64)


def environment_of(coefficients: Doubles, scene: Scene) -> LightEnvironment:
    """The environment of coefficients, shape (K, 3): it stands upright in the scene, and is not seen directly."""
    light = EnvironmentProbe(coefficients).light(ENVIRONMENT_ROWS, scene.upright_wxyz)
    return LightEnvironment(light.image, rotation_wxyz=light.rotation_wxyz, visible=False, name=ENVIRONMENT_NAME)
