"""Fits the powers of lights at given positions, and an SH environment, to images by robust linear least squares."""

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
"""Residual, in standard deviations, up to which Huber's loss is quadratic: 95 % efficiency for normal residuals (Huber
1981)."""

TUKEY_WIDTH = 4.685
"""Residual, in standard deviations, from which Tukey's weight is 0: 95 % efficiency for normal residuals (Beaton and
Tukey 1974)."""

DEVIATION_MIN = 1e-4
"""Lower bound of the residuals' standard deviation, in units of the expected noise. Perfect images have no residuals,
and the computation of weights divides by the deviation."""

ROBUST_STEPS = 40
"""Maximum number of steps in which robust weights are recomputed."""

ROBUST_CHANGE = 1e-7
"""Relative change of the unknowns at which the recomputation of robust weights ends."""

NORMAL_RIDGE = 1e-9
"""Ridge of the normal equations, relative to their diagonal: with it, lights with equal renders get equal powers."""

NOISE_SHARE_MAX = 0.5
"""Largest fraction that is subtracted as noise from the squared norm of a sum of renders."""

_MAD_TO_DEVIATION = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """The N pixels of all images, to which the model is fitted."""

    target: Doubles
    """Linear light of the pixels, shape (N, 3)."""
    counts: Flags
    """True for the channels of pixels that are fitted, shape (N, 3)."""
    noise: Doubles
    """Expected error of the pixels' linear light, shape (N, 3)."""
    blocks: Rows
    """Index of the square block of pixels, with correlated residuals, that contains each pixel, shape (N,)."""
    sizes: tuple[tuple[int, int], ...]
    """Height and width of each image, pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """The K columns of the linear problem with U unknowns: renders whose weighted sum models the images' N pixels."""

    renders: Doubles
    """Renders of the columns, each made twice with independent noise, shape (2, K, N, 3)."""
    fixed: Doubles
    """Render of the light that is not fitted, twice with independent noise, shape (2, N, 3)."""
    tints: tuple[Doubles | None, ...]
    """Factors, shape (3,), by which the one unknown of each column scales the channels. None: the column has an
    unknown for each channel."""
    bounded: Doubles
    """Matrix of the R inequality constraints ``bounded @ x >= least`` on the unknowns x, shape (R, U)."""
    least: Doubles
    """Right side of the constraints, shape (R,)."""
    ridge: Doubles = field(default_factory=lambda: np.zeros(0))
    """Ridge of each unknown, relative to the diagonal of the normal equations, shape (U,); empty: no ridge."""

    @property
    def spread(self) -> Doubles:
        """Linear map from the U unknowns to the factors of the K renders in each channel, shape (3, K, U)."""
        return spread_of(self.tints)

    def channels(self, unknowns: Doubles) -> Doubles:
        """Returns the factor of each of the K renders in each channel for given unknowns, shape (K, 3)."""
        return np.asarray(np.einsum("cku,u->kc", self.spread, unknowns))

    def model(self, unknowns: Doubles) -> Doubles:
        """Returns the modelled linear light of the pixels for given unknowns, shape (N, 3)."""
        factors = self.channels(unknowns)
        return self.fixed.mean(axis=0) + np.einsum("knc,kc->nc", self.renders.mean(axis=0), factors)


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The U unknowns with the smallest robust loss, and the model of N pixels."""

    unknowns: Doubles
    """Values of the unknowns, shape (U,)."""
    model: Doubles
    """Modelled pixels, shape (N, 3)."""
    weights: Doubles
    """Weights of the squared residuals, shape (N, 3)."""
    deviation: Doubles
    """Standard deviation of the residuals, in units of the expected noise, as a 0-dimensional array."""


def unknown_counts(tints: Sequence[Doubles | None]) -> list[int]:
    """Returns the number of unknowns of each column: 1 with a tint, 3 without."""
    return [3 if tint is None else 1 for tint in tints]


def spread_of(tints: Sequence[Doubles | None]) -> Doubles:
    """Returns the linear map of `Columns.spread` for the tints of K columns."""
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
    """Returns the weighted normal equations ``G x = m``: matrix G, positive definite, and right side m.

    Products are taken between the two renders of each column, whose noise is independent, so that noise does not bias
    the products. At most `NOISE_SHARE_MAX` of the squared norm of a sum of renders is removed as noise.
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
    """Adds a ridge, relative to the diagonal, to a matrix, so that the matrix becomes positive definite.

    Args:
        gram: Positive semidefinite matrix of U unknowns, shape (U, U).
        ridge: Ridge in addition to `NORMAL_RIDGE`, shape (U,); empty: none.
    """
    diagonal = np.diag(gram)
    largest = float(diagonal.max(initial=0.0)) or 1.0
    extra = ridge if ridge.size else np.zeros(len(gram))
    return gram + np.diag((NORMAL_RIDGE + extra) * np.maximum(diagonal, 1e-6 * largest))


