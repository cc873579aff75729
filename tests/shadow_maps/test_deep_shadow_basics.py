"""Deep shadow maps: accepted and refused arguments, memory between frames, and files."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.demo.shapes import icosphere
from lumisplat.scene.ops.mesh_sampling import sample_surface
from lumisplat.shadow_maps import casters_and_receivers
from support.scenes.raster_scenes import joined, one_gaussian, random_gaussians, similarity

LIGHT = (0.0, 0.0, -4.0)
BEHIND = np.array([[0.0, 0.0, 4.0], [3.5, 0.0, 4.0]], np.float32)
"""Points in the shadow of a caster at the origin, and beside it."""
SMALL = ls.config.DeepShadowConfig(resolution=256, bins=64)


def ball(**changes: Any) -> ls.Gaussians:
    """Returns one wide, dense Gaussian at the origin."""
    return one_gaussian((0.0, 0.0, 0.0), scale=0.3, opacity=0.95, **changes)


def behind(casters: Any, light: Any = LIGHT, config: ls.config.DeepShadowConfig = SMALL, **options: Any) -> np.ndarray:
    """Returns the transmittance to the points `BEHIND`."""
    return ls.DeepShadowMap.build(casters, light, BEHIND, config, device="cpu", **options).transmittance(BEHIND)


def test_deep_shadow_map_shadows_points_behind_the_caster_and_not_beside_it() -> None:
    """Transmittance in the middle of a ball's shadow is that of the closed form; beside the ball it is 1."""
    seen = behind(ball())
    # avg: beta integrated along a line through the centre of an isotropic Gaussian is tau itself.
    assert seen[0] == pytest.approx(0.05, abs=2e-3)
    assert seen[1] == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize(
    "light",
    [
        list(LIGHT),
        np.array(LIGHT),
        ls.LightPoint(LIGHT),
        ls.LightSpot(LIGHT, direction=(0.0, 0.0, 1.0)),
    ],
    ids=lambda light: type(light).__name__,
)
def test_deep_shadow_maps_of_lights_without_extent_at_one_position_are_equal(light: Any) -> None:
    """A point, a point light and a spot without radius cast one shadow."""
    np.testing.assert_array_equal(behind(ball(), light), behind(ball()))


def test_deep_shadow_maps_accept_captures_instances_scenes_and_lists_as_casters() -> None:
    """Equal Gaussians cast equal shadows in any form."""
    moved = replace(ball(), means=ball().means + np.array([1.0, 2.0, 3.0], np.float32))
    back = similarity((0.3, -0.2, 1.0), 0.7)
    back[:3, 3] = -back[:3, :3] @ [1.0, 2.0, 3.0]
    placed = ls.SplatInstance(moved, back)
    expected = behind(ball())
    for given in ([ball()], placed, (placed,), ls.Scene(splats=(placed,)), [ls.Scene(splats=(ball(),))]):
        np.testing.assert_allclose(behind(given), expected, atol=2e-5)


def test_deep_shadow_of_a_scaled_capture_instance_equals_that_of_a_capture_of_that_size() -> None:
    """A set of half the size, scaled by two, casts the shadow of the original set."""
    half = replace(ball(), scales=ball().scales * np.float32(0.5))
    np.testing.assert_allclose(behind(ls.SplatInstance(half, np.diag([2.0, 2.0, 2.0, 1.0]))), behind(ball()), atol=1e-6)


def test_transmittances_of_two_casters_multiply_in_a_deep_shadow_map() -> None:
    """The optical depths of the casters add up."""
    other = one_gaussian((0.1, 0.0, 1.0), scale=0.4, opacity=0.5)
    np.testing.assert_allclose(behind([ball(), other]), behind(ball()) * behind(other), rtol=1e-4)
    np.testing.assert_array_equal(behind([ball(), other]), behind(joined(ball(), other)))


@pytest.fixture
def sampled(monkeypatch: pytest.MonkeyPatch) -> list[ls.Mesh]:
    """Returns a counter of meshes converted to Gaussians; conversions use fewer Gaussians than usual, to save time."""
    calls: list[ls.Mesh] = []
    monkeypatch.setattr(
        casters_and_receivers, "sample_surface", lambda mesh: calls.append(mesh) or sample_surface(mesh, 4000)
    )
    return calls


