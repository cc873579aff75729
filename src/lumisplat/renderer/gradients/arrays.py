"""Arrays of derivatives: those that callers give, those on the device, and those that callers get."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import warp as wp

from lumisplat.device.structs.gradients import GaussianGradient
from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles, FloatArray, host_array
from lumisplat.renderer.scene.assets import SplatAsset
from lumisplat.runtime.buffers import Buffers, device_array

DLPACK_CUDA = 2
"""kDLCUDA of dlpack.h."""


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


def given_array(name: str, values: Any, shape: tuple[int, ...]) -> FloatArray:
    """A caller's array as C-contiguous float32, without a copy where that is possible; those of GPUs are downloaded.

    Raises:
        SceneError: It cannot be read, has another shape, or values that are not finite.
    """
    try:
        array = _read(values)
    except (BufferError, RuntimeError, TypeError, ValueError) as error:
        problem = str(error).partition("\n")[0].rstrip(".")
        raise SceneError(
            f"{name} cannot be read as an array: {problem}; expected numbers, and a tensor that has gradients detached"
        ) from None
    if array.shape != shape:
        raise SceneError(f"{name} has shape {array.shape}, expected {shape}")
    bad = array.size - int(np.isfinite(array).sum())
    if bad:
        raise SceneError(f"{name}: {bad:,} of {array.size:,} values are not finite")
    return array


def _read(values: Any) -> FloatArray:
    """As ``given_array``, of any shape.

    Raises:
        BufferError, RuntimeError, TypeError, ValueError: Its package refuses, or it is no array.
    """
    if _is_on_gpu(values):
        there = cast(Any, wp).from_dlpack(values)
        values = there.numpy()
    return np.ascontiguousarray(host_array(values), dtype=np.float32)


def _is_on_gpu(values: Any) -> bool:
    """Whether an array says, by DLPack, that NumPy cannot read its memory."""
    device = getattr(values, "__dlpack_device__", None)
    return device is not None and int(device()[0]) == DLPACK_CUDA


def gradient_of_asset(buffers: Buffers, asset: SplatAsset, number: int) -> GaussianGradient:
    """Arrays with undefined contents.

    Args:
        buffers: Hold them.
        asset: The Gaussians.
        number: The asset's, in the scene.
    """
    get, count = buffers.get, asset.gaussians.count
    out = GaussianGradient()
    out.means = get(f"backward.means{number}", wp.vec3, count)
    out.rotations = get(f"backward.rotations{number}", wp.quat, count)
    out.scales = get(f"backward.scales{number}", wp.vec3, count)
    out.opacities = get(f"backward.opacities{number}", wp.float32, count)
    out.sh_count = asset.data.sh_count
    out.sh = get(f"backward.sh{number}", wp.vec3, count * out.sh_count)
    return out


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
