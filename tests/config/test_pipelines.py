"""Tests that a pipeline is defined by its visibility and integrator, and that no other module compares names."""

from __future__ import annotations

import ast
from dataclasses import replace
from pathlib import Path

import pytest

import lumisplat
import lumisplat as ls
from lumisplat.config.pipelines import Integrator, Visibility

SOURCES = Path(lumisplat.__file__).parent


@pytest.mark.parametrize("pipeline", ls.Pipeline)
def test_no_two_pipelines_have_the_same_visibility_and_integrator(pipeline: ls.Pipeline) -> None:
    """No two pipelines render the same way."""
    pair = pipeline.visibility, pipeline.integrator
    assert [one for one in ls.Pipeline if (one.visibility, one.integrator) == pair] == [pipeline]


def test_hybrid_pipeline_has_the_visibility_of_raster_and_the_integrator_of_trace() -> None:
    """Hybrid frames find primary hits as raster does, and carry light as trace does."""
    assert ls.Pipeline.RASTER.visibility is ls.Pipeline.HYBRID.visibility is Visibility.RASTERISED
    assert ls.Pipeline.TRACE.integrator is ls.Pipeline.HYBRID.integrator is Integrator.WHITTED


@pytest.mark.parametrize("pipeline", ls.Pipeline)
def test_pipelines_with_light_bounces_compute_lighting_also_without_lights(pipeline: ls.Pipeline) -> None:
    """Other pipelines light a scene only if it has lights; the setting lighting has precedence."""
    config = ls.RenderConfig(pipeline=pipeline)
    assert config.is_lit(by_default=True)
    assert config.is_lit(by_default=False) == (pipeline in (ls.Pipeline.PATH, ls.Pipeline.REALTIME))
    for lighting in (True, False):
        given = ls.RenderConfig(pipeline=pipeline, lighting=lighting)
        assert given.is_lit(by_default=not lighting) == lighting


def test_each_unused_setting_is_listed_with_the_frames_that_would_use_it() -> None:
    """The text for an unused setting names other pipelines, lit frames, or frames with shadows."""
    unused = ls.RenderConfig(pipeline=ls.Pipeline.RASTER, shadows=ls.Shadows.OFF).unused_settings(lit=True)
    assert unused["max_bounces"] == "Used by the pipelines trace, hybrid, path, realtime."
    assert unused["trace.dilation"] == unused["max_bounces"]
    assert not {"trace", "trace.hit_distance", "trace.normal_method"} & unused.keys(), "the rasteriser reads these two"
    assert unused["realtime"] == "Used by the pipeline realtime."
    assert unused["shadow_rays"] == "Used with shadows, hard or soft."
    assert "raster" not in unused and "tone_map" not in unused
    shared = ls.RenderConfig(shadow_rays=ls.ShadowConfig(method=ls.config.ShadowMethod.STOCHASTIC, shared_draws=True))
    told = shared.unused_settings(lit=True)
    assert "shared_draws" in told["shadow_rays.color_strength"] and "shadow_rays.transmittance_threshold" in told
    assert "tone_map" in ls.RenderConfig().unused_settings(lit=False)


def test_samples_and_seed_are_unused_settings_of_frames_that_are_exact_with_one_sample() -> None:
    """An exact frame is unlit, sorted, and rasterised by projected ellipses.

    Lit, stochastic or unscented frames use seed and samples.
    """
    exact = ls.RenderConfig()
    assert exact.unused_settings(lit=False).keys() >= {"samples", "seed", "jitter", "noise", "time_limit", "response"}
    stochastic = replace(exact, raster=ls.RasterConfig(strategy="stochastic"))  # pyright: ignore[reportArgumentType]
    unscented = replace(exact, raster=ls.RasterConfig(projection="unscented"))  # pyright: ignore[reportArgumentType]
    for unused in (stochastic.unused_settings(lit=False), unscented.unused_settings(lit=False)):
        assert not {"samples", "seed", "jitter"} & unused.keys()
    assert not {"samples", "seed", "response"} & exact.unused_settings(lit=True).keys()
    assert "response" in replace(exact, shadows=ls.Shadows.OFF).unused_settings(lit=True)
    assert "trace.strategy" in replace(exact, pipeline=ls.Pipeline.PATH).unused_settings(lit=True)


def test_only_the_file_config_pipelines_py_compares_values_with_pipelines() -> None:
    """Other code asks for the property that it depends on: `rasterises`, `bounces_light` and so on."""
    asking: list[str] = []
    for path in SOURCES.rglob("*.py"):
        if path == SOURCES / "config" / "pipelines.py":
            continue
        source = path.read_text()
        for node in ast.walk(ast.parse(source)) if "Pipeline." in source else ():
            if not isinstance(node, ast.Compare):
                continue
            sides = [node.left, *node.comparators]
            names = [name for side in sides for name in ast.walk(side) if isinstance(name, ast.Attribute)]
            if any(ast.unparse(name.value) in ("Pipeline", "ls.Pipeline") for name in names):
                asking.append(f"{path.relative_to(SOURCES)}:{node.lineno}")
    assert not asking
