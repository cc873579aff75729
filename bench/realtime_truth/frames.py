"""Renders real-time sequences and their path-traced truth, and measures the difference."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from bench.realtime_truth.scenes import WIDTH, View
from bench.timing import parser, quiet_warp
from lumisplat.config.render import PATH_PARTS
from lumisplat.math.tone_map import lit_picture

Doubles = npt.NDArray[np.float64]

BLOCK = 16
"""Side of the tiles whose means are compared, pixels."""
FAINT = 0.1
"""Smallest value by which a tile's error is divided, as a fraction of the layer's mean."""
BOUNCES = 16
"""Bounces of the truth: with 8, the default, white rooms lack 0.9 % of their light, with 32 nothing more."""
BARS = {"direct": 0.03, "indirect": 0.05, "diffuse": 0.05, "glossy": 0.10}
"""Largest relative error of a tile of a layer on meshes; twice that on Gaussians."""
LAYERS = {
    "direct": ("direct_diffuse",),
    "indirect": ("indirect_diffuse",),
    "glossy": ("direct_glossy", "indirect_glossy"),
}


def options(name: str, description: str | None, *, samples: int = 0, width: int = WIDTH) -> argparse.ArgumentParser:
    """Returns a parser of the common options; ``samples`` adds those of commands with a path-traced truth."""
    given = parser(f"realtime_truth.{name}", description)
    given.add_argument("--width", type=int, default=width, help=f"width of frames, pixels (default: {width})")
    if samples:
        given.add_argument(
            "--samples", type=int, default=samples, help=f"samples per pixel of the truth (default: {samples})"
        )
        help_text = "stores and reuses path-traced frames there; empty it when the path tracer changes"
        given.add_argument("--truths", type=Path, metavar="FOLDER", help=help_text)
    quiet_warp()
    return given


def add_quality(asked: argparse.ArgumentParser) -> None:
    """Adds the option of the real-time quality."""
    asked.add_argument("--quality", default="balanced", help="preview, balanced or high (default: balanced)")


def log(text: str) -> None:
    """Prints a line of progress to standard error, apart from the tables."""
    print(f"{time.strftime('%H:%M:%S')} {text}", file=sys.stderr, flush=True)


def realtime(**settings: Any) -> ls.RenderConfig:
    """Returns settings of a real-time sequence with its layers."""
    given = {"aovs": PATH_PARTS, "tone_map": ls.ToneMap.NEUTRAL} | settings
    return ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, **given)


def paths(samples: int, seed: int) -> ls.RenderConfig:
    """Returns settings of a path-traced frame whose primary hits are those of real time."""
    return ls.RenderConfig(
        pipeline=ls.Pipeline.PATH,
        samples=samples,
        seed=seed,
        path=ls.PathConfig(primary=ls.config.PathPrimary.ISO),
        max_bounces=BOUNCES,
        tone_map=ls.ToneMap.NEUTRAL,
        aovs=(*PATH_PARTS, "albedo"),
    )


def frames_of(renderer: ls.Renderer, view: View, count: int) -> Iterator[ls.Frame]:
    """Yields the next frames of a still sequence."""
    for _ in range(count):
        yield renderer.render(view.scene, view.camera)


def last_of(renderer: ls.Renderer, view: View, count: int) -> ls.Frame:
    """Returns the last of ``count`` frames."""
    *_, frame = frames_of(renderer, view, count)
    return frame


@dataclass(frozen=True)
class Truth:
    """Two independent path-traced frames; the product of errors against both is free of their noise."""

    pictures: Doubles
    """Tone-mapped frames, shape (2, H, W, 3)."""
    whole: Doubles
    """Tone-mapped mean of both frames, shape (H, W, 3)."""
    images: dict[str, Doubles]
    """``color`` and the layers, linear, each of shape (2, H, W, 3)."""

    def layer(self, name: str) -> Doubles:
        """Returns one of `LAYERS`, or ``diffuse``, or an image, shape (2, H, W, 3)."""
        return _layer(name, lambda part: self.images[part])

    def squared_error(self, picture: npt.NDArray[np.floating]) -> float:
        """Returns the mean squared error of a tone-mapped frame, without the truth's noise."""
        first, second = (np.asarray(picture, np.float64) - half for half in self.pictures)
        return float(np.mean(first * second))

    def psnr(self, picture: npt.NDArray[np.floating]) -> float:
        """Returns the PSNR of a tone-mapped frame without the truth's noise, dB."""
        return decibels(self.squared_error(picture))


