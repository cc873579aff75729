"""Layers of a frame: their names, their EXR channels, and how each is shown as an image or false-colour view."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import listed_names, quoted
from lumisplat.config.render import AOVS, PATH_PARTS
from lumisplat.constants import LUMINANCE
from lumisplat.errors import ConfigError
from lumisplat.frame.frame_data import FrameData
from lumisplat.math.arrays import FloatArray
from lumisplat.math.color import encode_srgb

Image = npt.NDArray[Any]
"""Pixels of any dtype, shape (H, W, ...)."""

_MATTE = "shadow_matte"

LAYERS = ("depth", "normal", "gaussian_index", "instance_index", "position", *AOVS, _MATTE)
"""Names of layers. A layer in `AOVS` exists only if ``RenderConfig.aovs`` requests it, and ``shadow_matte`` only if
``shadow_ratio`` is requested. Every frame has the other layers."""

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
"""Fields of a frame that hold float layers which ``RenderConfig.aovs`` requests, such as albedo or hits."""

COUNTS = ("sample_count", "motion_known", "probes", "cache_cells")
"""Fields of a frame that hold integer layers which ``RenderConfig.aovs`` requests, such as sample_count."""

_UNSAFE = re.compile(r"[^\w-]+", re.ASCII)
_LABEL_MAX = 60
"""Largest number of characters of a light's name in a layer's name: file names and EXR channel names may have 255
bytes."""


class LightLayers(NamedTuple):
    """Images of a frame that show the contribution of one light."""

    label: str
    """Name of the light, made safe for channel and file names."""
    direct: FloatArray
    """Linear radiance that surfaces would reflect from the light if nothing cast shadows, (H, W, 3)."""
    shadow: FloatArray
    """Fraction of ``direct`` that arrives despite shadows, 0..1, (H, W, 3)."""
    total: FloatArray | None
    """Radiance that the light contributes to a path-traced frame, including bounces, (H, W, 3); None in other frames.
    """


def present_layers(frame: FrameData) -> tuple[str, ...]:
    """Returns the layers that ``frame`` has, in the order of `LAYERS`."""
    requestable = (*AOVS, _MATTE)
    return tuple(layer for layer in LAYERS if layer not in requestable or frame.has(_field(layer)))


def layer_names(layers: object) -> tuple[str, ...]:
    """Parses names of layers from a list or a comma-separated text, without checking that the layers exist.

    Raises:
        ConfigError: ``layers`` is neither a list nor a text.
    """
    names = listed_names(layers)
    if names is None:
        raise ConfigError(f"layers is {quoted(layers)}, expected some of {', '.join(LAYERS)}")
    return names


def view_names(views: object) -> tuple[str, ...]:
    """Parses names of views from a list or a comma-separated text.

    Raises:
        ConfigError: ``views`` is neither a list nor a text, or there is no view of one of the names.
    """
    names = listed_names(views)
    if names is None:
        raise ConfigError(f"insets is {quoted(views)}, expected some of {', '.join(VIEWS)}")
    for name in names:
        _check_view(name)
    return names


def check_layer(frame: FrameData, layer: str) -> None:
    """Raises ConfigError unless ``frame`` has the layer."""
    if layer not in LAYERS:
        raise ConfigError(f"unknown layer '{layer}', expected some of {', '.join(LAYERS)}")
    if layer not in present_layers(frame):
        aov = _field(layer) if layer == _MATTE else layer
        is_requested = frame.config is not None and aov in frame.config.aovs
        name = "it" if aov == layer else f"'{aov}'"
        why = (
            "only lit frames have it (RenderConfig.lighting=True)"
            if is_requested
            else f"add {name} to RenderConfig.aovs"
        )
        raise ConfigError(f"the frame has no '{layer}': {why}")


def exr_channels(frame: FrameData, layers: Collection[str]) -> dict[str, Image]:
    """Returns EXR channels of layers, named so that Nuke groups them; radiance that is not finite becomes 0.

    Raises:
        ConfigError: The frame does not have one of the layers.
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
    """Returns the EXR channels of all lights' layers by name."""
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
    """Returns the layers of each light. Check first with `check_layer` that the frame has them."""
    assert frame.light_direct is not None and frame.light_shadow is not None
    labels = light_labels(frame.light_names or ("",) * len(frame.light_direct))
    totals = [None] * len(labels) if frame.light_total is None else list(frame.light_total[:-1])
    return [LightLayers(*row) for row in zip(labels, frame.light_direct, frame.light_shadow, totals, strict=True)]