def _without(gram: Doubles, noise: Doubles) -> Doubles:
    """Subtracts the renders' noise from their inner products, at most `NOISE_SHARE_MAX` of any sum's squared norm."""
    if not noise.any():
        return gram
    root = np.linalg.cholesky(gram)
    inverse = np.linalg.inv(root)
    shares, vectors = np.linalg.eigh(inverse @ noise @ inverse.T)
    whitened = root @ vectors
    return np.asarray((whitened * (1.0 - np.minimum(shares, NOISE_SHARE_MAX))) @ whitened.T)


def robust_solve(observed: Observed, columns: Columns, *, redescends: bool = False) -> Solution:
    """Solves for the unknowns by iteratively reweighted least squares with Huber's loss.

    Args:
        observed: Pixels of the images.
        columns: Columns of the linear problem.
        redescends: Whether to end with Tukey's loss, which gives outliers weight 0: objects that the scene lacks.
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
    """Averages residuals over the fitted pixels of each 3 x 3 neighbourhood, shape (N, 3).

    The robust weights use these means, because noise must not choose the weights; objects that the scene lacks are
    larger than a pixel.
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
    """Returns the sum over each pixel and its eight neighbours, C channels, shape (H, W, C)."""
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)))
    down = padded[:-2] + padded[1:-1] + padded[2:]
    return np.asarray(down[:, :-2] + down[:, 1:-1] + down[:, 2:])


def huber_cost(observed: Observed, model: Doubles, deviation: Doubles) -> float:
    """Returns the mean Huber loss of the residuals, in units of the squared deviation."""
    size = np.abs((observed.target - model) / (observed.noise * deviation))[observed.counts]
    return float(np.where(size <= HUBER_WIDTH, 0.5 * size**2, HUBER_WIDTH * (size - 0.5 * HUBER_WIDTH)).mean())


def huber_weights(residuals: Doubles) -> Doubles:
    """Returns Huber's weights of residuals in standard deviations: 1 up to `HUBER_WIDTH`, then falling as 1 / x."""
    return HUBER_WIDTH / np.maximum(np.abs(residuals), HUBER_WIDTH)


def tukey_weights(residuals: Doubles) -> Doubles:
    """Returns Tukey's biweights of residuals in standard deviations, which fall to 0 at `TUKEY_WIDTH`."""
    return np.maximum(1.0 - (residuals / TUKEY_WIDTH) ** 2, 0.0) ** 2


def deviation_of(residuals: Doubles) -> float:
    """Estimates the standard deviation of residuals from their median magnitude, which outliers do not change."""
    return max(_MAD_TO_DEVIATION * float(np.median(np.abs(residuals))), DEVIATION_MIN)


