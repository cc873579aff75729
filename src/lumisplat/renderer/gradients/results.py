"""Derivatives as callers get them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.device.structs.gradients import GaussianGradient
from lumisplat.math.arrays import FloatArray
from lumisplat.runtime.buffers import device_array

Doubles = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class SetGradient:
    """Derivatives by the Gaussians of one set, as that stores them; 0 for those that the camera does not see."""

    means: FloatArray
    """Shape (N, 3)."""
    rotations_wxyz: FloatArray
    """By quaternions that are normalised after they have changed, so at right angles to them; shape (N, 4)."""
    scales: FloatArray
    """By standard deviations, not by their logarithms; shape (N, 3)."""
    opacities: FloatArray
    """By 0..1, not by logits; shape (N,)."""
    sh: FloatArray
    """Shape (N, K, 3); 0 for degrees above those of the frame."""


@dataclass(frozen=True, slots=True, eq=False)
class SplatGradients:
    """Derivatives of a number by what a frame was drawn from."""

    sets: tuple[SetGradient, ...]
    """By the distinct Gaussian sets of the scene, in the order of their first instances; over all instances of each."""
    background: Doubles
    """By the colour of the background, shape (3,)."""
    camera_from_world: Doubles | None
    """By the elements of the camera's pose, shape (4, 4), whose last row is 0; None: it was not asked for. Small turns
    and shifts of the camera follow from it by the chain rule; of a frame of rays, nothing else is in it, and both poses
    of a rolling shutter move together."""
    centers: FloatArray
    """By where splats are in the image, pixels; of all Gaussians of the scene, instance by instance, shape (N, 2). No
    rows, like what follows, of a frame of rays: these know no splats."""
    centers_absolute: FloatArray
    """The same with the magnitudes of what pixels add by way of colour and alpha (AbsGS, Ye et al. 2024), shape
    (N, 2)."""
    weights: FloatArray
    """Sum of the weights with which each is blended in the frame, shape (N,)."""
    features: FloatArray | None = None
    """By the features that were shown, shape (N, C); None: they were not asked for."""


@dataclass(frozen=True, slots=True, eq=False)
class RayGradients:
    """Derivatives of a number by the Gaussians that rays have hit."""

    sets: tuple[SetGradient, ...]
    """As of `SplatGradients`."""
    weights: FloatArray
    """As of `SplatGradients`."""


def set_gradient(gradient: GaussianGradient) -> SetGradient:
    """Derivatives by a Gaussian set, of those on the device."""
    rotations = host_values(gradient.rotations)
    return SetGradient(
        means=host_values(gradient.means),
        rotations_wxyz=np.roll(rotations, 1, axis=1),
        scales=host_values(gradient.scales),
        opacities=host_values(gradient.opacities),
        sh=host_values(gradient.sh).reshape(len(rotations), gradient.sh_count, 3),
    )


def host_values(array: wp.array[Any]) -> FloatArray:
    """A copy on the host."""
    return np.array(device_array(array).numpy(), np.float32)


def by_background(by_color: FloatArray, transmittance: FloatArray) -> Doubles:
    """Derivatives by the colour of the background, seen through pixels."""
    return np.asarray(transmittance.reshape(-1).astype(np.float64) @ by_color.reshape(-1, 3), np.float64)
