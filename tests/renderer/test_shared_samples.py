"""Frames merged from parts of their samples: the same bits, whichever process rendered the parts."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.frame.sample_part import SUMS, SamplePart, merged
from support.scenes import lit_scene
from support.scenes.lenses import lens

SIZE = 24, 16
CAMERA = lit_scene.camera(*SIZE)


def settings(pipeline: ls.Pipeline = ls.Pipeline.PATH, samples: int = 38, **changes: object) -> ls.RenderConfig:
    """Returns the config of a lit frame with a part of 32 samples and one of 6."""
    return lit_scene.config(pipeline, samples=samples, **changes)


def part_of(values: np.ndarray, first: int, layer: np.ndarray) -> SamplePart:
    """Returns a part of a frame of one pixel with the given sample values; NaN samples are dropped."""
    valid = values[~np.isnan(values)].astype(np.float64)
    count = len(valid)
    mean = valid.mean() if count else 0.0
    sums = {name: np.full(1 if name in ("alpha", "captured_weight") else 3, valid.sum()) for name in SUMS[:4]}
    sums["squares"] = np.full(3, np.square(valid - mean).sum())
    held = {
        "count": np.array([count], np.int32).view(np.float32),
        "sums": np.concatenate(list(sums.values())).view(np.float32),
        "albedo": np.full(3, layer[~np.isnan(values)].mean() if count else np.nan, np.float32),
    }
    return SamplePart(first, len(values), (1, 1), held, {})


def test_sums_merged_from_parts_of_a_frames_samples_equal_the_sums_over_all() -> None:
    """Counts, sums, centred squares and layer means agree in float64; parts without samples have no effect."""
    rng = np.random.default_rng(2)
    values = 5.0 + rng.normal(size=90).astype(np.float32)
    layer = rng.random(90).astype(np.float32)
    values[[3, 40]] = np.nan
    values[64:80] = np.nan
    cuts = [0, 32, 64, 80, 90]
    parts = [part_of(values[a:b], a, layer[a:b]) for a, b in pairwise(cuts)]
    whole = merged(parts)
    valid = values[~np.isnan(values)].astype(np.float64)
    sums = whole.accumulated["sums"].view(np.float64)
    assert whole.count == 90 and whole.accumulated["count"].view(np.int32)[0] == len(valid)
    np.testing.assert_allclose(sums[:7], valid.sum(), rtol=1e-14)
    np.testing.assert_allclose(sums[7:], np.square(valid - valid.mean()).sum(), rtol=1e-12)
    np.testing.assert_allclose(whole.accumulated["albedo"], layer[~np.isnan(values)].mean(dtype=np.float64), rtol=1e-6)


@pytest.mark.parametrize("pipeline", [ls.Pipeline.PATH, ls.Pipeline.HYBRID])
def test_frame_merged_from_samples_of_two_renderers_equals_that_of_one_to_the_bit(
    pipeline: ls.Pipeline, tmp_path: Path
) -> None:
    """The parts are rendered in any order and stored in files; a frame rendered at once is nearly equal."""
    config = settings(pipeline, shadows=ls.Shadows.SOFT, aovs=("albedo", "lights", "variance", "sample_count"))
    scene = lit_scene.scene(*lit_scene.LIGHTS, lit_scene.ENVIRONMENT)
    one, other = (ls.create_renderer(config, "cpu") for _ in range(2))
    blocks = ls.farm.sample_blocks(one, scene)
    assert [len(block) for block in blocks] == [32, 6]
    serial = ls.farm.merge_samples(
        one, scene, CAMERA, (ls.farm.render_samples(one, scene, CAMERA, block) for block in blocks)
    )
    for number, renderer in ((1, other), (0, one)):
        ls.farm.render_samples(renderer, scene, CAMERA, blocks[number]).save(tmp_path / f"{number}.npz")
    loaded = (SamplePart.load(tmp_path / f"{number}.npz") for number in range(2))
    shared = ls.farm.merge_samples(ls.create_renderer(config, "cpu"), scene, CAMERA, loaded)
    plain = other.render(scene, CAMERA)
    assert shared.samples == 38
    for name, image in serial.arrays().items():
        np.testing.assert_array_equal(shared.arrays()[name], image, name)
        expected = plain.arrays()[name]
        if expected.dtype.kind != "f":
            np.testing.assert_array_equal(image, expected, name)
        else:  # layers are running float32 means, and catcher light is averaged per part
            np.testing.assert_allclose(image, expected, rtol=2e-3, atol=2e-5, err_msg=name)
    assert np.abs(shared.color - plain.color).max() < 1e-5


def test_merging_overlapping_incomplete_or_unrelated_sample_parts_is_refused() -> None:
    """The parts overlap, leave a gap, belong to other frames, or are missing; each error is one line."""
    scene, renderer = lit_scene.scene(), ls.create_renderer(settings(samples=2), "cpu")
    part = ls.farm.render_samples(renderer, scene, CAMERA, range(2))
    with pytest.raises(ls.ConfigError, match="begins at sample 2, expected 0"):
        ls.farm.merge_samples(renderer, scene, CAMERA, [replace(part, first=2)])
    with pytest.raises(ls.ConfigError, match="begins at sample 0, expected 2"):
        ls.farm.merge_samples(renderer, scene, CAMERA, [part, part])
    with pytest.raises(ls.ConfigError, match="there are no parts to merge"):
        ls.farm.merge_samples(renderer, scene, CAMERA, [])
    with pytest.raises(ls.ConfigError, match="expected 2 of 24 x 16"):
        ls.farm.merge_samples(renderer, scene, CAMERA, [part, replace(part, first=2)])
    with pytest.raises(ls.ConfigError, match="belong to different frames"):
        ls.farm.merge_samples(renderer, scene, CAMERA, [part, replace(part, first=2, size=(16, 24))])
    with pytest.raises(ls.ConfigError, match="expected a block"):
        ls.farm.render_samples(renderer, scene, CAMERA, range(0))


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (ls.RenderConfig(), "drawn in one go"),
        (ls.RenderConfig(pipeline=ls.Pipeline.REALTIME), "drawn in one go"),
        (settings(noise=0.1), "set only samples"),
        (ls.RenderConfig(pipeline=ls.Pipeline.PATH, time_limit=1.0), "set only samples"),
    ],
)
def test_frames_that_cannot_be_split_into_sample_parts_are_refused(config: ls.RenderConfig, message: str) -> None:
    """Rasterised, real-time, and noise- or time-limited frames are refused in one line."""
    renderer = ls.create_renderer(config, "cpu")
    scene = ls.Scene() if config.pipeline is ls.Pipeline.RASTER else lit_scene.scene()
    with pytest.raises(ls.ConfigError, match=message):
        ls.farm.sample_blocks(renderer, scene)


def test_rasterised_frames_of_distorted_lenses_cannot_be_split_into_parts() -> None:
    """Such frames are resampled, so that their samples cannot be merged."""
    renderer = ls.create_renderer(settings(ls.Pipeline.HYBRID), "cpu")
    with pytest.raises(ls.ConfigError, match="lens distortion"):
        ls.farm.render_samples(
            renderer, lit_scene.scene(), lens(50.0, SIZE, distortion=(0.05, 0, 0, 0, 0, 0)), range(2)
        )


def test_damaged_sample_part_files_are_refused(tmp_path: Path) -> None:
    """Truncated files and files of other formats are refused."""
    renderer, scene = ls.create_renderer(settings(samples=1), "cpu"), lit_scene.scene()
    path = tmp_path / "part.npz"
    ls.farm.render_samples(renderer, scene, CAMERA, range(1)).save(path)
    content = path.read_bytes()
    for wrong in (content[: len(content) // 2], b"nothing", content[:3]):
        path.write_bytes(wrong)
        with pytest.raises(ls.FormatError, match="part"):
            SamplePart.load(path)
    with pytest.raises(ls.errors.MissingFileError):
        SamplePart.load(tmp_path / "lost.npz")
