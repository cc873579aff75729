"""Controls offer what has an effect and is accepted, and messages speak of controls, not of Python."""

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
    """Whether a frame has a view."""
    try:
        renderer.reconfigure(frame_config(renderer.config, view))
        renderer.render(scene, camera(height=9)).view(view)
    except ls.ConfigError:
        return False
    return True


@pytest.mark.parametrize("pipeline", ls.Pipeline)
def test_the_views_that_are_offered_are_those_that_frames_have(pipeline: ls.Pipeline) -> None:
    """All of them and no other, by default and where lighting is chosen against it, for a lit and an unlit scene."""
    for scene, lighting in ((lit_scene(), None), (lit_scene(), False), (UNLIT, None), (UNLIT, True)):
        config = ls.RenderConfig(pipeline=pipeline, lighting=lighting)
        renderer = ls.create_renderer(config, "cpu")
        there = [view for view in ls.Frame.VIEWS if shows(renderer, scene, view)]
        lit = config.is_lit(by_default=scene.is_lit_by_default)
        assert available_views(config, lit=lit) == ("color", *there), (lighting, scene.lights)


def test_a_view_that_other_settings_do_not_have_becomes_the_colour() -> None:
    """Instead of an error for each frame."""
    session, problems = Session(Options()), []
    session.error_listeners.append(problems.append)
    session.open(State(ls.io.SceneDocument.of(lit_scene()), ls.RenderConfig(pipeline=ls.Pipeline.REALTIME)))
    session.set_options(view="cache")
    session.configure(lambda config: replace(config, pipeline=ls.Pipeline.HYBRID))
    assert session.options.view == "color" and "cache" not in session.views and not problems


def test_settings_without_an_effect_change_no_pixel() -> None:
    """Those that are disabled for a pipeline, each at another value, but for those that would be refused."""
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
def test_no_choice_beside_others_is_refused_by_frames(pipeline: ls.Pipeline) -> None:
    """Each choice of each setting, in groups too, that is not disabled, beside any of the rasteriser's own choices."""
    combinations = itertools.product(ls.config.Projection, ls.config.RasterStrategy, ls.config.GaussianSurface)
    disabled = 0
    for projection, strategy, surface in combinations:
        raster = ls.RasterConfig(projection=projection, strategy=strategy, surface=surface)
        config = ls.RenderConfig(pipeline=pipeline, raster=raster)
        if is_refused(config):
            continue
        unused = unused_settings(config, lit=True)
        disabled += any(name.startswith("raster.") for name in unused)
        for field in control_settings(ls.RasterConfig):
            for choice in field.choices if f"raster.{field.name}" not in unused and "raster" not in unused else ():
                assert not is_refused(replace(config, raster=replace(raster, **{field.name: choice}))), choice
    assert disabled > 0


def is_refused(config: ls.RenderConfig) -> bool:
    """Whether frames of such settings are refused because of the projection."""
    try:
        check_projection(config)
    except ls.ConfigError:
        return True
    return False


def test_controls_of_settings_without_an_effect_are_disabled_and_say_why() -> None:
    """On the page, as the pipeline changes."""
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


def test_each_choice_that_is_offered_is_accepted() -> None:
    """Of settings and all their groups; means of shadow rays, for one, would be refused."""
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


def test_whole_numbers_go_by_the_steps_that_are_accepted() -> None:
    """A shadow map has a multiple of 8 texels."""
    fields = {field.name: field for field in control_settings(ls.config.DeepShadowConfig)}
    assert fields["resolution"].range.step == 8 and fields["resolution"].low == 8


def test_no_background_can_be_chosen_and_taken_back() -> None:
    """Transparent is no colour: it has a control of its own."""
    viewer = ls.view(lit_scene(), height=90, device="cpu", config=ls.RenderConfig(background=None, samples=2))
    viewer._loader.join()
    session = viewer._session
    with PageClient(viewer.url) as page:
        page.look(camera())
        settled(viewer, page)
        page.choose("no background", False)
        eventually(lambda: session.state.config.background == (0.0, 0.0, 0.0), "there is no background yet")
        page.choose("background", [255, 0, 0])
        eventually(lambda: session.state.config.background == (1.0, 0.0, 0.0), "the background is not red")
        page.choose("no background", True)
        eventually(lambda: session.state.config.background is None, "the background stays")
        page.choose("no background", False)
        eventually(lambda: session.state.config.background == (1.0, 0.0, 0.0), "its colour is forgotten")
    viewer.close()


@pytest.mark.parametrize(
    ("message", "words"),
    [
        ("Pipeline.HYBRID has no cache among its aovs: Pipeline.REALTIME does", "pipeline hybrid has no cache among"),
        ("only lit frames have it (RenderConfig.lighting=True)", "only lit frames have it (lighting on)"),
        ("RenderConfig.adaptive=True needs traced camera rays: use Pipeline.PATH", "adaptive on needs traced"),
        ("where RenderConfig.shadow_rays.hit_distance is 'mean'", "where hit distance is 'mean'"),
        ("hit_distance is 'mean', expected 'peak'", "hit distance is 'mean'"),
        ("NormalMethod.ELLIPSOID is not used", "normal method ellipsoid is not used"),
        ("my_max_bounces.ply: cannot be read", "my_max_bounces.ply: cannot be read"),
        ("/a/time_limit/b/max_bounces.toml: no such file", "/a/time_limit/b/max_bounces.toml: no such file"),
        ("max_bounces-2.png is not written", "max_bounces-2.png is not written"),
        ("set max_bounces.", "set max bounces."),
    ],
)
def test_messages_speak_of_the_controls_of_the_page(message: str, words: str) -> None:
    """By their labels; what is no setting stays."""
    assert page_words(message).startswith(words)


def test_no_choice_of_a_setting_is_told_as_python_writes_it() -> None:
    """Of all settings, whatever class they are of."""

    def choices(cls: type) -> list[Enum]:
        groups = [choices(field.group) for field in control_settings(cls) if field.group is not None]
        return [choice for field in control_settings(cls) for choice in field.choices] + [c for g in groups for c in g]

    found = choices(ls.RenderConfig)
    assert len(found) > 20
    for choice in found:
        told = page_words(f"use {type(choice).__name__}.{choice.name}")
        assert told.endswith(f" {choice.value}") and not re.search(r"[A-Z]\w*\.|_", told.removesuffix(choice.value))
