"""Damaged glTF files with captures, meshes, lights and cameras: a one-line error, or a valid scene."""

from __future__ import annotations

import json
import logging
import struct
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from support.files.mesh_files import QUAD, QUAD_TRIANGLES, QUAD_UVS
from support.files.rig_files import BEND, TubeRig
from support.files.splat_files import capture

REPLACEMENTS: tuple[Any, ...] = (
    *(None, True, -1, 0, 1, 3, 255, 5121, 2**31, 2**63, 10**30, 0.5, -1e30, 1e308, float("nan"), float("inf")),
    *("", "ellipse", "VEC4", "nowhere.bin", "data:;base64,AAAA", [], {}, [0], [1e308] * 16, {"0": 0}),
)
"""Values that replace values of a document."""
MEMORY_MAX = 64 * 2**20
"""Memory in bytes that a damaged file of a few thousand bytes may take."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Returns a file with everything that is written, and some that is only read."""
    path = tmp_path_factory.mktemp("gltf") / "whole.glb"
    texture = np.zeros((2, 2, 3), np.uint8)
    mesh = ls.Mesh(QUAD, QUAD_TRIANGLES, uvs=QUAD_UVS, material=ls.MaterialPbr(base_color_texture=texture))
    gaussians = capture(4, albedo=np.full((4, 3), 0.5), comments=("a",), antialiased=True)
    stretched = np.diag([1.0, 2.0, 1.0, 1.0])
    scene = ls.Scene(
        splats=[ls.SplatInstance(gaussians, material=ls.MaterialPbr(roughness=0.25), name="capture"), gaussians],
        meshes=[ls.MeshInstance(mesh, stretched)],
        lights=[ls.LightSpot((0, 1, 0), (0, -1, 0), radius=0.5), ls.LightDirectional((0, -1, 0), angle=0.1)],
    )
    ls.save(path, scene, cameras=[ls.Camera.look_at((0, 0, 5), (0, 0, 0), width=64, height=48)])
    return path.read_bytes()


def chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Returns the JSON of a GLB, and the bytes after it."""
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[20 + size :]


def packed(document: dict[str, Any], rest: bytes) -> bytes:
    """Returns a GLB of JSON and bytes, the inverse of `chunks`."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON") + text + rest