def test_meshes_are_opaque_casters_of_deep_shadow_maps(sampled: list[ls.Mesh], monkeypatch: pytest.MonkeyPatch) -> None:
    """A mesh is opaque in its middle, also if an instance stretches or mirrors it."""
    sphere = icosphere(radius=0.5)
    with monkeypatch.context() as plain:
        plain.setattr(casters_and_receivers, "sample_surface", sample_surface)
        assert behind(sphere)[0] < 0.01
    stretched = np.diag([-8.0, 1.0, 1.0, 1.0])
    seen = behind(ls.MeshInstance(sphere, stretched))
    assert seen[0] < 0.01
    # The shadow of a sphere eight times as wide reaches x = 8 at z = 4.
    assert seen[1] < 0.01
    assert behind(ls.MeshInstance(sphere))[1] == 1.0


def test_deep_shadow_map_converts_a_moving_mesh_to_gaussians_once(sampled: list[ls.Mesh]) -> None:
    """A moving mesh keeps its Gaussians from frame to frame."""
    sphere = icosphere(radius=0.5)
    shadow = ls.DeepShadowMap.build(sphere, LIGHT, BEHIND, SMALL, device="cpu")
    shadow.rebuild(ls.MeshInstance(sphere, similarity((1.0, 0.0, 0.0), 0.5, 1.0, (0.0, 0.1, 0.0))))
    assert sampled == [sphere]


def test_deep_shadow_map_samples_a_deforming_mesh_once_and_moves_its_gaussians(sampled: list[ls.Mesh]) -> None:
    """Poses with the same triangles are one surface, whose Gaussians follow the pose."""
    sphere = icosphere(radius=0.5)
    moved = replace(sphere, positions=sphere.positions * np.array([8.0, 1.0, 1.0], np.float32), normals=None)
    shadow = ls.DeepShadowMap.build(sphere, LIGHT, BEHIND, SMALL, device="cpu")
    assert shadow.transmittance(BEHIND)[1] == 1.0
    shadow.rebuild(moved)
    assert shadow.transmittance(BEHIND)[1] < 0.01
    assert sampled == [sphere]
    shadow.rebuild(sphere)
    np.testing.assert_array_equal(shadow.transmittance(BEHIND), behind(sphere))


def test_mesh_that_disappears_and_returns_casts_the_same_deep_shadow(sampled: list[ls.Mesh]) -> None:
    """Earlier frames of an animation do not change a frame."""
    sphere = icosphere(radius=0.5)
    moved = replace(sphere, positions=sphere.positions * np.array([3.0, 1.0, 1.0], np.float32), normals=None)
    shadow = ls.DeepShadowMap.build(sphere, LIGHT, BEHIND, SMALL, device="cpu")
    shadow.rebuild(moved)
    expected = shadow.transmittance(BEHIND)
    shadow.rebuild(ball())
    shadow.rebuild(moved)
    np.testing.assert_array_equal(shadow.transmittance(BEHIND), expected)
    assert sampled == [sphere]


def test_deep_shadow_map_caches_a_bounded_number_of_meshes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The most recently used meshes are cached."""
    assert casters_and_receivers.SURFACES_HELD < 1000
    monkeypatch.setattr(casters_and_receivers, "SURFACES_HELD", 3)
    monkeypatch.setattr(casters_and_receivers, "sample_surface", partial(sample_surface, count=10))
    turned = casters_and_receivers.MeshesAsGaussians()
    tiny = ls.Mesh([[0, 0, 0], [1e-3, 0, 0], [0, 1e-3, 0]], [[0, 1, 2]])
    shown = [replace(tiny, indices=tiny.indices.copy()) for _ in range(8)]
    for mesh in shown:
        turned.placed("casters", mesh)
    assert list(turned._surfaces) == [id(mesh.indices) for mesh in shown[-3:]]


def test_light_at_the_centre_of_a_gaussian_passes_half_the_gaussians_optical_depth() -> None:
    """The transmittance is equal in all directions."""
    points = np.array([[3.0, 0.0, 0.0], [0.0, -3.0, 0.0], [-1.0, 2.0, 1.5]], np.float32)
    config = replace(SMALL, bins=256)
    seen = ls.DeepShadowMap.build(ball(), (0.0, 0.0, 0.0), points, config, device="cpu").transmittance(points)
    np.testing.assert_allclose(seen, np.sqrt(0.05), rtol=1e-3)


def test_deep_shadow_map_of_a_sun_includes_casters_at_any_distance() -> None:
    """A caster far towards the sun casts a shadow; a caster behind the receivers casts none."""
    sun = ls.LightDirectional((0.0, 0.0, 1.0))
    for z, expected in ((-50.0, 0.05), (0.0, 0.05), (60.0, 1.0)):
        caster = replace(ball(), means=np.array([[0.0, 0.0, z]], np.float32))
        seen = behind(caster, sun, replace(SMALL, resolution=512))
        np.testing.assert_allclose(seen, [expected, 1.0], atol=2e-3)


@pytest.mark.parametrize("receivers", [np.empty((0, 3)), []], ids=["array", "list"])
def test_deep_shadow_map_with_an_empty_receiver_list_logs_a_warning_and_shadows_nothing(
    receivers: Any, caplog: pytest.LogCaptureFixture
) -> None:
    """The transmittance is 1 everywhere."""
    with caplog.at_level(logging.WARNING, "lumisplat"):
        shadow = ls.DeepShadowMap.build(ball(), LIGHT, receivers, SMALL, device="cpu")
    assert "no receivers" in caplog.text
    assert (shadow.transmittance(BEHIND) == 1.0).all()
    assert shadow.stats.voxels == 0
    shadow.rebuild(ball())


def test_receivers_beyond_the_region_radius_of_a_deep_shadow_map_are_not_shadowed(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A warning is logged if no receiver is within the radius."""
    points = np.array([[0.0, 0.0, 1.5], [0.0, 0.0, 4.0]], np.float32)
    config = replace(SMALL, region_radius=2.0)
    shadow = ls.DeepShadowMap.build(ball(), LIGHT, points, config, device="cpu")
    seen = shadow.transmittance(points[:1])
    assert seen[0] < 0.06
    assert not caplog.records
    ls.DeepShadowMap.build(ball(), LIGHT, points[1:], config, device="cpu")
    assert "no receivers are near" in caplog.text or "no receivers near" in caplog.text


