"""Settings files: saved settings load again, and errors name the line."""

from __future__ import annotations

import tomllib
from dataclasses import fields
from enum import Enum
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast, get_type_hints

import numpy as np
import pytest
from hypothesis import given, strategies as st

import lumisplat as ls
from lumisplat.config.render import AOVS
from lumisplat.config.setting import all_settings
from support.files.scene_files import refuses, write_scene


def between(low: float, high: float) -> st.SearchStrategy[float]:
    """Generates numbers of a range, including integers and both ends."""
    return st.floats(low, high) | st.sampled_from([low, high]) | st.integers(int(np.ceil(low)), int(high))


HITS = st.sampled_from([4, 8, 16, 32])
SETTINGS: dict[type, dict[str, st.SearchStrategy[Any]]] = {
    ls.RasterConfig: {
        "dilation": between(0.0, 10.0),
        "sh_degree": st.integers(0, 3),
        "transmittance_min": between(0.0, 1.0),
        "depth_iso_transmittance": between(0.0, 1.0),
    },
    ls.TraceConfig: {
        "hits_per_pass": HITS,
        "hit_distance": st.none() | st.sampled_from(ls.config.HitDistance),
        "dilation": between(0.0, 10.0),
        "sh_degree": st.integers(0, 3),
        "transmittance_min": between(0.0, 1.0),
        "depth_iso_transmittance": between(0.0, 1.0),
        "acceptance_scale": between(1e-3, 1.0),
    },
    ls.config.ResponseConfig: {
        "kernel_degree": st.none() | st.integers(0, 5),
        "min_response": st.floats(0.0, 0.97),
    },
    ls.ShadowConfig: {
        "hits": HITS,
        "offset": between(0.0, 100.0),
        "offset_absolute": between(0.0, 1e6),
        "transmittance_min": between(0.0, 1.0),
        "transmittance_threshold": st.floats(0.0, 0.99),
        "acceptance_scale": between(1e-3, 1.0),
        "color_strength": between(0.0, 5.0),
    },
    ls.PathConfig: {},
    ls.config.FilterConfig: {
        "frames": st.integers(1, 1024),
        "indirect_frames": st.integers(1, 1024),
        "passes": st.integers(0, 6),
        "radius": st.integers(1, 2),
    },
    ls.config.ProbeConfig: {
        "tile": st.integers(8, 64),
        "cells": st.integers(4, 16),
        "refreshed": st.floats(0.01, 1.0),
        "history": st.integers(1, 256),
        "adaptive": between(0.0, 1.0),
    },
    ls.config.RadianceCacheConfig: {
        "tiles": st.integers(64, 2**20),
        "cell_size": st.floats(1e-3, 0.99),
        "history": st.none() | st.integers(1, 1024),
        "bounce_history": st.integers(1, 1024),
        "samples_min": st.integers(1, 1024),
        "bounces": st.integers(128, 2**20),
        "unused_frames": st.integers(1, 10_000),
    },
    ls.RealtimeConfig: {"light_interval": st.integers(1, 2)},
    ls.RenderConfig: {
        "background": st.none() | st.tuples(*[between(0.0, 1.0)] * 3),
        "lighting": st.none() | st.booleans(),
        "aovs": st.lists(st.sampled_from(AOVS), unique=True),
        "samples": st.none() | st.integers(1, 16_777_216),
        "time_limit": st.none() | st.floats(1e-3, 1e6),
        "noise": st.none() | st.floats(1e-6, 0.99),
        "adaptive": st.none() | st.booleans(),
        "glossy_reflections": st.none() | st.booleans(),
        "capture_gain": between(-16.0, 16.0),
        "seed": st.integers(0, 2**32 - 1),
        "max_bounces": st.integers(0, 64),
    },
}


def configs(kind: type) -> st.SearchStrategy[Any]:
    """Generates settings of a stage with random fields."""
    chosen = dict(SETTINGS[kind])
    for name, hint in get_type_hints(kind).items():
        if isinstance(hint, type) and issubclass(hint, Enum):
            chosen[name] = st.sampled_from(all_settings(kind)[name].choices)
        elif hint is bool:
            chosen[name] = st.booleans()
        elif hint in SETTINGS:
            chosen[name] = configs(hint)
    assert set(chosen) == {field.name for field in fields(kind)}  # new settings are tested, too
    return st.builds(kind, **chosen)


@given(configs(ls.RenderConfig))
def test_saved_render_settings_load_with_exactly_equal_values(config: ls.RenderConfig) -> None:
    """Random settings are equal to the last bit."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "settings.toml"
        ls.save_config(path, config)
        assert ls.load_config(path) == config


def test_settings_file_has_a_table_per_stage_and_every_setting(tmp_path: Path) -> None:
    """None is written as a word such as "none" or "auto"."""
    ls.save_config(tmp_path / "new" / "a.toml", ls.RenderConfig(background=None, aovs=("hits", "albedo")))
    document = tomllib.loads((tmp_path / "new" / "a.toml").read_text())
    render = document["render"]
    assert set(document) == {"render"} and set(render) == {field.name for field in fields(ls.RenderConfig)}
    assert (render["background"], render["lighting"], render["pipeline"]) == ("none", "auto", "raster")
    assert render["response"]["kernel_degree"] == "auto" and render["shadow_rays"]["method"] == "exact"
    assert render["aovs"] == ["albedo", "hits"]


def test_settings_with_numpy_numbers_are_saved_as_python_numbers(tmp_path: Path) -> None:
    """The loaded settings are equal, and have Python's own number types."""
    config = ls.RenderConfig(
        response=ls.config.ResponseConfig(min_response=np.float64(0.1), kernel_degree=cast(Any, np.int64(4))),
        samples=cast(Any, np.int32(3)),
        jitter=cast(Any, np.bool_(False)),
        background=cast(Any, np.array([0.5, 0.25, 0.0])),
    )
    ls.save_config(tmp_path / "a.toml", config)
    assert ls.load_config(tmp_path / "a.toml") == config


