"""Fits the powers (colour times intensity) of lights, and an SH environment, to images by robust least squares."""

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
"""Residual, in standard deviations, at which Huber's loss changes from quadratic to linear: 95 % efficiency for normal
residuals (Huber 1981)."""

TUKEY_WIDTH = 4.685
"""Residual, in standard deviations, from which Tukey's weight is 0: 95 % efficiency for normal residuals (Beaton and
Tukey 1974)."""

DEVIATION_MIN = 1e-4
"""Lower bound of the residuals' standard deviation, in units of the expected noise. Robust weights divide by the
standard deviation, and rendered images may have no residuals."""

ROBUST_STEPS = 40
"""Maximum number of reweightings for each robust loss."""

ROBUST_CHANGE = 1e-7
"""Reweighting ends when no unknown changes by more than this, relative to the largest unknown."""

NORMAL_RIDGE = 1e-9
"""Ridge added to the normal equations, as a fraction of their diagonal: lights with equal renders get equal powers."""

NOISE_SHARE_MAX = 0.5
"""Largest fraction that is subtracted as render noise from the squared norm of any weighted sum of renders."""

_MAD_TO_DEVIATION = 1.4826
"""Factor from median absolute deviation to standard deviation, for a normal distribution."""


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """The N pixels of all images together: the data to which the linear model of light is fitted."""

    target: Doubles
    """Linear Rec.709 light of the images' pixels, shape (N, 3)."""
    counts: Flags
    """True for each channel of each pixel that is fitted: not clipped, not masked, and showing surfaces that reflect
    light, shape (N, 3)."""
    noise: Doubles
    """Expected standard error of each pixel's linear light, shape (N, 3); residuals are divided by this error."""
    blocks: Rows
    """Number of the 8 x 8 block to which each pixel belongs, shape (N,); residuals within a block count as correlated.
    """
    sizes: tuple[tuple[int, int], ...]
    """Height and width of each image, pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """Linear model of the images' N pixels: a fixed render plus K renders, with factors that U unknowns determine."""

    renders: Doubles
    """The K renders to be scaled, each made twice with independent noise, N pixels, shape (2, K, N, 3)."""
    fixed: Doubles
    """Render, twice with independent noise, of the emission and of all lights with held power, shape (2, N, 3)."""
    tints: tuple[Doubles | None, ...]
    """Held colour, shape (3,), of each of the K renders whose light has one unknown, the scale of this colour. None:
    the render has one unknown per channel."""
    bounded: Doubles
    """Matrix, (R, U), of R constraints ``bounded @ x >= least`` on the U unknowns x. The constraints keep powers and
    environment from being negative."""
    least: Doubles
    """Right side of the constraints ``bounded @ x >= least``, shape (R,)."""
    ridge: Doubles = field(default_factory=lambda: np.zeros(0))
    """Ridge of each unknown, shape (U,), as a fraction of the unknown's diagonal entry in the normal equations; empty:
    none."""

    @property
    def spread(self) -> Doubles:
        """Matrix from the U unknowns to the factors of the K renders in each channel, shape (3, K, U)."""
        return spread_of(self.tints)

    def channels(self, unknowns: Doubles) -> Doubles:
        """Returns the factors of the K renders per channel, shape (K, 3), for the U unknowns."""
        return np.asarray(np.einsum("cku,u->kc", self.spread, unknowns))

    def model(self, unknowns: Doubles) -> Doubles:
        """Returns the modelled linear light of N pixels, (N, 3): the fixed render plus the K renders times factors."""
        factors = self.channels(unknowns)
        return self.fixed.mean(axis=0) + np.einsum("knc,kc->nc", self.renders.mean(axis=0), factors)


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Result of a robust fit: the U unknowns with the smallest loss, and the modelled light of N pixels."""

    unknowns: Doubles
    """Fitted values of the U unknowns: light powers, then SH coefficients of the environment, shape (U,)."""
    model: Doubles
    """Linear light that the fitted unknowns give at the N pixels, shape (N, 3)."""
    weights: Doubles
    """Weight of each squared residual: robust weight over squared expected noise, 0 if not fitted, shape (N, 3)."""
    deviation: Doubles
    """Robust standard deviation of all fitted residuals, in units of the expected noise, as a 0-dimensional array."""


def unknown_counts(tints: Sequence[Doubles | None]) -> list[int]:
    """Returns the number of unknowns of each render: 1 for a held colour (a tint), 3 for None."""
    return [3 if tint is None else 1 for tint in tints]


def spread_of(tints: Sequence[Doubles | None]) -> Doubles:
    """Returns the matrix `Columns.spread`, (3, K, U), for the tints of K renders."""
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
    """Returns the weighted normal equations ``G x = m`` of the unknowns x: G, shape (U, U), and m, shape (U,).

    Each light is rendered twice with independent noise. Products of the two renders keep the noise from biasing G and
    m. At most `NOISE_SHARE_MAX` of the squared norm of a sum of renders is removed as noise.
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
    """Makes a matrix positive definite by a ridge, which is added as a fraction of the diagonal.

    Args:
        gram: Positive semidefinite matrix of U unknowns, shape (U, U).
        ridge: Ridge in addition to `NORMAL_RIDGE`, shape (U,); empty: none.
    """
    diagonal = np.diag(gram)
    largest = float(diagonal.max(initial=0.0)) or 1.0
    extra = ridge if ridge.size else np.zeros(len(gram))
    return gram + np.diag((NORMAL_RIDGE + extra) * np.maximum(diagonal, 1e-6 * largest))