def covariance(observed: Observed, columns: Columns, solution: Solution, held: Doubles) -> Doubles:
    """Estimates the covariance of U unknowns, with residuals correlated within blocks of pixels (White 1980).

    Args:
        observed: Pixels of the images.
        columns: Columns of the linear problem.
        solution: The solution.
        held: Matrix added to the normal equations, such as the anchor of base colours, shape (U, U).

    Returns:
        Covariance matrix, shape (U, U).
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
    # Unknowns that are determined up to a common factor have no curvature: the ridge keeps their variance finite.
    least = np.finfo(np.float64).eps * float(np.trace(normal)) * np.eye(len(normal))
    inverse = np.linalg.inv(normal + least)
    return np.asarray(inverse @ (scores.T @ scores) @ inverse)


RELATIVE_NOISE = 0.02
"""Expected error of a pixel's light, relative to the sum of the pixel's light and the image's mean: no model is more
exact."""

NOISE_BLUR = 2
"""Radius, in pixels, of the blur applied to an image before its expected error is computed. Without the blur, pixels
that noise has darkened would get larger weights."""

ENVIRONMENT_ROWS = 32
"""Height, in pixels, of the images of SH environments: of the basis functions and of the fitted environment."""

ENVIRONMENT_DIRECTIONS = 96
"""Number of evenly spread directions in which the SH environment must not be negative."""

BLOCK_PX = 8
"""Side, in pixels, of the square blocks within which residuals count as correlated for standard errors."""

_SH_RIDGE = 1e-7
"""Ridge of the environment's coefficients above degree 0: in directions that no surface faces, the environment stays
constant."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A guess of lights, base colours and exposures, with its renders and the powers that fit best."""

    scene: Scene
    """Scene with the guessed light parameters; its lights still have the powers of the previous candidate."""
    gains: Doubles
    """Exposure factors of the V images, shape (V,)."""
    lights: Mapping[int, Doubles]
    """Render of each fitted light with power 1, by the light's index, N pixels, shape (2, N, 3)."""
    sh_renders: Doubles
    """Render under each of the K SH basis functions of the environment, shape (2, K, N, 3); K is 0 without an SH
    environment."""
    fixed: Doubles
    """Render of the light that is not fitted, shape (2, N, 3)."""
    columns: Columns
    solution: Solution

    @property
    def powers(self) -> dict[int, Doubles]:
        """Fitted power (colour times intensity) of each fitted light by the light's index, shape (3,) each."""
        factors = self.columns.channels(self.solution.unknowns)
        numbers = list(self.lights)
        if len(factors) < len(numbers):  # powers are given
            return {number: power_of(self.scene.lights[number]) for number in numbers}
        return {number: np.maximum(factors[row], 0.0) for row, number in enumerate(numbers)}

    @property
    def coefficients(self) -> Doubles:
        """Fitted SH coefficients of the environment, K per channel, shape (K, 3)."""
        count = self.sh_renders.shape[1]
        factors = self.columns.channels(self.solution.unknowns)
        return factors[len(factors) - count :]

    @property
    def lit_scene(self) -> Scene:
        """The scene with the fitted powers, and the SH environment as its last light."""
        lights = list(self.scene.lights)
        for number, power in self.powers.items():
            lights[number] = with_power(lights[number], power)
        if self.sh_renders.shape[1]:
            lights.append(environment_of(self.coefficients, self.scene))
        return replace(self.scene, lights=tuple(lights))


