"""Weight of cached real-time lighting after lights or objects change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.renderer.scene.motion import (
    BRIGHTENED_HISTORY_WEIGHT,
    CHANGED_FRAMES,
    CHANGED_HISTORY_WEIGHT,
    MOVED_FRAMES,
    MOVED_HISTORY_WEIGHT,
    OUTDATED_HISTORY_WEIGHT,
    LightChanges,
    in_order,
)
from support.scenes.raster_scenes import octahedron, random_gaussians

ENVIRONMENT = np.ones((4, 8, 3), np.float32)
GLOWS = ls.MaterialPbr(emissive=(1, 1, 1))
EMITTER = octahedron((0.9, 0.0, 0.0), 0.2, material=GLOWS)
SPOT = ls.LightSpot((0.0, 2.0, 0.0), (0.0, -1.0, 0.0), color=(1.0, 0.5, 0.2), intensity=3.0)
LIT = ls.Scene(
    [ls.SplatInstance(random_gaussians(3), material=ls.MaterialPbr(roughness=0.4))],
    [octahedron((0.1, 0.0, 0.0), 0.5), EMITTER],
    [SPOT, ls.LightEnvironment(ENVIRONMENT)],
)
ELSEWHERE = np.diag([2.0, 2.0, 2.0, 1.0])


def with_spot(**changes: object) -> ls.Scene:
    """Returns the scene with another spot light."""
    return replace(LIT, lights=[replace(SPOT, **changes), LIT.lights[1]])  # pyright: ignore[reportArgumentType]


def with_environment(**settings: object) -> ls.Scene:
    """Returns the scene with another environment."""
    environment = {"image": ENVIRONMENT} | settings
    return replace(LIT, lights=[SPOT, ls.LightEnvironment(**environment)])  # pyright: ignore[reportArgumentType]


SAME = {
    "nothing": LIT,
    "equal lights": with_spot(),
    "equal materials": replace(LIT, splats=[replace(LIT.splats[0], material=ls.MaterialPbr(roughness=0.4))]),
}
MOVED = {
    "a mesh that moves": replace(LIT, meshes=[ls.MeshInstance(LIT.meshes[0].mesh, ELSEWHERE), LIT.meshes[1]]),
    "a capture that moves": replace(
        LIT, splats=[ls.SplatInstance(LIT.splats[0].gaussians, ELSEWHERE, material=LIT.splats[0].material)]
    ),
    "a capture of another SH degree": replace(LIT, splats=[replace(LIT.splats[0], sh_degree=0)]),
    "a mesh that catches shadows": replace(
        LIT, meshes=[ls.MeshInstance(LIT.meshes[0].mesh, shadow_catcher=True), LIT.meshes[1]]
    ),
}
CHANGED = {
    "a light's position": with_spot(position=(0.0, 2.1, 0.0)),
    "a light's direction": with_spot(direction=(0.1, -1.0, 0.0)),
    "its cone": with_spot(outer_angle=0.5),
    "its strength, a little": with_spot(intensity=2.0),
    "its colour, a little": with_spot(color=(1.0, 0.5, 0.3)),
    "another environment": with_environment(image=0.5 * ENVIRONMENT),
    "a rotated environment": with_environment(rotation_wxyz=(0.9, 0.1, 0.0, 0.0)),
    "a deformed emitter": replace(LIT, meshes=[LIT.meshes[0], octahedron((0.9, 0.1, 0.0), 0.3, material=GLOWS)]),
    "a moved emitter": replace(LIT, meshes=[LIT.meshes[0], ls.MeshInstance(EMITTER, ELSEWHERE)]),
    "a material": replace(LIT, splats=[replace(LIT.splats[0], material=ls.MaterialPbr())]),
    "a removed object": replace(LIT, meshes=LIT.meshes[1:]),
}
OTHER = {
    "a light of intensity 0": with_spot(intensity=0.0),
    "a light of another colour": with_spot(color=(1.0, 0.5, 1.0)),
    "a disabled light": with_spot(enabled=False),
    "a removed light": replace(LIT, lights=LIT.lights[1:]),
    "a removed emitter": replace(LIT, meshes=LIT.meshes[:1]),
    "a faint emitter": replace(
        LIT, meshes=[LIT.meshes[0], replace(EMITTER, material=replace(GLOWS, emissive=(0.1, 0.1, 0.1)))]
    ),
}


@pytest.mark.parametrize("change", SAME | CHANGED | OTHER)
def test_weight_of_earlier_frames_in_realtime_light_falls_when_lights_change(change: str) -> None:
    """The weight falls for several frames after a small change, and to almost 0 in the frame of an abrupt one."""
    changes = LightChanges()
    assert [changes.history_weight(LIT, False) for _ in range(3)] == [1.0] * 3
    after = [changes.history_weight((SAME | CHANGED | OTHER)[change], False) for _ in range(CHANGED_FRAMES + 1)]
    by_strength = change in OTHER or "a little" in change
    fading = 1.0 if change in SAME else BRIGHTENED_HISTORY_WEIGHT if by_strength else CHANGED_HISTORY_WEIGHT
    assert after[0] == (OUTDATED_HISTORY_WEIGHT if change in OTHER else fading)
    assert after[1:CHANGED_FRAMES] == [fading] * (CHANGED_FRAMES - 1)
    assert after[CHANGED_FRAMES] in (1.0, MOVED_HISTORY_WEIGHT)  # a removed object may have moved


@pytest.mark.parametrize("move", MOVED)
def test_moving_objects_lower_the_weight_of_earlier_frames_less_than_changed_lights(move: str) -> None:
    """After a change of lights, the weight falls more and recovers sooner."""
    changes = LightChanges()
    changes.history_weight(LIT, False)
    after = [changes.history_weight(MOVED[move], False) for _ in range(MOVED_FRAMES + 1)]
    assert after == [MOVED_HISTORY_WEIGHT] * MOVED_FRAMES + [1.0]


def test_moving_or_new_emissive_capture_counts_as_a_change_of_lights() -> None:
    """A moving emissive capture changes the lighting, and a capture that becomes emissive is a new light."""
    changes = LightChanges()
    assert [changes.history_weight(LIT, False, (0,)) for _ in range(2)] == [1.0] * 2
    assert changes.history_weight(MOVED["a capture that moves"], False, (0,)) == CHANGED_HISTORY_WEIGHT
    assert changes.history_weight(MOVED["a capture that moves"], False) == OUTDATED_HISTORY_WEIGHT


def test_history_of_realtime_light_has_its_full_weight_at_the_start_of_each_sequence() -> None:
    """Every sequence starts with the full weight, also after a reset."""
    changes = LightChanges()
    assert changes.history_weight(LIT, False) == 1.0
    changes.forget()
    assert changes.history_weight(ls.Scene(), False) == 1.0


def test_lamps_that_pass_each_other_are_recognised() -> None:
    """Their order in the frame's list changes, which is by position; this is no abrupt change of a light's strength."""
    faint, bright = ls.LightPoint((0.0, 1.0, 0.0)), ls.LightPoint((0.1, 1.0, 0.0), intensity=9.0)
    changes = LightChanges()
    changes.history_weight(replace(LIT, lights=in_order([faint, bright])), False)
    passed = in_order([replace(faint, position=(0.2, 1.0, 0.0)), bright])
    assert changes.history_weight(replace(LIT, lights=passed), False) == CHANGED_HISTORY_WEIGHT


def test_headlight_that_replaces_removed_lights_counts_as_a_change_of_lights() -> None:
    """When the last light is removed, the headlight is a new light."""
    changes, dark = LightChanges(), replace(LIT, lights=())
    assert [changes.history_weight(dark, False) for _ in range(2)] == [1.0] * 2
    assert changes.history_weight(dark, True) == OUTDATED_HISTORY_WEIGHT


def test_lights_are_sorted_independently_of_their_order_in_the_scene() -> None:
    """Disabled lights are left out."""
    lights = [*LIT.lights, ls.LightPoint((1.0, 0.0, 0.0)), ls.LightPoint((0.0, 0.0, 0.0), enabled=False)]
    assert in_order(lights) == in_order(lights[::-1])
    assert len(in_order(lights)) == 3
