"""Damaged scene files, glTF files with lights and environment maps load, or give a one-line error."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from support.files.hdr_files import hdr_bytes
from support.files.mesh_files import Gltf, quad_gltf
from support.files.scene_files import write_scene

OURS = ("object at", "has no attribute", "unexpected keyword", "positional argument", "not subscriptable", "NoneType")
"""Texts of errors about Lumisplat's code instead of the file."""


def survives(load: Callable[[], object]) -> bool:
    """Loads a file, or checks that the error is one line. Warnings are errors here, as in all tests."""
    try:
        load()
    except ls.FormatError as error:
        assert "\n" not in str(error)
        assert not [words for words in OURS if words in str(error)]
        return False
    return True


@pytest.mark.parametrize("encoding", ["flat", "old", "new"])
def test_damaged_hdr_environments_either_load_or_are_refused_with_a_one_line_error(
    tmp_path: Path, encoding: str
) -> None:
    """Bytes are changed anywhere, or the file is truncated."""
    rng = random.Random(1)
    pixels = np.repeat(np.random.default_rng(0).integers(2, 256, (4, 10, 4)), 4, axis=1).astype(np.uint8)
    data, path = hdr_bytes(pixels, encoding), tmp_path / "a.hdr"
    loaded = 0
    for _ in range(150):
        damaged = bytearray(data)
        for _ in range(rng.randint(1, 4)):
            damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        path.write_bytes(damaged[: rng.choice([len(data), rng.randrange(1, len(data))])])
        loaded += survives(lambda: ls.io.load_radiance(path))
    assert 0 < loaded < 150


JUNK: list[Any] = [None, -1, 0, 1e300, float("nan"), "x", [], {}, True, [1, 2, 3], {"a": 1}, 10**12, 3.5]


def point_light_gltf() -> Gltf:
    """Returns a glTF document that uses many features."""
    gltf = quad_gltf()
    spot = {"type": "spot", "color": [1, 1, 1], "range": 4.0, "spot": {"innerConeAngle": 0.1, "outerConeAngle": 0.3}}
    gltf.json["extensions"] = {"KHR_lights_punctual": {"lights": [spot, {"type": "directional"}]}}
    for which in (0, 1):
        gltf.add("nodes", extensions={"KHR_lights_punctual": {"light": which}}, translation=[1, 2, 3], scale=[1, 1, 1])
    gltf.add("cameras", type="perspective", perspective={"yfov": 0.8, "znear": 0.1, "aspectRatio": 1.5})
    gltf.add("cameras", type="orthographic", orthographic={"xmag": 1.0, "ymag": 1.0, "znear": 0.1, "zfar": 9.0})
    gltf.add("nodes", camera=0, children=[1, 2])
    gltf.add("nodes", camera=1, rotation=[0, 0, 0, 1])
    gltf.json["materials"][0] |= {
        "normalTexture": {"index": 0, "scale": 0.5, "extensions": {"KHR_texture_transform": {"offset": [0, 0]}}},
        "emissiveFactor": [1, 1, 1],
        "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 3.0}},
    }
    return gltf


def spoil(document: Any, rng: random.Random) -> None:
    """Replaces or removes one value anywhere in a JSON document."""
    entries: list[tuple[Any, Any]] = []
    pending = [document]
    while pending:
        here = pending.pop()
        keys = here if isinstance(here, dict) else range(len(here))
        entries += [(here, key) for key in keys]
        pending += [here[key] for key in keys if isinstance(here[key], dict | list)]
    here, key = rng.choice(entries)
    if isinstance(here, dict) and rng.random() < 0.2:
        del here[key]
    else:
        here[key] = rng.choice(JUNK)


@pytest.mark.parametrize("files", [80, pytest.param(250, marks=pytest.mark.deep)])
def test_gltf_with_random_json_values_either_loads_or_is_refused_with_a_one_line_error(
    tmp_path: Path, files: int
) -> None:
    """A value of any kind replaces a random value."""
    rng, path, loaded = random.Random(2), tmp_path / "a.gltf", 0
    for _ in range(files):
        gltf = point_light_gltf()
        gltf.gltf()
        spoil(gltf.json, rng)
        data = gltf.gltf() if rng.random() < 0.9 else gltf.gltf("lost.bin")
        path.write_bytes(data)
        loaded += survives(lambda: ls.load(path)) + survives(lambda: ls.load_cameras(path))
    assert 0 < loaded < 2 * files


SCENE = """
[[meshes]]
path = "mesh.obj"
material = "dull"
position = [0, 0, 1]
rotation_wxyz = [1, 0, 0, 0]
scale = 2
[materials.dull]
type = "simple"
diffuse = 0.5
[[lights]]
type = "spot"
position = [0, 0, 0]
direction = [0, 0, 1]
range = 3
outer_angle_degrees = 30
[[lights]]
type = "rect"
position = [0, 0, 0]
edge_u = [1, 0, 0]
edge_v = [0, 1, 0]
[[lights]]
type = "disk"
position = [0, 0, 0]
direction = [0, 1, 0]
radius = 0.5
[environment]
color = [1, 1, 1]
rotation_wxyz = [1, 0, 0, 0]
[[cameras]]
eye = [0, 0, 2]
target = [0, 0, 4]
up = [0, -1, 0]
width = 24
fov_y_degrees = 30
exposure = 1
[render]
samples = 2
background = "none"
aovs = ["hits"]
[render.shadow_rays]
offset = 3
"""

VALUES = "1 -1 0 nan inf -inf true 'x' [] [1,2,3] [1,2,3,4] [nan,0,0] {} {a=1} 1979-05-27 1e308 'mesh.obj' [[1]] ''"
VALUES += " 9223372036854775807 [1e308,0,0] [1e39,1,1] 1e-320 [0,0,0] [0,0,0,0] ['x','y','z']"
HEADINGS = ["x = 1", "[a]", "[[lights]]", "[[cameras]]", '"a.b" = 1', "[render.trace]", "[materials]"]


def test_damaged_scene_files_either_load_or_are_refused_with_a_one_line_error(tmp_path: Path) -> None:
    """Keys have values of any kind, and headings are misplaced."""
    rng, loaded = random.Random(3), 0
    (tmp_path / "mesh.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    for _ in range(400):
        lines: list[str] = [*SCENE.splitlines()]
        for _ in range(rng.randint(1, 2)):
            at = rng.randrange(len(lines))
            key, equals, _ = lines[at].partition("=")
            lines[at] = f"{key}= {rng.choice(VALUES.split())}" if equals else rng.choice([lines[at], *HEADINGS])
        path = write_scene(tmp_path, "\n".join(lines))
        for load in (ls.load, ls.load_cameras, ls.load_config):
            loaded += survives(lambda load=load, path=path: load(path))
    assert 0 < loaded < 1200
