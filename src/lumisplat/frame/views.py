"""Layers of a frame as pictures that can be looked at, and views of what went on in it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from lumisplat.errors import ConfigError
from lumisplat.frame.aovs import check_layer, lights
from lumisplat.math.arrays import FloatArray
from lumisplat.math.color import encode_srgb

if TYPE_CHECKING:
    from lumisplat.frame.frame import Frame

Limits = tuple[float, float]
"""Values at the two ends of a colour map."""

VIEWS = ("normal", "depth", "index", "shadow", "hits", "transmittance")

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
"""Dark blue over green to red: equal steps of depth stay apart, which a grey ramp does not show."""

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
"""Dark violet over red to pale yellow, in equal steps of OKLab: twice as far apart looks twice as different."""

_HITS_TOP = 255.0
"""Gaussians a ray that look hottest; more look the same."""
_UNLIT = (0.09, 0.13, 0.32)
"""Where no light could arrive anyway: a blue that no shade of grey is."""
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def layer_pictures(frame: Frame, layer: str) -> dict[str, FloatArray]:
    """Display-referred colours of one layer, by the names of the pictures, each of shape (H, W, 3), 0..1.

    Depth runs from red (near) to blue (far) over its own range, normals are mapped from -1..1, positions from their own
    box, indices get a colour of their own each. Radiance is exposed and encoded as sRGB, what is brighter than white is
    white. Where there is no surface the picture is black. There is one picture, called as the layer is, but of
    ``lights`` there are ``light.NAME.direct`` and ``light.NAME.shadow`` for each.

    Args:
        frame: What was rendered.
        layer: One of ``Frame.LAYERS``.

    Raises:
        ConfigError: The frame has no such layer.
    """
    check_layer(frame, layer)
    if layer == "lights":
        pictures = {}
        for label, direct, shadow in lights(frame):
            pictures[f"light.{label}.direct"] = _radiance_picture(frame, direct)
            pictures[f"light.{label}.shadow"] = shadow
    elif layer in ("depth", "normal", "hits"):
        pictures = {layer: view_picture(frame, layer)}
    elif layer == "position":
        pictures = {layer: _position_picture(frame)}
    elif layer == "albedo":
        pictures = {layer: encode_srgb(getattr(frame, layer))}
    elif layer in ("gaussian_index", "instance_index"):
        pictures = {layer: _index_picture(getattr(frame, layer))}
    else:
        pictures = {layer: _radiance_picture(frame, getattr(frame, layer))}
    return {name: _clean(picture) for name, picture in pictures.items()}


def view_limits(frame: Frame, view: str) -> Limits:
    """What the colours of a view span: of depth its own range, percentiles 1 to 99; of the others always the same.

    Raises:
        ConfigError: There is no such view.
    """
    _check_view(view)
    if view == "hits":
        return 0.0, _HITS_TOP
    surface = frame.depth[np.isfinite(frame.depth)]
    if view != "depth" or not surface.size:
        return 0.0, 1.0
    near, far = np.percentile(surface, (1, 99))
    return float(near), float(far)


def view_picture(frame: Frame, view: str, limits: Limits | None = None) -> FloatArray:
    """Display-referred colours of one view, shape (H, W, 3), 0..1.

    Args:
        frame: What was rendered.
        view: ``normal``: from -1..1, black where there is nothing. ``depth``: red (near) to blue (far), black where
            there is no surface. ``index``: a colour for each Gaussian, and for each mesh. ``shadow``: how much of the
            direct light arrives, of all lights together, from black (none) to white (all); blue where no light would
            come if nothing were in the way. ``hits``: Gaussians that a ray blends, from violet over red to yellow on a
            logarithmic scale, black for none. ``transmittance``: what gets through to the background, from violet
            (none) to yellow (all).
        limits: Values at the ends of the colour map of ``depth`` and ``hits``; None: those of `view_limits`.

    Raises:
        ConfigError: There is no such view, or the frame was rendered without what it needs.
    """
    low, high = view_limits(frame, view) if limits is None else limits
    if view == "depth":
        picture = _depth_picture(frame.depth, low, high)
    elif view == "normal":
        picture = np.where(frame.normal.any(axis=2, keepdims=True), 0.5 + 0.5 * frame.normal, 0.0)
    elif view == "index":
        # Spread over instances, too: Gaussian 0 of two captures, and two meshes, which have no Gaussian, differ.
        picture = _index_picture(
            frame.gaussian_index + 1 + 8191 * frame.instance_index.astype(np.int64), frame.instance_index >= 0
        )
    elif view == "shadow":
        picture = _shadow_picture(frame)
    elif view == "hits":
        check_layer(frame, "hits")
        hits = np.maximum(np.nan_to_num(np.asarray(frame.hits, np.float64)), 0.0)
        start, end = np.log2(1.0 + low), np.log2(1.0 + high)
        heat = _ramp(_HEAT_RAMP, (np.log2(1.0 + hits) - start) / max(end - start, 1e-9))
        picture = np.where(hits[..., None] > 0.0, heat, 0.0)
    else:
        _check_view(view)
        picture = _ramp(_HEAT_RAMP, 1.0 - frame.alpha)
    return _clean(picture)


def _check_view(view: str) -> None:
    if view not in VIEWS:
        raise ConfigError(f"unknown view '{view}', expected one of {', '.join(VIEWS)}")


def _clean(picture: npt.NDArray) -> FloatArray:
    return np.clip(np.nan_to_num(picture), 0.0, 1.0).astype(np.float32)


def _ramp(stops: npt.NDArray, values: npt.NDArray) -> npt.NDArray:
    """Colours at 0..1 along equally spaced stops, shape (..., 3)."""
    places = np.linspace(0.0, 1.0, len(stops))
    return np.stack([np.interp(values, places, stops[:, channel]) for channel in range(3)], axis=-1)


def _depth_picture(depth: FloatArray, near: float, far: float) -> npt.NDArray:
    hit = np.isfinite(depth)
    closeness = (far - np.where(hit, depth, far)) / max(far - near, 1e-9)
    return np.where(hit[..., None], _ramp(_DEPTH_RAMP, closeness), 0.0)


def _position_picture(frame: Frame) -> npt.NDArray:
    hit, position = np.isfinite(frame.depth), frame.position
    if not hit.any():
        return np.zeros_like(position)
    low, high = np.percentile(position[hit], (1, 99), axis=0)
    return np.where(hit[..., None], (position - low) / np.maximum(high - low, 1e-9), 0.0)


def _index_picture(indices: npt.NDArray, shown: npt.NDArray | None = None) -> npt.NDArray:
    # Knuth's multiplicative hash: neighbours in index get colours far apart, the same ones in every frame.
    hashed = indices.astype(np.uint32) * np.uint32(2654435761)
    colors = np.stack([(hashed >> shift) & 0xFF for shift in (8, 16, 24)], axis=-1) / 255.0
    return np.where((indices >= 0 if shown is None else shown)[..., None], 0.2 + 0.8 * colors, 0.0)


def _shadow_picture(frame: Frame) -> npt.NDArray:
    check_layer(frame, "lights")
    direct = np.zeros(frame.alpha.shape)
    arriving = np.zeros_like(direct)
    for _, light, shadow in lights(frame):
        direct += np.nan_to_num(light) @ _LUMINANCE
        arriving += np.nan_to_num(light * shadow) @ _LUMINANCE
    share = np.divide(arriving, direct, out=np.zeros_like(direct), where=direct > 0.0)
    return np.where((direct > 0.0)[..., None], share[..., None], np.array(_UNLIT))


def _radiance_picture(frame: Frame, radiance: FloatArray) -> npt.NDArray:
    return encode_srgb(np.clip(radiance, 0.0, None) * np.exp2(np.float32(frame.camera.exposure)))
