"""Text files from Windows: a byte order mark or UTF-16 changes nothing."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.cli import main
from support.files.mesh_files import QUAD, QUAD_TRIANGLES, ply_text, quad_gltf, stl_text, write_obj
from support.files.training_image_files import ring_cameras, write_colmap_images
from support.files.usd_files import write_usda

ENCODINGS = {"utf-8": "utf-8-sig", "utf-16": "utf-16"}


def _marked(path: Path, encoding: str) -> Path:
    path.write_text(path.read_text(encoding="utf-8"), encoding=ENCODINGS[encoding])
    return path


def _mesh(path: Path) -> ls.Mesh:
    mesh = ls.load(path)
    scene = mesh if isinstance(mesh, ls.Scene) else ls.Scene(meshes=[mesh])  # pyright: ignore[reportArgumentType]
    return scene.meshes[0].mesh


def _obj(folder: Path, encoding: str) -> Path:
    path = write_obj(folder)
    _marked(folder / "quad.mtl", encoding)
    return _marked(path, encoding)


def _stl(folder: Path, encoding: str) -> Path:
    (folder / "quad.stl").write_bytes(stl_text(QUAD[QUAD_TRIANGLES]))
    return _marked(folder / "quad.stl", encoding)


def _gltf(folder: Path, encoding: str) -> Path:
    gltf = quad_gltf()
    (folder / "quad.bin").write_bytes(gltf.data)
    buffers = [{"uri": "quad.bin", "byteLength": len(gltf.data)}]
    (folder / "quad.gltf").write_text(json.dumps(gltf.json | {"buffers": buffers}))
    return _marked(folder / "quad.gltf", encoding)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("write", [_obj, _stl, _gltf])
def test_mesh_files_may_begin_with_a_byte_order_mark_or_be_utf_16(
    tmp_path: Path, write: Callable[[Path, str], Path], encoding: str
) -> None:
    """The files are OBJ, MTL, STL and glTF."""
    mesh = _mesh(write(tmp_path, encoding))
    np.testing.assert_array_equal(mesh.positions[mesh.indices], QUAD[QUAD_TRIANGLES])
    if write is not _stl:
        assert mesh.material.name == "painted"
        assert isinstance(mesh.material, ls.MaterialPbr)
        assert mesh.material.base_color == (0.5, 0.25, 1.0)
        assert mesh.material.base_color_texture is not None


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian"])
def test_ply_files_may_begin_with_a_byte_order_mark(tmp_path: Path, order: str) -> None:
    """The rows begin three bytes later than in a file without the mark."""
    (tmp_path / "quad.ply").write_bytes(b"\xef\xbb\xbf" + ply_text(order))
    np.testing.assert_array_equal(_mesh(tmp_path / "quad.ply").positions, QUAD)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_scene_files_may_begin_with_a_byte_order_mark_or_be_utf_16(tmp_path: Path, encoding: str, capsys) -> None:
    """The command ``info`` parses scene files separately and accepts them, too."""
    write_obj(tmp_path)
    (tmp_path / "scene.toml").write_text(
        'up = "y-up"\n[[meshes]]\npath = "quad.obj"\n[[cameras]]\nname = "ä"\neye = [0, 0, 3]\ntarget = [0, 0, 0]\n'
        "[render]\nsamples = 3\n",
        encoding="utf-8",
    )
    path = _marked(tmp_path / "scene.toml", encoding)
    assert len(ls.load(path).meshes) == 1  # pyright: ignore[reportAttributeAccessIssue]
    assert ls.load_cameras(path)[0].name == "ä"
    assert ls.load_config(path).samples == 3
    assert main(["info", str(path)]) == 0
    assert main(["export", str(path), "-o", str(tmp_path / "out.glb")]) == 0
    assert "of 1 mesh instance, 1 camera" in capsys.readouterr().out


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_camera_files_may_begin_with_a_byte_order_mark_or_be_utf_16(tmp_path: Path, encoding: str) -> None:
    """The files are transforms.json and COLMAP's text files, whose first line need not be a comment."""
    cameras = ring_cameras()
    ls.save_cameras(tmp_path / "transforms.json", cameras)
    assert len(ls.load_cameras(_marked(tmp_path / "transforms.json", encoding))) == len(cameras)
    model = write_colmap_images(tmp_path, cameras, np.eye(3), text=True) / "sparse/0"
    for name in ("cameras.txt", "images.txt"):
        text = (model / name).read_text().replace("# Cameras\n", "")
        (model / name).write_text(text)
        _marked(model / name, encoding)
    assert [camera.name for camera in ls.load_cameras(model)] == [camera.name for camera in cameras]


def test_sog_and_dataset_settings_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    """The files are meta.json and lod-meta.json of SOGs, and data set settings."""
    rng = np.random.default_rng(1)
    gaussians = ls.Gaussians(
        rng.normal(size=(9, 3)),
        np.tile((1.0, 0, 0, 0), (9, 1)),
        np.full((9, 3), 0.1),
        np.full(9, 0.5),
        np.zeros((9, 1, 3)),
    )
    ls.save(tmp_path / "sog" / "meta.json", gaussians)
    ls.save(tmp_path / "levels" / "lod-meta.json", gaussians)
    for path in (tmp_path / "sog" / "meta.json", tmp_path / "levels" / "lod-meta.json"):
        assert ls.load(_marked(path, "utf-8")).count == 9  # pyright: ignore[reportAttributeAccessIssue]
    (tmp_path / "set.toml").write_text("views = 7\n", encoding="utf-8-sig")
    assert ls.io.load_dataset_config(tmp_path / "set.toml").views == 7


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("name", ["a.usda", "a.usd"])
@pytest.mark.parametrize("how", ["itself", "reference", "sublayer"])
def test_usd_text_layers_may_begin_with_a_byte_order_mark_or_be_utf_16(
    tmp_path: Path, how: str, name: str, encoding: str
) -> None:
    """The marked file is the root layer, a referenced layer or a sublayer."""
    body = """def Mesh "m" {
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
}"""
    path = _marked(write_usda(tmp_path / name, body), encoding)
    if how == "reference":
        path = write_usda(tmp_path / "outer.usda", f'def "m" (references = @./{name}@</m>) {{\n}}')
    elif how == "sublayer":
        path = write_usda(tmp_path / "outer.usda", "", head=f"subLayers = [@./{name}@]")
    np.testing.assert_array_equal(_mesh(path).positions, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