def _without(gram: Doubles, noise: Doubles) -> Doubles:
    """Subtracts the render noise, (U, U), from the matrix ``gram``, but at most `NOISE_SHARE_MAX` of any norm."""
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
        columns: Renders whose factors are the unknowns.
        redescends: Whether to continue with Tukey's loss. With it, outliers, such as objects that the scene lacks, get
            weight 0.
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
    """Averages residuals, (N, 3), over each pixel and its eight neighbours, as far as these are fitted.

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
    """Returns for each pixel the sum over itself and its eight neighbours in the image, shape (H, W, C)."""
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)))
    down = padded[:-2] + padded[1:-1] + padded[2:]
    return np.asarray(down[:, :-2] + down[:, 1:-1] + down[:, 2:])


def huber_cost(observed: Observed, model: Doubles, deviation: Doubles) -> float:
    """Returns the mean Huber loss of the fitted residuals over their standard deviation: noise times ``deviation``."""
    size = np.abs((observed.target - model) / (observed.noise * deviation))[observed.counts]
    return float(np.where(size <= HUBER_WIDTH, 0.5 * size**2, HUBER_WIDTH * (size - 0.5 * HUBER_WIDTH)).mean())


def huber_weights(residuals: Doubles) -> Doubles:
    """Returns Huber's weights of standardised residuals x: ``min(1, HUBER_WIDTH / |x|)``."""
    return HUBER_WIDTH / np.maximum(np.abs(residuals), HUBER_WIDTH)


def tukey_weights(residuals: Doubles) -> Doubles:
    """Returns Tukey's biweights of standardised residuals x: ``(1 - (x / TUKEY_WIDTH)^2)^2``, 0 beyond the width."""
    return np.maximum(1.0 - (residuals / TUKEY_WIDTH) ** 2, 0.0) ** 2


def deviation_of(residuals: Doubles) -> float:
    """Estimates the standard deviation of residuals from their median magnitude, which outliers do not change."""
    return max(_MAD_TO_DEVIATION * float(np.median(np.abs(residuals))), DEVIATION_MIN)


def covariance(observed: Observed, columns: Columns, solution: Solution, held: Doubles) -> Doubles:
    """Estimates the covariance of U unknowns, with residuals correlated within blocks of pixels (White 1980).

    Args:
        observed: Pixels of the images.
        columns: Renders whose factors are the unknowns.
        solution: The fitted unknowns, with the weights of the pixels.
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
"""Expected error of a pixel's light, as a fraction of the sum of the pixel's light and the image's mean light: no
light model is more exact."""

NOISE_BLUR = 2
"""Radius, pixels, of the box blur that is applied to an image before its expected error is computed: without it,
pixels that noise darkened would get larger weights."""

ENVIRONMENT_ROWS = 32
"""Height, pixels, of the latitude-longitude images of SH basis functions and of the fitted SH environment."""

ENVIRONMENT_DIRECTIONS = 96
"""Number of evenly spread directions in which the SH environment must not be negative."""

BLOCK_PX = 8
"""Side, in pixels, of the square blocks within which residuals count as correlated for standard errors."""

_SH_RIDGE = 1e-7
"""Relative ridge on the environment's SH coefficients above degree 0. Where no surface receives light, the
coefficients tend to 0, a constant environment."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A guess of light positions, base colours and exposures, with its renders and the light powers that fit best."""

    scene: Scene
    """Scene with guessed positions, radii, angles and base colours. The powers of its lights are not the fitted ones,
    which `powers` returns."""
    gains: Doubles
    """Factors ``2^exposure`` of the V images, shape (V,)."""
    lights: Mapping[int, Doubles]
    """Two renders of what each fitted light adds with colour times intensity 1, by the light's index, shape (2, N, 3).
    """
    sh_renders: Doubles
    """Two renders of what each of K SH basis functions adds as the environment, shape (2, K, N, 3); K is 0 without an
    SH environment."""
    fixed: Doubles
    """Two renders of the scene's emission without any light, shape (2, N, 3)."""
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
        """The candidate's scene with the fitted powers; an SH environment is appended as the last light."""
        lights = list(self.scene.lights)
        for number, power in self.powers.items():
            lights[number] = with_power(lights[number], power)
        if self.sh_renders.shape[1]:
            lights.append(environment_of(self.coefficients, self.scene))
        return replace(self.scene, lights=tuple(lights))


