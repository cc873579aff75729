"""Exposure and pose of each training image, optimised with the Gaussians (Kerbl et al. 2023, code; Lin et al. 2021)."""

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
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.camera import Camera
from lumisplat.training import exposure_kernels as kernels

IDENTITY = np.eye(3, 4)


@dataclass(frozen=True, slots=True, eq=False)
class Exposures:
    """Those of the photographs that are learnt from; their mean stays the identity, or colours would drift."""

    values: Doubles
    """By which colours are multiplied, and what is added to them, shape (K, 3, 4)."""
    adam: Adam

    @classmethod
    def neutral(cls, count: int) -> Exposures:
        """Of photographs that are as they are."""
        return cls(np.repeat(IDENTITY[None], count, axis=0), Adam.still((count, 12), by_rows=True))

    @property
    def state(self) -> dict[str, Doubles]:
        """All that the next step depends on."""
        return {"exposures": self.values} | self.adam.state("exposures")

    def restore(self, state: dict[str, Doubles]) -> None:
        """Goes on from a state."""
        for name, values in self.state.items():
            values[:] = state[name]

    def move(self, number: int, gradient: Doubles, rate: float) -> None:
        """A step of one of them.

        Args:
            number: The photograph.
            gradient: Derivatives of the loss by its exposure, shape (3, 4).
            rate: How far it moves.
        """
        self.values[number] += rate * self.adam.step(gradient.reshape(12), row=number).reshape(3, 4)
        self.values[:] -= self.values.mean(axis=0) - IDENTITY


class ExposedFrame:
    """A frame as a photograph was exposed, and what is before it in the chain rule.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        exposure: Of the photograph, shape (3, 4).
        background: Display-referred sRGB behind the Gaussians, which no exposure changes.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, exposure: Doubles, background: Sequence[float]) -> None:
        self._launcher, self._buffers = launcher, buffers
        self._exposure = Exposure()
        self._exposure.matrix = wp.mat33(*exposure[:, :3].astype(float).reshape(-1))
        self._exposure.offset, self._exposure.background = wp.vec3(*exposure[:, 3]), wp.vec3(*background)

    def of(self, pixels: PixelData) -> PixelData:
        """What a photograph would have of them."""
        exposed, count = PixelData(), len(pixels.alpha)
        exposed.color, exposed.alpha = self._buffers.get("exposed.color", wp.vec3, count), pixels.alpha
        self._launcher.run_banded(kernels.expose, count, self._exposure, pixels, exposed.color)
        return exposed

    def backward(self, pixels: PixelData, by_exposed: PixelGradient) -> tuple[PixelGradient, Doubles]:
        """Derivatives by pixels, and by the exposure, shape (3, 4).

        Args:
            pixels: Of the frame, as it was before.
            by_exposed: Derivatives by what ``of`` has made of them.
        """
        get, count = self._buffers.get, len(pixels.alpha)
        chunks = -(-count // EXPOSURE_CHUNK)
        by_pixels = PixelGradient()
        by_pixels.color, by_pixels.alpha = (
            get("exposed.by_color", wp.vec3, count),
            get("exposed.by_alpha", wp.float32, count),
        )
        sums = get("exposed.by_matrix", wp.mat33, chunks), get("exposed.by_offset", wp.vec3, chunks)
        inputs = (self._exposure, pixels, by_exposed, by_pixels)
        self._launcher.run_banded(kernels.differentiate_chunks, chunks, *inputs, *sums)
        by_matrix, by_offset = (rows.numpy().sum(axis=0, dtype=np.float64) for rows in sums)
        return by_pixels, np.column_stack([by_matrix, by_offset])


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Those of the photographs that are learnt from, and where they began.

    If all cameras and all Gaussians move alike, no photograph changes: the mean of the motions of the cameras, seen
    from the world, stays 0.
    """

    values: Doubles
    """``camera_from_world`` of each, shape (K, 4, 4)."""
    given: Doubles
    """The same, before they moved."""
    adam: Adam
    length: float
    """Scene units that count as much as a radian: the distance from cameras to what they look at."""

    @classmethod
    def of(cls, cameras: Sequence[Camera], length: float) -> Poses:
        """Those of cameras that have not moved yet.

        Raises:
            SceneError: One has a rolling shutter or an aperture: it is not in one place.
        """
        for camera in cameras:
            if camera.camera_from_world_end is not None or camera.aperture > 0.0:
                what = "an aperture" if camera.camera_from_world_end is None else "a rolling shutter"
                raise SceneError(
                    f"the camera of {camera.name} has {what}, expected one that is in one place to learn where: leave "
                    "TrainConfig.refine_poses off"
                )
        given = np.stack([np.asarray(camera.camera_from_world, np.float64) for camera in cameras])
        return cls(given.copy(), given, Adam.still((len(cameras), 6), by_rows=True), length)

    @property
    def state(self) -> dict[str, Doubles]:
        """All that the next step depends on."""
        return {"poses": self.values} | self.adam.state("poses")

    def restore(self, state: dict[str, Doubles]) -> None:
        """Goes on from a state."""
        for name, values in self.state.items():
            values[:] = state[name]

    def posed(self, number: int, camera: Camera) -> Camera:
        """A camera of a photograph where that is now."""
        return replace(camera, camera_from_world=self.values[number])

    def move(self, number: int, gradient: Doubles, rate: float) -> None:
        """A step of one of them.

        Args:
            number: The photograph.
            gradient: Derivatives of the loss by the upper rows of its ``camera_from_world``, shape (3, 4).
            rate: How far it turns, radians.
        """
        by_parameters = self._twist_from_parameters.T @ twist_gradient(self.values[number], gradient)
        step = self._twist_from_parameters @ (rate * self.adam.step(by_parameters, row=number))
        self.values[number] = rigid_from_twist(step) @ self.values[number]
        moved = np.linalg.inv(self.given) @ self.values
        drift = np.mean([twist_from_rigid(one) for one in moved], axis=0)
        self.values[:] = self.values @ rigid_from_twist(-drift)

    @property
    def _twist_from_parameters(self) -> Doubles:
        """What moves: turns about a point on the optical axis, as far as what the camera looks at, and shifts.

        Turns about the camera itself look like shifts, so that one would undo the other for long; shape (6, 6).
        """
        point = np.array([0.0, 0.0, self.length])
        parameters = np.eye(6)
        parameters[3:, :3] = cross_matrix(point)
        parameters[3:, 3:] *= self.length
        return parameters


def twist_gradient(pose: Doubles, gradient: Doubles) -> Doubles:
    """Derivatives by a twist of the camera, ``exp(twist) @ pose`` at 0: a turn and a shift in its axes, shape (6,).

    Args:
        pose: ``camera_from_world``, shape (4, 4).
        gradient: Derivatives by its upper rows, shape (3, 4).
    """
    m = gradient @ pose[:3].T
    return np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], *gradient[:, 3]])