def test_settings_in_a_scene_file_override_the_defaults(tmp_path: Path) -> None:
    """Missing settings keep their defaults, and the other tables of the file are ignored."""
    text = '[[splats]]\npath = "lost.ply"\n[render]\npipeline = "hybrid"\nbackground = [1, 0.5, 0]\n'
    text += "[render.shadow_rays]\nhits = 8\n"
    expected = ls.RenderConfig(
        pipeline=ls.Pipeline.HYBRID, background=(1.0, 0.5, 0.0), shadow_rays=ls.ShadowConfig(hits=8)
    )
    assert ls.load_config(write_scene(tmp_path, text)) == expected
    assert ls.load_config(write_scene(tmp_path, "# nothing")) == ls.RenderConfig()


@pytest.mark.parametrize(
    ("written", "value"), [('"on"', True), ('"off"', False), ("true", True), ("false", False), ('"auto"', None)]
)
def test_settings_files_accept_on_off_and_auto_for_settings_that_may_be_unset(
    tmp_path: Path, written: str, value: bool | None
) -> None:
    """``lighting = "off"`` is valid as on the command line; flags that cannot be None accept only true and false."""
    text = f"[render]\nlighting = {written}\nadaptive = {written}\n"
    assert ls.load_config(write_scene(tmp_path, text)) == ls.RenderConfig(lighting=value, adaptive=value)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("sampels = 4", "line 2, render: unknown 'sampels', did you mean 'samples'?"),
        ("colour = 4", "line 2, render: unknown 'colour', expected pipeline, background, raster"),
        ("samples = 0", "line 2, render: samples is 0, expected a whole number from 1 to"),
        ("samples = 1.5", "line 2, render: samples is 1.5, expected a whole number"),
        ("samples = true", "line 2, render: samples is True, expected a whole number"),
        ("\nseed = 'x'", "line 3, render: seed is 'x', expected a whole number"),
        ("pipeline = 'rastr'", "line 2, render: pipeline is 'rastr', did you mean 'raster'?"),
        ("pipeline = 'gpu'", "line 2, render: pipeline is 'gpu', expected raster, trace, hybrid"),
        ("shadows = false", "line 2, render: shadows is false, expected off, hard, soft"),
        (
            "lighting = 'none'",
            'line 2, render: lighting is \'none\', expected true or false, as words "on" or "off", or "auto"',
        ),
        ("jitter = 'off'", "line 2, render: jitter is 'off', expected true or false"),
        ("background = 'auto'", "line 2, render: background is 'auto', expected three numbers"),
        ("background = [1, 2, 3]", "line 2, render: background is (1, 2, 3), expected three numbers in 0..1"),
        ("aovs = 'color'", "line 2, render: aovs has 'color', which every frame has"),
        ("aovs = ['hits', 'xyz']", "line 2, render: aovs has 'xyz', expected albedo, emission"),
        ("aovs = [['hits']]", "line 2, render: aovs is"),
        ("trace = 3", "line 2, render: trace is 3, expected a table"),
        ("jitter = 1", "line 2, render: jitter is 1, expected true or false"),
        ("[render.shadow]\nmethod = 'exact'", "line 2, render: unknown 'shadow', did you mean 'shadows'?"),
        ("[render.trace]\nhits_per_pass = 17", "line 3, render.trace: hits_per_pass is 17, expected 4, 8, 16 or 32"),
        (
            "[render.response]\nkernel_degree = 'none'",
            "line 3, render.response: kernel_degree is 'none', expected a whole",
        ),
        ("[render.raster]\ndilation = -1", "line 3, render.raster: dilation is -1, expected 0.0 to 10.0"),
        (
            "[render.shadow_rays]\nmethod = 'exakt'",
            "line 3, render.shadow_rays: method is 'exakt', did you mean 'exact'?",
        ),
        ("[render.shaddow_rays]\n", "line 2, render: unknown 'shaddow_rays', did you mean 'shadow_rays'?"),
    ],
)
def test_error_for_an_invalid_setting_in_a_file_names_file_line_and_setting(
    tmp_path: Path, text: str, problem: str
) -> None:
    """The error is one line."""
    with pytest.raises(ls.FormatError) as caught:
        ls.load_config(write_scene(tmp_path, f"[render]\n{text}\n"))
    refuses(caught, tmp_path, problem)


def test_save_config_refuses_other_objects_and_folders_without_writing_a_file(tmp_path: Path) -> None:
    """Only a RenderConfig can be saved, and not to the path of a folder."""
    with pytest.raises(ls.ConfigError, match="config is a RasterConfig, expected a RenderConfig"):
        ls.save_config(tmp_path / "a.toml", cast(Any, ls.RasterConfig()))
    with pytest.raises(ls.FormatError, match="is a folder"):
        ls.save_config(tmp_path, ls.RenderConfig())
    assert not list(tmp_path.iterdir())
