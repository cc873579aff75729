"""Optimises one exposure (Kerbl et al. 2023, code) and one pose (Lin et al. 2021) for each training image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from lumisplat.constants import EXPOSURE_CHUNK
from lumisplat.device.structs.camera import PixelData
from lumisplat.device.structs.gradients import PixelGradient
from lumisplat.device.training import Exposure
from lumisplat.errors import SceneError
from lumisplat.math.adam import Adam
from lumisplat.math.arrays import Doubles
from lumisplat.math.transforms import cross_matrix, rigid_from_twist, twist_from_rigid
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.camera import Camera
from lumisplat.training import exposure_kernels as kernels

IDENTITY = np.eye(3, 4)


@dataclass(frozen=True, slots=True, eq=False)
class Exposures:
    """Exposures of the K training images.

    The mean over the images is kept at the identity, because a common exposure could be compensated by the Gaussians'
    colours.
    """

    values: Doubles
    """Affine exposures of K images, shape (K, 3, 4): a colour matrix each, and in the last column a colour that is
    added."""
    adam: Adam

    @classmethod
    def neutral(cls, count: int) -> Exposures:
        """Returns ``count`` exposures that change no colour: an identity matrix and no added colour each."""
        return cls(np.repeat(IDENTITY[None], count, axis=0), Adam.still((count, 12), by_rows=True))

    @property
    def state(self) -> dict[str, Doubles]:
        """Exposures and their Adam moments by name, for checkpoints; ``restore`` reads them."""
        return {"exposures": self.values} | self.adam.state("exposures")

    def restore(self, state: dict[str, Doubles]) -> None:
        """Copies the arrays of an earlier ``state`` into the exposures and Adam moments."""
        for name, values in self.state.items():
            values[:] = state[name]

    def update(self, number: int, gradient: Doubles, rate: float) -> None:
        """Makes an Adam update of one exposure, then shifts all exposures so that their mean is the identity.

        Args:
            number: Index of the image.
            gradient: Gradient of the loss with respect to the image's exposure, shape (3, 4).
            rate: Learning rate.
        """
        self.values[number] += rate * self.adam.step(gradient.reshape(12), row=number).reshape(3, 4)
        self.values[:] -= self.values.mean(axis=0) - IDENTITY


class ExposedFrame:
    """Applies the exposure of an image to a frame, and propagates gradients back through it.

    Args:
        launcher: Runs the kernels.
        buffers: Owner of the device arrays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers
        self._exposure: DeviceArray
        """``Exposure`` of the current image, an array with one element."""
        self._sums: tuple[DeviceArray, DeviceArray]

    def begin(self, exposure: Doubles, background: Sequence[float]) -> None:
        """Uploads the exposure of an image.

        Args:
            exposure: Exposure of the image, shape (3, 4).
            background: Display-referred sRGB behind the Gaussians, which exposure does not change.
        """
        row = Exposure()
        row.matrix = wp.mat33(*exposure[:, :3].astype(float).reshape(-1))
        row.offset, row.background = wp.vec3(*exposure[:, 3]), wp.vec3(*background)
        self._exposure = self._buffers.table("exposed.exposure", Exposure, [row])

    def apply(self, pixels: PixelData) -> PixelData:
        """Returns a copy of a frame's pixels with the exposure applied."""
        exposed, count = PixelData(), len(pixels.alpha)
        exposed.color, exposed.alpha = self._buffers.get("exposed.color", wp.vec3, count), pixels.alpha
        self._launcher.run_banded(kernels.expose, count, self._exposure, pixels, exposed.color)
        return exposed

    def backward(self, pixels: PixelData, by_exposed: PixelGradient) -> PixelGradient:
        """Returns the gradient with respect to the pixels before exposure. It only launches kernels.

        Args:
            pixels: Pixels of the frame before exposure.
            by_exposed: Gradient of the loss with respect to the pixels after exposure.
        """
        get, count = self._buffers.get, len(pixels.alpha)
        chunks = -(-count // EXPOSURE_CHUNK)
        by_pixels = PixelGradient()
        by_pixels.color, by_pixels.alpha = (
            get("exposed.by_color", wp.vec3, count),
            get("exposed.by_alpha", wp.float32, count),
        )
        self._sums = get("exposed.by_matrix", wp.mat33, chunks), get("exposed.by_offset", wp.vec3, chunks)
        inputs = (self._exposure, pixels, by_exposed, by_pixels)
        self._launcher.run_banded(kernels.differentiate_chunks, chunks, *inputs, *self._sums)
        return by_pixels

    def by_exposure(self) -> Doubles:
        """Waits for ``backward``, and returns the gradient with respect to the exposure, shape (3, 4)."""
        by_matrix, by_offset = (rows.numpy().sum(axis=0, dtype=np.float64) for rows in self._sums)
        return np.column_stack([by_matrix, by_offset])


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Current and initial poses of the K training images.

    A common motion of all cameras and Gaussians changes no image. The mean motion of the cameras in world space is
    therefore kept at 0.
    """

    values: Doubles
    """Current ``camera_from_world`` of each of K images, shape (K, 4, 4)."""
    initial: Doubles
    """``camera_from_world`` of each of K images before training, shape (K, 4, 4)."""
    adam: Adam
    length: float
    """Distance from the cameras to their common target, scene units; a translation by it counts as much as a rotation
    by one radian."""

    @classmethod
    def of(cls, cameras: Sequence[Camera], length: float) -> Poses:
        """Returns the poses of the cameras, as current and as initial values.

        Raises:
            SceneError: A camera has a rolling shutter or an aperture, so a single pose does not describe it.
        """
        for camera in cameras:
            if camera.camera_from_world_end is not None or camera.aperture > 0.0:
                what = "an aperture" if camera.camera_from_world_end is None else "a rolling shutter"
                raise SceneError(
                    f"the camera of {camera.name} has {what}, expected a single pose to refine: turn off "
                    "TrainConfig.refine_poses"
                )
        initial = np.stack([np.asarray(camera.camera_from_world, np.float64) for camera in cameras])
        return cls(initial.copy(), initial, Adam.still((len(cameras), 6), by_rows=True), length)

    @property
    def state(self) -> dict[str, Doubles]:
        """Current poses and their Adam moments by name, for checkpoints; ``restore`` reads them."""
        return {"poses": self.values} | self.adam.state("poses")

    def restore(self, state: dict[str, Doubles]) -> None:
        """Copies the arrays of an earlier ``state`` into the poses and Adam moments."""
        for name, values in self.state.items():
            values[:] = state[name]

    def posed(self, number: int, camera: Camera) -> Camera:
        """Returns a copy of ``camera`` with the current pose of image ``number``."""
        return replace(camera, camera_from_world=self.values[number])

    def update(self, number: int, gradient: Doubles, rate: float) -> None:
        """Makes an Adam update of one pose, then moves all poses so that their mean motion is 0.

        Args:
            number: Index of the image.
            gradient: Gradient of the loss with respect to the first three rows of ``camera_from_world``, shape (3, 4).
            rate: Learning rate, radians.
        """
        by_parameters = self._twist_from_parameters.T @ twist_gradient(self.values[number], gradient)
        step = self._twist_from_parameters @ (rate * self.adam.step(by_parameters, row=number))
        self.values[number] = rigid_from_twist(step) @ self.values[number]
        motions = np.linalg.inv(self.initial) @ self.values
        drift = np.mean([twist_from_rigid(one) for one in motions], axis=0)
        self.values[:] = self.values @ rigid_from_twist(-drift)

    @property
    def _twist_from_parameters(self) -> Doubles:
        """Matrix that maps the optimised parameters to a twist of the camera, shape (6, 6).

        The parameters are a rotation about the point on the optical axis at distance ``length``, and a translation. A
        rotation about the camera's own centre changes the image almost like a translation, so optimising both would
        make them cancel for many iterations.
        """
        point = np.array([0.0, 0.0, self.length])
        parameters = np.eye(6)
        parameters[3:, :3] = cross_matrix(point)
        parameters[3:, 3:] *= self.length
        return parameters


def twist_gradient(pose: Doubles, gradient: Doubles) -> Doubles:
    """Returns the gradient of the loss with respect to a twist of the camera, shape (6,).

    The twist is a rotation, then a translation, along the camera's axes. It moves the pose to ``exp(twist) @ pose``;
    the gradient is taken at a twist of 0.

    Args:
        pose: ``camera_from_world``, shape (4, 4).
        gradient: Gradient of the loss with respect to the first three rows of ``pose``, shape (3, 4).
    """
    m = gradient @ pose[:3].T
    return np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], *gradient[:, 3]])
