"""Saved documents: in-memory assets are stored exactly beside the file, and no other files are overwritten."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from support.kinds import expect_kind, pbr_of, present
from support.scenes.raster_scenes import random_gaussians

TRIANGLE = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
UVS = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Returns the working folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def round_trip(scene: Any, name: str = "scene.toml") -> ls.Scene:
    """Saves a scene or document, and loads it."""
    document = scene if isinstance(scene, ls.io.SceneDocument) else ls.io.SceneDocument.of(scene)
    document.save(name)
    return expect_kind(ls.Scene, ls.load(name))


def scattered(**changes: Any) -> ls.Mesh:
    """Returns a mesh with random numbers in all arrays, including unused vertices."""
    rng = np.random.default_rng(1)
    count = 300
    arrays: dict[str, Any] = {
        "positions": rng.normal(size=(count, 3)),
        "indices": rng.permutation(count - 30).reshape(-1, 3),
        "normals": rng.normal(size=(count, 3)),
        "uvs": rng.uniform(-2.0, 2.0, (count, 2)),
        "colors": rng.uniform(0.0, 1.0, (count, 3)),
    }
    return ls.Mesh(**arrays | changes)


@pytest.mark.parametrize("without", [(), ("normals",), ("uvs",), ("colors",), ("normals", "uvs", "colors")])
def test_meshes_saved_by_a_document_load_with_equal_arrays(without: tuple[str, ...]) -> None:
    """No arrays are added to the mesh, and unused vertices stay."""
    mesh = scattered(**dict.fromkeys(without))
    found = round_trip(mesh).meshes[0].mesh
    for name in ("positions", "indices", "normals", "uvs", "colors"):
        np.testing.assert_array_equal(getattr(found, name), getattr(mesh, name), err_msg=name)
    assert pbr_of(found).mesh_color == pbr_of(mesh).mesh_color == (0.8, 0.8, 0.8)


@pytest.mark.parametrize("mirrored", [False, True])
def test_documents_save_sheared_meshes_in_world_space(mirrored: bool) -> None:
    """Normals stay on their side of the surface, and triangles keep their winding."""
    shear = np.array(
        [[1.0, 0.5, 0.0, 1.0], [0.0, 2.0, 0.0, 2.0], [0.0, 0.0, -1.0 if mirrored else 1.0, 3.0], [0, 0, 0, 1]]
    )
    mesh = ls.Mesh(TRIANGLE, [[0, 1, 2]], normals=[[0.0, 0.6, 0.8]] * 3)
    found = round_trip(ls.Scene(meshes=[ls.MeshInstance(mesh, shear)])).meshes[0]
    world = found.mesh.positions @ found.transform[:3, :3].T + found.transform[:3, 3]
    np.testing.assert_allclose(world, mesh.positions @ shear[:3, :3].T + shear[:3, 3], atol=1e-6)
    a, b, c = world[found.mesh.indices[0]]
    side = np.linalg.det(shear[:3, :3]) * np.linalg.inv(shear[:3, :3]).T @ (0.0, 0.0, 1.0)
    assert np.cross(b - a, c - a) @ side * np.linalg.det(shear[:3, :3]) > 0.0
    expected = np.linalg.inv(shear[:3, :3]).T @ (0.0, 0.6, 0.8)
    np.testing.assert_allclose(
        present(found.mesh.normals), np.tile(expected / np.linalg.norm(expected), (3, 1)), atol=1e-6
    )


def test_documents_save_every_field_of_mesh_materials() -> None:
    """Default colours of simple materials and wrap modes are kept; a texture used twice is one file."""
    texture = np.random.default_rng(1).integers(0, 256, (3, 5, 4), np.uint8)
    texture.flags.writeable = False  # keeps the material from copying the texture
    tiled = ls.MaterialPbr(
        base_color_texture=texture,
        emissive_texture=texture,
        texture_wraps={"base_color_texture": (ls.TextureWrap.CLAMP, ls.TextureWrap.MIRROR)},
        attenuation_distance=3.0,
        alpha_mode=ls.AlphaMode.MASK,
        name="tiles",
    )
    meshes = [
        ls.Mesh(TRIANGLE, [[0, 1, 2]], uvs=UVS, material=tiled),
        ls.Mesh(TRIANGLE, [[0, 1, 2]], material=ls.MaterialSimple(diffuse=0.5)),
    ]
    first, second = (instance.mesh.material for instance in round_trip(ls.Scene(meshes=meshes)).meshes)
    material = expect_kind(ls.MaterialPbr, first)
    for found in (material.base_color_texture, material.emissive_texture):
        np.testing.assert_array_equal(present(found), texture)
    assert material.texture_wraps == {"base_color_texture": (ls.TextureWrap.CLAMP, ls.TextureWrap.MIRROR)}
    assert (material.attenuation_distance, material.alpha_mode, material.name) == (3.0, ls.AlphaMode.MASK, "tiles")
    simple = expect_kind(ls.MaterialSimple, second)
    assert (simple.diffuse, simple.base_color) == ((0.5, 0.5, 0.5), (1.0, 1.0, 1.0))
    assert len(list(Path("scene.assets").glob("*.png"))) == 1


def test_edited_materials_are_saved_as_the_document_shows_them() -> None:
    """The edit may change the type of the material."""
    mesh = ls.Mesh(TRIANGLE, [[0, 1, 2]], material=ls.MaterialPbr(roughness=0.1, base_color=(0.1, 0.2, 0.3)))
    document = ls.io.SceneDocument.of(mesh).changed(0, material={"type": "simple", "diffuse": 0.5})
    shown = expect_kind(ls.MaterialSimple, document.scene().meshes[0].mesh.material)
    saved = expect_kind(ls.MaterialSimple, round_trip(document).meshes[0].mesh.material)
    assert (saved.diffuse, saved.base_color) == (shown.diffuse, shown.base_color) == ((0.5,) * 3, (0.1, 0.2, 0.3))


def test_saved_environment_images_keep_every_float_bit() -> None:
    """Values up to 100,000 are stored as floats."""
    image = np.random.default_rng(1).uniform(0.0, 1e5, (4, 8, 3)).astype(np.float32)
    (environment,) = round_trip(ls.Scene(lights=[ls.LightEnvironment(image, intensity=0.1)])).lights
    np.testing.assert_array_equal(present(expect_kind(ls.LightEnvironment, environment).image), image)


def test_saving_a_document_never_overwrites_foreign_asset_files() -> None:
    """Assets are overwritten only on request, and files to which the scene refers never are."""
    ls.io.SceneDocument.of(random_gaussians(1, count=20)).save("scene.toml")
    there, saved_bytes = Path("scene.assets/capture_0.ply"), Path("scene.assets/capture_0.ply").read_bytes()
    Path("scene.toml").unlink()
    assert round_trip(random_gaussians(2, count=7)).splats[0].gaussians.count == 7
    assert there.read_bytes() == saved_bytes
    document, _ = ls.io.SceneDocument.of(random_gaussians(3, count=5)).added("splats", {"path": str(there)})
    document.save("scene.toml", overwrite=True)
    scene = expect_kind(ls.Scene, ls.load("scene.toml"))
    assert [splat.gaussians.count for splat in scene.splats] == [5, 20]
    ls.io.SceneDocument.of(random_gaussians(3, count=3)).save("scene.toml", overwrite=True)
    assert expect_kind(ls.Scene, ls.load("scene.toml")).splats[0].gaussians.count == 3
    assert there.read_bytes() != saved_bytes


def test_document_with_an_unsavable_actor_writes_no_files() -> None:
    """The actor was made by a program, so there is no file to name; the error names the actor."""
    capture = random_gaussians(1, count=4)
    with pytest.raises(ls.FormatError, match="walker was made by a program"):
        ls.io.SceneDocument.of(ls.Animation(ls.Scene([capture]), [ls.Actor(capture, name="walker")])).save("scene.toml")
    assert not list(Path().iterdir())


def test_saved_relative_paths_are_valid_in_symbolically_linked_folders() -> None:
    """The path ``..`` leads from a linked folder to the parent of the link's target."""
    ls.save("capture.ply", random_gaussians(1, count=4))
    Path("far/away").mkdir(parents=True)
    os.symlink("far/away", "near", target_is_directory=True)
    document = ls.io.SceneDocument.open("capture.ply")
    assert len(round_trip(document, "near/scene.toml").splats) == 1
    assert 'path = "../../capture.ply"' in Path("near/scene.toml").read_text()
    from_link = ls.io.SceneDocument.open("near/scene.toml")
    assert len(round_trip(from_link, "other.toml").splats) == 1


