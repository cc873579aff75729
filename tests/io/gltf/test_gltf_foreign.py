"""Exchange of glTF files with other programs, if Node and its packages are installed.

Node and the packages are searched in ~/.cache/lumisplat/node, or in the folder in LUMISPLAT_NODE:
``npm install --prefix ~/.cache/lumisplat/node gltf-validator @playcanvas/splat-transform@2.7.1 three``.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.math.transforms import matrices_from_quaternions
from support.files.mesh_files import QUAD, QUAD_TRIANGLES, QUAD_UVS
from support.files.splat_files import capture, load_gaussians
from support.kinds import expect_kind

NODE = shutil.which("node")
FOLDER = Path(os.environ.get("LUMISPLAT_NODE") or Path.home() / ".cache" / "lumisplat" / "node")

VALIDATE = """
import fs from "fs";
import validator from "gltf-validator";
const report = await validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2])), {maxIssues: 1000});
console.log(JSON.stringify(report.issues.messages));
"""

READ_BY_THREE = """
import fs from "fs";
globalThis.self = globalThis;
const {Vector3} = await import("three");
const {GLTFLoader} = await import("three/addons/loaders/GLTFLoader.js");
const {GLTFGaussianSplatLoaderExtension} = await import("three/addons/loaders/GLTFGaussianSplatLoaderExtension.js");
const loader = new GLTFLoader();
loader.register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
const data = fs.readFileSync(process.argv[2]);
const buffer = data.buffer.slice(data.byteOffset, data.byteOffset + data.byteLength);
const gltf = await new Promise((resolve, reject) => loader.parse(buffer, "", resolve, reject));
gltf.scene.updateMatrixWorld(true);
const objects = [];
gltf.scene.traverse((object) => {
  const position = new Vector3().setFromMatrixPosition(object.matrixWorld).toArray();
  const item = {type: object.type, name: object.name, position};
  if (object.isLight) Object.assign(item, {intensity: object.intensity, color: object.color.toArray()});
  if (object.isCamera) Object.assign(item, {fov: object.fov, aspect: object.aspect, near: object.near});
  objects.push(item);
});
const splats = [];
for (const index of [0]) {
  const geometries = await gltf.parser.loadGeometries(gltf.parser.json.meshes[index].primitives);
  for (const [name, attribute] of Object.entries(geometries[0].attributes)) {
    splats.push([name, Array.from({length: attribute.count}, (_, i) =>
      Array.from({length: attribute.itemSize}, (_, k) => attribute.getComponent(i, k)))]);
  }
}
console.log(JSON.stringify({objects, splats: Object.fromEntries(splats)}));
"""


def needed(package: str) -> None:
    """Skips a test if an npm package is missing."""
    if NODE is None:
        pytest.skip("no node")
    if not (FOLDER / "node_modules" / package).is_dir():
        pytest.skip(f"no {package} in {FOLDER} (set LUMISPLAT_NODE, or npm install it there)")


def node(*args: str | Path) -> str:
    """Returns the output of a node command."""
    done = subprocess.run(
        [str(NODE), *map(str, args)], cwd=FOLDER, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def script(folder: Path, text: str, file: Path) -> Any:
    """Returns the JSON output of a JavaScript module for a file."""
    (folder / "node_modules").symlink_to(FOLDER / "node_modules")
    (folder / "script.mjs").write_text(text)
    return json.loads(node(folder / "script.mjs", file))


def whole_scene() -> tuple[ls.Scene, ls.Camera]:
    """Returns a scene with every written feature: material extensions, a mirrored mesh, all lights and captures."""
    texture = np.random.default_rng(0).integers(0, 256, (4, 4, 4)).astype(np.uint8)
    materials = [
        ls.MaterialPbr(
            base_color_texture=texture, normal_texture=texture, occlusion_texture=texture, alpha_mode=ls.AlphaMode.MASK
        ),
        ls.MaterialPbr(transmission=1.0, attenuation_color=(0.5, 1, 1), attenuation_distance=2.0, ior=1.33),
        ls.MaterialPbr(clearcoat=1.0, sheen_color=(1, 0.5, 0), emissive=(5.0, 1.0, 0.0), specular=0.5),
        ls.MaterialSimple(name="sign"),
        ls.MaterialSimple(diffuse=(0.5, 0.5, 0.5), specular=(0.5, 0.5, 0.5), emissive=(3.0, 0.0, 0.0)),
    ]
    normals = np.tile([0.0, 0.0, 1.0], (4, 1))
    meshes = [
        ls.MeshInstance(
            ls.Mesh(QUAD, QUAD_TRIANGLES, normals, QUAD_UVS, one, np.ones((4, 3))), np.diag([1, -2, 3, 1.0])
        )
        for one in materials
    ]
    materials_of_capture = {"albedo": np.full((9, 3), 0.5), "roughness": np.full(9, 0.5), "normals": np.ones((9, 3))}
    rotated = ls.SplatInstance(capture(9, 3, **materials_of_capture), position=(1, 2, 3), rotation_degrees=(10, 20, 30))
    lights = [
        ls.LightPoint((1, 2, 3), (0.25, 0.5, 1.0), 5.0, range=8.0, name="bulb"),
        ls.LightSpot((0, 5, 0), (0, -0.8, 0.6), outer_angle=np.pi / 2.0),
        ls.LightDirectional((0, -1, 0)),
    ]
    camera = ls.Camera.look_at((0, 1, 6), (0, 0, 0), width=320, height=200, fov_y=0.7, name="front")
    return ls.Scene(splats=[rotated], meshes=meshes, lights=lights, up="y-up"), camera


@pytest.mark.parametrize("extension", ["glb", "gltf"])
def test_khronos_validator_accepts_written_gltf_files(tmp_path: Path, extension: str) -> None:
    """The validator reports one error, which every file with Gaussians gets.

    Its latest release, 2.0.0-dev.3.10, predates the extension and rejects attribute names with a colon. It warns about
    normal maps without tangents, which glTF allows and readers compute.
    """
    needed("gltf-validator")
    scene, camera = whole_scene()
    path = tmp_path / f"whole.{extension}"
    ls.save(path, scene, cameras=[camera])
    found = script(tmp_path, VALIDATE, path)
    serious = [one for one in found if one["severity"] < 2]
    colons = [one for one in serious if one["pointer"].rpartition("/")[2].startswith("KHR_gaussian_splatting:")]
    assert {one["code"] for one in colons} <= {"MESH_PRIMITIVE_INVALID_ATTRIBUTE"}
    rest = [one for one in serious if one not in colons]
    assert {(one["severity"], one["code"]) for one in rest} <= {(1, "MESH_PRIMITIVE_GENERATED_TANGENT_SPACE")}


def test_gltf_files_of_splat_transform_are_read_as_the_source_ply(tmp_path: Path) -> None:
    """splat-transform rotates a PLY by a half turn about z, Lumisplat about x.

    The results differ by a half turn about y.
    """
    needed("@playcanvas/splat-transform")
    given = capture(50, 3)
    ls.save(tmp_path / "a.ply", given)
    command = FOLDER / "node_modules" / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"
    node(command, tmp_path / "a.ply", tmp_path / "a.glb")
    read = load_gaussians(tmp_path / "a.glb")
    rotated = ls.transform(read, rotation_degrees=(0, 180, 0))
    order = np.argsort(rotated.means[:, 0])[
        np.argsort(np.argsort(given.means[:, 0]))
    ]  # splat-transform may reorder the Gaussians
    rotated = rotated.subset(order)
    np.testing.assert_allclose(rotated.means, given.means, rtol=0, atol=1e-5)
    np.testing.assert_allclose(rotated.scales, given.scales, rtol=1e-4)
    np.testing.assert_allclose(rotated.opacities, given.opacities, rtol=0, atol=1e-5)
    np.testing.assert_allclose(rotated.sh, given.sh, rtol=0, atol=1e-5)
    # The axes of an ellipsoid may have the opposite sign.
    axes = [matrices_from_quaternions(one.rotations_wxyz) for one in (rotated, given)]
    np.testing.assert_allclose(np.abs(np.einsum("nji,njk->nik", *axes)), np.tile(np.eye(3), (50, 1, 1)), atol=1e-4)


def test_three_js_reads_written_gltf_scenes(tmp_path: Path) -> None:
    """Objects have the written transforms, lights the written intensities, and Gaussians identical numbers."""
    needed("three")
    scene, camera = whole_scene()
    plain = [
        ls.MeshInstance(ls.Mesh(QUAD, QUAD_TRIANGLES), position=(4, 5, 6), name="quad")
    ]  # Node cannot decode images
    given = ls.Scene(splats=scene.splats, meshes=plain, lights=scene.lights, up="y-up")
    ls.save(tmp_path / "scene.glb", given, cameras=[camera])
    found = script(tmp_path, READ_BY_THREE, tmp_path / "scene.glb")
    objects = {item["type"]: item for item in found["objects"]}
    np.testing.assert_allclose(objects["GaussianSplat"]["position"], (1, 2, 3), atol=1e-6)
    np.testing.assert_allclose(objects["Mesh"]["position"], (4, 5, 6), atol=1e-6)
    np.testing.assert_allclose(objects["PointLight"]["position"], (1, 2, 3), atol=1e-6)
    assert (objects["PointLight"]["intensity"], objects["PointLight"]["color"]) == (5, [0.25, 0.5, 1])
    found_camera = objects["PerspectiveCamera"]
    np.testing.assert_allclose(found_camera["position"], (0, 1, 6), atol=1e-6)
    np.testing.assert_allclose([found_camera["fov"], found_camera["aspect"]], [np.degrees(0.7), 1.6], rtol=1e-6)
    read = expect_kind(ls.Scene, ls.load(tmp_path / "scene.glb")).splats[0].gaussians
    names = {name.lower(): np.array(values) for name, values in found["splats"].items()}
    np.testing.assert_array_equal(names["position"], read.means * np.array([1, -1, -1], np.float32))
    np.testing.assert_array_equal(names["khr_gaussian_splatting:scale"], read.scales)
    np.testing.assert_array_equal(names["khr_gaussian_splatting:opacity"][:, 0], read.opacities)
    np.testing.assert_array_equal(names["khr_gaussian_splatting:sh_degree_0_coef_0"], read.sh[:, 0])