def decibels(squared_error: float) -> float:
    """Returns the PSNR of a mean squared error, dB."""
    return -10.0 * float(np.log10(max(squared_error, 1e-9)))


def layer_of(frame: ls.Frame, name: str) -> Doubles:
    """Returns one of `LAYERS`, or ``diffuse``, or an image, shape (H, W, 3)."""
    return _layer(name, lambda part: np.asarray(getattr(frame, part), np.float64))


def _layer(name: str, image: Callable[[str], Doubles]) -> Doubles:
    if name == "diffuse":
        return _layer("direct", image) + _layer("indirect", image)
    return sum((image(part) for part in LAYERS.get(name, (name,))), np.zeros(1))


def truth_of(view: View, samples: int, device: str, folder: Path | None) -> Truth:
    """Path traces a view, half of the samples in each frame; reads and stores it in the folder, if there is one."""
    size = f"{view.camera.width}x{view.camera.height}"
    stored = folder / f"{view.name.replace(' ', '_')}-{size}-{samples}.npz" if folder else None
    if stored and stored.is_file():
        images = {name: values.astype(np.float64) for name, values in np.load(stored).items()}
        return Truth(images.pop("pictures"), images.pop("whole"), images)
    log(f"{samples} paths a pixel: {view.name}, {size}")
    halves = [ls.create_renderer(paths(samples // 2, seed), device).render(view.scene, view.camera) for seed in (1, 2)]
    pictures = np.stack([half.pixels_srgb() for half in halves]).astype(np.float64)
    captured, weight, light = (
        np.mean([getattr(half, part) for half in halves], axis=0) for part in ("captured", "captured_weight", "light")
    )
    whole = lit_picture(captured, weight, light, view.camera.exposure, ls.ToneMap.NEUTRAL)
    whole = np.clip(whole, 0.0, 1.0).astype(np.float64)
    images = {
        name: np.stack([np.asarray(getattr(half, name), np.float64) for half in halves])
        for name in ("color", *PATH_PARTS)
    }
    if stored:
        stored.parent.mkdir(parents=True, exist_ok=True)
        stored_arrays = {"pictures": pictures, "whole": whole, **images}
        np.savez(stored, **{name: values.astype(np.float32) for name, values in stored_arrays.items()})  # pyright: ignore[reportArgumentType]
    return Truth(pictures, whole, images)


class Bias(NamedTuple):
    """Errors of tile means, relative to the truth."""

    mean: float
    """Signed error of the whole frame."""
    rms: float
    """Root mean square over tiles."""
    largest: float
    """Signed error of the worst tile."""
    beyond: float
    """Fraction of tiles whose error exceeds the target."""
    noise: float
    """Root mean square of the truth's standard errors."""


def bias(image: Doubles, truth: Doubles, bar: float) -> Bias:
    """Returns the errors of an image, shape (H, W, 3), against two frames of the truth, shape (2, H, W, 3)."""
    ours, (first, second) = blocks(image), (blocks(half) for half in truth)
    expected = 0.5 * (first + second)
    scale = np.maximum(expected, FAINT * expected.mean())
    off, noise = (ours - expected) / scale, 0.5 * (first - second) / scale
    return Bias(
        mean=float(ours.mean() / expected.mean() - 1.0),
        rms=rms(off),
        largest=float(off.flat[np.argmax(np.abs(off))]),
        beyond=float(np.mean(np.abs(off) > bar)),
        noise=rms(noise),
    )


def blocks(image: npt.NDArray[np.floating]) -> Doubles:
    """Returns means over complete tiles and over channels."""
    rows, columns = image.shape[0] // BLOCK, image.shape[1] // BLOCK
    whole = np.asarray(image[: rows * BLOCK, : columns * BLOCK], np.float64)
    return whole.reshape(rows, BLOCK, columns, BLOCK, 3).mean(axis=(1, 3, 4))


def rms(values: Doubles) -> float:
    """Returns the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def percent(value: float, digits: int = 1) -> str:
    """Formats a fraction as percent."""
    return f"{100.0 * value:.{digits}f} %"
