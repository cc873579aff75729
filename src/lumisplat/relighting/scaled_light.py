"""Gaussians, or an instance of them, under more or less light."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.recolor import scale_light
from lumisplat.scene.scene import SplatInstance

Subject = TypeVar("Subject", Gaussians, SplatInstance)
"""What is relit or shadowed: a function returns the kind that it was given."""


def scale_light_of(subject: Subject, factors: npt.NDArray[np.floating]) -> Subject:
    """A subject under ``factors`` of its light, shape (N, 3), see `scale_light`; the same object if all are 1."""
    if isinstance(subject, Gaussians):
        return scale_light(subject, factors)
    scaled = scale_light(subject.gaussians, factors)
    return subject if scaled is subject.gaussians else replace(subject, gaussians=scaled)
