"""Scenes with actors are lit as by `lumisplat animate`, and are cached while their inputs stay."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_viewer import cloud

import lumisplat as ls
from lumisplat.viewer.frames.scene_builder import Levels, SceneBuilder

UP = (0.0, -1.0, 0.0)
CONFIG = ls.RenderConfig()


def floor(count: int = 3000) -> ls.Gaussians:
    """Returns a captured grey floor; y is down."""
    rng = np.random.default_rng(1)
    means = np.column_stack([rng.uniform(-2, 2, count), np.full(count, 0.6), rng.uniform(-2, 2, count)])
    return ls.Gaussians(
        means=means,
        rotations_wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        scales=np.tile([0.08, 0.005, 0.08], (count, 1)),
        opacities=np.full(count, 0.9),
        sh=np.zeros((count, 1, 3)),
    )


def animation(lighting: ls.config.AvatarLightingConfig | None = None) -> ls.Animation:
    """Returns a ball that moves from left to right over the floor, under a sun."""
    stage = ls.Scene([floor()], lights=[ls.LightDirectional((0.3, 1.0, 0.0))], up=UP)
    ball = ls.Actor(cloud(), ls.Keyframes([0.0, 2.0], positions=[(-1.0, 0.0, 0.0), (1.0, 0.0, 0.0)]))
    return ls.Animation(stage, [ball], frame_count=50, lighting=lighting or ls.config.AvatarLightingConfig())


@pytest.fixture
def scenes() -> Iterator[SceneBuilder]:
    """Returns a scene builder that fails on any report."""
    levels = Levels(lambda: None)
    yield SceneBuilder(levels, "cpu", lambda label, share: None, report=pytest.fail)
    levels.close()


def colors(scene: ls.Scene) -> list[np.ndarray]:
    """Returns the SH coefficients of all captures."""
    return [np.asarray(instance.gaussians.sh) for instance in scene.splats]


def test_viewer_shows_actors_with_the_colours_that_animation_frames_give_them(scenes: SceneBuilder) -> None:
    """Floor and actor have the colours that `AvatarLighter` gives them, bit for bit."""
    wanted = animation()
    shown = scenes.of(ls.io.SceneDocument.of(wanted), CONFIG, 1.0, 0, waits=True)
    lighter = ls.AvatarLighter(wanted.scene, config=wanted.lighting, device="cpu")
    lighter.light(wanted.actors_at(0.0))  # exposures are those of frame 0
    expected = lighter.light(wanted.actors_at(1.0))
    for found, wanted_colors in zip(colors(shown), colors(expected), strict=True):
        np.testing.assert_array_equal(found, wanted_colors)
    assert np.abs(colors(shown)[0] - colors(wanted.scene)[0]).max() > 0.1  # there is a shadow


def test_viewer_moves_lights_with_time_as_animation_frames_do(scenes: SceneBuilder) -> None:
    """Shadows of an actor follow a sun that moves; without actors, the light of the scene does."""
    path = ls.lights.LightPath([ls.LightDirectional((x, 1.0, 0.0)) for x in (0.9, -0.9)], [0.0, 2.0])
    wanted = replace(animation(), scene=ls.Scene([floor()], up=UP), lights=[path])
    document = ls.io.SceneDocument.of(wanted)
    scenes.of(document, CONFIG, 0.5, 0, waits=True)
    shown = scenes.of(document, CONFIG, 1.5, 0, waits=True)
    lighter = ls.AvatarLighter(wanted.scene_at(0.0), config=wanted.lighting, device="cpu")
    lighter.light(wanted.actors_at(0.0))  # exposures are those of frame 0
    lighter.update(wanted.scene_at(1.5))
    for found, expected in zip(colors(shown), colors(lighter.light(wanted.actors_at(1.5))), strict=True):
        np.testing.assert_array_equal(found, expected)
    alone = ls.io.SceneDocument.of(replace(wanted, actors=[]))
    for time in (0.5, 1.5):
        directions: list[Any] = [
            one.lights[0] for one in (scenes.of(alone, CONFIG, time, 0, waits=True), wanted.scene_at(time))
        ]
        np.testing.assert_allclose(directions[0].direction, directions[1].direction, atol=1e-12)


def test_viewers_scene_builder_returns_the_same_scene_object_for_equal_inputs(scenes: SceneBuilder) -> None:
    """Another time or lighting setting gives another scene."""
    document = ls.io.SceneDocument.of(animation())
    first = scenes.of(document, CONFIG, 1.0, 0, waits=True)
    assert scenes.of(document, CONFIG, 1.0, 0, waits=False) is first
    later = scenes.of(document, CONFIG, 1.5, 0, waits=False)
    assert later is not first and np.abs(colors(later)[0] - colors(first)[0]).max() > 0.1
    weaker = document.with_animation(lighting=ls.config.AvatarLightingConfig(direct=0.1))
    half = scenes.of(weaker, CONFIG, 1.0, 0, waits=True)
    assert np.abs(colors(half)[0] - colors(first)[0]).max() > 0.05


def test_viewer_shows_actors_unlit_until_their_lighting_is_prepared(scenes: SceneBuilder) -> None:
    """A change of the static scene makes the lighting invalid again."""
    document, plain = ls.io.SceneDocument.of(animation()), colors(animation().scene)[0]
    unlit = scenes.of(document, CONFIG, 1.0, 0, waits=False)
    assert len(unlit.splats) == 2
    np.testing.assert_array_equal(colors(unlit)[0], plain)
    scenes.of(document, CONFIG, 1.0, 0, waits=True)
    assert not np.array_equal(colors(scenes.of(document, CONFIG, 1.2, 0, waits=False))[0], plain)
    sun = next(entry.id for entry in document.entries if entry.kind == "lights")
    moved = document.changed(sun, direction=[-0.5, 1.0, 0.0])
    np.testing.assert_array_equal(colors(scenes.of(moved, CONFIG, 1.2, 0, waits=False))[0], plain)


def test_viewer_changes_no_colour_of_floor_or_actor_if_actor_lighting_is_off(scenes: SceneBuilder) -> None:
    """Without shadows and relighting, floor and actor keep their colours."""
    off = ls.config.AvatarLightingConfig(shadows=False, relight=False)
    shown = scenes.of(ls.io.SceneDocument.of(animation(off)), CONFIG, 1.0, 0, waits=True)
    for found, wanted_colors in zip(colors(shown), [colors(animation().scene)[0], cloud().sh], strict=True):
        np.testing.assert_array_equal(found, wanted_colors)


def test_viewer_shows_actors_unlit_if_no_light_is_found() -> None:
    """The failure is reported once and the frame is still rendered."""
    reported: list[str] = []
    levels = Levels(lambda: None)
    scenes = SceneBuilder(levels, "cpu", lambda label, share: None, report=reported.append)
    dark = replace(animation(), scene=replace(animation().scene, lights=[]))
    document = ls.io.SceneDocument.of(dark)
    for time in (0.0, 1.0):
        assert len(scenes.of(document, CONFIG, time, 0, waits=True).splats) == 2
    assert len(reported) == 1 and reported[0].startswith("actors keep their captured colours")
    levels.close()
