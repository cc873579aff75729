"""What a fit may change, decided once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, cast

import numpy as np

from lumisplat.config import check_whole
from lumisplat.config.checks import check_flag, is_number
from lumisplat.constants.light_fit import FIT_DEGREE_MAX
from lumisplat.errors import ConfigError, SceneError
from lumisplat.math.arrays import Doubles
from lumisplat.relighting.fitting.moves import Move, moves_of
from lumisplat.relighting.fitting.paints import Paint, paints_of
from lumisplat.scene.lights import LightEnvironment, PlacedLight
from lumisplat.scene.scene import Scene

Exposure = float | Sequence[float] | Literal["fit"] | None


@dataclass(frozen=True, slots=True, kw_only=True)
class FitOptions:
    """What a caller asks for, as of `lumisplat.fit_lights`."""

    environment_degree: int | Literal["auto"] | None = "auto"
    intensities: bool = True
    keep_hues: bool = False
    positions: bool = False
    radii: bool = False
    angles: bool = False
    base_colors: bool | Sequence[str] = False
    exposure: Exposure = None

    def __post_init__(self) -> None:
        for name in ("intensities", "keep_hues", "positions", "radii", "angles"):
            check_flag(name, getattr(self, name))
        if self.environment_degree is not None and self.environment_degree != "auto":
            check_whole("environment_degree", self.environment_degree, 0, FIT_DEGREE_MAX)
        if isinstance(self.base_colors, str):
            raise ConfigError(f"base_colors is '{self.base_colors}', expected True or a list of names of materials")


@dataclass(frozen=True, slots=True, eq=False)
class FitTask:
    """The unknowns of a fit."""

    scene: Scene
    """Where it begins: without its environment, if harmonics replace it."""
    lights: tuple[int, ...]
    """Numbers of the lights that are fitted: those that are enabled."""
    degree: int | None
    """Of the environment's harmonics; None: there are none."""
    scales: bool
    """Whether powers of lights are unknown."""
    keeps_hues: bool
    """Whether the channels of a light share one unknown."""
    moves: tuple[Move, ...]
    paints: tuple[Paint, ...]
    anchors: bool
    """Whether the base colours' mean is held, for only its product with the lights' strength is known."""
    exposed: tuple[bool, ...]
    """Which photographs' exposures are unknown."""
    gains: Doubles
    """Factors of the exposures where it begins, shape (V,)."""
    size: float
    """Of the room, scene units: the longest side of the box that holds the scene."""
    low: Doubles
    """Of a box for lamps: that of the scene, and of the lamps as they are."""
    high: Doubles

    @classmethod
    def of(
        cls, scene: Scene, options: FitOptions, exposures: Sequence[float], *, shines: Callable[[], bool]
    ) -> FitTask:
        """The unknowns.

        Args:
            scene: The scene as it was given.
            options: What is asked for.
            exposures: Of the photographs' cameras, stops.
            shines: Says whether something in the scene shines that is not fitted.

        Raises:
            ConfigError: Nothing is asked for, or an exposure is none.
            SceneError: The scene has no lights to fit, is empty, or has no such material.
        """
        start, degree = _with_harmonics(scene, options)
        lights = tuple(number for number, light in enumerate(start.lights) if light.enabled)
        if not lights and degree is None:
            raise SceneError(
                "the scene has no lights to fit: put lamps where they may be (ls.estimate_lights finds some of a "
                "capture), or ask for an environment_degree"
            )
        low, high = start.bulk_bounds()
        size = float((high - low).max())
        moves = [
            move
            for number in lights
            for move in moves_of(
                number,
                start.lights[number],
                size,
                positions=options.positions,
                radii=options.radii,
                angles=options.angles,
            )
        ]
        paints = paints_of(start, options.base_colors)
        fits_exposure = isinstance(options.exposure, str) and options.exposure == "fit"
        if not (options.intensities or moves or paints or fits_exposure or degree is not None):
            raise ConfigError(
                "nothing is left to find: intensities are kept, and neither places, sizes, colours, an exposure nor an "
                "environment are asked for, or the scene has none that could change"
            )
        unknown = [fits_exposure] * len(exposures)
        if fits_exposure and options.intensities and not shines():
            unknown[0] = False  # else all lights could be twice as strong, and the exposure a stop less
        every = isinstance(options.base_colors, bool) or len(paints) == len(paints_of(start, True))
        lamps = [start.lights[number] for number in lights]
        placed = [lamp.position for lamp in lamps if isinstance(lamp, PlacedLight)]
        places = np.array(placed, np.float64).reshape(-1, 3)
        return cls(
            scene=start,
            lights=lights,
            degree=degree,
            scales=options.intensities,
            keeps_hues=options.keep_hues,
            moves=tuple(moves),
            paints=tuple(paints),
            anchors=bool(paints) and options.intensities and every,
            exposed=tuple(unknown),
            gains=np.exp2(_stops(options.exposure, exposures)),
            size=size,
            low=np.minimum(low, places.min(axis=0, initial=np.inf)),
            high=np.maximum(high, places.max(axis=0, initial=-np.inf)),
        )


def _with_harmonics(scene: Scene, options: FitOptions) -> tuple[Scene, int | None]:
    """The scene, without the environment that harmonics replace, and their degree."""
    own = [light for light in scene.lights if isinstance(light, LightEnvironment) and light.enabled]
    degree = options.environment_degree
    if degree == "auto":
        has_image = any(light.image is not None for light in own)
        degree = None if has_image or not options.intensities else 2
    if degree is None or not own:
        return scene, degree
    return replace(scene, lights=tuple(light for light in scene.lights if light is not own[0])), degree


def _stops(exposure: Exposure, cameras: Sequence[float]) -> Doubles:
    """The exposure of each photograph, as it is given, else as its camera says.

    Raises:
        ConfigError: It is neither a number, nor one a photograph, nor "fit".
    """
    if exposure is None or (isinstance(exposure, str) and exposure == "fit"):
        return np.array(cameras, np.float64)
    given = [exposure] * len(cameras) if is_number(exposure) else list(cast(Sequence[float], exposure))
    if len(given) != len(cameras) or not all(map(is_number, given)):
        raise ConfigError(
            f"exposure is {exposure!r}, expected stops, for all photographs or for each of the {len(cameras)}, or 'fit'"
        )
    if not np.isfinite(given).all():
        raise ConfigError(f"exposure is {exposure!r}, expected finite stops")
    return np.array(given, np.float64)