class PowerFitter:
    """Renders candidates for images of one resolution, with N pixels together, and fits the candidates' powers.

    Args:
        task: The unknowns.
        images: Images at this resolution.
        layers: Renderer of single lights.
    """

    def __init__(self, task: FitTask, images: Sequence[FitImage], layers: LightLayers) -> None:
        self.task, self.images, self.layers = task, images, layers
        sizes = [image.light.shape[0] * image.light.shape[1] for image in images]
        self.view: Rows = np.repeat(np.arange(len(sizes)), sizes)
        """Index of the image that each pixel belongs to, shape (N,)."""
        counts = np.concatenate([image.counts.reshape(-1, 3) for image in images])
        self.observed = Observed(
            target=np.concatenate([image.light.reshape(-1, 3) for image in images]),
            counts=counts & layers.lit_pixels(task.scene, images)[:, None],
            noise=np.concatenate([_expected_noise(image).reshape(-1, 3) for image in images]),
            blocks=_blocks(images),
            sizes=tuple((image.camera.height, image.camera.width) for image in images),
        )

    def begin(self, scene: Scene, gains: Doubles) -> Candidate:
        """Renders all lights of ``scene``, and returns the first candidate."""
        return self._guess(scene, gains, None)

    def moved(self, candidate: Candidate, scene: Scene, gains: Doubles) -> Candidate:
        """Returns a candidate with the lights, base colours and exposures of ``scene`` and ``gains``.

        Renders of ``candidate`` whose light and surfaces are unchanged are reused.
        """
        return self._guess(scene, gains, candidate)

    def settled(self, candidate: Candidate) -> Candidate:
        """Returns the candidate with powers solved again under Tukey's loss, which ignores outliers."""
        return replace(candidate, solution=robust_solve(self.observed, candidate.columns, redescends=True))

    def render_of(self, candidate: Candidate, number: int, scene: Scene) -> Doubles:
        """Renders the light number ``number`` of ``scene`` with power 1, shape (2, N, 3)."""
        return self.layers.render_light(candidate.scene, unit(scene.lights[number]), self.images, candidate.fixed)

    def exposed(self, renders: Doubles, gains: Doubles) -> Doubles:
        """Returns renders of N pixels, shape (..., N, 3), multiplied by the exposure factor of each pixel's image."""
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
        """Builds the columns: lights, then SH basis functions. Lights with held power are part of the fixed render."""
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
        """Returns the colour of a light if it is held, scaled to brightest channel 1; None if channels are fitted."""
        if not self.task.keeps_hues:
            return None
        color = np.array(scene.lights[number].color, np.float64)
        return color / color.max() if color.any() else np.ones(3)


def _differs_only_in_lights(scene: Scene, other: Scene) -> bool:
    """Returns whether two scenes have the same meshes and splat instances."""
    return scene.meshes == other.meshes and scene.splats == other.splats


def _expected_noise(image: FitImage) -> Doubles:
    """Returns the expected error of an image's linear light, computed from blurred pixels, shape (H, W, 3)."""
    light = _blurred(image.light)
    step = 1.0 / (255.0 * _encoding_slope(light))
    return RELATIVE_NOISE * (light + light.mean()) + step


def _blurred(image: Doubles) -> Doubles:
    """Returns a box blur of the image, with its border repeated."""
    height, width = image.shape[:2]
    padded = np.pad(image, ((NOISE_BLUR, NOISE_BLUR), (NOISE_BLUR, NOISE_BLUR), (0, 0)), mode="edge")
    reach = range(2 * NOISE_BLUR + 1)
    shifted = np.array([padded[y : y + height, x : x + width] for y in reach for x in reach])
    return np.asarray(shifted.mean(axis=0), np.float64)


def _encoding_slope(light: Doubles) -> Doubles:
    """Returns the derivative of display values with respect to linear light."""
    bright = np.clip(light, 1e-4, 1.0)
    return np.asarray((encode_srgb(1.01 * bright) - encode_srgb(0.99 * bright)) / (0.02 * bright))


def _blocks(images: Sequence[FitImage]) -> Rows:
    """Returns the index of the square block of pixels to which each of the N pixels belongs, shape (N,)."""
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
"""Name of the fitted environment."""


def render_sh_lights(degree: int, render_light: Callable[[Light], Doubles]) -> Doubles:
    """Renders the scene under each SH basis function as an environment.

    Basis functions with negative values are rendered with a constant added, whose render is subtracted again.

    Args:
        degree: SH degree.
        render_light: Renders one light into N pixels, twice with independent noise, shape (2, N, 3).

    Returns:
        Renders, shape (2, K, N, 3), K = (degree + 1)^2; all 0 if light from an environment reaches no pixel.
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
    """Returns the matrix from K SH coefficients to radiance in D evenly spread directions, shape (D, K)."""
    return np.asarray(sh_basis(even_directions(ENVIRONMENT_DIRECTIONS), degree), np.float64)


def environment_of(coefficients: Doubles, scene: Scene) -> LightEnvironment:
    """Returns an environment light from K SH coefficients, (K, 3), upright in the scene, invisible to the camera."""
    light = EnvironmentProbe(coefficients).light(ENVIRONMENT_ROWS, scene.upright_wxyz)
    return LightEnvironment(light.image, rotation_wxyz=light.rotation_wxyz, visible=False, name=ENVIRONMENT_NAME)
