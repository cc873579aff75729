"""Layers of a frame, the images beside its colour: which there are, and what an EXR calls them."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.config import AOVS, PATH_PARTS, listed_names
from lumisplat.config.checks import quoted
from lumisplat.errors import ConfigError
from lumisplat.frame.frame_data import FrameData
from lumisplat.math.arrays import FloatArray

Image = npt.NDArray[Any]
"""Pixels of any dtype, shape (H, W, ...)."""

_MATTE = "shadow_matte"

LAYERS = ("depth", "normal", "gaussian_index", "instance_index", "position", *AOVS, _MATTE)
"""Names of layers. A frame has those of `AOVS` if ``RenderConfig.aovs`` asked for them, ``shadow_matte`` if it asked
for ``shadow_ratio``, the others always."""

RADIANCE = (
    "albedo",
    "emission",
    "reflection",
    "hits",
    "shadow_ratio",
    "light_direct",
    "light_shadow",
    "light_total",
    "variance",
    *PATH_PARTS[:4],
    "bounces",
    "motion",
    "history",
    "cache",
)
"""Fields of a frame that hold the layers of `AOVS`, as floats."""

COUNTS = ("sample_count", "motion_known", "probes", "cache_cells")
"""Those that hold them as integers."""

_UNSAFE = re.compile(r"[^\w-]+", re.ASCII)
_LABEL_MAX = 60
"""Longest name of a light in a layer's name, characters: file names and EXR channels end at 255 bytes."""


class LightLayers(NamedTuple):
    """The layers of one light."""

    label: str
    """Its name, fit for channels and file names."""
    direct: FloatArray
    """Radiance if nothing blocked it, (H, W, 3)."""
    shadow: FloatArray
    """Share of ``direct`` that arrives, 0..1, (H, W, 3)."""
    total: FloatArray | None
    """All of its light in frames of paths, bounces included, (H, W, 3)."""


def present_layers(frame: FrameData) -> tuple[str, ...]:
    """The layers that ``frame`` has, in the order of `LAYERS`."""
    asked = (*AOVS, _MATTE)
    return tuple(layer for layer in LAYERS if layer not in asked or frame.has(_field(layer)))


def layer_names(layers: object) -> tuple[str, ...]:
    """Names of layers, given as a list or as a text with commas.

    Raises:
        ConfigError: It is neither; whether there are such layers is not checked.
    """
    names = listed_names(layers)
    if names is None:
        raise ConfigError(f"layers is {quoted(layers)}, expected some of {', '.join(LAYERS)}")
    return names


def check_layer(frame: FrameData, layer: str) -> None:
    """Raises ConfigError unless ``frame`` has the layer."""
    if layer not in LAYERS:
        raise ConfigError(f"unknown layer '{layer}', expected some of {', '.join(LAYERS)}")
    if layer not in present_layers(frame):
        wanted = _field(layer) if layer == _MATTE else layer
        asked = frame.config is not None and wanted in frame.config.aovs
        name = "it" if wanted == layer else wanted
        why = "only lit frames have it (RenderConfig.lighting=True)" if asked else f"RenderConfig.aovs asks for {name}"
        raise ConfigError(f"the frame has no '{layer}': {why}")


def exr_channels(frame: FrameData, layers: Collection[str]) -> dict[str, Image]:
    """Channels of layers, named so that Nuke groups them; radiance that is not finite is 0.

    Raises:
        ConfigError: The frame has no such layer.
    """
    channels: dict[str, Image] = {}
    for layer in layers:
        check_layer(frame, layer)
        if layer == "depth":
            channels["depth.Z"] = frame.depth
        elif layer in ("normal", "position"):
            channels |= _planes(layer, getattr(frame, layer), "XYZ")
        elif layer in ("gaussian_index", "instance_index"):
            channels[f"index.{layer.removesuffix('_index')}"] = getattr(frame, layer)
        elif layer == "lights":
            channels |= _light_channels(frame)
        elif layer == "bounces":
            assert frame.bounces is not None
            for number, image in enumerate(frame.bounces):
                channels |= _planes(f"bounce.{number}", _finite(image), "RGB")
        elif layer == "motion":
            assert frame.motion is not None and frame.motion_known is not None
            channels |= _planes(layer, frame.motion, "XYZ") | {"motion.known": frame.motion_known}
        elif layer == _MATTE:
            channels |= _planes(layer, _finite(getattr(frame, layer)), "RGBA")
        elif layer in COUNTS:
            channels[f"{layer}.Y"] = getattr(frame, layer)
        elif layer in ("hits", "history"):
            channels[f"{layer}.Y"] = _finite(getattr(frame, layer))
        else:
            channels |= _planes(layer, _finite(getattr(frame, layer)), "RGB")
    return channels


def _light_channels(frame: FrameData) -> dict[str, Image]:
    """Channels of the layers of each light."""
    channels: dict[str, Image] = {}
    for light in light_layers(frame):
        channels |= _planes(f"light.{light.label}.direct", _finite(light.direct), "RGB")
        channels |= _planes(f"light.{light.label}.shadow", _finite(light.shadow), "RGB")
        if light.total is not None:
            channels |= _planes(f"light.{light.label}.total", _finite(light.total), "RGB")
    if frame.light_total is not None:
        channels |= _planes("light_other", _finite(frame.light_total[-1]), "RGB")
    return channels


def light_layers(frame: FrameData) -> list[LightLayers]:
    """The layers of each light, of a frame that has them, see `check_layer`."""
    assert frame.light_direct is not None and frame.light_shadow is not None
    labels = light_labels(frame.light_names or ("",) * len(frame.light_direct))
    totals = [None] * len(labels) if frame.light_total is None else list(frame.light_total[:-1])
    return [LightLayers(*row) for row in zip(labels, frame.light_direct, frame.light_shadow, totals, strict=True)]


def light_labels(names: Sequence[str]) -> list[str]:
    """A label for each light, fit for channels and file names: its name, else its number; no two are equal."""
    taken: set[str] = set()
    copies: dict[str, int] = {}
    labels: list[str] = []
    for index, name in enumerate(names):
        safe = _UNSAFE.sub("_", name)[:_LABEL_MAX].strip("_") or str(index)
        label = safe
        while label.casefold() in taken:
            copies[safe] = copies.get(safe, 1) + 1
            label = f"{safe}_{copies[safe]}"
        taken.add(label.casefold())
        labels.append(label)
    return labels


def _field(layer: str) -> str:
    return {"lights": "light_direct", _MATTE: "shadow_ratio"}.get(layer, layer)


def _planes(layer: str, values: Image, axes: str) -> dict[str, Image]:
    return {f"{layer}.{axis}": values[..., index] for index, axis in enumerate(axes)}


def _finite(values: FloatArray) -> FloatArray:
    return np.where(np.isfinite(values), values, np.float32(0.0))