def test_region_radius_of_a_deep_shadow_map_includes_the_ground_at_the_foot_of_casters() -> None:
    """With a radius of 1.5, a column of 8 units casts its shadow on the floor at its foot."""
    heights = np.linspace(0.0, 8.0, 81)
    means = np.stack([np.zeros(81), np.zeros(81), heights], axis=1)
    column = replace(random_gaussians(0, 81), means=means, scales=np.full((81, 3), 0.1), opacities=np.full(81, 0.95))
    points = np.array([[0.5, 0.0, -0.3], [3.0, 0.0, -0.3]], np.float32)
    config = replace(SMALL, region_radius=1.5)
    shadow = ls.DeepShadowMap.build(column, (-2.0, 0.0, 1.5), points, config, device="cpu")
    assert shadow.transmittance(points[:1])[0] < 0.5


def test_receivers_within_the_region_radius_of_a_deep_shadow_map_keep_their_shadow() -> None:
    """Near receivers sample the same points as without a radius, whatever their index."""
    receivers, casters = random_gaussians(4, 400, extent=(6.0, 6.0, 1.0)), random_gaussians(5, 40)
    whole, part = (
        ls.DeepShadowMap.build(casters, LIGHT, receivers, config, device="cpu").transmittance_of(receivers)
        for config in (replace(SMALL, max_distance=12.0), replace(SMALL, max_distance=12.0, region_radius=2.0))
    )
    center = np.average(casters.means, axis=0, weights=casters.opacities)
    near = np.abs(receivers.means - center).max(axis=1) < 1.99
    assert 20 < near.sum() < 200 and whole[near].min() < 0.9
    np.testing.assert_allclose(part[near], whole[near], atol=1e-6)


def test_deep_shadow_map_without_receivers_covers_all_points_behind_casters() -> None:
    """The map is as exact as one for receivers."""
    casters = random_gaussians(3, 40)
    points = np.random.default_rng(0).uniform(-3.0, 9.0, (500, 3)).astype(np.float32)
    light, config = (-5.0, -4.0, -3.0), replace(SMALL, max_distance=25.0)
    anyone = ls.DeepShadowMap.build(casters, light, None, config, device="cpu")
    one_map = ls.DeepShadowMap.build(casters, light, points, config, device="cpu")
    assert one_map.transmittance(points).min() < 0.9
    np.testing.assert_allclose(anyone.transmittance(points), one_map.transmittance(points), atol=2e-6)


def test_sample_points_of_a_deep_shadow_map_receiver_are_repeatable() -> None:
    """Equal sample points in each frame avoid flicker; another seed gives other points."""
    casters, receivers = random_gaussians(3, 40), random_gaussians(4, 200)
    config = replace(SMALL, max_distance=20.0, region=False)
    shadow = ls.DeepShadowMap.build(casters, (-4.0, -4.0, -4.0), receivers, config, device="cpu")
    first = shadow.transmittance_of(receivers)
    shadow.rebuild(casters)
    np.testing.assert_array_equal(shadow.transmittance_of(receivers), first)
    shadow.config = replace(config, seed=1)
    assert (shadow.transmittance_of(receivers) != first).any()