class PowerFitter:
    """Fits light powers to images of one resolution, N pixels together, for guesses of all other unknowns.

    Args:
        task: Unknowns of the fit.
        images: Images, all scaled to this fitter's resolution.
        layers: Renders single lights.
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
        """Renders every light of ``scene`` and fits the powers; ``gains`` are the V images' exposure factors."""
        return self._guess(scene, gains, None)

    def moved(self, candidate: Candidate, scene: Scene, gains: Doubles) -> Candidate:
        """Returns a candidate for another ``scene`` with the same lights, and for other exposure factors ``gains``.

        The lights of ``scene`` may be moved or resized. Renders of ``candidate`` are reused if their light and all
        surfaces are unchanged.
        """
        return self._guess(scene, gains, candidate)

    def settled(self, candidate: Candidate) -> Candidate:
        """Returns the candidate with powers solved again under Tukey's loss, in which large residuals have weight 0."""
        return replace(candidate, solution=robust_solve(self.observed, candidate.columns, redescends=True))

    def render_of(self, candidate: Candidate, number: int, scene: Scene) -> Doubles:
        """Renders what light number ``number`` of ``scene`` adds with colour times intensity 1, shape (2, N, 3)."""
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
        """Builds the linear model: renders of lights, then of SH basis functions; held lights join the fixed render."""
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
        """Returns a light's colour, brightest channel 1, if the colour is held; None if every channel is an unknown."""
        if not self.task.keeps_hues:
            return None
        color = np.array(scene.lights[number].color, np.float64)
        return color / color.max() if color.any() else np.ones(3)


def _differs_only_in_lights(scene: Scene, other: Scene) -> bool:
    """Returns whether two scenes have the same meshes and splat instances."""
    return scene.meshes == other.meshes and scene.splats == other.splats


def _expected_noise(image: FitImage) -> Doubles:
    """Returns the expected error of an image's linear light, shape (H, W, 3): model error plus one 8-bit step.

    The error is computed from blurred pixels. Otherwise, pixels that noise darkened would get larger weights.
    """
    light = _blurred(image.light)
    step = 1.0 / (255.0 * _encoding_slope(light))
    return RELATIVE_NOISE * (light + light.mean()) + step


def _blurred(image: Doubles) -> Doubles:
    """Returns the image box-blurred over 2 `NOISE_BLUR` + 1 pixels in each direction; border pixels are repeated."""
    height, width = image.shape[:2]
    padded = np.pad(image, ((NOISE_BLUR, NOISE_BLUR), (NOISE_BLUR, NOISE_BLUR), (0, 0)), mode="edge")
    reach = range(2 * NOISE_BLUR + 1)
    shifted = np.array([padded[y : y + height, x : x + width] for y in reach for x in reach])
    return np.asarray(shifted.mean(axis=0), np.float64)


def _encoding_slope(light: Doubles) -> Doubles:
    """Returns the derivative of sRGB display values by linear light; the light is clamped to 0.0001..1 first."""
    bright = np.clip(light, 1e-4, 1.0)
    return np.asarray((encode_srgb(1.01 * bright) - encode_srgb(0.99 * bright)) / (0.02 * bright))


def _blocks(images: Sequence[FitImage]) -> Rows:
    """Returns for each of N pixels the number of its 8 x 8 block (`BLOCK_PX`), counted over all images, shape (N,)."""
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
"""Name of the light that is the fitted SH environment; messages also use it for the environment's unknowns."""


def render_sh_lights(degree: int, render_light: Callable[[Light], Doubles]) -> Doubles:
    """Renders the scene under each SH basis function as an environment.

    A basis function with negative values is rendered with a constant added. The render of the constant is then
    subtracted.

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
