"""OpenUSD scenes: round trips, validity for other programs, and what is reported as lost."""

from __future__ import annotations

import zipfile
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import lumisplat as ls
from lumisplat.errors import FormatError
from lumisplat.io.usd.scene import holds_one_capture
from lumisplat.math.transforms import quaternions_from_matrices, rotation_matrix
from lumisplat.scene.lights import Light
from lumisplat.scene.placing import y_up_from
from support.files.splat_files import capture
from support.files.usd_files import EXTENSIONS, usd_core, validation_messages
from support.kinds import expect_kind
from support.scenes.usd_scene import full_scene

LIMITS = {"inner_angle": 5e-8, "outer_angle": 5e-8, "angle": 5e-8, "uvs": 2.0**-24, "edge_u": 3e-8, "edge_v": 3e-8}
"""Tolerances by field: angles are stored in degrees, edges as lengths, in float32; v is flipped twice."""


def difference(saved: Any, loaded: Any) -> float:
    """Returns the largest absolute difference of two numbers or arrays; inf if their shapes differ."""
    if np.shape(saved) != np.shape(loaded):
        return np.inf
    with np.errstate(invalid="ignore"):
        apart = np.abs(np.asarray(saved, np.float64) - np.asarray(loaded, np.float64))
    return float(np.where(np.asarray(saved) == np.asarray(loaded), 0.0, apart).max(initial=0.0))


def assert_same(saved: Any, loaded: Any, label: str, moved: float) -> None:
    """Compares all fields of two objects: data exactly, values that the axes rotate within ``moved``."""
    assert type(saved) is type(loaded), label
    for field in fields(saved):
        a, b, where = getattr(saved, field.name), getattr(loaded, field.name), f"{label}.{field.name}"
        if field.name in ("mesh", "gaussians", "material") and a is not None:
            assert_same(a, b, where, moved)
        elif field.name == "name" and "mesh" in label.split(".")[1:]:
            continue  # a mesh with one instance is named after the instance
        elif isinstance(a, np.ndarray) or (isinstance(a, tuple | float) and not isinstance(a, bool)):
            limit = LIMITS.get(field.name, moved)
            exact = isinstance(a, np.ndarray) and a.dtype != np.float64 and field.name != "uvs"
            assert difference(a, b) <= (0.0 if exact else limit), where
        else:
            assert a is b or a == b, where


def rotated_light(light: Light, rotation: npt.NDArray[np.float64]) -> Light:
    """Returns a light under a rotation, shape (3, 3)."""
    changed: dict[str, Any] = {
        name: tuple(rotation @ getattr(light, name))
        for name in ("position", "direction", "edge_u", "edge_v")
        if name in {field.name for field in fields(light)}
    }
    if isinstance(light, ls.LightEnvironment):
        world_from_environment = rotation @ rotation_matrix(np.asarray(light.rotation_wxyz))
        changed["rotation_wxyz"] = quaternions_from_matrices(world_from_environment[None])[0]
    return replace(light, **changed)


def upright_scene(scene: ls.Scene) -> ls.Scene:
    """Returns the scene rotated so that y is up and its front faces +z."""
    rotation = np.eye(4)
    rotation[:3, :3] = y_up_from(scene.up_direction)
    return ls.Scene(
        [replace(one, world_from_object=rotation @ one.transform) for one in scene.splats],
        [replace(one, world_from_object=rotation @ one.transform) for one in scene.meshes],
        [rotated_light(light, rotation[:3, :3]) for light in scene.lights],
        up="y-up",
    )


