"""Edited scenes: the saved file shows the edited scene, and unedited parts do not change."""

from __future__ import annotations

import math
import tomllib
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

import lumisplat as ls
from lumisplat.io.document.tables import light_table
from lumisplat.io.images.radiance import write_radiance
from lumisplat.io.scene_toml.lights import read_environment, read_light
from lumisplat.io.scene_toml.toml_table import TomlTable, toml_text
from lumisplat.math.transforms import rotation_matrix
from support.kinds import with_values

SCENE = """
up = "z-up"

[[splats]]
path = "row.ply"
position = [1.0, 2.0, 3.0]
material = { roughness = 0.3 }
name = "row"

[[meshes]]
path = "two.obj"
ground = 0.5
material = "shiny"

[[lights]]
type = "spot"
position = [0.0, 0.0, 3.0]
target = [0.0, 0.0, 0.0]
outer_angle_degrees = 30.0
name = "lamp"

[environment]
color = [0.2, 0.3, 0.4]

[materials.shiny]
metallic = 1.0
roughness = 0.2

[[cameras]]
name = "front"
eye = [0.0, -4.0, 1.0]
target = [0.0, 0.0, 0.0]

[render]
pipeline = "hybrid"
samples = 3
"""
TWO = "v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl red\nf 1 2 3\nv 5 0 0\nv 6 0 0\nv 5 1 0\nusemtl blue\nf 4 5 6\n"