def test_rebuilding_a_deep_shadow_map_of_the_same_size_allocates_nothing() -> None:
    """The device memory stays constant from frame to frame."""
    casters, receivers = random_gaussians(3, 60), random_gaussians(4, 300)
    shadow = ls.DeepShadowMap.build(casters, (-4.0, -4.0, -4.0), receivers, SMALL, device="cpu")
    shadow.rebuild(casters)
    before, held = shadow._buffers.allocations, shadow.bytes
    moved = replace(casters, means=casters.means + np.float32(1e-4))
    for frame in (moved, casters, moved):
        shadow.rebuild(frame)
    assert (shadow._buffers.allocations, shadow.bytes) == (before, held)


@pytest.mark.parametrize("light", [LIGHT, ls.LightDirectional((0.1, 0.0, 1.0))], ids=["point", "parallel"])
def test_saved_deep_shadow_map_equals_the_original_and_can_be_rebuilt(light: Any, tmp_path: Path) -> None:
    """Transmittances of the loaded map are equal."""
    config = replace(
        SMALL, absorption=ls.config.Absorption.MASS, strength=0.01, sampling=ls.config.ReceiverSampling.STENCIL
    )
    receivers, casters = random_gaussians(4, 100), random_gaussians(5, 30)
    shadow = ls.DeepShadowMap.build(casters, light, receivers, config, device="cpu")
    shadow.save(tmp_path / "map.npz")
    again = ls.DeepShadowMap.load(tmp_path / "map.npz", device="cpu")
    assert again.config == config
    np.testing.assert_array_equal(again.transmittance_of(receivers), shadow.transmittance_of(receivers))
    for one in (shadow, again):
        one.rebuild(joined(casters, ball()))
    np.testing.assert_array_equal(again.transmittance_of(receivers), shadow.transmittance_of(receivers))


@pytest.mark.parametrize("culling", [True, False])
def test_deep_shadow_map_loaded_without_receivers_covers_moved_casters_after_a_rebuild(
    culling: bool, tmp_path: Path
) -> None:
    """A rebuild for casters elsewhere computes another region."""
    shadow = ls.DeepShadowMap.build(ball(), LIGHT, None, replace(SMALL, culling=culling), device="cpu")
    shadow.save(tmp_path / "map.npz")
    again = ls.DeepShadowMap.load(tmp_path / "map.npz", device="cpu")
    np.testing.assert_array_equal(again.transmittance(BEHIND), shadow.transmittance(BEHIND))
    aside = np.array([[6.0, 0.0, 4.0]], np.float32)
    for one in (shadow, again):
        assert one.transmittance(aside) > 0.99
        one.rebuild(replace(ball(), means=np.array([[3.0, 0.0, 0.0]], np.float32)))
        assert one.transmittance(aside) < 0.1


def test_missing_foreign_and_damaged_deep_shadow_map_files_are_refused(tmp_path: Path) -> None:
    """Messages are one line and name the file."""
    good = tmp_path / "good.npz"
    shadow = ls.DeepShadowMap.build(ball(), LIGHT, BEHIND, SMALL, device="cpu")
    shadow.save(good)
    with pytest.raises(ls.FormatError, match=r"\.npz"):
        shadow.save(tmp_path / "map.png")
    with pytest.raises(ls.errors.MissingFileError, match=r"missing\.npz: no such file"):
        ls.DeepShadowMap.load(tmp_path / "missing.npz")
    (tmp_path / "text.npz").write_text("no archive")
    (tmp_path / "cut.npz").write_bytes(good.read_bytes()[:300])
    np.savez(tmp_path / "foreign.npz", a=np.zeros(3))
    np.savez(tmp_path / "pickled.npz", header=np.array([{}], dtype=object))
    for name in ("text", "cut", "foreign", "pickled"):
        with pytest.raises(ls.FormatError, match=f"{name}.npz: is damaged, or not a deep shadow map$"):
            ls.DeepShadowMap.load(tmp_path / f"{name}.npz")
    with np.load(good) as file:
        arrays: dict[str, Any] = dict(file)
    header = json.loads(arrays["header"].tobytes())
    for name, changed in {
        "bins": arrays | {"count": arrays["count"] + 100},
        "texels": arrays | {"texels": arrays["texels"] + 256 * 256},
        "table": arrays | {"table": arrays["table"][1:]},
        "nan": arrays | {"table": arrays["table"] * np.nan},
        "bright": arrays | {"table": arrays["table"] + 1.0},
        "nowhere": arrays | {"header": _tampered(header, origin=[0.0, float("nan"), 0.0])},
    }.items():
        np.savez(tmp_path / f"{name}.npz", **changed)
        with pytest.raises(ls.FormatError, match="damaged"):
            ls.DeepShadowMap.load(tmp_path / f"{name}.npz")
    arrays["header"] = _tampered(header, version=9)
    np.savez(tmp_path / "newer.npz", **arrays)
    with pytest.raises(ls.FormatError, match="version 9"):
        ls.DeepShadowMap.load(tmp_path / "newer.npz")
    endless = header["atlas"] | {"size": float("inf")}
    arrays["header"] = _tampered(header, atlas=endless)
    np.savez(tmp_path / "endless.npz", **arrays)
    with pytest.raises(ls.FormatError, match=r"is damaged, or not a deep shadow map$"):
        ls.DeepShadowMap.load(tmp_path / "endless.npz")