@pytest.mark.parametrize(
    ("extension", "up", "moved"),
    [(".usda", "y-down", 0.0), (".usdc", "z-up", 0.0), (".usdz", (0.3, 1.0, 0.2), 2e-15), (".usd", "x-down", 0.0)],
)
def test_usd_round_trip_keeps_every_object_of_a_scene(tmp_path: Path, extension: str, up: str, moved: float) -> None:
    """Objects are rotated to y up, exactly if up was an axis."""
    usd_core()
    saved, path = full_scene(up), tmp_path / f"scene{extension}"
    ls.save(path, saved)
    loaded = expect_kind(ls.Scene, ls.load(path))
    assert loaded.up_direction == (0.0, 1.0, 0.0)
    saved = upright_scene(saved)
    for name in ("splats", "meshes", "lights"):
        before, after = getattr(saved, name), getattr(loaded, name)
        assert [one.name for one in after] == [one.name for one in before]
        for one, other in zip(before, after, strict=True):
            assert_same(one, other, one.name, max(moved, 3e-8 if name == "lights" else 0.0))
    assert loaded.splats[0].gaussians is loaded.splats[1].gaussians
    assert loaded.meshes[-1].mesh is loaded.meshes[-2].mesh is loaded.meshes[-3].mesh


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_scenes_written_to_usd_pass_the_validators_of_usd_core(tmp_path: Path, extension: str) -> None:
    """Textures are beside the file, or inside a package."""
    usd_core()
    path = tmp_path / f"scene{extension}"
    ls.save(path, full_scene("y-down"), cameras=[ls.Camera.look_at((3, 2, 1), (0, 0, 0), name="view")])
    assert not validation_messages(path)
    if extension == ".usdz":
        assert [file.name for file in tmp_path.iterdir()] == ["scene.usdz"]
        with zipfile.ZipFile(path) as package:
            assert package.namelist()[0] == "scene.usdc"
            assert "textures/textures_base_color.png" in package.namelist()
    else:
        assert {file.name for file in (tmp_path / "scene_textures").iterdir()} >= {"sky.exr", "textures_normal.png"}


def test_all_features_of_a_scene_lost_in_usd_are_named_in_one_log_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The warning lists everything that OpenUSD cannot store."""
    usd_core()
    ls.save(tmp_path / "a.usdc", full_scene("y-down"))
    (line,) = [record.getMessage() for record in caplog.records]
    for remark in (
        "relighting of captures, which only Lumisplat reads (relit)",
        "shadow_catcher, sh_degree and depth_iso_transmittance of captures, which only Lumisplat reads (relit)",
        "vertex colours of textured meshes (textures)",
        "the range of lights (bulb)",
        "lights that cameras do not see (visible = false) (ball, sky, disk)",
        "sheared rectangle lights (parallelograms) (skewed)",
        "the falloff of spots between inner and outer cone, which follows another curve (spot)",
    ):
        assert remark in line


def test_material_features_that_usd_cannot_store_are_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The features are sheen, absorption, thin walls and simple materials."""
    usd_core()
    odd = ls.MaterialPbr(name="odd", sheen_color=(1, 0, 0), thin_walled=True, specular=0.5, attenuation_distance=2.0)
    simple = ls.MaterialSimple(name="simple", emissive=0.25, diffuse=0.5, base_color=(1.0, 0.5, 0.0))
    ball = full_scene("y-up").meshes[0].mesh
    ls.save(tmp_path / "a.usdc", ls.Scene(meshes=[replace(ball, material=odd), replace(ball, material=simple)]))
    text = caplog.text
    for remark in (
        "sheen (odd)",
        "thin-walled transmission (odd)",
        "absorption inside meshes (odd)",
        "specular strength (odd)",
    ):
        assert remark in text
    assert "simple materials, reduced to diffuse reflection and emission (simple)" in text
    near = expect_kind(ls.Scene, ls.load(tmp_path / "a.usdc")).meshes[1].mesh.material
    near = expect_kind(ls.MaterialPbr, near)
    assert near.base_color == (0.5, 0.25, 0.0) and near.emissive == (0.25, 0.125, 0.0)