def light_labels(names: Sequence[str]) -> list[str]:
    """Returns a unique label for each light, safe in channel and file names: the light's name, or else its number."""
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


Limits = tuple[float, float]
"""Values that the first and the last colour of a colour map stand for."""

_REALTIME = ("motion", "history", "probes", "cache", "cache_cells")
"""Views of real-time frames: motion, and the state that is reused from frame to frame."""

VIEWS = ("normal", "depth", "index", "shadow", "hits", "transmittance", *PATH_PARTS, *_REALTIME)

_DEPTH_RAMP = np.array(
    [
        [0.19, 0.07, 0.23],
        [0.27, 0.45, 0.95],
        [0.12, 0.86, 0.73],
        [0.72, 0.95, 0.23],
        [0.98, 0.55, 0.14],
        [0.55, 0.05, 0.03],
    ]
)
"""Colour map from dark blue over green to red; it separates depths better than grey."""

_HEAT_RAMP = np.array(
    [
        [0.078, 0.000, 0.285],
        [0.251, 0.004, 0.399],
        [0.455, 0.004, 0.440],
        [0.660, 0.086, 0.374],
        [0.821, 0.241, 0.242],
        [0.940, 0.405, 0.124],
        [0.999, 0.594, 0.128],
        [0.998, 0.789, 0.401],
        [0.999, 0.957, 0.696],
    ]
)
"""Colour map from dark violet over red to pale yellow in equal steps of OKLab, so that equal differences look equal."""

_HITS_TOP = 255.0
"""Gaussians per ray at the last colour of the colour map of ``hits``; larger counts have that colour, too."""
_MOTION_TOP = 16.0
"""Motion in pixels per frame that is shown at full saturation."""
_REFRESHES_TOP = 64.0
"""Probe updates at the last colour of the colour map of ``probes``; larger counts have that colour, too."""
_PROBE_PX = 2
"""Half the side, in pixels, of the square that marks a probe."""
_DIMMED = 0.35
"""Brightness of the grey frame behind the marks of probes, as a fraction."""
_NO_LIGHT = (0.09, 0.13, 0.32)
"""Colour of pixels that no light would reach even without shadows: blue, because shadows are shades of grey."""


_DISPLAYED_AS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "albedo": encode_srgb,
    "shadow_ratio": lambda ratio: ratio,
    "shadow_matte": lambda matte: matte[..., 3:].repeat(3, axis=2),
}
"""Function that converts a layer to display colours, by layer name; layers that are not listed are linear radiance."""


def layer_pictures(frame: FrameData, layer: str) -> dict[str, FloatArray]:
    """Returns display-referred images of one layer by name, each of shape (H, W, 3), 0..1.

    Depth runs from red (nearest in the frame) to blue (farthest), normals are mapped from -1..1, positions from their
    bounding box, and each index has its colour. Radiance is exposed, encoded as sRGB and clipped to white; ``variance``
    shows its square root. ``sample_count`` runs from violet (none) to yellow (the most). Pixels without a surface are
    black. Most layers give one image, with the layer's name. ``lights`` gives ``light.NAME.direct`` and
    ``light.NAME.shadow`` for each light, and in path-traced frames ``light.NAME.total`` and ``light_other`` too;
    ``bounces`` gives ``bounce.0`` and so on. ``shadow_matte`` shows its alpha.

    Args:
        frame: Rendered frame.
        layer: One of ``Frame.LAYERS``.

    Raises:
        ConfigError: The frame does not have the layer.
    """
    check_layer(frame, layer)
    if layer == "lights":
        pictures: dict[str, Image] = {}
        for light in light_layers(frame):
            pictures[f"light.{light.label}.direct"] = _radiance_picture(frame, light.direct)
            pictures[f"light.{light.label}.shadow"] = light.shadow
            if light.total is not None:
                pictures[f"light.{light.label}.total"] = _radiance_picture(frame, light.total)
        if frame.light_total is not None:
            pictures["light_other"] = _radiance_picture(frame, frame.light_total[-1])
    elif layer == "bounces":
        assert frame.bounces is not None
        pictures = {f"bounce.{number}": _radiance_picture(frame, image) for number, image in enumerate(frame.bounces)}
    elif layer in ("depth", "normal", "hits", *_REALTIME):
        pictures = {layer: view_picture(frame, layer)}
    elif layer == "position":
        pictures = {layer: _position_picture(frame)}
    elif layer == "variance":
        pictures = {layer: _radiance_picture(frame, np.sqrt(getattr(frame, layer)))}
    elif layer == "sample_count":
        pictures = {layer: _sample_count_picture(frame)}
    elif layer in _DISPLAYED_AS:
        pictures = {layer: _DISPLAYED_AS[layer](getattr(frame, layer))}
    elif layer in ("gaussian_index", "instance_index"):
        indices: Image = getattr(frame, layer)
        pictures = {layer: _index_picture(indices, indices >= 0)}
    else:
        pictures = {layer: _radiance_picture(frame, getattr(frame, layer))}
    return {name: _displayable(picture) for name, picture in pictures.items()}


