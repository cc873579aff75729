"""Controls offer only settings with an effect and valid choices, and messages use the labels of controls."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace
from enum import Enum
from typing import Any

import numpy as np
import pytest
from test_viewer import camera, eventually, lit_scene, settled

import lumisplat as ls
from lumisplat.renderer.checks import check_projection
from lumisplat.viewer.frames.loop import frame_config
from lumisplat.viewer.panels.controls import SettingsPanel, control_settings
from lumisplat.viewer.session import Options, Session, State, available_views, unused_settings
from lumisplat.viewer.words import page_words
from support.viewer.page_client import PageClient

UNLIT = ls.Scene([replace(lit_scene().splats[0], material=None)])


def shows(renderer: ls.Renderer, scene: ls.Scene, view: str) -> bool:
    """Returns True if frames of a renderer have a view."""
    try:
        renderer.reconfigure(frame_config(renderer.config, view))
        renderer.render(scene, camera(height=9)).view(view)
    except ls.ConfigError:
        return False
    return True


@pytest.mark.parametrize("pipeline", ls.Pipeline)
def test_views_offered_by_the_viewer_are_exactly_those_that_its_frames_have(pipeline: ls.Pipeline) -> None:
    """The test covers lit and unlit scenes, with lighting by default and explicitly on or off."""
    for scene, lighting in ((lit_scene(), None), (lit_scene(), False), (UNLIT, None), (UNLIT, True)):
        config = ls.RenderConfig(pipeline=pipeline, lighting=lighting)
        renderer = ls.create_renderer(config, "cpu")
        there = [view for view in ls.Frame.VIEWS if shows(renderer, scene, view)]
        lit = config.is_lit(by_default=scene.is_lit_by_default)
        assert available_views(config, lit=lit) == ("color", *there), (lighting, scene.lights)


def test_viewer_shows_color_after_a_change_to_a_pipeline_that_lacks_the_chosen_view() -> None:
    """The view changes instead of causing an error for each frame."""
    session, problems = Session(Options()), []
    session.error_listeners.append(problems.append)
    session.open(State(ls.io.SceneDocument.of(lit_scene()), ls.RenderConfig(pipeline=ls.Pipeline.REALTIME)))
    session.set_options(view="cache")
    session.configure(lambda config: replace(config, pipeline=ls.Pipeline.HYBRID))
    assert session.options.view == "color" and "cache" not in session.views and not problems


def test_settings_that_a_pipeline_does_not_use_change_no_pixel() -> None:
    """For each pipeline, every unused setting is given another valid value."""
    others: dict[str, Any] = {
        "max_bounces": 0,
        "seed": 7,
        "jitter": False,
        "response": ls.config.ResponseConfig(kernel_degree=4),
        "glossy_reflections": True,
        "energy_compensation": True,
        "tone_map": ls.ToneMap.AGX,
        "shadows": ls.Shadows.SOFT,
        "raster": ls.RasterConfig(strategy=ls.config.RasterStrategy.STOCHASTIC),
        "trace": ls.TraceConfig(strategy=ls.config.TraceStrategy.STOCHASTIC_HIT),
        "path": ls.PathConfig(primary=ls.config.PathPrimary.ISO),
        "realtime": ls.RealtimeConfig(quality=ls.config.RealtimeQuality.HIGH),
        "shadow_rays": ls.ShadowConfig(method=ls.config.ShadowMethod.FIRST_HITS),
    }
    for pipeline, scene in itertools.product(ls.Pipeline, (lit_scene(), UNLIT)):
        config = ls.RenderConfig(pipeline=pipeline, samples=None if pipeline is ls.Pipeline.REALTIME else 1)
        renderer = ls.create_renderer(config, "cpu")
        expected = renderer.render(scene, camera(height=18)).color
        lit = config.is_lit(by_default=scene.is_lit_by_default)
        for name in unused_settings(config, lit=lit).keys() & others.keys():
            renderer.reconfigure(replace(config, **{name: others[name]}))
            np.testing.assert_array_equal(renderer.render(scene, camera(height=18)).color, expected, f"{name}")


@pytest.mark.parametrize("pipeline", ls.Pipeline)
def test_every_choice_of_an_enabled_raster_control_is_valid_with_all_other_choices(pipeline: ls.Pipeline) -> None:
    """Every choice of an enabled raster setting is valid with every combination of the other raster settings."""
    combinations = itertools.product(ls.config.Projection, ls.config.RasterStrategy, ls.config.GaussianSurface)
    disabled = 0
    for projection, strategy, surface in combinations:
        raster = ls.RasterConfig(projection=projection, strategy=strategy, surface=surface)
        config = ls.RenderConfig(pipeline=pipeline, raster=raster)
        if is_rejected(config):
            continue
        unused = unused_settings(config, lit=True)
        disabled += any(name.startswith("raster.") for name in unused)
        for field in control_settings(ls.RasterConfig):
            for choice in field.choices if f"raster.{field.name}" not in unused and "raster" not in unused else ():
                assert not is_rejected(replace(config, raster=replace(raster, **{field.name: choice}))), choice
    assert disabled > 0


def is_rejected(config: ls.RenderConfig) -> bool:
    """Returns True if the settings are rejected because of the projection."""
    try:
        check_projection(config)
    except ls.ConfigError:
        return True
    return False


def test_controls_of_unused_settings_are_disabled_with_a_reason() -> None:
    """Controls on the page change with the pipeline and with the scene."""
    viewer = ls.view(
        lit_scene(), height=90, device="cpu", config=ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, samples=2)
    )
    viewer._loader.join()
    with PageClient(viewer.url) as page:
        page.look(camera())
        settled(viewer, page)
        handles: Any = viewer._viser.gui._gui_input_handle_from_uuid
        bounces, view = handles[page.control("max bounces")], handles[page.control("view")]
        assert not bounces.disabled and "shadow" in view.options
        page.choose("pipeline", "raster")
        eventually(lambda: bounces.disabled, "the control is not disabled")
        assert bounces.hint.startswith("Used by the pipelines trace, hybrid, path, realtime.")
        page.choose("pipeline", "hybrid")
        eventually(lambda: not bounces.disabled, "the control stays disabled")
        assert not bounces.hint.startswith("Used by")
        viewer.show(UNLIT)
        eventually(lambda: "shadow" not in view.options, "a view is offered that unlit frames do not have")
        settled(viewer, page)
        assert not any(note.startswith("error: ") for note in page.notes())
    viewer.close()


def test_every_choice_that_a_control_of_the_viewer_offers_is_a_valid_setting() -> None:
    """Choices of all settings and nested groups are valid; ``mean`` of shadow rays, which is not, is not offered."""
    viewer = ls.view(lit_scene(), height=90, device="cpu")
    viewer._loader.join()
    config = ls.RenderConfig()
    offered = 0

    def check(panel: SettingsPanel[Any], settings: Any) -> None:
        nonlocal offered
        for name, control in panel._controls.items():
            for choice in control.field.choices:
                replace(settings, **{name: choice})
                offered += 1
        for name, group in panel._groups.items():
            check(group, getattr(settings, name))

    check(SettingsPanel(viewer._viser.gui, config, lambda change, field: None, print), config)
    assert offered > 20
    viewer.close()


def test_control_of_the_shadow_map_resolution_has_steps_of_8_texels() -> None:
    """The resolution of a shadow map is a multiple of 8 texels."""
    fields = {field.name: field for field in control_settings(ls.config.DeepShadowConfig)}
    assert fields["resolution"].range.step == 8 and fields["resolution"].low == 8


def test_clearing_the_transparent_background_checkbox_restores_the_last_colour() -> None:
    """A checkbox sets a transparent background; clearing it restores the last colour."""
    viewer = ls.view(lit_scene(), height=90, device="cpu", config=ls.RenderConfig(background=None, samples=2))
    viewer._loader.join()
    session = viewer._session
    with PageClient(viewer.url) as page:
        page.look(camera())
        settled(viewer, page)
        page.choose("no background", False)
        eventually(lambda: session.state.config.background == (0.0, 0.0, 0.0), "the background is not black")
        page.choose("background", [255, 0, 0])
        eventually(lambda: session.state.config.background == (1.0, 0.0, 0.0), "the background is not red")
        page.choose("no background", True)
        eventually(lambda: session.state.config.background is None, "the background is not transparent")
        page.choose("no background", False)
        eventually(
            lambda: session.state.config.background == (1.0, 0.0, 0.0), "the last background colour is not restored"
        )
    viewer.close()


@pytest.mark.parametrize(
    ("message", "words"),
    [
        ("Pipeline.HYBRID has no cache among its aovs: Pipeline.REALTIME does", "pipeline hybrid has no cache among"),
        ("only lit frames have it (RenderConfig.lighting=True)", "only lit frames have it (lighting on)"),
        ("RenderConfig.adaptive=True needs traced camera rays: use Pipeline.PATH", "adaptive on needs traced"),
        ("where RenderConfig.shadow_rays.hit_distance is 'mean'", "where hit distance is 'mean'"),
        ("hit_distance is 'mean', expected 'peak'", "hit distance is 'mean'"),
        ("my_max_bounces.ply: cannot be read", "my_max_bounces.ply: cannot be read"),
        ("/a/time_limit/b/max_bounces.toml: no such file", "/a/time_limit/b/max_bounces.toml: no such file"),
        ("max_bounces-2.png is not written", "max_bounces-2.png is not written"),
        ("set max_bounces.", "set max bounces."),
    ],
)
def test_messages_of_the_viewer_name_settings_by_the_labels_of_their_controls(message: str, words: str) -> None:
    """Words that are not settings are unchanged."""
    assert page_words(message).startswith(words)


def test_viewer_messages_contain_no_python_enum_names() -> None:
    """The law holds for all choices of all settings."""

    def choices(cls: type) -> list[Enum]:
        groups = [choices(field.group) for field in control_settings(cls) if field.group is not None]
        return [choice for field in control_settings(cls) for choice in field.choices] + [c for g in groups for c in g]

    found = choices(ls.RenderConfig)
    assert len(found) > 20
    for choice in found:
        message = page_words(f"use {type(choice).__name__}.{choice.name}")
        assert message.endswith(f" {choice.value}") and not re.search(
            r"[A-Z]\w*\.|_", message.removesuffix(choice.value)
        )
