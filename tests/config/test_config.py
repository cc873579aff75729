"""Tests that settings are refused in one line when created with a wrong type or a value out of range."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any, cast

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.config.setting import all_settings
from support.scenes.raster_scenes import front_camera, random_gaussians

WHOLE = "expected a whole number from"


@pytest.mark.parametrize(
    ("kind", "settings", "message"),
    [
        (
            ls.RenderConfig,
            {"pipeline": "rays"},
            "pipeline is 'rays', expected 'raster', 'trace', 'hybrid', 'path' or 'realtime'",
        ),
        (
            ls.RenderConfig,
            {"pipeline": None},
            "pipeline is None, expected 'raster', 'trace', 'hybrid', 'path' or 'realtime'",
        ),
        (
            ls.RenderConfig,
            {"pipeline": ls.config.TraceStrategy.SORTED},
            "expected 'raster', 'trace', 'hybrid', 'path' or 'realtime'",
        ),
        (
            ls.RasterConfig,
            {"antialiasing": "On"},
            "antialiasing is 'On', expected 'auto', 'off' or 'on'",
        ),
        (ls.TraceConfig, {"strategy": "stochastic"}, "strategy is 'stochastic', expected 'sorted', 'stochastic-hit'"),
        (ls.TraceConfig, {"hit_distance": "far"}, "expected 'mean', 'peak' or 'hull'"),
        (ls.TraceConfig, {"dilation": -0.1}, "dilation is -0.1, expected 0.0 to 10.0"),
        (ls.TraceConfig, {"antialiasing": True}, "antialiasing is True, expected 'auto', 'off' or 'on'"),
        (
            ls.TraceConfig,
            {"normal_method": 1},
            "normal_method is 1, expected 'plane' or 'ellipsoid'",
        ),
        (ls.RenderConfig, {"raster": {"dilation": 0.0}}, "raster is {'dilation': 0.0}, expected a RasterConfig"),
        (ls.RenderConfig, {"trace": ls.RasterConfig()}, "expected a TraceConfig"),
        (ls.RenderConfig, {"samples": 1.5}, f"samples is 1.5, {WHOLE} 1 to 16777216"),
        (ls.RenderConfig, {"samples": 0}, f"samples is 0, {WHOLE} 1 to"),
        (ls.RenderConfig, {"seed": 0.5}, f"seed is 0.5, {WHOLE} 0 to 4294967295"),
        (ls.RenderConfig, {"max_bounces": 2.5}, f"max_bounces is 2.5, {WHOLE} 0 to 64"),
        (ls.RenderConfig, {"max_bounces": np.float32(2.0)}, f"max_bounces is 2.0, {WHOLE} 0 to 64"),
        (
            ls.RenderConfig,
            {"background": "mauvish"},
            "background is 'mauvish', expected three numbers in 0..1, '#ff8800'",
        ),
        (ls.RenderConfig, {"background": "1,0"}, "background is '1,0', expected three numbers in 0..1"),
        (ls.RenderConfig, {"background": "#11223344"}, "background is '#11223344', expected three numbers in 0..1"),
        (ls.RenderConfig, {"background": 0.5}, "background is 0.5, expected three numbers"),
        (ls.RenderConfig, {"background": np.eye(3)}, "expected three numbers in 0..1"),
        (ls.RenderConfig, {"background": ("r", "g", "b")}, "expected three numbers in 0..1"),
        (ls.RenderConfig, {"lighting": 1}, "lighting is 1, expected True or False"),
        (ls.RenderConfig, {"shadows": True}, "shadows is True, expected 'off', 'hard' or 'soft'"),
        (ls.RenderConfig, {"shadow_rays": None}, "shadow_rays is None, expected a ShadowConfig"),
        (ls.RenderConfig, {"response": ls.TraceConfig()}, "expected a ResponseConfig"),
        (ls.RenderConfig, {"jitter": 3}, "jitter is 3, expected True or False"),
        (ls.RenderConfig, {"tone_map": "aces"}, "tone_map is 'aces', expected 'none', 'neutral' or 'agx'"),
        (ls.RenderConfig, {"aovs": "albdo"}, "aovs has 'albdo', did you mean 'albedo'"),
        (ls.RenderConfig, {"aovs": ("hits", "depth")}, "aovs has 'depth', which every frame has"),
        (ls.RenderConfig, {"aovs": [["hits"]]}, "aovs is [['hits']], expected some of"),
        (ls.RenderConfig, {"aovs": 3}, "aovs is 3, expected some of"),
        (ls.ShadowConfig, {"method": "fast"}, "method is 'fast', expected 'exact', 'first-hits' or 'stochastic'"),
        (ls.ShadowConfig, {"hits": 17}, "hits is 17, expected 4, 8, 16 or 32"),
        (ls.ShadowConfig, {"offset": -1.0}, "offset is -1.0, expected 0.0 to 100.0"),
        (ls.ShadowConfig, {"offset_absolute": np.inf}, "offset_absolute is inf, expected 0.0 to 1000000.0"),
        (ls.ShadowConfig, {"hit_distance": "mean"}, "hit_distance is 'mean', expected 'peak' or 'hull'"),
        (ls.ShadowConfig, {"transmittance_min": 1.5}, "transmittance_min is 1.5, expected 0.0 to 1.0"),
        (ls.ShadowConfig, {"transmittance_threshold": 1.0}, "transmittance_threshold is 1.0, expected 0.0 to 0.99"),
        (ls.ShadowConfig, {"acceptance_scale": 0.0}, "acceptance_scale is 0.0, expected 0.001 to 1.0"),
        (ls.ShadowConfig, {"shared_draws": 1}, "shared_draws is 1, expected True or False"),
        (ls.ShadowConfig, {"color_strength": 6.0}, "color_strength is 6.0, expected 0.0 to 5.0"),
        (ls.RasterConfig, {"strategy": "Sorted"}, "strategy is 'Sorted', expected 'sorted' or 'stochastic'"),
        (ls.RasterConfig, {"sh_degree": 1.5}, f"sh_degree is 1.5, {WHOLE} 0 to 3"),
        (ls.RasterConfig, {"dilation": "0.3"}, "dilation is '0.3', expected 0.0 to 10.0"),
        (ls.RasterConfig, {"dilation": True}, "dilation is True, expected 0.0 to 10.0"),
        (ls.TraceConfig, {"sh_degree": 1.5}, f"sh_degree is 1.5, {WHOLE} 0 to 3"),
        (ls.config.ResponseConfig, {"kernel_degree": 2.5}, f"kernel_degree is 2.5, {WHOLE} 0 to 5"),
        (ls.config.ResponseConfig, {"kernel_degree": True}, f"kernel_degree is True, {WHOLE} 0 to 5"),
        (ls.TraceConfig, {"hits_per_pass": 16.0}, "hits_per_pass is 16.0, expected 4, 8, 16 or 32"),
        (ls.TraceConfig, {"hits_per_pass": np.eye(9)}, "expected 4, 8, 16 or 32"),
        (ls.config.ResponseConfig, {"adaptive_clamping": None}, "adaptive_clamping is None, expected True or False"),
        (ls.config.ResponseConfig, {"min_response": "a"}, "min_response is 'a', expected 0.0 to 0.97"),
        (ls.TraceConfig, {"acceptance_scale": 5e-4}, "acceptance_scale is 0.0005, expected 0.001 to 1.0"),
        (ls.RenderConfig, {"realtime": ls.config.FilterConfig()}, "expected a RealtimeConfig"),
        (ls.RealtimeConfig, {"quality": "low"}, "quality is 'low', expected 'preview', 'balanced' or 'high'"),
        (ls.RealtimeConfig, {"light_interval": 3}, f"light_interval is 3, {WHOLE} 1 to 2"),
        (ls.RealtimeConfig, {"highlight_rays": 1}, "highlight_rays is 1, expected True or False"),
        (ls.RealtimeConfig, {"filter": {"frames": 8}}, "filter is {'frames': 8}, expected a FilterConfig"),
        (ls.RealtimeConfig, {"probes": None}, "probes is None, expected a ProbeConfig"),
        (ls.RealtimeConfig, {"cache": ls.config.FilterConfig()}, "expected a RadianceCacheConfig"),
        (ls.config.FilterConfig, {"frames": 0}, f"frames is 0, {WHOLE} 1 to 1024"),
        (ls.config.FilterConfig, {"frames": 1025}, f"frames is 1025, {WHOLE} 1 to 1024"),
        (ls.config.FilterConfig, {"frames": 2.5}, f"frames is 2.5, {WHOLE} 1 to"),
        (ls.config.FilterConfig, {"indirect_frames": 0}, f"indirect_frames is 0, {WHOLE} 1 to 1024"),
        (ls.config.FilterConfig, {"passes": -1}, f"passes is -1, {WHOLE} 0 to 6"),
        (ls.config.FilterConfig, {"passes": 7}, f"passes is 7, {WHOLE} 0 to 6"),
        (ls.config.FilterConfig, {"radius": 3}, f"radius is 3, {WHOLE} 1 to 2"),
        (ls.config.FilterConfig, {"radius": True}, f"radius is True, {WHOLE} 1 to 2"),
        (ls.config.RadianceCacheConfig, {"tiles": 63}, f"tiles is 63, {WHOLE} 64 to"),
        (ls.config.RadianceCacheConfig, {"cell_size": -0.1}, "cell_size is -0.1, expected"),
        (ls.config.RadianceCacheConfig, {"cell_size": 0.0}, "cell_size is 0.0, expected"),
        (ls.config.RadianceCacheConfig, {"history": 0}, f"history is 0, {WHOLE} 1 to 1024"),
        (ls.config.RadianceCacheConfig, {"bounces": 1.5}, f"bounces is 1.5, {WHOLE} 128 to"),
        (ls.config.AvatarLightingConfig, {"direct": 1.1}, "direct is 1.1, expected 0.0 to 1.0"),
        (ls.config.AvatarLightingConfig, {"shadows": 1}, "shadows is 1, expected True or False"),
        (ls.config.AvatarLightingConfig, {"relight": None}, "relight is None, expected True or False"),
        (ls.config.AvatarLightingConfig, {"light_count": 0}, f"light_count is 0, {WHOLE} 1 to 64"),
        (ls.config.AvatarLightingConfig, {"shadow_map": ls.ShadowConfig()}, "expected a DeepShadowConfig"),
        (ls.config.AvatarLightingConfig, {"transfer": 1.0}, "transfer is 1.0, expected a RelightConfig"),
        (ls.config.AvatarLightingConfig, {"estimation": {}}, "estimation is {}, expected a LightEstimationConfig"),
        (ls.config.LightEstimationConfig, {"radius": 0.0}, "radius is 0.0, expected 1e-06 to"),
        (
            ls.config.LightEstimationConfig,
            {"viewpoint_distance": -1.0},
            "viewpoint_distance is -1.0, expected 1e-06 to",
        ),
        (ls.config.LightEstimationConfig, {"emitter_size": "a"}, "emitter_size is 'a', expected 1e-06 to"),
        (ls.config.LightEstimationConfig, {"separation": np.nan}, "separation is nan, expected 1e-06 to"),
        (ls.config.LightEstimationConfig, {"compactness": 2.0}, "compactness is 2.0, expected 0.0 to 1.0"),
        (ls.config.LightEstimationConfig, {"weakest": -0.1}, "weakest is -0.1, expected 0.0 to 1.0"),
        (ls.config.LightEstimationConfig, {"irradiance": 0.0}, "irradiance is 0.0, expected 1e-06 to"),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
def test_settings_of_wrong_type_or_range_are_refused_when_created(
    kind: type, settings: dict[str, object], message: str
) -> None:
    """The one-line message names the setting, its value and what was expected."""
    with pytest.raises(ls.ConfigError) as caught:
        kind(**settings)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_render_configs_with_equal_layers_in_any_order_or_iterable_are_equal() -> None:
    """A layer named twice counts once."""
    names: Any = (name for name in ("hits", "albedo", "hits"))
    config = ls.RenderConfig(aovs=names)
    assert config == ls.RenderConfig(aovs=("albedo", "hits"))
    assert config.aovs == ("albedo", "hits")


def test_settings_accept_numpy_numbers() -> None:
    """The frame equals that of Python numbers, and a background array becomes a tuple."""
    one, two = np.int64(1), np.int32(2)
    trace: dict[str, Any] = {
        "hits_per_pass": np.int64(8),
        "sh_degree": one,
        "transmittance_min": np.float32(0.0),
    }
    response: dict[str, Any] = {"kernel_degree": two, "min_response": np.float64(0.1)}
    frame_settings: dict[str, Any] = {
        "samples": two,
        "jitter": np.bool_(False),
        "seed": np.uint32(7),
        "max_bounces": one,
        "background": np.array([0.5, 0.25, 0.0]),
    }
    config = ls.RenderConfig(
        pipeline=ls.Pipeline.TRACE,
        trace=ls.TraceConfig(strategy=ls.config.TraceStrategy.STOCHASTIC_PASS, **trace),
        response=ls.config.ResponseConfig(**response),
        **frame_settings,
    )
    plain = ls.RenderConfig(
        pipeline=ls.Pipeline.TRACE,
        trace=ls.TraceConfig(
            strategy=ls.config.TraceStrategy.STOCHASTIC_PASS,
            hits_per_pass=8,
            sh_degree=1,
            transmittance_min=0.0,
        ),
        response=ls.config.ResponseConfig(kernel_degree=2, min_response=0.1),
        samples=2,
        jitter=False,
        seed=7,
        max_bounces=1,
        background=(0.5, 0.25, 0.0),
    )
    assert config == plain
    listed: Any = [0.5, 0.25, 0.0]
    assert ls.RenderConfig(background=listed) == ls.RenderConfig(background=(0.5, 0.25, 0.0))
    scene = ls.Scene([random_gaussians(5, 60, degree=2)])
    frame, expected = (ls.render(scene, front_camera(24, 18), c, device="cpu") for c in (config, plain))
    np.testing.assert_array_equal(frame.color, expected.color)


CHOICES = [
    (ls.config.DatasetPoses, "where", ls.config.PosePlaces),
    (ls.TrainConfig, "densification", ls.config.Densification),
    (ls.RenderConfig, "pipeline", ls.Pipeline),
    (ls.RenderConfig, "shadows", ls.Shadows),
    (ls.RenderConfig, "tone_map", ls.ToneMap),
    (ls.RasterConfig, "strategy", ls.config.RasterStrategy),
    (ls.RasterConfig, "projection", ls.config.Projection),
    (ls.RasterConfig, "surface", ls.config.GaussianSurface),
    (ls.RasterConfig, "antialiasing", ls.config.Antialiasing),
    (ls.TraceConfig, "strategy", ls.config.TraceStrategy),
    (ls.TraceConfig, "antialiasing", ls.config.Antialiasing),
    (ls.TraceConfig, "normal_method", ls.config.NormalMethod),
    (ls.ShadowConfig, "method", ls.config.ShadowMethod),
    (ls.ShadowConfig, "hit_distance", ls.config.HitDistance),
    (ls.PathConfig, "primary", ls.config.PathPrimary),
    (ls.RealtimeConfig, "quality", ls.config.RealtimeQuality),
    (ls.config.RelightConfig, "normals", ls.config.NormalEstimate),
    (ls.config.DeepShadowConfig, "layout", ls.config.AtlasLayout),
    (ls.config.DeepShadowConfig, "absorption", ls.config.Absorption),
    (ls.config.DeepShadowConfig, "sampling", ls.config.ReceiverSampling),
    (ls.TrainConfig, "pipeline", ls.Pipeline),
    (ls.TrainConfig, "projection", ls.config.Projection),
]


@pytest.mark.parametrize(("settings", "name", "kind"), CHOICES)
def test_choice_settings_accept_exactly_their_declared_choices(
    settings: type[Any], name: str, kind: type[Enum]
) -> None:
    """The text of a choice becomes the enum member, so that settings compare equal."""
    declared = all_settings(settings)[name].choices
    for member in kind:
        if member not in declared:
            for value in (member, member.value):
                with pytest.raises(ls.ConfigError, match=rf"{name} is .*, expected "):
                    settings(**{name: value})
            continue
        by_value = settings(**{name: member.value})
        assert getattr(by_value, name) is member and by_value == settings(**{name: member})


def test_every_setting_with_choices_is_in_the_list_of_tested_settings() -> None:
    """Choices that are added to settings later must be added to the list, too."""
    every = {
        (kind, field.name)
        for kind in (getattr(ls.config, name) for name in ls.config.__all__)
        if isinstance(kind, type) and is_dataclass(kind) and kind.__module__.startswith("lumisplat.config")
        for field in fields(kind)
        if isinstance(field.default, Enum)
    }
    assert every <= {(kind, name) for kind, name, _ in CHOICES}


@pytest.mark.parametrize(
    ("text", "color"),
    [
        ("black", (0.0, 0.0, 0.0)),
        ("White", (1.0, 1.0, 1.0)),
        ("#ff8000", (1.0, 128 / 255, 0.0)),
        ("#f80", (1.0, 136 / 255, 0.0)),
        ("0.5,0.25,0", (0.5, 0.25, 0.0)),
        ("0.5 0.25 0", (0.5, 0.25, 0.0)),
        ("transparent", None),
        ("none", None),
    ],
)
def test_background_colour_of_a_config_may_be_given_as_text(
    text: str, color: tuple[float, float, float] | None
) -> None:
    """The command line passes backgrounds as text."""
    assert ls.RenderConfig(background=cast(Any, text)) == ls.RenderConfig(background=color)


def test_layers_of_a_render_config_may_be_given_as_one_string() -> None:
    """A single name needs no tuple, and a text may list several names."""
    assert ls.RenderConfig(aovs=cast(Any, "hits")).aovs == ("hits",)
    assert ls.RenderConfig(aovs=cast(Any, "hits, albedo")).aovs == ("albedo", "hits")