def test_saving_a_scene_in_another_folder_keeps_its_texture_wraps() -> None:
    """A ``texture_wraps`` table has texture names as keys, but its values are not paths."""
    ls.save("capture.ply", random_gaussians(1, count=4))
    material = 'material = { texture_wraps = { normal_texture = "clamp" } }'
    Path("scene.toml").write_text(f'[[splats]]\npath = "capture.ply"\n{material}\n')
    Path("below").mkdir()
    (splat,) = round_trip(ls.io.SceneDocument.open("scene.toml"), "below/scene.toml").splats
    clamp = ls.TextureWrap.CLAMP
    assert expect_kind(ls.MaterialPbr, splat.material).texture_wraps == {"normal_texture": (clamp, clamp)}


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere, all names are text")
def test_scene_files_refuse_to_store_undecodable_file_names() -> None:
    """TOML files are UTF-8 text, which cannot store a Latin-1 file name."""
    name = os.fsdecode(b"wei\xdf.ply")
    ls.save(name, random_gaussians(1, count=4))
    with pytest.raises(ls.FormatError, match=r"scene.toml: cannot be written: the name of a file that it refers to"):
        ls.io.SceneDocument.open(name).save("scene.toml")
    assert not Path("scene.toml").exists()


@pytest.mark.parametrize("suffix", ["", ".ply"])
def test_saving_a_document_with_another_extension_than_toml_is_refused(suffix: str) -> None:
    """Files of other extensions could not be loaded again."""
    with pytest.raises(ls.FormatError, match=r"is not a \.toml"):
        ls.io.SceneDocument.of(ls.Scene()).save(f"scene{suffix}")