def containers(value: Any, found: list[tuple[Any, Any]]) -> list[tuple[Any, Any]]:
    """Returns all containers of a document with the keys of their values."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        found.append((value, key))
        containers(inner, found)
    return found


def mutated(document: dict[str, Any], rng: np.random.Generator) -> None:
    """Removes or replaces a value somewhere in a document, or changes a number a little."""
    container, key = (found := containers(document, []))[rng.integers(len(found))]
    kind = rng.integers(4)
    if kind == 0:
        del container[key]
    elif kind == 1 and isinstance(container[key], int | float) and not isinstance(container[key], bool):
        container[key] += int(rng.integers(-3, 4))
    elif kind == 2:
        other, source = found[rng.integers(len(found))]
        container[key] = json.loads(json.dumps(other[source])) if source in other or isinstance(other, list) else None
    else:
        container[key] = REPLACEMENTS[rng.integers(len(REPLACEMENTS))]


def play(animation: ls.Animation) -> None:
    """Poses everything that moves, at frames and between them."""
    for time in (0.0, 0.013, 0.1, float(animation.times[-1])):
        animation.actors_at(time)
        if animation.camera_path is not None:
            animation.camera_path.at(time)


def moving(whole: bytes) -> bytes:
    """Returns a file that animates each of its nodes, with all interpolations in turn."""
    document, rest = chunks(whole)
    data = rest[8:]

    def stored(values: list[Any], kind: str) -> int:
        """Appends numbers to the buffer, and returns their accessor."""
        nonlocal data
        packed_values = np.array(values, np.float32).tobytes()
        view = {"buffer": 0, "byteOffset": len(data), "byteLength": len(packed_values)}
        document["bufferViews"].append(view)
        accessor = {"bufferView": len(document["bufferViews"]) - 1, "componentType": 5126, "type": kind}
        document["accessors"].append({**accessor, "count": len(values)})
        data += packed_values
        return len(document["accessors"]) - 1

    interpolations, samplers, channels = ("LINEAR", "STEP", "CUBICSPLINE"), [], []
    for index, node in enumerate(document["nodes"]):
        if "matrix" in node:
            continue
        interpolation = interpolations[index % 3]
        values = [(0.1 * row, 1.0, 0.0) for row in range(9 if interpolation == "CUBICSPLINE" else 3)]
        keys = {"input": stored([0.0, 0.1, 0.2], "SCALAR"), "output": stored(values, "VEC3")}
        channels.append({"sampler": len(samplers), "target": {"node": index, "path": "translation"}})
        samplers.append({**keys, "interpolation": interpolation})
    document["animations"] = [{"samplers": samplers, "channels": channels}]
    document["buffers"][0]["byteLength"] = len(data)
    data += b"\0" * (-len(data) % 4)
    return packed(document, struct.pack("<I4s", len(data), b"BIN\0") + data)


def morphing(folder: Path) -> bytes:
    """Returns a rig with joints and morph targets."""
    rig = TubeRig(clips={"bend": [*BEND, (0, "weights", [0.0, 0.2, 1.0], [0.0, 1.0, 0.5, 0.0, 1.0, 0.2], "STEP")]})
    rig.targets = [np.full_like(rig.positions, 0.1), -rig.positions]
    return rig.write(folder / "tube.glb").read_bytes()


def survives(path: Path, data: bytes, *, moves: bool = False) -> bool:
    """Returns whether the data load, also as an animation if something moves; else checks the one-line error."""
    path.write_bytes(data)
    try:
        ls.load(path)
        ls.load_cameras(path)
        if moves:
            play(ls.load_animation(path))
    except ls.LumisplatError as error:
        assert str(path.parent) in str(error)
        assert "\n" not in str(error)
        return False
    return True


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    """Silences log lines, of which damaged files give hundreds."""
    logging.getLogger("lumisplat").setLevel(logging.CRITICAL)
    yield
    logging.getLogger("lumisplat").setLevel(logging.NOTSET)


def check_all(folder: Path, variants: list[bytes], low: float, high: float) -> None:
    """Checks that all variants load or are refused, with fractions of each within bounds."""
    good = sum(survives(folder / "mutated.glb", data) for data in variants)
    assert low < good / len(variants) < high


FEW_AND_ALL = [120, pytest.param(2000, marks=pytest.mark.deep)]
"""Number of files in the daily and in the deep test suite."""


@pytest.mark.parametrize("count", FEW_AND_ALL)
def test_gltf_with_mutated_json_either_loads_or_is_refused_with_a_one_line_error(
    tmp_path: Path, whole: bytes, count: int
) -> None:
    """One field is removed, replaced, changed a little, or copied from another item."""
    rng = np.random.default_rng(21)
    variants: list[bytes] = []
    for _ in range(count):
        document, rest = chunks(whole)
        mutated(document, rng)
        variants.append(packed(document, rest))
    check_all(tmp_path, variants, 0.2, 0.8)


@pytest.mark.parametrize("count", FEW_AND_ALL)
def test_gltf_with_mutated_bytes_either_loads_or_is_refused_with_a_one_line_error(
    tmp_path: Path, whole: bytes, count: int
) -> None:
    """A few random bytes are changed, or the file is truncated."""
    rng = np.random.default_rng(22)
    variants: list[bytes] = []
    for k in range(count):
        damaged = np.frombuffer(whole, np.uint8).copy()
        where = rng.integers(0, len(damaged), rng.integers(1, 6))
        damaged[where] = rng.integers(0, 256, len(where))
        variants.append(damaged.tobytes() if k % 4 else whole[: rng.integers(1, len(whole))])
    check_all(tmp_path, variants, 0.02, 0.8)


@pytest.mark.parametrize("kind", ["rig", "scene"])
@pytest.mark.parametrize("count", FEW_AND_ALL)
def test_mutated_gltf_animations_either_load_or_are_refused_with_a_one_line_error(
    tmp_path: Path, whole: bytes, count: int, kind: str
) -> None:
    """The file is a rig with morph targets, or a scene of captures, meshes, lights and cameras.

    Its JSON or its bytes are damaged.
    """
    rng = np.random.default_rng(23)
    original = morphing(tmp_path) if kind == "rig" else moving(whole)
    assert survives(tmp_path / "mutated.glb", original, moves=True)
    good = 0
    for k in range(count):
        document, rest = chunks(original)
        if k % 2:
            mutated(document, rng)
            data = packed(document, rest)
        else:
            damaged = np.frombuffer(original, np.uint8).copy()
            where = rng.integers(0, len(damaged), rng.integers(1, 6))
            damaged[where] = rng.integers(0, 256, len(where))
            data = damaged.tobytes()
        good += survives(tmp_path / "mutated.glb", data, moves=True)
    assert 0.1 < good / count < 0.9


def test_total_size_of_copies_of_shared_gltf_accessors_is_limited(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Many primitives may share an accessor, but the copies must not fill the memory."""
    monkeypatch.setattr("lumisplat.io.files.source.DECODED_BYTES_FREE", 1000)
    monkeypatch.setattr("lumisplat.io.files.source.EXPANSION_MAX", 2)
    for asset in (capture(300), ls.sphere(1.0)):
        ls.save(tmp_path / "a.glb", asset)
        assert survives(tmp_path / "mutated.glb", (tmp_path / "a.glb").read_bytes())
        document, rest = chunks((tmp_path / "a.glb").read_bytes())
        document["meshes"][0]["primitives"] *= 20
        (tmp_path / "mutated.glb").write_bytes(packed(document, rest))
        with pytest.raises(ls.FormatError, match="its accessors would take"):
            ls.load(tmp_path / "mutated.glb")


def test_external_gltf_buffers_count_toward_the_size_of_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The limit of decoded data depends on the stored bytes, which include the buffer beside a small .gltf."""
    monkeypatch.setattr("lumisplat.io.files.source.DECODED_BYTES_FREE", 1000)
    monkeypatch.setattr("lumisplat.io.files.source.EXPANSION_MAX", 2)
    ls.save(tmp_path / "a.glb", capture(2000))
    document, rest = chunks((tmp_path / "a.glb").read_bytes())
    (tmp_path / "a.bin").write_bytes(rest[8:])
    document["buffers"][0]["uri"] = "a.bin"
    document["nodes"][0] = {"mesh": 0, "scale": [1, 2, 1]}
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    assert isinstance(ls.load(tmp_path / "a.gltf"), ls.Gaussians)


def test_impossible_gltf_accessor_counts_allocate_no_memory(tmp_path: Path, whole: bytes) -> None:
    """A billion rows, with or without a buffer view, are refused before any allocation."""
    count = len(chunks(whole)[0]["accessors"])
    for index in (*range(0, count, 3), count - 1):
        for with_view in (True, False):
            document, rest = chunks(whole)
            document["accessors"][index]["count"] = 10**9
            if not with_view:
                del document["accessors"][index]["bufferView"]
            tracemalloc.start()
            try:
                assert not survives(tmp_path / "mutated.glb", packed(document, rest))
                assert tracemalloc.get_traced_memory()[1] < MEMORY_MAX
            finally:
                tracemalloc.stop()
