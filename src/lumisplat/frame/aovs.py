"""Images of a frame beside its colour: which there are, and what an EXR calls them."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from lumisplat.config import AOVS
from lumisplat.errors import ConfigError
from lumisplat.math.arrays import FloatArray

if TYPE_CHECKING:
    from lumisplat.frame.frame import Frame

LAYERS = ("depth", "normal", "gaussian_index", "instance_index", "position", *AOVS)
"""Names of layers. Those of `AOVS` are there where ``RenderConfig.aovs`` asked for them."""

RADIANCE = ("albedo", "emission", "reflection", "hits", "light_direct", "light_shadow")
"""Fields of a frame that make up the layers of `AOVS`."""

_UNSAFE = re.compile(r"[^\w-]+", re.ASCII)
_LABEL_MAX = 60
"""Longest name of a light in a layer's name, characters: file names and EXR channels end at 255 bytes."""


def present_layers(frame: Frame) -> tuple[str, ...]:
    """Those that ``frame`` has, in order."""
    return tuple(layer for layer in LAYERS if layer not in AOVS or getattr(frame, _field(layer)) is not None)


def check_layer(frame: Frame, layer: str) -> None:
    """Raises ConfigError unless ``frame`` has the layer."""
    if layer not in LAYERS:
        raise ConfigError(f"unknown layer '{layer}', expected some of {', '.join(LAYERS)}")
    if layer not in present_layers(frame):
        raise ConfigError(f"the frame has no '{layer}': lit frames do, where RenderConfig.aovs asks for it")


def exr_channels(frame: Frame, layers: Collection[str]) -> dict[str, npt.NDArray]:
    """Channels of layers by the names that Nuke groups; radiance that is not finite is 0.

    Raises:
        ConfigError: The frame has no such layer.
    """
    channels: dict[str, npt.NDArray] = {}
    for layer in layers:
        check_layer(frame, layer)
        if layer == "depth":
            channels["depth.Z"] = frame.depth
        elif layer in ("normal", "position"):
            channels |= _planes(layer, getattr(frame, layer), "XYZ")
        elif layer in ("gaussian_index", "instance_index"):
            channels[f"index.{layer.removesuffix('_index')}"] = getattr(frame, layer)
        elif layer == "lights":
            for label, direct, shadow in lights(frame):
                channels |= _planes(f"light.{label}.direct", _finite(direct), "RGB")
                channels |= _planes(f"light.{label}.shadow", _finite(shadow), "RGB")
        elif layer == "hits":
            channels["hits.Y"] = _finite(getattr(frame, layer))
        else:
            channels |= _planes(layer, _finite(getattr(frame, layer)), "RGB")
    return channels


def lights(frame: Frame) -> list[tuple[str, FloatArray, FloatArray]]:
    """Label, direct light and shadow of each light; `check_layer` comes first."""
    direct, shadow = frame.light_direct, frame.light_shadow
    assert direct is not None and shadow is not None
    names = frame.light_names or ("",) * len(direct)
    return list(zip(light_labels(names), direct, shadow, strict=True))


def light_labels(names: Sequence[str]) -> list[str]:
    """A label for each light, fit for channels and file names: its name, else its number; no two are equal."""
    taken: set[str] = set()
    labels = []
    for index, name in enumerate(names):
        safe = _UNSAFE.sub("_", name)[:_LABEL_MAX].strip("_") or str(index)
        label, number = safe, 2
        while label.casefold() in taken:
            label, number = f"{safe}_{number}", number + 1
        taken.add(label.casefold())
        labels.append(label)
    return labels


def _field(layer: str) -> str:
    return "light_direct" if layer == "lights" else layer


def _planes(layer: str, values: npt.NDArray, axes: str) -> dict[str, npt.NDArray]:
    return {f"{layer}.{axis}": values[..., index] for index, axis in enumerate(axes)}


def _finite(values: FloatArray) -> FloatArray:
    return np.where(np.isfinite(values), values, np.float32(0.0))