@pytest.mark.data
@pytest.mark.parametrize("name", ["biker.spz", "biker.compressed.ply"])
def test_captures_of_real_files_survive_saving_a_document(data_dir: Path, name: str) -> None:
    """An opened capture is saved as its path, a loaded one exactly, except opacities whose logit is not a float32."""
    loaded = expect_kind(ls.Gaussians, ls.load(data_dir / "splats" / name))
    document = ls.io.SceneDocument.open(data_dir / "splats" / name).changed(0, sh_degree=0)
    for scene in (document.scene(), round_trip(document, "opened.toml")):
        assert scene.splats[0].sh_degree == 0
        for key, values in loaded.arrays().items():
            np.testing.assert_array_equal(scene.splats[0].gaussians.arrays()[key], values)
    found = round_trip(loaded, "made.toml").splats[0].gaussians
    for key, values in loaded.arrays().items():
        np.testing.assert_array_max_ulp(found.arrays()[key], values, 4 if key == "opacities" else 0)
    twice = round_trip(found, "twice.toml").splats[0].gaussians
    np.testing.assert_array_equal(twice.opacities, found.opacities)


def test_absolute_asset_paths_of_scene_files_stay_absolute_when_saved(tmp_path: Path) -> None:
    """Relative asset paths are rewritten relative to the folder of the saved scene file."""
    (tmp_path / "assets").mkdir()
    (tmp_path / "saved").mkdir()
    triangle = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    for name in ("near.obj", "far.obj"):
        (tmp_path / "assets" / name).write_text(triangle)
    far = str(tmp_path / "assets" / "far.obj")
    scene = tmp_path / "scene.toml"
    scene.write_text(f'[[meshes]]\npath = "assets/near.obj"\n\n[[meshes]]\npath = "{far}"\n')
    ls.io.SceneDocument.open(scene).save(tmp_path / "saved" / "again.toml")
    saved = ls.io.SceneDocument.open(tmp_path / "saved" / "again.toml")
    assert [entry.table["path"] for entry in saved.entries] == ["../assets/near.obj", far]


def test_assets_opened_by_relative_paths_are_saved_with_relative_paths(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assets opened by absolute paths are saved with absolute ones; all saved paths refer to the opened files."""
    monkeypatch.chdir(tmp_path)
    for name in ("near.obj", "far.obj"):
        Path(name).write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (tmp_path / "saved").mkdir()
    document = ls.io.SceneDocument.open(["near.obj", tmp_path / "far.obj"])
    document.save("saved/scene.toml")
    saved = ls.io.SceneDocument.open("saved/scene.toml")
    assert [entry.table["path"] for entry in saved.entries] == ["../near.obj", str(tmp_path / "far.obj")]
    assert len(saved.scene().meshes) == 2
