"""Mattes: names, coverage at edges, of Gaussians and of the nearest objects, and their EXR files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

import lumisplat as ls
from lumisplat.frame.mattes import id_bits
from lumisplat.io.images.exr import read_exr


def card(name: str, left: float, right: float, depth: float = 4.0, material: str = "") -> ls.MeshInstance:
    """Returns a rectangle over the whole height of the image, from one x to another."""
    corners = np.array([(left, -9, depth), (right, -9, depth), (right, 9, depth), (left, 9, depth)], dtype=float)
    mesh = ls.Mesh(corners, np.array([(0, 1, 2), (0, 2, 3)]), material=ls.MaterialPbr(name=material))
    return ls.MeshInstance(mesh, name=name)


@pytest.fixture
def camera() -> ls.Camera:
    """Returns a camera of 8 x 6 pixels, each half a unit wide at depth 4; its axis is between two columns."""
    return ls.Camera.look_at((0, 0, 0), (0, 0, 1), (0, -1, 0), width=8, height=6, fov_y=2 * np.arctan(1.5 / 4))


@pytest.mark.parametrize("pipeline", [ls.Pipeline.RASTER, ls.Pipeline.PATH])
def test_matte_of_a_mesh_at_its_edge_is_the_covered_fraction_of_the_pixel(
    camera: ls.Camera, pipeline: ls.Pipeline
) -> None:
    """A card that ends a quarter into a column, in front of another card, covers a quarter of the column."""
    scene = ls.Scene(meshes=[card("front", -9.0, 0.125), card("back", -9.0, 9.0, depth=8.0)])
    objects = ls.layers.render_mattes(scene, camera, ls.RenderConfig(pipeline=pipeline), device="cpu").objects
    expected = np.array([1, 1, 1, 1, 0.25, 0, 0, 0])
    np.testing.assert_allclose(objects.coverage("front"), np.broadcast_to(expected, (6, 8)), atol=1e-6)
    np.testing.assert_allclose(objects.coverage("back"), np.broadcast_to(1 - expected, (6, 8)), atol=1e-6)
    assert objects.names[objects.ranks[0, 3, 4]] == "back" and objects.names[objects.ranks[1, 3, 4]] == "front"
    with pytest.raises(ls.SceneError, match=r"no object or material is named 'side'.*front, back"):
        objects.coverage("side")


def test_matte_of_a_capture_has_the_alpha_of_its_gaussians(camera: ls.Camera) -> None:
    """A half-opaque Gaussian covers half of the pixel; a Gaussian too thin to be a surface covers nothing."""
    ball = ls.Gaussians([(0, 0, 4)], [(1, 0, 0, 0)], [(5.0, 5.0, 5.0)], [0.5], [[(0.0, 0.0, 0.0)]])
    mattes = ls.layers.render_mattes(ls.Scene(splats=[ls.SplatInstance(ball, name="fog")]), camera, device="cpu")
    frame = ls.render(ls.Scene(splats=[ball]), camera, device="cpu")
    middle = mattes.objects.coverage("fog")[2:4, 3:5]
    np.testing.assert_allclose(middle, frame.alpha[2:4, 3:5], atol=2e-3)
    assert (middle > 0.45).all() and (mattes.materials.coverage("fog")[2:4, 3:5] == middle).all()
    thin = replace(ball, opacities=np.array([0.2]))
    assert not ls.layers.render_mattes(ls.Scene(splats=[thin]), camera, device="cpu").objects.shares.any()


def test_instances_of_equal_name_share_one_matte(camera: ls.Camera) -> None:
    """Unnamed instances are named by their index, and their material by the object."""
    scene = ls.Scene(
        meshes=[
            card("door", -9, -1, material="oak"),
            card("door", 1, 9, material="oak"),
            card("", -1, 0),
            card("wall", 0, 1),
        ]
    )
    mattes = ls.layers.render_mattes(scene, camera, device="cpu")
    assert mattes.objects.names == ("door", "mesh 2", "wall")
    assert mattes.materials.names == ("oak", "mesh 2", "wall")
    assert (mattes.objects.coverage("door").sum(axis=1) == 4.0).all()


def test_exr_files_store_mattes_as_separate_parts(tmp_path: Path, camera: ls.Camera) -> None:
    """The first part is the unchanged image; ids and coverage are read back, with the manifest in each header."""
    scene = ls.Scene(meshes=[card("front", -9.0, 0.125, material="oak"), card("back", -9.0, 9.0, depth=8.0)])
    frame, mattes = ls.render(scene, camera, device="cpu"), ls.layers.render_mattes(scene, camera, device="cpu")
    frame.save(tmp_path / "with.exr", ["depth"], mattes)
    frame.save(tmp_path / "without.exr", ["depth"])
    first, alone = read_exr(tmp_path / "with.exr"), read_exr(tmp_path / "without.exr")
    assert first.keys() == alone.keys() and all((first[name] == alone[name]).all() for name in alone)
    file: Any
    with OpenEXR.File(str(tmp_path / "with.exr"), separate_channels=True) as file:
        assert [part.name() for part in file.parts] == ["rgba", "CryptoObject", "CryptoMaterial"]
        channels = file.parts[1].channels
        ids = channels["CryptoObject00.R"].pixels.view(np.uint32)
        assert ids[0, 0] == id_bits("front") and ids[0, 7] == id_bits("back")
        assert channels["CryptoObject00.G"].pixels[0, 4] == pytest.approx(0.75)
        kinds = {value for key, value in file.header(0).items() if key.endswith("/name")}
        assert kinds >= {"CryptoObject", "CryptoMaterial"}
        assert any("oak" in str(value) for key, value in file.header(2).items() if key.endswith("/manifest"))


def test_saving_mattes_of_another_size_or_in_another_format_is_refused(tmp_path: Path, camera: ls.Camera) -> None:
    """No file is written."""
    scene = ls.Scene(meshes=[card("front", -9.0, 0.125)])
    mattes = ls.layers.render_mattes(scene, camera, device="cpu")
    frame = ls.render(scene, camera.scaled(16), device="cpu")
    with pytest.raises(ls.SceneError, match="the mattes have"):
        frame.save(tmp_path / "other.exr", mattes=mattes)
    with pytest.raises(ls.ConfigError, match="can only be written to EXR files"):
        ls.render(scene, camera, device="cpu").save(tmp_path / "other.png", mattes=mattes)
    assert not list(tmp_path.iterdir())
