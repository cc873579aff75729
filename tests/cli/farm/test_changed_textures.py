"""Tests that frames are not continued after a texture of the scene has changed."""

from __future__ import annotations

import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from PIL import Image

import lumisplat as ls
from lumisplat.cli.input.loading import file_fingerprints
from support.files.cli_files import Workspace

SIZE = ("--width", "24", "--height", "16", "--device", "cpu")


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workspace:
    """Returns a folder to run commands in; Warp's log level is restored afterwards."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    return Workspace(tmp_path, capsys)


def write_texture(path: Path, red: int) -> None:
    """Writes a texture of one colour with its own modification time."""
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(np.full((4, 4, 3), (red, 90, 30), np.uint8)).save(path)
    os.utime(path, ns=(10**18 + red, 10**18 + red))


def write_gltf(path: Path, uri: str) -> None:
    """Writes a textured triangle whose texture is a file beside it."""
    positions = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], np.float32).tobytes()
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "scene": 0,
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"uri": uri}],
        "buffers": [{"uri": "body.bin", "byteLength": 60}],
        "bufferViews": [
            {"buffer": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 24},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [-1, -1, 0], "max": [1, 1, 0]},
            {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
        ],
    }
    (path.parent / "body.bin").write_bytes(positions + np.array([[0, 0], [1, 0], [0, 1]], np.float32).tobytes())
    text = json.dumps(document).encode()
    if path.suffix == ".gltf":
        path.write_bytes(text)
        return
    text += b" " * (-len(text) % 4)
    path.write_bytes(struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), b"JSON") + text)


@pytest.mark.parametrize("name", ["body.gltf", "body.glb"])
@pytest.mark.parametrize("uri", ["tex/bark.png", "tex/old%20bark.png"])
def test_continuing_a_frame_folder_is_refused_after_a_gltf_texture_changed(work, name: str, uri: str) -> None:
    """Percent-encoded texture names and binary glTF files count, too; the error names the texture."""
    texture = work.path(uri.replace("%20", " "))
    write_texture(texture, 200)
    write_gltf(work.path(name), uri)
    command = ("orbit", f"@{name}", "-o", "@out", *SIZE, "--seconds", "0.2", "--fps", "10")
    done = work.run(*command)
    assert done.status == 0, done.err
    write_texture(texture, 20)
    refused = work.run(*command)
    assert refused.status == 2
    assert f"holds frames of other settings or files ({uri.replace('%20', ' ')}): " in refused.err


def test_fingerprint_of_a_binary_usd_includes_its_textures(work) -> None:
    """The fingerprint covers all time samples of a .usdc, and the layers that it references."""
    sdf = pytest.importorskip("pxr.Sdf")
    usd = pytest.importorskip("pxr.Usd")
    for name in ("one.usdc", "other.usd"):
        stage = usd.Stage.CreateNew(str(work.path(name)))
        prim = stage.DefinePrim("/A")
        shown = prim.CreateAttribute("inputs:file", sdf.ValueTypeNames.Asset)
        shown.Set(sdf.AssetPath(f"./tex/{name}.png"))
        shown.Set(sdf.AssetPath(f"tex/{name}.later.png"), 1.0)
        if name == "one.usdc":
            stage.GetRootLayer().subLayerPaths.append("./other.usd")
        stage.Save()
        for end in ("png", "later.png"):
            write_texture(work.path(f"tex/{name}.{end}"), 200)
    (work.path("scene.toml")).write_text('[[meshes]]\npath = "one.usdc"\n')
    marks = file_fingerprints([work.path("scene.toml")], work.path("out"))
    assert set(marks) == {
        "scene.toml", "one.usdc", "other.usd", "tex/one.usdc.png", "tex/one.usdc.later.png", "tex/other.usd.png",
        "tex/other.usd.later.png",
    }  # fmt: skip


def test_continuing_a_frame_folder_is_refused_after_a_usd_texture_changed(work) -> None:
    """The mesh has a texture beside its .usdc, and the error names the texture."""
    pytest.importorskip("pxr")
    write_texture(work.path("tex/bark.png"), 200)
    write_gltf(work.path("body.gltf"), "tex/bark.png")
    body = ls.load(work.path("body.gltf"))
    assert isinstance(body, ls.Scene | ls.Mesh)
    ls.save(work.path("body.usdc"), ls.Scene(meshes=[ls.MeshInstance(body)]) if isinstance(body, ls.Mesh) else body)
    textures = [name for name in file_fingerprints([work.path("body.usdc")], work.path("out")) if name.endswith(".png")]
    assert len(textures) == 1
    command = ("orbit", "@body.usdc", "-o", "@out", *SIZE, "--seconds", "0.2", "--fps", "10")
    assert work.run(*command).status == 0
    write_texture(work.path(textures[0]), 20)
    refused = work.run(*command)
    assert refused.status == 2 and f"settings or files ({textures[0]}): " in refused.err
