"""The script of folders for Blender: its arithmetic here, and all of it in Blender, where that is at hand as a module.

``pip install bpy`` into a Python of its own, which LUMISPLAT_BPY names, else ~/.cache/lumisplat/bpy/bin/python.
"""

from __future__ import annotations

import json
import math
import os
import runpy
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

import lumisplat as ls
from lumisplat.math.color import decode_srgb
from lumisplat.scene.gaussians import Gaussians
from support.files.splat_files import capture

BPY = Path(os.environ.get("LUMISPLAT_BPY") or Path.home() / ".cache" / "lumisplat" / "bpy" / "bin" / "python")

LOOK = """
import json, runpy, sys, bpy
script, picture = sys.argv[1:]
runpy.run_path(script, run_name="__main__")
scene = bpy.context.scene
things = {item.name: item for item in scene.objects}
lamps = {name: item.data for name, item in things.items() if item.type == "LIGHT"}
geometry = things["blob"].evaluated_get(bpy.context.evaluated_depsgraph_get()).evaluated_geometry()
scene.cycles.device, scene.cycles.samples = "CPU", 16
scene.cycles.use_denoising = False
scene.render.filepath = picture
bpy.ops.render.render(write_still=True)
print("found" + json.dumps({
    "scene": scene.name,
    "others": sorted(item.name for item in bpy.data.objects if item.name not in things),
    "things": sorted(things),
    "camera": scene.camera.name,
    "size": [scene.render.resolution_x, scene.render.resolution_y],
    "aperture": scene.camera.data.lens / 2000.0 / scene.camera.data.dof.aperture_fstop,
    "radius": {name: lamp.shadow_soft_size for name, lamp in lamps.items() if lamp.type != "SUN"},
    "angle": lamps["sun"].angle,
    "shadows": {name: lamp.use_shadow for name, lamp in lamps.items()},
    "where": list(things["blob"].data.vertices[0].co),
    "points": len(geometry.pointcloud.points),
    "ball": geometry.pointcloud.attributes["radius"].data[0].value,
    "materials": [material.name for material in geometry.pointcloud.materials],
}))
"""


class Item(dict[str, Any]):
    """A lamp, a camera or a mesh of Blender: attributes, and a dictionary of what other programs say of it."""

    def __init__(self, own: dict[str, Any] | None = None, **fields: Any) -> None:
        super().__init__({"lumisplat": own} if own else {})
        self.__dict__.update(fields)


class Attributes(dict[str, Any]):
    """Attributes of a mesh, by name."""

    def new(self, name: str, kind: str, domain: str) -> Any:
        """Adds one that keeps what it is given."""
        assert domain == "POINT"
        size = {"FLOAT": 1, "FLOAT_COLOR": 4}[kind]

        def foreach_set(field: str, values: Any) -> None:
            assert field == {1: "value", 4: "color"}[size]
            self[name] = values.reshape(-1, size)

        return SimpleNamespace(data=SimpleNamespace(foreach_set=foreach_set))


@pytest.fixture
def functions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Callable[..., Any]]:
    """The functions of a script, which is not run."""
    ls.save(tmp_path / "a.blend-ready", ls.Scene(splats=[ls.SplatInstance(capture(3))]))
    monkeypatch.setitem(sys.modules, "bpy", SimpleNamespace())
    return runpy.run_path(str(tmp_path / "a.blend-ready" / "import_into_blender.py"))