def test_usd_round_trip_renders_the_same_image(tmp_path: Path) -> None:
    """The image is rendered through the scene's own camera."""
    usd_core()
    camera = ls.Camera.look_at((1.5, -2.0, -6.0), (1, 0, 0), (0, -1, 0), width=48, height=32, name="view")
    saved = full_scene("y-down")
    ls.save(tmp_path / "a.usdz", saved, cameras=[camera])
    loaded = expect_kind(ls.Scene, ls.load(tmp_path / "a.usdz"))
    config = ls.RenderConfig(pipeline=ls.Pipeline.RASTER, samples=1)
    before = ls.render(saved, camera, config, device="cpu").pixels_srgb()
    after = ls.render(loaded, ls.load_cameras(tmp_path / "a.usdz")[0], config, device="cpu").pixels_srgb()
    assert before.std() > 0.05
    assert ls.metrics.psnr(before, after) > 90.0


def test_single_mesh_is_written_to_usd_as_a_scene(tmp_path: Path) -> None:
    """The loaded scene has y up and one mesh."""
    usd_core()
    ls.save(tmp_path / "a.usdc", full_scene("y-up").meshes[0].mesh)
    loaded = expect_kind(ls.Scene, ls.load(tmp_path / "a.usdc"))
    assert len(loaded.meshes) == 1 and loaded.up_direction == (0.0, 1.0, 0.0)


def test_usd_with_one_capture_loads_as_a_scene_only_if_it_has_a_material_or_flag(tmp_path: Path) -> None:
    """The transform is applied to the Gaussians, with y down; a material or shadow catcher flag makes a scene."""
    usd_core()
    ls.save(tmp_path / "a.usdc", ls.Scene([ls.SplatInstance(capture(5), position=(1, 2, 3))], up="y-down"))
    loaded = expect_kind(ls.Gaussians, ls.load(tmp_path / "a.usdc"))
    np.testing.assert_allclose(loaded.means, capture(5).means + np.array((1, 2, 3)), atol=1e-6)
    ls.save(tmp_path / "b.usdc", ls.Scene([ls.SplatInstance(capture(5), material=ls.MaterialPbr(roughness=0.25))]))
    scene = expect_kind(ls.Scene, ls.load(tmp_path / "b.usdc"))
    material = expect_kind(ls.MaterialPbr, scene.splats[0].material)
    assert (material.roughness, material.base_color, material.metallic) == (0.25, None, None)  # no factors
    ls.save(tmp_path / "c.usdc", ls.Scene([ls.SplatInstance(capture(5), shadow_catcher=True)]))
    assert expect_kind(ls.Scene, ls.load(tmp_path / "c.usdc")).splats[0].shadow_catcher
    assert [holds_one_capture(tmp_path / name) for name in ("a.usdc", "b.usdc", "c.usdc")] == [True, False, False]


def test_object_names_with_any_characters_survive_usd(tmp_path: Path) -> None:
    """Names are equal, empty or those of Lumisplat's own prims, too."""
    usd_core()
    names = ["", "Materials", "1 ü/ö", "a", "a", "Prototypes"]
    ball = full_scene("y-up").meshes[0].mesh
    ls.save(tmp_path / "a.usda", ls.Scene(meshes=[ls.MeshInstance(ball, name=name) for name in names]))
    loaded = expect_kind(ls.Scene, ls.load(tmp_path / "a.usda"))
    assert [one.name for one in loaded.meshes][1:] == names[1:]


def test_failed_write_of_a_usd_package_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No other file is left."""
    usd_core()
    path = tmp_path / "a.usdz"
    ls.save(path, capture(5))
    before = path.read_bytes()
    monkeypatch.setattr("lumisplat.io.usd.writing.USD_PACKAGE_BYTES_MAX", 10)
    with pytest.raises(FormatError, match=r"more than a .usdz can hold: write a .usdc"):
        ls.save(path, full_scene("y-up"))
    assert path.read_bytes() == before and [file.name for file in tmp_path.iterdir()] == ["a.usdz"]
    (tmp_path / "b.usdc").mkdir()
    with pytest.raises(FormatError, match="is a folder, expected the name of a file to write"):
        ls.save(tmp_path / "b.usdc", capture(5))
