"""Gradient arrays: upstream gradients that callers pass, gradients on the device, and the results that callers get."""

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
"""Device type of CUDA memory, kDLCUDA of dlpack.h."""


@dataclass(frozen=True, slots=True, eq=False)
class SetGradient:
    """Gradients of the loss with respect to the stored parameters of one Gaussian set with N Gaussians.

    Gaussians out of view have gradients of 0.
    """

    means: FloatArray
    """Gradients with respect to the means of N Gaussians, shape (N, 3)."""
    rotations_wxyz: FloatArray
    """Gradients with respect to the quaternions (w, x, y, z) of N Gaussians, shape (N, 4). Each gradient is
    perpendicular to its quaternion, because quaternions are expected to be normalised after each update."""
    scales: FloatArray
    """Gradients with respect to the standard deviations of N Gaussians, not their logarithms; shape (N, 3)."""
    opacities: FloatArray
    """Gradients with respect to the opacities of N Gaussians in 0..1, not their logits; shape (N,)."""
    sh: FloatArray
    """Gradients with respect to the K SH coefficients of each of N Gaussians, shape (N, K, 3); 0 for degrees above the
    SH degree of the frame.
    """


@dataclass(frozen=True, slots=True, eq=False)
class SplatGradients:
    """Gradients of the loss with respect to the inputs of a frame: Gaussians, background, camera pose and features.

    Arrays for all Gaussians of the scene list them splat instance by splat instance, N in all.
    """

    sets: tuple[SetGradient, ...]
    """Gradients of the distinct Gaussian sets, in the order of their first instances. If several instances use a set,
    their gradients are summed."""
    background: Doubles
    """Gradient of the loss with respect to the background colour, display-referred sRGB, shape (3,)."""
    camera_from_world: Doubles | None
    """Gradient with respect to the elements of the camera pose, shape (4, 4), with a last row of 0; None if not
    requested. The chain rule turns it into gradients of small rotations and translations of the camera. With
    ``Pipeline.TRACE`` and ``Projection.UNSCENTED`` the gradient is restricted to rigid motions of the camera, and both
    poses of a rolling shutter move together."""
    centers: FloatArray
    """Gradients with respect to the splat centres in the image, pixels, shape (N, 2), for all N Gaussians of the
    scene, instance by instance. Shape (0, 2) with ``Pipeline.TRACE`` and ``Projection.UNSCENTED``, which have no 2D
    splats."""
    centers_absolute: FloatArray
    """Like ``centers``, through colour and alpha only, but each pixel's gradient is made absolute before the sum over
    pixels (AbsGS, Ye et al. 2024); shape (N, 2) for all N Gaussians of the scene. Shape (0, 2) if the shape of
    ``centers`` is (0, 2).
    """
    weights: FloatArray
    """Blending weight (alpha times transmittance) of each Gaussian of the scene, summed over the pixels."""
    features: FloatArray | None = None
    """Gradients with respect to the C rendered features of all N Gaussians of the scene, shape (N, C); None if not
    requested."""


@dataclass(frozen=True, slots=True, eq=False)
class RayGradients:
    """Gradients of the loss with respect to the Gaussians that a caller's rays hit."""

    sets: tuple[SetGradient, ...]
    """Gradients of the distinct Gaussian sets, ordered as in `SplatGradients`."""
    weights: FloatArray
    """Blending weight (alpha times transmittance) of each Gaussian of the scene, summed over the rays."""


def given_array(name: str, values: Any, shape: tuple[int, ...]) -> FloatArray:
    """Returns a caller's array as C-contiguous float32, without a copy if possible; GPU arrays are downloaded.

    Raises:
        SceneError: The array cannot be read, does not have ``shape``, or has values that are not finite. The message
            contains ``name``.
    """
    try:
        array = _read(values)
    except (BufferError, RuntimeError, TypeError, ValueError) as error:
        problem = str(error).partition("\n")[0].rstrip(".")
        raise SceneError(
            f"{name} cannot be read as an array: {problem}; expected an array of numbers; detach tensors with gradients"
        ) from None
    if array.shape != shape:
        raise SceneError(f"{name} has shape {array.shape}, expected {shape}")
    nonfinite = array.size - int(np.isfinite(array).sum())
    if nonfinite:
        raise SceneError(f"{name}: {nonfinite:,} of {array.size:,} values are not finite, expected finite numbers")
    return array


def _read(values: Any) -> FloatArray:
    """Converts a caller's array of any shape to C-contiguous float32.

    Raises:
        BufferError, RuntimeError, TypeError, ValueError: The array's package refuses, or the value is no array.
    """
    if _is_on_gpu(values):
        array = cast(Any, wp).from_dlpack(values)
        values = array.numpy()
    return np.ascontiguousarray(host_array(values), dtype=np.float32)


def _is_on_gpu(values: Any) -> bool:
    """Returns whether DLPack reports that the array is in CUDA memory, which NumPy cannot read."""
    device = getattr(values, "__dlpack_device__", None)
    return device is not None and int(device()[0]) == DLPACK_CUDA


def gradient_of_asset(buffers: Buffers, asset: SplatAsset, number: int) -> GaussianGradient:
    """Returns uninitialised gradient arrays for the Gaussians of one asset.

    Args:
        buffers: Holds the arrays.
        asset: The Gaussians.
        number: Index of the asset in the scene.
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
    """Downloads the gradients of a Gaussian set from the device."""
    rotations = host_values(gradient.rotations)
    return SetGradient(
        means=host_values(gradient.means),
        rotations_wxyz=np.roll(rotations, 1, axis=1),
        scales=host_values(gradient.scales),
        opacities=host_values(gradient.opacities),
        sh=host_values(gradient.sh).reshape(len(rotations), gradient.sh_count, 3),
    )


def host_values(array: wp.array[Any]) -> FloatArray:
    """Copies a device array to the host as float32."""
    return np.array(device_array(array).numpy(), np.float32)


def by_background(by_color: FloatArray, transmittance: FloatArray) -> Doubles:
    """Returns the gradient with respect to the background colour, from the pixels' gradients and transmittances."""
    return np.asarray(transmittance.reshape(-1).astype(np.float64) @ by_color.reshape(-1, 3), np.float64)