def view_limits(frame: FrameData, view: str) -> Limits:
    """Returns the default values at the two ends of a view's colour map.

    Depth: the 1st and 99th percentile of the frame's depths. History: up to the largest number of frames that the
    settings allow. Other views: fixed values.

    Raises:
        ConfigError: There is no view of this name.
    """
    _check_view(view)
    if view == "hits":
        return 0.0, _HITS_TOP
    if view == "motion":
        return 0.0, _MOTION_TOP
    if view == "probes":
        return 0.0, _REFRESHES_TOP
    if view == "history" and frame.config is not None:
        return 0.0, float(frame.config.realtime.of_quality.filter.frames)
    surface = frame.depth[np.isfinite(frame.depth)]
    if view != "depth" or not surface.size:
        return 0.0, 1.0
    near, far = np.percentile(surface, (1, 99))
    return float(near), float(far)


def view_picture(frame: FrameData, view: str, limits: Limits | None = None) -> FloatArray:
    """Returns a false-colour view in display-referred colours, shape (H, W, 3), 0..1.

    Args:
        frame: Rendered frame.
        view: One of `VIEWS`, see ``Frame.view``.
        limits: Values at the ends of the colour map of ``depth``, ``hits``, ``motion``, ``history`` and ``probes``;
            None: the limits from `view_limits`.

    Raises:
        ConfigError: There is no view of this name, or the frame was rendered without the layer that the view needs.
    """
    low, high = view_limits(frame, view) if limits is None else limits
    if view == "depth":
        picture = _depth_picture(frame.depth, low, high)
    elif view == "normal":
        picture = np.where(frame.normal.any(axis=2, keepdims=True), 0.5 + 0.5 * frame.normal, 0.0)
    elif view == "index":
        # The instance is hashed, too, so that Gaussian 0 of two captures differs, and so do two meshes.
        indices = frame.gaussian_index + 1 + 8191 * frame.instance_index.astype(np.int64)
        picture = _index_picture(indices, frame.instance_index >= 0)
    elif view == "shadow":
        picture = _shadow_picture(frame)
    elif view == "hits":
        picture = _hits_picture(frame, low, high)
    elif view in (*PATH_PARTS, "cache"):
        check_layer(frame, view)
        picture = _radiance_picture(frame, getattr(frame, view))
    elif view == "motion":
        picture = _motion_picture(frame, low, high)
    elif view == "history":
        picture = _history_picture(frame, low, high)
    elif view == "probes":
        picture = _probes_picture(frame, low, high)
    elif view == "cache_cells":
        check_layer(frame, view)
        cells: Image = np.asarray(frame.cache_cells)
        picture = _index_picture(cells, cells >= 0)
    else:
        _check_view(view)
        picture = _ramp(_HEAT_RAMP, 1.0 - frame.alpha)
    return _displayable(picture)


def _check_view(view: str) -> None:
    if view not in VIEWS:
        raise ConfigError(f"unknown view '{view}', expected one of {', '.join(VIEWS)}")


def _displayable(picture: Image) -> FloatArray:
    return np.clip(np.nan_to_num(picture), 0.0, 1.0).astype(np.float32)


def _ramp(stops: npt.NDArray[Any], values: Image) -> Image:
    """Returns the colours of values 0..1 by interpolation between equally spaced ``stops``, shape (..., 3)."""
    stops_at = np.linspace(0.0, 1.0, len(stops))
    return np.stack([np.interp(values, stops_at, stops[:, channel]) for channel in range(3)], axis=-1)


def _depth_picture(depth: FloatArray, near: float, far: float) -> Image:
    hit = np.isfinite(depth)
    closeness = (far - np.where(hit, depth, far)) / max(far - near, 1e-9)
    return np.where(hit[..., None], _ramp(_DEPTH_RAMP, closeness), 0.0)