def row() -> ls.Gaussians:
    """Returns three Gaussians along x."""
    return ls.Gaussians(
        means=[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]],
        rotations_wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (3, 1)),
        scales=np.full((3, 3), 0.1),
        opacities=np.full(3, 0.5),
        sh=np.zeros((3, 1, 3)),
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Writes a scene file with an entry of each kind, and its files."""
    ls.save(tmp_path / "row.ply", row())
    (tmp_path / "two.obj").write_text(TWO)
    (tmp_path / "scene.toml").write_text(SCENE)
    return tmp_path


def assert_same_scene(found: Any, expected: ls.Scene) -> None:
    """Checks that arrays, transforms, materials and lights are equal up to rounding."""
    assert isinstance(found, ls.Scene) and found.up_direction == expected.up_direction
    for mine, other in zip(found.splats, expected.splats, strict=True):
        for name, values in other.gaussians.arrays().items():
            np.testing.assert_allclose(
                mine.gaussians.arrays()[name], values, rtol=2e-7
            )  # PLY files store logarithms of scales
        np.testing.assert_allclose(mine.transform, other.transform, atol=1e-11)
        assert_same(mine.material, other.material)
        assert (mine.sh_degree, mine.shadow_catcher, mine.name) == (other.sh_degree, other.shadow_catcher, other.name)
    for mine, other in zip(found.meshes, expected.meshes, strict=True):
        world = [i.mesh.positions @ i.transform[:3, :3].T + i.transform[:3, 3] for i in (mine, other)]
        np.testing.assert_allclose(world[0][mine.mesh.indices], world[1][other.mesh.indices], rtol=1e-6, atol=1e-6)
        assert_same(with_values(mine.mesh.material), with_values(other.mesh.material))
    for mine, other in zip(found.lights, expected.lights, strict=True):
        assert_same(mine, other)


def assert_same(mine: Any, other: Any) -> None:
    """Checks that all fields are equal; numbers to one unit in the last place, as files store degrees."""
    assert type(mine) is type(other)
    for field in () if other is None else fields(other):
        first, second = getattr(mine, field.name), getattr(other, field.name)
        if isinstance(second, np.ndarray):
            np.testing.assert_array_equal(first, second)
        elif isinstance(second, float | tuple) and not isinstance(second, str):
            np.testing.assert_allclose(first, second, rtol=3e-16, atol=1e-15)
        else:
            assert first == second, field.name


def test_document_opened_from_a_file_equals_the_loaded_file(folder: Path) -> None:
    """Scene, settings and cameras are equal."""
    document = ls.io.SceneDocument.open(folder / "scene.toml")
    assert [entry.kind for entry in document.entries] == ["splats", "meshes", "lights", "environment"]
    assert_same_scene(document.scene(), ls.load(folder / "scene.toml"))  # pyright: ignore[reportArgumentType]
    assert document.config == ls.load_config(folder / "scene.toml")
    assert [camera.name for camera in document.cameras] == ["front"] and document.animation is None


def test_document_with_edits_of_every_kind_loads_as_edited(folder: Path) -> None:
    """The document is saved in another folder; the opened file is unchanged."""
    document = ls.io.SceneDocument.open(folder / "scene.toml")
    document = document.placed(0, np.diag([2.0, 2.0, 2.0, 1.0])).changed(1, material={"roughness": 0.7})
    document = document.changed(2, target=None, direction=[0.0, 1.0, -1.0], intensity=7.0)
    document, _ = document.added("meshes", {"shape": "box", "size": [1.0, 2.0, 3.0], "position": [0.0, 0.0, 9.0]})
    document, _ = document.duplicated(2)
    document = document.with_config(replace(document.config, samples=5, background=None))
    target = folder / "elsewhere" / "edited.toml"
    target.parent.mkdir()
    document.save(target)
    assert_same_scene(ls.load(target), document.scene())
    assert (
        ls.load_config(target)
        == document.config
        == replace(ls.load_config(folder / "scene.toml"), samples=5, background=None)
    )
    assert (folder / "scene.toml").read_text() == SCENE


def test_documents_refuse_to_overwrite_a_scene_file_unless_overwrite_is_given(folder: Path) -> None:
    """Files without the extension .toml are refused."""
    document = ls.io.SceneDocument.open(folder / "scene.toml").removed(3)
    with pytest.raises(ls.FormatError, match="exists already"):
        document.save(folder / "scene.toml")
    assert (folder / "scene.toml").read_text() == SCENE
    document.save(folder / "scene.toml", overwrite=True)
    assert_same_scene(ls.load(folder / "scene.toml"), document.scene())
    with pytest.raises(ls.FormatError, match=r"is not a \.toml"):
        document.save(folder / "row.ply", overwrite=True)


def test_edited_documents_share_all_objects_that_the_edit_does_not_change(folder: Path) -> None:
    """Renderers cache assets by object identity, and undo returns to the previous document."""
    before = ls.io.SceneDocument.open(folder / "scene.toml")
    scene = before.scene()
    after = before.placed(0, np.eye(4)).changed(2, intensity=3.0)
    assert after.scene().splats[0].gaussians is scene.splats[0].gaussians
    assert after.scene().meshes[0] is scene.meshes[0]
    assert before.scene() is scene and before.entry(2).lights[0].intensity == 1.0


def test_error_for_an_invalid_edit_of_a_document_names_the_key_and_nothing_changes(folder: Path) -> None:
    """Unknown keys, kinds and ids, values out of range, and missing files are refused."""
    document = ls.io.SceneDocument.open(folder / "scene.toml")
    entries = document.entries
    with pytest.raises(ls.FormatError, match="roughness is 7"):
        document.changed(0, material={"roughness": 7})
    with pytest.raises(ls.FormatError, match="unknown 'radus'"):
        document.changed(2, radus=1.0)
    with pytest.raises(ls.FormatError, match=r"no such file"):
        document.added("splats", {"path": "gone.ply"})
    with pytest.raises(ls.ConfigError, match="lights"):
        document.added("light", {})  # pyright: ignore[reportArgumentType]
    with pytest.raises(ls.ConfigError, match="an environment already"):
        document.added("environment", {})
    with pytest.raises(ls.SceneError, match="mirrors"):
        document.placed(0, np.diag([-1.0, 1.0, 1.0, 1.0]))
    with pytest.raises(ls.SceneError, match="no entry 9"):
        document.removed(9)
    assert document.entries is entries


def test_instances_of_a_document_are_numbered_without_its_hidden_entries(folder: Path) -> None:
    """`owner` numbers captures first, then meshes; hidden lights are disabled."""
    document = ls.io.SceneDocument.open(folder / "scene.toml")
    assert [document.owner(number).id for number in range(3)] == [0, 1, 1]
    hidden = document.changed(0, hidden=True).changed(2, enabled=False)
    assert [hidden.owner(number).id for number in range(2)] == [1, 1]
    assert not hidden.scene().splats
    assert [light.enabled for light in hidden.scene().lights] == [False, True]
    with pytest.raises(ls.SceneError, match="no instance 2"):
        hidden.owner(2)


def test_splitting_a_document_entry_into_its_meshes_leaves_the_scene_unchanged(folder: Path) -> None:
    """The meshes of the file keep their transforms and materials."""
    document = ls.io.SceneDocument.open(folder / "scene.toml")
    split = document.split(1)
    assert [entry.name for entry in split.entries if entry.kind == "meshes"] == ["red", "blue"]
    assert_same_scene(replace(split.scene(), meshes=()), replace(document.scene(), meshes=()))
    for mine, other in zip(split.scene().meshes, document.scene().meshes, strict=True):
        np.testing.assert_allclose(mine.transform, other.transform, atol=1e-11)
        assert_same(with_values(mine.mesh.material), with_values(other.mesh.material))
    with pytest.raises(ls.SceneError, match="nothing to split"):
        split.split(split.entries[-1].id)


def test_ids_of_removed_document_entries_are_never_reused(folder: Path) -> None:
    """The id of a removed entry never refers to an entry added later."""
    document = ls.io.SceneDocument.open(folder / "scene.toml")
    document, first = document.added("lights", {"type": "point", "position": [0.0, 0.0, 0.0]})
    _, second = document.removed(first).added("lights", {"type": "point", "position": [0.0, 0.0, 0.0]})
    assert first != second


def test_document_lists_unreadable_files_as_problems(folder: Path) -> None:
    """Each unreadable file gives one line; opening fails if no file can be read."""
    (folder / "broken.ply").write_text("ply\nnonsense")
    document = ls.io.SceneDocument.open([folder / "row.ply", folder / "broken.ply", folder / "gone.obj"])
    assert len(document.entries) == 1 and len(document.problems) == 2
    assert "broken.ply" in document.problems[0] and "gone.obj" in document.problems[1]
    with pytest.raises(ls.FormatError, match="broken"):
        ls.io.SceneDocument.open(folder / "broken.ply")
    with pytest.raises(ls.ConfigError, match="both scene files"):
        ls.io.SceneDocument.open([folder / "scene.toml", folder / "scene.toml"])


def memory_scene() -> ls.Scene:
    """Returns a scene without files: shared and sheared assets, textures, colours, all light types."""
    rng = np.random.default_rng(1)
    texture = rng.integers(0, 256, (4, 8, 3), np.uint8)
    material = ls.MaterialPbr(base_color_texture=texture, roughness=0.123456789, emissive=(2.0, 0.0, 1.5), name="tile")
    square = ls.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], uvs=[[0, 0], [1, 0], [0, 1]], material=material)
    shear = np.array([[1.0, 0.5, 0.0, 1.0], [0.0, 2.0, 0.0, 2.0], [0.0, 0.0, 1.0, 3.0], [0.0, 0.0, 0.0, 1.0]])
    gaussians = row()
    lights = (
        ls.LightPoint((0.1, 0.2, 0.3), (1.0, 0.5, 0.25), 3.3, range=7.7, radius=0.1, name="p"),
        ls.LightSpot((1, 2, 3), (0, -1, 1), inner_angle=0.2, outer_angle=0.7, casts_shadow=False),
        ls.LightDirectional((1, 2, 3), angle=0.005, shadow_distance=4.0),
        ls.LightSphere((0, 1, 0), 0.5, visible=False),
        ls.LightRect((0, 1, 0), (1, 0, 0), (0, 0, 2), intensity=9.0, enabled=False),
        ls.LightEnvironment(rng.uniform(0.0, 2.0, (4, 8, 3)).astype(np.float32), intensity=0.5),
    )
    return ls.Scene(
        splats=[
            ls.SplatInstance(gaussians, name="a", material=ls.MaterialSimple(ambient=(0.2, 0.3, 0.4), shininess=30.0)),
            ls.SplatInstance(
                gaussians,
                position=(5.0, 0.0, 0.0),
                shadow_catcher=True,
                sh_degree=1,
                depth_iso_transmittance=0.5,
                name="b",
            ),
        ],
        meshes=[ls.MeshInstance(square, position=(0, 0, 4), scale_by=0.25), ls.MeshInstance(square, shear)],
        lights=lights,
        up=(0.0, 0.6, 0.8),
    )


def test_documents_save_in_memory_scenes_with_asset_files(tmp_path: Path) -> None:
    """The loaded scene equals the scene in memory; a capture used twice is written once."""
    scene = memory_scene()
    document = ls.io.SceneDocument.of(scene)
    assert_same_scene(document.scene(), scene)
    assert document.scene().splats[0].gaussians is document.scene().splats[1].gaussians
    document.save(tmp_path / "made.toml")
    assert_same_scene(ls.load(tmp_path / "made.toml"), scene)
    assert len(list((tmp_path / "made.assets").glob("capture_*.ply"))) == 1
    assert (
        "made.assets/" in (tmp_path / "made.toml").read_text()
        and str(tmp_path) not in (tmp_path / "made.toml").read_text()
    )


def test_in_memory_actors_of_documents_can_be_hidden_but_not_saved(tmp_path: Path) -> None:
    """The error of saving names the actor."""
    still = np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))
    motion = ls.Keyframes([0.0, 1.0], [[0.0, 0.0, 0.0], [4.0, 0.0, 0.0]], still, [1.0, 1.0])
    animation = ls.Animation(ls.Scene([row()]), [ls.Actor(row(), motion, name="walker")], fps=10.0, frame_count=11)
    document = ls.io.SceneDocument.of(animation)
    assert document.scene(0.5).splats[1].transform[0, 3] == pytest.approx(2.0)
    assert document.owner(1, 0.5).name == "walker"
    again = document.animation
    assert again is not None and (again.fps, again.frame_count) == (10.0, 11)
    assert len(document.changed(1, hidden=True).scene().splats) == 1
    with pytest.raises(ls.FormatError, match="walker was made by a program"):
        document.save(tmp_path / "made.toml")
    assert not (tmp_path / "made.toml").exists()


NUMBERS = st.floats(1e-3, 1e3)
VECTORS = st.tuples(NUMBERS, NUMBERS, NUMBERS)
LIGHTS = st.one_of(
    st.builds(ls.LightPoint, VECTORS, VECTORS, NUMBERS, NUMBERS, NUMBERS, name=st.text(max_size=5)),
    st.builds(
        lambda position, direction, inner, rest: ls.LightSpot(
            position, direction, inner_angle=inner, outer_angle=inner + rest
        ),
        VECTORS,
        VECTORS,
        st.floats(0.0, 0.7),
        st.floats(0.01, 0.8),
    ),
    st.builds(lambda d, a: ls.LightDirectional(d, angle=a), VECTORS, st.floats(0.0, math.pi / 2)),
    st.builds(ls.LightSphere, VECTORS, NUMBERS, VECTORS, NUMBERS, enabled=st.booleans()),
    st.builds(lambda p, s: ls.LightRect(p, (s, 0.0, 0.0), (0.0, 1.0, s)), VECTORS, NUMBERS),
    st.builds(ls.LightEnvironment, st.none(), VECTORS, NUMBERS, st.tuples(*[NUMBERS] * 4), st.booleans()),
)


@given(LIGHTS)
def test_light_table_of_a_scene_file_restores_every_light_type(light: Any) -> None:
    """Lights of all types are restored from text."""
    table = TomlTable.of(Path("scene.toml"), tomllib.loads(toml_text(light_table(light))))
    assert_same(read_environment(table) if isinstance(light, ls.LightEnvironment) else read_light(table), light)


VALUES = st.recursive(
    st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=12,
)


@given(st.dictionaries(st.text(), VALUES, max_size=4))
def test_text_written_by_toml_text_parses_to_equal_values(values: dict[str, Any]) -> None:
    """Keys, text and nesting are arbitrary."""
    assert tomllib.loads(toml_text(values)) == values


def test_scene_file_arrays_are_one_line_with_short_floats() -> None:
    """People edit scene files by hand."""
    text = toml_text({"splats": [{"path": Path("a.ply"), "transform": np.eye(4), "scale": 0.1}]})
    row = "0.0, 0.0, 0.0"
    assert text.splitlines()[1:3] == [
        'path = "a.ply"',
        f"transform = [[1.0, {row}], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [{row}, 1.0]]",
    ]
    assert "scale = 0.1\n" in text


def tilted(degrees: float) -> np.ndarray:
    """Returns a unit vector that leans by an angle from y down towards z."""
    return np.array([0.0, -math.cos(math.radians(degrees)), math.sin(math.radians(degrees))])


def test_upright_objects_of_a_document_rotate_with_its_up_direction(tmp_path: Path) -> None:
    """Upright objects rotate about their foot and keep their size; captures, lights and tilted objects stay."""
    ls.save(tmp_path / "row.ply", row())
    (tmp_path / "two.obj").write_text(TWO)
    (tmp_path / "scene.toml").write_text(
        '[[splats]]\npath = "row.ply"\nupright = true\n'
        '[[meshes]]\npath = "two.obj"\nupright = true\nposition = [1.0, 2.0, 3.0]\nscale = 2.0\nname = "words"\n'
        '[[meshes]]\nshape = "box"\nground = -0.5\nlook_at = [3.0, 0.0, 0.0]\nname = "looks"\n'
        '[[meshes]]\nshape = "box"\nrotation_wxyz = [0.0, 1.0, 0.0, 0.0]\nname = "numbers"\n'
        '[[meshes]]\nshape = "box"\nrotation_degrees = [30.0, 0.0, 0.0]\nname = "leans"\n'
        '[[lights]]\ntype = "directional"\ndirection = [0.0, 1.0, 0.0]\n'
    )
    before, up = ls.io.SceneDocument.open(tmp_path / "scene.toml"), tilted(25.0)
    after = before.with_up(up)
    np.testing.assert_allclose(after.scene().up_direction, up, atol=1e-12)
    for old, new in zip(before.entries, after.entries, strict=True):
        if old.name not in ("words", "looks", "numbers"):
            assert old.lights == new.lights and (old.world_from_file is None) == (new.world_from_file is None)
            if old.world_from_file is not None and new.world_from_file is not None:
                np.testing.assert_allclose(new.world_from_file, old.world_from_file, atol=1e-9)
            continue
        start, end = np.asarray(old.world_from_file), np.asarray(new.world_from_file)
        assert np.cbrt(np.linalg.det(end[:3, :3])) == pytest.approx(np.cbrt(np.linalg.det(start[:3, :3])))
        np.testing.assert_allclose(end[:3, 1] / np.linalg.norm(end[:3, 1]), up, atol=1e-9)
        corners = [
            np.asarray(e.meshes[0].mesh.positions) @ m[:3, :3].T + m[:3, 3] for e, m in ((old, start), (new, end))
        ]
        low, high = (corners[0].min(axis=0), corners[0].max(axis=0))
        foot = 0.5 * (low + high) * (1.0, 0.0, 1.0) + (0.0, high[1], 0.0)  # y is down
        back = np.linalg.inv(start) @ np.append(foot, 1.0)
        np.testing.assert_allclose((end @ back)[:3], foot, atol=1e-6)
        assert (corners[1] @ up).min() == pytest.approx(float(foot @ up), abs=1e-6)
    after.save(tmp_path / "saved.toml")
    saved = ls.load(tmp_path / "saved.toml")
    assert isinstance(saved, ls.Scene)
    np.testing.assert_allclose(saved.up_direction, up, atol=1e-12)
    for one, other in zip((*after.scene().splats, *after.scene().meshes), (*saved.splats, *saved.meshes), strict=True):
        np.testing.assert_allclose(one.transform, other.transform, atol=1e-9)


def test_changing_up_of_a_document_of_meshes_leaves_their_transforms_unchanged(tmp_path: Path) -> None:
    """Placement keys such as `upright` are replaced by numbers, which do not depend on up."""
    (tmp_path / "scene.toml").write_text('[[meshes]]\nshape = "box"\nupright = true\nground = 1.0\n')
    before = ls.io.SceneDocument.open(tmp_path / "scene.toml")
    after = before.with_up("z-up")
    placements = [np.asarray(document.entries[0].world_from_file) for document in (before, after)]
    np.testing.assert_allclose(placements[1], placements[0], atol=1e-9)
    after.save(tmp_path / "saved.toml")
    saved = ls.load(tmp_path / "saved.toml")
    assert isinstance(saved, ls.Scene) and saved.up_direction == (0.0, 0.0, 1.0)
    np.testing.assert_allclose(saved.meshes[0].transform, before.scene().meshes[0].transform, atol=1e-9)


def test_upright_environments_of_a_document_rotate_with_its_up_direction(tmp_path: Path) -> None:
    """A tilted environment was rotated on purpose and stays."""
    write_radiance(tmp_path / "sky.exr", np.ones((4, 8, 3), np.float32))
    text = '[[splats]]\npath = "row.ply"\n[environment]\npath = "sky.exr"\nrotation_wxyz = [{}, 1.0, 0.0, 0.0]\n'
    ls.save(tmp_path / "row.ply", row())
    for w, expected in ((0.0, tilted(25.0)), (0.1, None)):
        (tmp_path / "scene.toml").write_text(text.format(w))
        before = ls.io.SceneDocument.open(tmp_path / "scene.toml")
        after = before.with_up(tilted(25.0))
        environments: list[Any] = [document.scene().lights[0] for document in (before, after)]
        rotations = [rotation_matrix(environment.rotation_wxyz) for environment in environments]
        np.testing.assert_allclose(rotations[1][:, 1], rotations[0][:, 1] if expected is None else expected, atol=1e-9)


@pytest.mark.parametrize("up", ["upwards", (0.0, 0.0, 0.0), (math.nan, 0.0, 1.0)])
def test_documents_refuse_an_invalid_up_direction_with_a_one_line_error(up: Any) -> None:
    """Up is an unknown word, a zero vector or NaN; the document is unchanged."""
    document = ls.io.SceneDocument.of(ls.Scene())
    with pytest.raises(ls.SceneError, match="up is"):
        document.with_up(up)