def _tampered(header: dict[str, Any], **changes: Any) -> np.ndarray:
    return np.frombuffer(json.dumps(header | changes).encode(), np.uint8)


def test_deep_shadow_map_file_with_a_changed_byte_raises_at_most_a_one_line_error(tmp_path: Path) -> None:
    """No exception other than Lumisplat's is raised."""
    path, rng = tmp_path / "map.npz", np.random.default_rng(0)
    ls.DeepShadowMap.build(ball(), LIGHT, BEHIND, SMALL, device="cpu").save(path)
    good = np.frombuffer(path.read_bytes(), np.uint8)
    refused = 0
    for position in rng.integers(0, len(good), 400):
        bad = good.copy()
        bad[position] ^= 1 << rng.integers(8)
        path.write_bytes(bad.tobytes())
        try:
            ls.DeepShadowMap.load(path, device="cpu")
        except ls.FormatError as error:
            assert "\n" not in str(error)
            refused += 1
    assert refused > 200


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ({"casters": []}, "casters have no Gaussians"),
        ({"casters": ls.Scene()}, "casters have no Gaussians"),
        ({"casters": 3}, "casters is a int"),
        ({"casters": ["a"]}, "casters holds a str"),
        ({"light_position": (0.0, np.nan, 0.0)}, "light_position has 1 non-finite"),
        ({"light_position": (0.0, 1.0)}, "light_position has shape"),
        ({"light_position": ls.LightEnvironment()}, "LightEnvironment"),
        ({"receivers": np.full((4, 3), np.inf)}, "points has 12 non-finite"),
        ({"receivers": np.zeros((4, 2))}, "points has shape"),
        ({"receivers": np.array(3.0)}, "points has shape"),
        ({"receivers": "floor"}, "points"),
    ],
)
def test_invalid_arguments_of_deep_shadow_maps_are_refused(given: dict[str, Any], problem: str) -> None:
    """Messages are one line."""
    settings = {"casters": ball(), "light_position": LIGHT, "receivers": BEHIND} | given
    with pytest.raises(ls.SceneError, match=problem) as error:
        ls.DeepShadowMap.build(**settings, device="cpu")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "changes",
    [
        {"resolution": 100},
        {"resolution": 4},
        {"bins": 0},
        {"samples": 0},
        {"strength": -1.0},
        {"max_distance": 0.0},
        {"absorption": "average"},
    ],
)
def test_error_for_an_invalid_setting_of_deep_shadow_maps_states_its_range(changes: dict[str, Any]) -> None:
    """The message gives the expected range."""
    with pytest.raises(ls.ConfigError, match=next(iter(changes))):
        ls.config.DeepShadowConfig(**changes)


@pytest.mark.parametrize("sampling", list(ls.config.ReceiverSampling))
def test_transmittance_of_unshadowed_receivers_of_a_deep_shadow_map_is_exactly_1(
    sampling: ls.config.ReceiverSampling,
) -> None:
    """Lit captures must keep their colours to the bit."""
    receivers = random_gaussians(6, 500, center=(40.0, 0.0, 4.0))
    config = replace(SMALL, sampling=sampling)
    shadow = ls.DeepShadowMap.build(ball(), LIGHT, receivers, config, device="cpu")
    assert (shadow.transmittance_of(receivers) == 1.0).all()
