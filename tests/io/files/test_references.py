"""Files that files refer to: regular, of limited size, and inside the folder unless allowed."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import lumisplat as ls
from lumisplat.cli import main
from lumisplat.errors import FormatError
from lumisplat.io.files import source
from support.files.mesh_files import ply_text, png_bytes, quad_gltf

OBJ = "mtllib {}\nusemtl paint\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"


def _gltf_buffer(folder: Path, name: str) -> Path:
    gltf = quad_gltf()
    (folder / "quad.gltf").write_text(
        json.dumps(gltf.json | {"buffers": [{"uri": name, "byteLength": len(gltf.data)}]})
    )
    return folder / "quad.gltf"


def _gltf_image(folder: Path, name: str) -> Path:
    gltf = quad_gltf()
    (folder / "quad.bin").write_bytes(gltf.data)
    buffers = [{"uri": "quad.bin", "byteLength": len(gltf.data)}]
    (folder / "quad.gltf").write_text(json.dumps(gltf.json | {"buffers": buffers, "images": [{"uri": name}]}))
    return folder / "quad.gltf"


def _obj_library(folder: Path, name: str) -> Path:
    (folder / "tri.obj").write_text(OBJ.format(name))
    return folder / "tri.obj"


def _mtl_texture(folder: Path, name: str) -> Path:
    (folder / "paint.mtl").write_text(f"newmtl paint\nmap_Kd {name}\n")
    return _obj_library(folder, "paint.mtl")


def _ply_texture(folder: Path, name: str) -> Path:
    comment = f"format ascii 1.0\ncomment TextureFile {name}\n".encode()
    (folder / "mesh.ply").write_bytes(ply_text().replace(b"format ascii 1.0\n", comment))
    return folder / "mesh.ply"


REFERRERS: dict[str, tuple[Callable[[Path, str], Path], bytes]] = {
    "buffer": (_gltf_buffer, quad_gltf().data),
    "image": (_gltf_image, png_bytes()),
    "library": (_obj_library, b"newmtl paint\nKd 1 0 0\n"),
    "map": (_mtl_texture, png_bytes()),
    "ply texture": (_ply_texture, png_bytes()),
}
"""Writers of files that refer to another file, with the content of that file."""


@pytest.fixture(params=REFERRERS)
def referrer(request) -> tuple[Callable[[Path, str], Path], bytes]:
    """Returns a writer of `REFERRERS`, and the content of the file to which it refers."""
    return REFERRERS[request.param]


@pytest.mark.parametrize("absolute", [False, True])
def test_references_of_a_file_to_others_outside_its_folder_are_refused_by_default(
    tmp_path: Path, referrer, absolute: bool
) -> None:
    """References outside the folder are refused before the referenced file is read."""
    write, content = referrer
    (tmp_path / "model" / "sub").mkdir(parents=True)
    (tmp_path / "secret").write_bytes(content)
    (tmp_path / "model" / "sub" / "own").write_bytes(content)
    ls.load(write(tmp_path / "model", "sub/../sub/own"))
    path = write(tmp_path / "model", os.fspath(tmp_path / "secret") if absolute else "../secret")
    with pytest.raises(FormatError, match=r"which is not in its folder: .*--allow-outside \(allow_outside=True\)"):
        ls.load(path)
    ls.load(path, allow_outside=True)


def test_backslashes_in_referenced_paths_count_as_slashes_unless_such_a_file_exists(tmp_path: Path, referrer) -> None:
    """Windows programs write backslashes; a path with backslashes cannot leave the folder either."""
    write, content = referrer
    (tmp_path / "model" / "my files").mkdir(parents=True)
    (tmp_path / "model" / "my files" / "one 1").write_bytes(content)
    (tmp_path / "secret").write_bytes(content)
    ls.load(write(tmp_path / "model", "my files\\one 1"))
    ls.load(write(tmp_path / "model", ".\\my files\\one 1"))
    (tmp_path / "model" / "back\\slash").write_bytes(content)
    ls.load(write(tmp_path / "model", "back\\slash"))
    with pytest.raises(FormatError, match="not in its folder"):
        ls.load(write(tmp_path / "model", "..\\secret"))


def test_paths_in_scene_files_may_have_backslashes(tmp_path: Path) -> None:
    """Scene files written on Windows have backslashes in paths."""
    (tmp_path / "parts").mkdir()
    _obj_library(tmp_path / "parts", "none.mtl")
    (tmp_path / "scene.toml").write_text("[[meshes]]\npath = 'parts\\tri.obj'\n")
    ls.load(tmp_path / "scene.toml")


def test_option_allow_outside_permits_references_to_other_folders(tmp_path: Path, capsys) -> None:
    """The error message about a refused reference names the option."""
    (tmp_path / "model").mkdir()
    (tmp_path / "wood.png").write_bytes(png_bytes())
    path = _mtl_texture(tmp_path / "model", "../wood.png")
    assert main(["info", str(path)]) == 2
    assert "paint.mtl: names '../wood.png', which is not in its folder" in capsys.readouterr().err
    assert main(["info", str(path), "--allow-outside"]) == 0


def test_mtl_libraries_may_use_textures_in_the_folder_of_their_obj(tmp_path: Path) -> None:
    """The MTL library lies in a subfolder, and its texture beside the mesh."""
    (tmp_path / "materials").mkdir()
    (tmp_path / "wood.png").write_bytes(png_bytes())
    (tmp_path / "materials" / "paint.mtl").write_text("newmtl paint\nmap_Kd ../wood.png\n")
    mesh = ls.load(_obj_library(tmp_path, "materials/paint.mtl"))
    assert isinstance(mesh, ls.Mesh)
    assert mesh.material.base_color_texture is not None


def test_scene_files_and_symbolic_links_may_refer_to_files_in_other_folders(tmp_path: Path) -> None:
    """A scene file may refer to any file; a mesh file that it loads may not."""
    (tmp_path / "model").mkdir()
    (tmp_path / "wood.png").write_bytes(png_bytes())
    (tmp_path / "model" / "link.png").symlink_to(tmp_path / "wood.png")
    _mtl_texture(tmp_path / "model", "link.png")
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "scene.toml").write_text('[[meshes]]\npath = "../model/tri.obj"\n')
    ls.load(tmp_path / "scenes" / "scene.toml")
    _mtl_texture(tmp_path / "model", "../wood.png")
    with pytest.raises(FormatError, match="not in its folder"):
        ls.load(tmp_path / "scenes" / "scene.toml")
    ls.load(tmp_path / "scenes" / "scene.toml", allow_outside=True)


@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_references_to_pipes_and_devices_are_refused_by_mesh_readers(tmp_path: Path, referrer, kind: str) -> None:
    """Reading a pipe would wait for its writer, and a device may never end."""
    write, _ = referrer
    name = "/dev/zero"
    if kind == "pipe":
        os.mkfifo(tmp_path / "pipe")
        name = "pipe"
    with pytest.raises(FormatError, match="is a device, a pipe or a socket, expected a file") as error:
        ls.load(write(tmp_path, name), allow_outside=True)
    assert str(error.value).count("expected a file") == 1


@pytest.mark.parametrize(
    "read", [ls.load, ls.load_cameras, ls.io.load_radiance, ls.load_image, ls.load_config, ls.DeepShadowMap.load]
)
@pytest.mark.parametrize("suffix", [".ply", ".spz", ".obj", ".glb", ".toml", ".json", ".exr"])
def test_every_reader_refuses_a_named_pipe_given_as_its_path(
    tmp_path: Path, read: Callable[[Path], object], suffix: str
) -> None:
    """Loading images, cameras, settings or shadow maps would wait for a writer."""
    os.mkfifo(tmp_path / f"pipe{suffix}")
    with pytest.raises(FormatError, match="is a device, a pipe or a socket"):
        read(tmp_path / f"pipe{suffix}")


@pytest.mark.parametrize(
    ("text", "read"),
    [
        ('[environment]\npath = "{}"\n', ls.load),
        ('[[splats]]\npath = "{}"\n', ls.load),
        ('[[meshes]]\npath = "{}"\n', ls.load),
        ('[materials.a]\nbase_color_texture = "{}"\n[[meshes]]\npath = "{}"\n', ls.load),
        ('[[cameras]]\npath = "{}"\n', ls.load_cameras),
        ('[[actors]]\npath = "{}"\n', ls.load_animation),
    ],
)
@pytest.mark.parametrize("name", ["/dev/zero", "pipe"])
def test_scene_files_refuse_pipes_and_devices_in_every_path_entry(tmp_path: Path, text: str, read, name: str) -> None:
    """Captures, meshes, actors, textures and environments have a path."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "scene.toml").write_text(text.replace("{}", name))
    with pytest.raises(FormatError, match=r"scene\.toml: line \d.* is '.*': a device, a pipe or a socket"):
        read(tmp_path / "scene.toml")


