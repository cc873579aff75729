"""Object identity in edited documents: unedited objects stay the same objects, and unused objects are freed."""

from __future__ import annotations

import gc
import weakref
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.io.document.entries import EntryKind
from support.files.rig_files import BEND, TubeRig
from support.kinds import present
from support.scenes.raster_scenes import random_gaussians

MOVED = np.array([[1.0, 0.0, 0.0, 2.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
BOX = {"crop_low": [-1.0, -1.0, -10.0], "crop_high": [1.0, 1.0, 10.0]}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Returns the working folder, with a capture and a rig."""
    monkeypatch.chdir(tmp_path)
    ls.save("capture.ply", random_gaussians(1, count=200))
    TubeRig(clips={"walk": BEND}).write(tmp_path / "walker.glb")
    return tmp_path


@pytest.mark.usefixtures("folder")
def test_changing_the_material_of_a_document_entry_does_not_crop_its_capture_again() -> None:
    """The capture is neither cropped again, nor is its kernel degree set again."""
    document, number = ls.io.SceneDocument.of(ls.Scene()).added(
        "splats", {"path": "capture.ply", "kernel_degree": 4, "material": {"roughness": 0.3}, **BOX}
    )
    before, after = (d.entry(number).splats[0] for d in (document, document.changed(number, material={"ior": 2.0})))
    assert 0 < before.gaussians.count < 200
    assert after.gaussians is before.gaussians
    assert after.material is not before.material


@pytest.mark.parametrize(
    ("kind", "table"),
    [
        ("splats", {"path": "capture.ply", "material": {"roughness": 0.3}, **BOX}),
        ("meshes", {"shape": "sphere"}),
        ("meshes", {"shape": "sphere", "material": {"roughness": 0.3}}),
        ("meshes", {"path": "walker.glb", "material": {"roughness": 0.3}, "crease_angle_degrees": 10.0}),
    ],
)
@pytest.mark.usefixtures("folder")
def test_moving_a_document_entry_keeps_its_capture_mesh_and_material_in_memory(
    kind: EntryKind, table: dict[str, object]
) -> None:
    """The moved entry is a capture with a material, a shape, or a mesh file with another material."""
    document, number = ls.io.SceneDocument.of(ls.Scene()).added(kind, table)
    before, after = (d.entry(number) for d in (document, document.placed(number, MOVED)))
    np.testing.assert_array_equal(present(after.world_from_file), MOVED)
    for mine, other in zip(after.splats, before.splats, strict=True):
        assert mine.gaussians is other.gaussians and mine.material is other.material
    for mine, other in zip(after.meshes, before.meshes, strict=True):
        assert mine.mesh is other.mesh


@pytest.mark.usefixtures("folder")
def test_editing_a_light_of_a_document_does_not_pose_its_actors_again() -> None:
    """An actor's pose at one time stays the same object; a pose at another time is a new object."""
    document, _ = ls.io.SceneDocument.of(ls.Scene()).added("actors", {"path": "walker.glb", "count": 100})
    document, light = document.added("lights", {"type": "point", "position": [0.0, 0.0, 0.0]})
    pose = document.scene(0.5).splats[0]
    assert document.changed(light, intensity=2.0).scene(0.5).splats[0] is pose
    assert document.scene(0.25).splats[0].gaussians is not pose.gaussians


@pytest.mark.usefixtures("folder")
def test_documents_free_captures_of_former_crop_boxes_from_memory() -> None:
    """Dragging a crop box makes a new capture at each step, of hundreds of megabytes per million Gaussians."""
    document, number = ls.io.SceneDocument.of(ls.Scene()).added("splats", {"path": "capture.ply", **BOX})
    left: list[weakref.ref[ls.Gaussians]] = []
    for k in range(10):
        left.append(weakref.ref(document.entry(number).splats[0].gaussians))
        document = document.changed(number, crop_low=[-1.0, -1.0, -9.0 + 0.1 * k])
    gc.collect()
    assert not [one for one in left if one() is not None]


def test_document_edits_do_not_validate_unchanged_large_arrays_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """A new mesh material and a rotated environment check at most the 16 numbers of a matrix."""
    scene = ls.Scene(meshes=[ls.sphere(1.0)], lights=[ls.LightEnvironment(np.ones((4, 8, 3), np.float32))])
    document = ls.io.SceneDocument.of(scene)
    checked: list[int] = []
    isfinite = np.isfinite
    monkeypatch.setattr(np, "isfinite", lambda values: (checked.append(np.size(values)), isfinite(values))[1])
    changed = document.changed(0, material={"roughness": 0.1}).changed(1, rotation_wxyz=[0.0, 1.0, 0.0, 0.0])
    assert max(checked, default=0) <= 16  # the size of a matrix; the image has 96 numbers
    assert changed.entry(0).meshes[0].mesh.positions is scene.meshes[0].mesh.positions
    environment = changed.entry(1).lights[0]
    assert isinstance(environment, ls.LightEnvironment) and environment.rotation_wxyz == (0.0, 1.0, 0.0, 0.0)
    assert environment.image is scene.lights[0].image  # pyright: ignore[reportAttributeAccessIssue]


def test_scene_files_refuse_a_part_number_for_a_shape(tmp_path: Path) -> None:
    """A shape such as a box is one mesh, so `part` cannot select one."""
    (tmp_path / "scene.toml").write_text('[[meshes]]\nshape = "box"\npart = 0\n')
    with pytest.raises(ls.FormatError, match=r"line 3.*part selects a mesh of a file, but there is no path"):
        ls.load(tmp_path / "scene.toml")