def _hits_picture(frame: FrameData, low: float, high: float) -> Image:
    check_layer(frame, "hits")
    hits = np.maximum(np.nan_to_num(np.asarray(frame.hits, np.float64)), 0.0)
    start, end = np.log2(1.0 + low), np.log2(1.0 + high)
    heat = _ramp(_HEAT_RAMP, (np.log2(1.0 + hits) - start) / max(end - start, 1e-9))
    return np.where(hits[..., None] > 0.0, heat, 0.0)


def _motion_picture(frame: FrameData, low: float, high: float) -> Image:
    """Colours motion: hue by direction (red to the right, yellow-green up), paler where slower, black where unknown."""
    check_layer(frame, "motion")
    x, y, _ = np.moveaxis(np.asarray(frame.motion, np.float64), -1, 0)
    strength = np.clip((np.hypot(x, y) - low) / max(high - low, 1e-9), 0.0, 1.0)[..., None]
    hue = np.arctan2(-y, x)[..., None] / (2.0 * np.pi) * 6.0 + np.array([0.0, 4.0, 2.0])
    colour = np.clip(np.abs(hue % 6.0 - 3.0) - 1.0, 0.0, 1.0)
    return np.where(np.asarray(frame.motion_known)[..., None] > 0, 1.0 + strength * (colour - 1.0), 0.0)


def _history_picture(frame: FrameData, low: float, high: float) -> Image:
    check_layer(frame, "history")
    history = np.nan_to_num(np.asarray(frame.history, np.float64))
    heat = _ramp(_HEAT_RAMP, (history - low) / max(high - low, 1e-9))
    return np.where(history[..., None] > 0.0, heat, 0.0)


def _probes_picture(frame: FrameData, low: float, high: float) -> Image:
    """Draws a square at each probe, coloured by its number of updates, over the frame in grey."""
    check_layer(frame, "probes")
    refreshes = np.asarray(frame.probes)
    grey = encode_srgb(
        _DIMMED * np.exp2(np.float32(frame.camera.exposure)) * (frame.color @ np.array(LUMINANCE, np.float32))
    )
    picture = np.repeat(np.clip(grey, 0.0, 1.0)[..., None], 3, axis=2)
    height, width = refreshes.shape
    start, end = np.log2(1.0 + low), np.log2(1.0 + high)
    for y, x in np.argwhere(refreshes >= 0):
        heat = _ramp(_HEAT_RAMP, (np.log2(1.0 + refreshes[y, x]) - start) / max(end - start, 1e-9))
        rows = slice(max(y - _PROBE_PX, 0), min(y + _PROBE_PX + 1, height))
        picture[rows, max(x - _PROBE_PX, 0) : min(x + _PROBE_PX + 1, width)] = heat
    return picture


def _sample_count_picture(frame: FrameData) -> Image:
    counts = np.asarray(frame.sample_count, np.float64)
    return _ramp(_HEAT_RAMP, counts / max(counts.max(initial=0.0), 1.0))


def _position_picture(frame: FrameData) -> Image:
    hit, position = np.isfinite(frame.depth), frame.position
    if not hit.any():
        return np.zeros_like(position)
    low, high = np.percentile(position[hit], (1, 99), axis=0)
    return np.where(hit[..., None], (position - low) / np.maximum(high - low, 1e-9), 0.0)


def _index_picture(indices: Image, hit: Image) -> Image:
    """Gives each index a colour, the same in all frames (Knuth's multiplicative hash); black where ``hit`` is False."""
    hashed = indices.astype(np.uint32) * np.uint32(2654435761)
    colors = np.stack([(hashed >> shift) & 0xFF for shift in (8, 16, 24)], axis=-1) / 255.0
    return np.where(hit[..., None], 0.2 + 0.8 * colors, 0.0)


def _shadow_picture(frame: FrameData) -> Image:
    check_layer(frame, "lights")
    direct = np.zeros(frame.alpha.shape)
    arriving = np.zeros_like(direct)
    for light in light_layers(frame):
        direct += np.nan_to_num(light.direct) @ np.array(LUMINANCE)
        arriving += np.nan_to_num(light.direct * light.shadow) @ np.array(LUMINANCE)
    share = np.divide(arriving, direct, out=np.zeros_like(direct), where=direct > 0.0)
    return np.where((direct > 0.0)[..., None], share[..., None], np.array(_NO_LIGHT))


def _radiance_picture(frame: FrameData, radiance: FloatArray) -> Image:
    return encode_srgb(np.clip(radiance, 0.0, None) * np.exp2(np.float32(frame.camera.exposure)))
