"""The demo scene: complete, within its promises, and solid from its own cameras."""

from __future__ import annotations

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import SH_C0
from lumisplat.scene import demo_room
from lumisplat.scene.color import decode_srgb


@pytest.fixture(scope="module")
def heard() -> list[float]:
    """What the progress callback was told while the scene was built."""
    return []


@pytest.fixture(scope="module")
def demo(heard: list[float]) -> ls.Scene:
    """The scene, built once."""
    return ls.demo_scene(progress=lambda _, share: heard.append(share))


def test_demo_scene_has_what_it_promises(demo: ls.Scene) -> None:
    """One set of 150,000 to 300,000 Gaussians with surface data, some meshes, all in a room of a few metres."""
    assert len(demo.splats) == 1
    assert 150_000 <= demo.gaussian_count <= 300_000
    assert {instance.name for instance in demo.meshes} == {"white paint", "striped glass", "brass", "aquamarine"}
    gaussians = demo.splats[0].gaussians
    for name in ("normals", "albedo", "roughness", "metallic"):
        assert getattr(gaussians, name) is not None
    low, high = demo.bounds()
    assert (low > [-4.0, -0.5, -4.5]).all()
    assert (high < [3.0, 4.0, 3.5]).all()


def test_the_room_is_seen_from_inside() -> None:
    """Walls, niche and floor face their middle: the sun must not shine on the outside of what is seen from within."""
    rng = np.random.default_rng(0)
    room, niche = (-0.05, 1.2, 0.0), (demo_room.NICHE_X, 0.9, demo_room.BACK - 0.1)
    walls = [*demo_room.side_walls(rng), demo_room.back_wall(rng), demo_room.floor(rng)]
    for mesh, middle in [*((wall, room) for wall in walls), (demo_room.niche(rng), niche)]:
        assert mesh.normals is not None
        assert np.einsum("ij,ij->i", mesh.normals, middle - mesh.positions).min() > 0.0
        a, b, c = mesh.positions[mesh.indices].swapaxes(0, 1)
        assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), middle - a) > 0.0).all()


def test_demo_is_made_of_different_materials(demo: ls.Scene) -> None:
    """Colours, roughness and metalness vary over the scene."""
    gaussians = demo.splats[0].gaussians
    assert gaussians.roughness is not None
    assert np.unique(gaussians.roughness).size >= 5
    assert any(instance.mesh.material.metallic == 1.0 for instance in demo.meshes)


def test_baked_daylight_only_darkens_the_albedo(demo: ls.Scene) -> None:
    """Display colour is albedo times a light of 0..1, and that light varies: there is sun and shade."""
    gaussians = demo.splats[0].gaussians
    assert gaussians.albedo is not None
    shown = decode_srgb(np.clip(gaussians.sh[:, 0] * SH_C0 + 0.5, 0.0, 1.0)).sum(axis=1)
    share = shown / np.maximum(gaussians.albedo.sum(axis=1), 1e-3)
    assert share.max() < 1.01
    assert np.percentile(share, 5) < 0.5
    assert np.percentile(share, 95) > 0.7
    for instance in demo.meshes:
        assert instance.mesh.colors is not None
        assert 0.0 <= instance.mesh.colors.min() < instance.mesh.colors.max() <= 1.0


def test_demo_cameras_are_named_and_start_with_the_hero() -> None:
    """Names are unique, sizes and count as asked for."""
    cameras = ls.demo_cameras(320, 180)
    names = [camera.name for camera in cameras]
    assert names[0] == "hero"
    assert len(set(names)) == len(names) >= 4
    assert {(camera.width, camera.height) for camera in cameras} == {(320, 180)}
    assert [camera.name for camera in ls.demo_cameras(count=2)] == names[:2]


def test_every_view_of_the_demo_is_filled_without_holes(demo: ls.Scene) -> None:
    """Behind every pixel of every view there is something opaque."""
    renderer = ls.create_renderer(device="cpu")
    for camera in ls.demo_cameras(480, 270):
        frame = renderer.render(demo, camera)
        assert (frame.alpha < 0.98).mean() < 2e-3, camera.name
        assert np.isfinite(frame.depth[frame.alpha > 0.98]).all()
        assert frame.color.std() > 0.06


def test_demo_reports_progress(demo: ls.Scene, heard: list[float]) -> None:
    """A progress callback hears of shares that only grow, up to one."""
    assert heard[0] == 0.0
    assert heard == sorted(heard)
    assert heard[-1] == 1.0
