"""Trained parameters and their moments: on the host, where Gaussians come and go, and on the device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.config import TrainConfig
from lumisplat.device.training import LearntSplats
from lumisplat.math.arrays import FloatArray
from lumisplat.runtime.buffers import Buffers, device_array
from lumisplat.scene.gaussians import Gaussians

Rows = npt.NDArray[np.intp] | npt.NDArray[np.bool_]

_ELEMENTS: dict[str, Any] = {
    "means": wp.vec3,
    "rotations": wp.vec4,
    "log_scales": wp.vec3,
    "logits": wp.float32,
    "sh": wp.vec3,
}
NAMES = tuple(_ELEMENTS)
"""Of parameters."""


@dataclass(frozen=True, slots=True, eq=False)
class TrainedParameters:
    """TrainedParameters of Gaussians, unbounded, and their moments; by names of `NAMES`, a row a Gaussian, float32."""

    values: dict[str, FloatArray]
    first: dict[str, FloatArray]
    second: dict[str, FloatArray]

    @classmethod
    def new(cls, values: dict[str, FloatArray]) -> TrainedParameters:
        """TrainedParameters that have not moved yet."""
        kept = {name: np.ascontiguousarray(values[name], np.float32) for name in NAMES}
        return cls(kept, _zeros_like(kept), _zeros_like(kept))

    @property
    def count(self) -> int:
        """Gaussians."""
        return len(self.values["means"])

    @property
    def opacities(self) -> npt.NDArray[np.float64]:
        """0..1, shape (N,)."""
        return 1.0 / (1.0 + np.exp(-self.values["logits"].astype(np.float64)))

    @property
    def scales(self) -> npt.NDArray[np.float64]:
        """Standard deviations, shape (N, 3)."""
        return np.exp(self.values["log_scales"].astype(np.float64))

    def rows(self, rows: Rows) -> TrainedParameters:
        """Some of them."""
        return TrainedParameters(*({name: part[name][rows] for name in NAMES} for part in self._parts))

    def fresh(self, rows: Rows) -> TrainedParameters:
        """Copies of some of them, which have not moved yet."""
        return TrainedParameters.new({name: self.values[name][rows] for name in NAMES})

    def joined(self, other: TrainedParameters) -> TrainedParameters:
        """These and others."""
        pairs = zip(self._parts, other._parts, strict=True)
        return TrainedParameters(*({name: np.concatenate([a[name], b[name]]) for name in NAMES} for a, b in pairs))

    def still(self, rows: Rows) -> None:
        """Forgets how some of them have moved."""
        for part in (self.first, self.second):
            for name in NAMES:
                part[name][rows] = 0.0

    def gaussians(self, config: TrainConfig) -> Gaussians:
        """What they are, as a capture of these settings has it."""
        return Gaussians(
            means=self.values["means"].copy(),
            rotations_wxyz=self.values["rotations"].copy(),
            scales=self.scales.astype(np.float32),
            opacities=self.opacities.astype(np.float32),
            sh=self.values["sh"].copy(),
            antialiased=config.antialiased,
            kernel_degree=config.kernel_degree,
        )

    @property
    def _parts(self) -> tuple[dict[str, FloatArray], ...]:
        return self.values, self.first, self.second


class DeviceParameters:
    """The same on the device.

    Args:
        buffers: Holds the arrays.
    """

    def __init__(self, buffers: Buffers) -> None:
        self._buffers = buffers
        self.values, self.first, self.second = LearntSplats(), LearntSplats(), LearntSplats()

    def upload(self, learnt: TrainedParameters) -> None:
        """Takes over what the host has."""
        for kind in ("values", "first", "second"):
            struct, arrays = getattr(self, kind), getattr(learnt, kind)
            struct.sh_count = arrays["sh"].shape[1]
            for name, element in _ELEMENTS.items():
                rows = arrays[name].reshape(-1, 3) if name == "sh" else arrays[name]
                setattr(struct, name, self._buffers.upload(f"learnt.{kind}.{name}", element, rows))

    def download(self) -> TrainedParameters:
        """What the device has."""
        return TrainedParameters(*(self._downloaded(kind) for kind in (self.values, self.first, self.second)))

    @staticmethod
    def _downloaded(struct: Any) -> dict[str, FloatArray]:
        arrays = {name: np.array(device_array(getattr(struct, name)).numpy(), np.float32) for name in NAMES}
        arrays["sh"] = arrays["sh"].reshape(len(arrays["means"]), struct.sh_count, 3)
        return arrays


def _zeros_like(arrays: dict[str, FloatArray]) -> dict[str, FloatArray]:
    return {name: np.zeros_like(array) for name, array in arrays.items()}
