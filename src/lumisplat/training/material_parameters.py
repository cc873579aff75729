"""Materials and environment in unbounded form, which Adam optimises."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lumisplat.constants import RADIANCE_LEAST
from lumisplat.math.adam import Adam
from lumisplat.math.arrays import Doubles
from lumisplat.training.lit_gaussians import Materials

ROUGHNESS_MIN = 0.1
"""Smallest roughness that a fit gives a Gaussian."""

ENVIRONMENT_SMOOTHNESS = 1e-3
"""Weight of squared differences of log radiance between neighbouring directions of the environment. The term that it is
added to, a mean over pixels, pairs or Gaussians, has weight 1."""

ENVIRONMENT_NEIGHBOURS = 6

_ROUGHNESS_RANGE = 1.0 - ROUGHNESS_MIN
_LOGIT_MAX = 7.0
_STATE_KEYS = ("albedo", "roughness", "sky")
"""Names of the optimised arrays in `MaterialParameters.state` and in state files."""


@dataclass(frozen=True, slots=True)
class MaterialRates:
    """Adam learning rates of the logits of materials, and of the environment's log radiance."""

    albedo: float
    roughness: float
    environment: float

    def scaled(self, factor: float) -> MaterialRates:
        """Returns all rates times a factor."""
        return MaterialRates(*(factor * rate for rate in (self.albedo, self.roughness, self.environment)))


class MaterialParameters:
    """Logits of albedo and roughness, log radiance of the environment, and their Adam moments.

    Args:
        start: Initial materials and environment. The normals stay as they are.
        directions: Evenly spread unit directions of the environment, shape (K, 3).
    """

    def __init__(self, start: Materials, directions: Doubles) -> None:
        self._normals, self._ring = start.normals, nearest_directions(directions)
        self._values = {
            "albedo": _logits(start.albedo),
            "roughness": _logits((start.roughness - ROUGHNESS_MIN) / _ROUGHNESS_RANGE),
            "sky": np.log(np.maximum(start.environment, RADIANCE_LEAST)),
        }
        self._moments = {name: Adam.still(values.shape) for name, values in self._values.items()}

    @property
    def materials(self) -> Materials:
        """Current materials and environment."""
        return materials_of(self._values, self._normals)

    @property
    def state(self) -> dict[str, Doubles]:
        """Optimised arrays and their Adam moments by name."""
        arrays = dict(self._values)
        for name, moments in self._moments.items():
            arrays |= {f"{name}.first": moments.first, f"{name}.second": moments.second}
        return arrays

    def restore(self, state: Mapping[str, Doubles], steps: int) -> None:
        """Continues from a stored ``state`` of the same Gaussians after a number of steps."""
        self._values = {name: state[name].copy() for name in _STATE_KEYS}
        self._moments = {
            name: Adam(state[f"{name}.first"].copy(), state[f"{name}.second"].copy(), np.array(float(steps)))
            for name in _STATE_KEYS
        }

    def step(self, gradient: Materials, rates: MaterialRates) -> None:
        """Makes an Adam step, given the gradient of the loss by materials and environment.

        The smoothness of the environment is added to the gradient.
        """
        now, sky = self.materials, self._values["sky"]
        share = (now.roughness - ROUGHNESS_MIN) / _ROUGHNESS_RANGE
        steps = {
            "albedo": (gradient.albedo * now.albedo * (1.0 - now.albedo), rates.albedo),
            "roughness": (gradient.roughness * _ROUGHNESS_RANGE * share * (1.0 - share), rates.roughness),
            "sky": (gradient.environment * now.environment + smoothness_gradient(sky, self._ring), rates.environment),
        }
        for name, (by_value, rate) in steps.items():
            self._values[name] += self._moments[name].step(by_value, rate)
            if name != "sky":
                np.clip(self._values[name], -_LOGIT_MAX, _LOGIT_MAX, out=self._values[name])


def materials_of(state: Mapping[str, Doubles], normals: Doubles) -> Materials:
    """Converts logits of materials and log radiance of the environment to `Materials` with ``normals``."""
    roughness = ROUGHNESS_MIN + _ROUGHNESS_RANGE * _shares(state["roughness"])
    return Materials(_shares(state["albedo"]), roughness, normals, np.exp(state["sky"]))


def _shares(logits: Doubles) -> Doubles:
    return 1.0 / (1.0 + np.exp(-logits))


def _logits(shares: Doubles) -> Doubles:
    least = 1.0 / (1.0 + math.exp(_LOGIT_MAX))
    inside = np.clip(shares, least, 1.0 - least)
    return np.log(inside / (1.0 - inside))


def nearest_directions(directions: Doubles) -> np.ndarray:
    """Returns, for each of K directions, the indices of the six nearest other directions, shape (K, 6)."""
    return np.argsort(-(directions @ directions.T), axis=1, kind="stable")[:, 1 : 1 + ENVIRONMENT_NEIGHBOURS]


def smoothness_gradient(log_environment: Doubles, neighbours: np.ndarray) -> Doubles:
    """Returns the smoothness term's gradient with respect to the log radiance of K directions, shape (K, 3).

    ``neighbours`` holds the indices of each direction's neighbours, shape (K, 6); their radiance is held fixed.
    """
    return (
        ENVIRONMENT_SMOOTHNESS
        / len(log_environment)
        * (log_environment[:, None] - log_environment[neighbours]).sum(axis=1)
    )