def test_named_pipe_in_place_of_the_image_of_a_camera_counts_as_missing(tmp_path: Path) -> None:
    """The camera has no size, so the size of its image is needed, which a pipe does not have."""
    os.mkfifo(tmp_path / "image.png")
    frame = {"file_path": "image.png", "transform_matrix": np.eye(4).tolist()}
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": [frame]}))
    with pytest.raises(FormatError, match="there is no image"):
        ls.load_cameras(tmp_path / "transforms.json")


def test_referenced_files_above_the_size_limit_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A sparse file takes no disk space, but reading it would fill the memory."""
    monkeypatch.setattr(source, "FILE_BYTES_MAX", 10**6)
    with (tmp_path / "huge.png").open("wb") as file:
        file.truncate(10**6 + 1)
    with pytest.raises(FormatError, match=r"huge\.png: has 1,000,001 bytes, expected at most 1,000,000 \(needed by"):
        ls.load(_gltf_image(tmp_path, "huge.png"))


def _bombs(folder: Path, count: int) -> Path:
    """Returns a glTF with ``count`` materials, each with a texture of 170 MB stored in 0.3 MB."""
    flat = io.BytesIO()
    Image.new("RGB", (7536, 7536)).save(flat, "PNG")
    gltf = quad_gltf()
    (folder / "quad.bin").write_bytes(gltf.data)
    for index in range(count):
        (folder / f"{index}.png").write_bytes(flat.getvalue())
    gltf.json["images"] = [{"uri": f"{index}.png"} for index in range(count)]
    gltf.json["textures"] = [{"source": index} for index in range(count)]
    gltf.json["materials"] = [
        {"pbrMetallicRoughness": {"baseColorTexture": {"index": index}}} for index in range(count)
    ]
    (primitive,) = gltf.json["meshes"][0]["primitives"]
    gltf.json["meshes"][0]["primitives"] = [primitive | {"material": index} for index in range(count)]
    buffers = [{"uri": "quad.bin", "byteLength": len(gltf.data)}]
    (folder / "quad.gltf").write_text(json.dumps(gltf.json | {"buffers": buffers}))
    return folder / "quad.gltf"


def test_gltf_textures_are_limited_in_total_size(tmp_path: Path) -> None:
    """Each texture is small enough, but not all of them together."""
    with pytest.raises(FormatError, match=r"quad\.gltf: textures up to \d\.png would take 1,\d+,\d+,\d+ bytes"):
        ls.load(_bombs(tmp_path, 10))