def test_points_have_colours_and_sizes(functions: dict[str, Callable[..., Any]]) -> None:
    """Linear colours of the constant harmonic, opacities, and balls that cover 2 pi a b, whichever axis is shortest."""
    given = capture(40, 0)
    shown = np.maximum(0.5 + given.sh[:, 0].astype(float) / math.sqrt(4.0 * math.pi), 0.0)
    logit = np.log(given.opacities / (1.0 - given.opacities))
    columns = {"opacity": logit, **{f"f_dc_{i}": given.sh[:, 0, i] for i in range(3)}}
    columns |= {f"scale_{i}": np.log(given.scales[:, i]) for i in range(3)}

    def attribute(values: Any) -> Any:
        return SimpleNamespace(data=SimpleNamespace(foreach_get=lambda _, out: np.copyto(out, values)))

    attributes = Attributes({name: attribute(values) for name, values in columns.items()})
    mesh = Item(vertices=range(given.count), attributes=attributes, color_attributes=SimpleNamespace())
    functions["add_looks"](mesh)
    np.testing.assert_allclose(attributes["Color"][:, :3], decode_srgb(shown), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(attributes["Color"][:, 3], given.opacities, rtol=1e-5)
    products = np.stack([given.scales[:, i] * given.scales[:, j] for i, j in ((0, 1), (0, 2), (1, 2))])
    np.testing.assert_allclose(attributes["radius"][:, 0] ** 2, 2.0 * products.max(axis=0), rtol=1e-5)


def test_cones_hold_as_much_light(functions: dict[str, Callable[..., Any]]) -> None:
    """The share of the sphere that a spot lights, by the window of glTF and by the smooth one of Cycles."""
    inner, outer = 0.2, 0.5
    lamp = Item(type="SPOT", spot_size=2.0 * outer, spot_blend=1.0 - inner / outer)  # as Blender's reader has it
    functions["set_lamp"](lamp)
    spot: Any = lamp
    cosine = np.linspace(0.5, 1.0, 200_001)
    ours = np.clip((cosine - math.cos(outer)) / (math.cos(inner) - math.cos(outer)), 0.0, 1.0) ** 2
    edge = math.cos(spot.spot_size / 2.0)
    there = np.clip((cosine - edge) / ((1.0 - edge) * spot.spot_blend), 0.0, 1.0)
    there = there**2 * (3.0 - 2.0 * there)
    assert there.mean() == pytest.approx(ours.mean(), rel=1e-4)
    assert np.abs(there - ours).max() < 0.2
    assert (there == 1.0).sum() == pytest.approx((ours == 1.0).sum(), rel=1e-3)


def test_lamps_and_pictures_without_our_word(functions: dict[str, Callable[..., Any]]) -> None:
    """What the file does not say is what it is by default, whatever Blender takes."""
    lamp: Any = Item(type="POINT", shadow_soft_size=0.1)
    functions["set_lamp"](lamp)
    assert (lamp.shadow_soft_size, lamp.use_shadow) == (0.0, True)
    render = SimpleNamespace(resolution_x=1920, resolution_y=1080, resolution_percentage=50)
    scene = SimpleNamespace(render=render, view_settings=SimpleNamespace(exposure=1.0))
    functions["set_picture"](scene, Item())
    assert (render.resolution_x, render.resolution_y, render.resolution_percentage) == (1920, 1080, 100)
    assert scene.view_settings.exposure == 0.0


PLACES = {"capture": (-1.0, 0.5), "quad": (1.5, -0.5), "behind": (0.2, -0.9)}
"""Where the frame below is looked at, scene units right of the middle and above it."""
SHOWN = np.array([0.8, 0.4, 0.2])
"""The colour of the capture below, as displays show it."""


def lit_scene() -> tuple[ls.Scene, list[ls.Camera]]:
    """A capture of one Gaussian, a grey quad in the sun, lamps too far away to matter, two cameras."""
    blob = Gaussians(
        np.array([[-1.0, 0.5, 0.0]]),
        np.array([[1.0, 0.0, 0.0, 0.0]]),
        np.array([[0.3, 0.3, 0.1]]),
        np.array([0.9999]),
        ((SHOWN - 0.5) * math.sqrt(4.0 * math.pi))[None, None],
    )
    matte = ls.MaterialPbr(base_color=(0.5, 0.5, 0.5), roughness=1.0, metallic=0.0, specular=0.0)
    corners = np.array([[0.5, -1.0, 0.0], [2.0, -1.0, 0.0], [2.0, 1.0, 0.0], [0.5, 1.0, 0.0]])
    quad = ls.Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), material=matte)
    lights = (
        ls.LightDirectional((0.0, 0.0, -1.0), intensity=1.5, angle=0.02, name="sun"),
        ls.LightPoint((0.0, 90.0, -90.0), intensity=0.1, radius=0.25, name="lamp"),
        ls.LightSpot((0.0, 90.0, -90.0), (0.0, 0.0, -1.0), intensity=0.1, casts_shadow=False, name="spot"),
    )
    camera = ls.Camera.look_at((0, 0, 5), (0, 0, 0), width=64, height=48, name="b", aperture=1e-4)
    cameras = [replace(camera, exposure=0.5), replace(camera, width=32, cx=16.0, name="a")]
    return ls.Scene([ls.SplatInstance(blob, name="blob")], [ls.MeshInstance(quad, name="quad")], lights), cameras


def test_in_blender(tmp_path: Path) -> None:
    """Its own scene without the start file's things; sizes, lamps, camera and points; colours of a frame as here."""
    if not BPY.is_file():
        pytest.skip(f"no Blender as a module: no {BPY} (set LUMISPLAT_BPY, or pip install bpy there)")
    scene, cameras = lit_scene()
    folder, picture = tmp_path / "room.blend-ready", tmp_path / "frame.png"
    ls.save(folder, replace(scene, up="y-up"), cameras=cameras)
    command = [str(BPY), "-c", LOOK, str(folder / "import_into_blender.py"), str(picture)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.partition("found")[2].splitlines()[0])
    assert found["scene"] == "room" and found["others"] == ["Camera", "Cube", "Light"]  # in their own scene
    assert found["things"] == ["a", "b", "blob", "lamp", "quad", "spot", "sun"]
    assert found["camera"] == "b" and found["size"] == [64, 48]
    assert found["aperture"] == pytest.approx(1e-4, rel=1e-5)
    assert found["radius"] == pytest.approx({"lamp": 0.25, "spot": 0.0}) and found["angle"] == pytest.approx(0.04)
    assert found["shadows"] == {"sun": True, "lamp": True, "spot": False}
    assert found["where"] == pytest.approx([-1.0, 0.0, 0.5])  # z up
    assert found["points"] == 1 and found["materials"] == ["Capture"]
    assert found["ball"] == pytest.approx(0.3 * math.sqrt(2.0))
    light = decode_srgb(np.asarray(Image.open(picture).convert("RGB"), np.float64) / 255.0) / 2.0**0.5
    unit = 48 / (2.0 * 5.0 * math.tan(0.4))  # pixels
    at = {name: light[int(24 - y * unit), int(32 + x * unit)] for name, (x, y) in PLACES.items()}
    np.testing.assert_allclose(at["capture"], decode_srgb(SHOWN), rtol=0.03)
    np.testing.assert_allclose(at["quad"], 0.5 * 1.5 / math.pi, rtol=0.03)
    assert at["behind"].max() == 0.0  # no grey sky
