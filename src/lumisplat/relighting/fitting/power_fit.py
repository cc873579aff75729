"""Fits the powers of lights at given positions, and an environment in SH, to images: a linear problem."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from lumisplat.math.arrays import Doubles, Rows
from lumisplat.math.color import encode_srgb
from lumisplat.math.directions import panorama_directions
from lumisplat.math.sh import even_directions, sh_basis
from lumisplat.relighting.fitting.images import FitPhotograph
from lumisplat.relighting.fitting.light_layers import LightLayers, power_of, unit, with_power
from lumisplat.relighting.fitting.normal_equations import Columns, Observed, Solution, explain, unknown_counts
from lumisplat.relighting.fitting.parameters import FitTask
from lumisplat.relighting.probe import EnvironmentProbe
from lumisplat.scene.lights import Light, LightEnvironment
from lumisplat.scene.scene import Scene

RELATIVE_NOISE = 0.02
"""Error of a photograph's light that is expected of it, relative to the pixel and to the mean: no model is better."""

NOISE_BLUR = 2
"""Pixels to each side over which a photograph is averaged to say what error is expected: by noisy pixels
themselves, those that noise has made dark would weigh more."""

SKY_ROWS = 32
"""Rows of the images of harmonics as environments, and of the environment that is found."""

SKY_DIRECTIONS = 96
"""Directions in which the radiance of harmonics must not be negative, spread evenly."""

BLOCK_PX = 8
"""Side of the squares of pixels whose residuals are taken to go together, where errors are estimated."""

_HARMONIC_RIDGE = 1e-7
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
    harmonics: Doubles
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
        count = self.harmonics.shape[1]
        factors = self.columns.channels(self.solution.unknowns)
        return factors[len(factors) - count :]

    @property
    def lit(self) -> Scene:
        """The scene with the lights as strong as they were found, the harmonics as its last light."""
        lights = list(self.scene.lights)
        for number, power in self.powers.items():
            lights[number] = with_power(lights[number], power)
        if self.harmonics.shape[1]:
            lights.append(environment_of(self.coefficients, self.scene))
        return replace(self.scene, lights=tuple(lights))


class PowerFitter:
    """Makes guesses for photographs of one resolution.

    Args:
        task: What is unknown.
        photographs: At this resolution.
        layers: Renders.
    """

    def __init__(self, task: FitTask, photographs: Sequence[FitPhotograph], layers: LightLayers) -> None:
        self.task, self.photographs, self.layers = task, photographs, layers
        sizes = [one.light.shape[0] * one.light.shape[1] for one in photographs]
        self.view: Rows = np.repeat(np.arange(len(sizes)), sizes)
        """Which photograph each pixel is of, shape (N,)."""
        counts = np.concatenate([one.counts.reshape(-1, 3) for one in photographs])
        self.observed = Observed(
            target=np.concatenate([one.light.reshape(-1, 3) for one in photographs]),
            counts=counts & layers.shown(task.scene, photographs)[:, None],
            noise=np.concatenate([_expected_noise(one).reshape(-1, 3) for one in photographs]),
            blocks=_blocks(photographs),
            sizes=tuple((one.camera.height, one.camera.width) for one in photographs),
        )

    def begin(self, scene: Scene, gains: Doubles) -> Candidate:
        """The first candidate."""
        return self._guess(scene, gains, None)

    def moved(self, candidate: Candidate, scene: Scene, gains: Doubles) -> Candidate:
        """A candidate with other lights, materials or exposures; what is as it was is not rendered again."""
        return self._guess(scene, gains, candidate)

    def settled(self, candidate: Candidate) -> Candidate:
        """The candidate, with what does not fit at all left out."""
        return replace(candidate, solution=explain(self.observed, candidate.columns, redescends=True))

    def picture_of(self, candidate: Candidate, number: int, scene: Scene) -> Doubles:
        """The picture of a light of a scene alone, of power 1, shape (2, N, 3)."""
        return self.layers.alone(candidate.scene, unit(scene.lights[number]), self.photographs, candidate.fixed)

    def exposed(self, pictures: Doubles, gains: Doubles) -> Doubles:
        """Pictures (..., N, 3), as the photographs are exposed."""
        return pictures * gains[self.view][:, None]

    def _guess(self, scene: Scene, gains: Doubles, before: Candidate | None) -> Candidate:
        task = self.task
        held = before if before is not None and _look_alike(before.scene, scene) else None
        fixed = self.layers.picture(scene, (), self.photographs) if held is None else held.fixed
        lights: dict[int, Doubles] = {}
        for number in task.lights:
            light = scene.lights[number]
            if held is not None and held.scene.lights[number] is light:
                lights[number] = held.lights[number]
            else:
                lights[number] = self.layers.alone(scene, unit(light), self.photographs, fixed)
        if held is not None:
            harmonics = held.harmonics
        elif task.degree is None:
            harmonics = np.zeros((2, 0, *fixed.shape[1:]))
        else:
            harmonics = harmonic_pictures(
                task.degree, lambda light: self.layers.alone(scene, light, self.photographs, fixed)
            )
        columns = self._columns(scene, gains, lights, harmonics, fixed)
        return Candidate(scene, gains, lights, harmonics, fixed, columns, explain(self.observed, columns))

    def _columns(
        self, scene: Scene, gains: Doubles, lights: Mapping[int, Doubles], harmonics: Doubles, fixed: Doubles
    ) -> Columns:
        """Of the lights, then of the harmonics; lights of a given power are a part of what is fixed."""
        pictures, tints = list(lights.values()), [self._tint(scene, number) for number in lights]
        if not self.task.scales:
            shining = (power_of(scene.lights[number]) * picture for number, picture in lights.items())
            fixed, pictures, tints = fixed + sum(shining), [], []
        lamps = sum(unknown_counts(tints))
        count = harmonics.shape[1]
        total = lamps + 3 * count
        sky = radiance_rows(self.task.degree or 0) if count else np.zeros((0, 0))
        bounded = np.zeros((lamps + 3 * len(sky), total))
        bounded[:lamps, :lamps] = np.eye(lamps)
        for channel in range(3 if count else 0):
            bounded[lamps + channel * len(sky) :][: len(sky), lamps + channel :: 3] = sky
        ridge = np.zeros(total)
        ridge[lamps + 3 :] = _HARMONIC_RIDGE
        stacked = np.stack(pictures, axis=1) if pictures else np.zeros((2, 0, *fixed.shape[1:]))
        return Columns(
            pictures=self.exposed(np.concatenate([stacked, harmonics], axis=1), gains),
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


def _look_alike(scene: Scene, other: Scene) -> bool:
    """Whether nothing but their lights is different."""
    return scene.meshes == other.meshes and scene.splats == other.splats


def _expected_noise(photograph: FitPhotograph) -> Doubles:
    """Errors that are expected of a photograph, (H, W, 3), by what is around pixels: noise must not weigh itself."""
    light = _blurred(photograph.light)
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


def _blocks(photographs: Sequence[FitPhotograph]) -> Rows:
    """Numbers of the squares that pixels are in, shape (N,)."""
    blocks: list[Rows] = []
    first = 0
    for one in photographs:
        height, width = one.light.shape[:2]
        across = -(-width // BLOCK_PX)
        down: Rows = np.arange(height, dtype=np.int64)[:, None] // BLOCK_PX
        places: Rows = down * across + np.arange(width, dtype=np.int64) // BLOCK_PX
        blocks.append(first + places.ravel())
        first = int(blocks[-1].max()) + 1
    return np.concatenate(blocks)


NAME = "environment"
"""Of the light that is found."""


def harmonic_pictures(degree: int, alone: Callable[[Light], Doubles]) -> Doubles:
    """Pictures under each harmonic as an environment.

    Args:
        degree: Of the harmonics.
        alone: The picture of a light alone, (2, N, 3).

    Returns:
        Shape (2, K, N, 3), K = (degree + 1)^2; all 0 if no light of an environment arrives anywhere.
    """
    basis = sh_basis(panorama_directions(SKY_ROWS, 2 * SKY_ROWS), degree)
    even = alone(LightEnvironment(visible=False))
    pictures = np.zeros((len(even), basis.shape[-1], *even.shape[1:]))
    if not even.any():
        return pictures
    pictures[:, 0] = basis[0, 0, 0] * even
    for number in range(1, basis.shape[-1]):
        values = basis[..., number]
        largest = float(np.abs(values).max())
        image = np.repeat((1.0 + values / largest)[..., None], 3, axis=2).clip(0.0)
        pictures[:, number] = largest * (alone(LightEnvironment(image, visible=False)) - even)
    return pictures


@cache
def radiance_rows(degree: int) -> Doubles:
    """Radiance in directions all around, of coefficients, shape (D, K): none of them may be negative."""
    return np.asarray(sh_basis(even_directions(SKY_DIRECTIONS), degree), np.float64)


def environment_of(coefficients: Doubles, scene: Scene) -> LightEnvironment:
    """The environment of coefficients, shape (K, 3): it stands upright in the scene, and is not seen directly."""
    light = EnvironmentProbe(coefficients).light(SKY_ROWS, scene.upright_wxyz)
    return LightEnvironment(light.image, rotation_wxyz=light.rotation_wxyz, visible=False, name=NAME)
