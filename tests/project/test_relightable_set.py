"""Sets of tools/make_relightable_set.py match the path tracer of Lumisplat on the same meshes."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.io.images.exr import read_exr, write_exr
from lumisplat.math.directions import panorama_directions
from support.oracles import bsdf_oracle as oracle

ROOT = Path(__file__).resolve().parents[2]
LIT_IN = {"environment": "test", "relit/sunny": "relit/sunny", "relit/studio": "relit/studio"}
"""Folder of the images lit by each environment."""
SIZE = 32


@pytest.fixture(scope="module")
def tool(monkeypatch_module: pytest.MonkeyPatch) -> ModuleType:
    """Returns the generator as a module."""
    monkeypatch_module.syspath_prepend(str(ROOT / "tools"))
    return importlib.import_module("make_relightable_set")


@pytest.fixture(scope="module")
def monkeypatch_module():
    """Yields a monkeypatch that is undone after this file."""
    with pytest.MonkeyPatch.context() as patch:
        yield patch


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Makes a set of a mesh, once."""
    if importlib.util.find_spec("mitsuba") is None:
        pytest.skip("needs Mitsuba")
    folder = tmp_path_factory.mktemp("sets")

    def make(mesh: Path, *options: str) -> Path:
        out = folder / f"{mesh.stem}{''.join(options)}"
        if not out.exists():
            write_exr(folder / "sky.exr", dict(zip("RGB", np.moveaxis(sky(), -1, 0), strict=True)))
            sizes = ("--views", "2", "--held-out", "2", "--size", str(SIZE), "--samples", "1024", *options)
            command = [sys.executable, ROOT / "tools" / "make_relightable_set.py", mesh, folder / "sky.exr", out]
            done = subprocess.run([*map(str, command), *sizes], capture_output=True, text=True, check=False)
            if "LLVM" in done.stderr and done.returncode:
                pytest.skip("needs a libLLVM that Mitsuba accepts")
            assert done.returncode == 0, done.stderr
        return out

    return make


def sky() -> np.ndarray:
    """Returns an environment that differs on all sides."""
    x, y, z = np.moveaxis(panorama_directions(32, 64), -1, 0)
    return np.stack([0.6 + 0.5 * x, 0.5 + 0.4 * y, 0.5 + 0.45 * z], axis=-1) ** 2


@pytest.fixture(scope="module")
def balls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns three balls that shadow each other, different from every side."""
    import trimesh

    parts = [trimesh.creation.icosphere(3, radius) for radius in (0.8, 0.5, 0.3)]
    for part, position in zip(parts, [(0.0, 0.0, 0.0), (0.9, 0.6, 0.2), (-0.2, 0.9, 0.7)], strict=True):
        part.apply_translation(position)
    path = tmp_path_factory.mktemp("meshes") / "balls.obj"
    trimesh.util.concatenate(parts).export(path)
    return path


def seen(tool: ModuleType, folder: Path, mesh: Path, environment: str | None) -> list[ls.Frame]:
    """Renders the meshes of a Lambertian set with Lumisplat's path tracer in an environment; None for any light."""
    meshes: list[ls.MeshInstance] = []
    for instance in tool.scene_of(mesh).meshes:
        material: Any = replace(instance.mesh.material, specular=0.0, metallic=0.0, base_color=(1.0, 1.0, 1.0))
        meshes.append(ls.MeshInstance(replace(instance.mesh, material=material), instance.world_from_object))
    image = None if environment is None else ls.io.load_radiance(folder / f"{environment}.exr")
    scene = ls.Scene(meshes=meshes, lights=[ls.LightEnvironment(image, visible=False)])
    config = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=256, max_bounces=4, background=None, aovs=("albedo",))
    renderer = ls.create_renderer(config, "cpu")
    return [renderer.render(scene, camera) for camera in ls.load_cameras(folder / "transforms_test.json")]


def layer(folder: Path, name: str, index: int, channels: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns the values of a layer, and the pixels that the object fills."""
    stored = read_exr(folder / "truth" / name / f"r_{index:03}.exr")
    return np.stack([stored[channel] for channel in channels], axis=-1), stored["A"] > 0.999


def test_relightable_data_set_holds_out_test_views_between_training_views(tool: ModuleType, balls: Path) -> None:
    """The requested number is held out, none at the ends; all cameras are at one distance and see the whole object."""
    scene = tool.scene_of(balls)
    views = tool.views_around(scene, SIZE, 12, 4)
    assert [name.startswith("test") for name in views] == 4 * [False, False, True, False]
    assert list(views)[:3] == ["train/r_000", "train/r_001", "test/r_000"]
    low, high = tool.bounds(scene)
    away = [np.linalg.norm(camera.eye - 0.5 * (low + high)) for camera in views.values()]
    np.testing.assert_allclose(away, away[0])


def test_large_panoramas_of_relightable_data_sets_are_downscaled_by_means_of_blocks(tool: ModuleType) -> None:
    """Small panoramas are unchanged."""
    image = np.random.default_rng(0).random((600, 1200, 3))
    smaller = tool.reduced(image)
    assert smaller.shape == (200, 400, 3)
    np.testing.assert_allclose(smaller[7, 9], image[21:24, 27:30].mean(axis=(0, 1)))
    np.testing.assert_array_equal(tool.reduced(image[:250]), image[:250])


@pytest.mark.deep
@pytest.mark.parametrize("environment", LIT_IN)
def test_mitsubas_images_of_the_relightable_data_set_match_lumisplats_path_tracer(
    tool, made, balls, environment: str
) -> None:
    """More than 38 dB, which checks light axes, exposure, bounces and encoding; less than 30 dB rotated or mirrored."""
    folder = made(balls)
    insides = [layer(folder, "albedo", index, "RGB")[1] for index in range(2)]
    images = [ls.load_image(folder / LIT_IN[environment] / f"r_{index:03}.png") for index in range(2)]
    frames = seen(tool, folder, balls, environment)
    for frame, rendered_image, inside in zip(frames, images, insides, strict=True):
        assert ls.metrics.psnr(frame.pixels_srgb()[..., :3], rendered_image, region=inside) > 38.0
    image = ls.io.load_radiance(folder / f"{environment}.exr")
    for wrong in (image[:, ::-1], np.roll(image, image.shape[1] // 2, axis=1), 1.15 * image):
        write_exr(folder / "wrong.exr", {name: wrong[..., i] for i, name in enumerate("RGB")})
        rendered = seen(tool, folder, balls, "wrong")[1].pixels_srgb()[..., :3]
        assert ls.metrics.psnr(rendered, images[1], region=insides[1]) < 32.0


@pytest.mark.deep
def test_material_layers_of_the_relightable_data_set_match_its_mesh(tool, made, balls) -> None:
    """Layers are base colour, world normals and coverage."""
    folder = made(balls)
    for index, frame in enumerate(seen(tool, folder, balls, None)):
        assert frame.albedo is not None
        albedo, inside = layer(folder, "albedo", index, "RGB")
        assert ls.metrics.psnr(np.clip(frame.albedo, 0.0, 1.0), albedo, region=inside) > 45.0
        normal, inside = layer(folder, "normal", index, "XYZ")
        np.testing.assert_allclose(np.linalg.norm(normal[inside], axis=-1), 1.0, atol=1e-5)
        cosine = np.sum(normal[inside] * frame.normal[inside], axis=-1)
        assert np.median(np.degrees(np.arccos(np.minimum(cosine, 1.0)))) < 0.5
        alpha = read_exr(folder / "truth" / "normal" / f"r_{index:03}.exr")["A"]
        np.testing.assert_allclose(frame.alpha, alpha, atol=0.25)
        assert abs(frame.alpha.mean() - alpha.mean()) < 2e-3
    assert not (folder / "truth" / "roughness").exists()
    assert json.loads((folder / "set.json").read_text())["specular"] == 0.0


@pytest.mark.deep
def test_roughness_in_the_relightable_data_set_is_interpolated_between_vertices(tool, made, balls) -> None:
    """Roughness varies over a triangle between its vertices; a glossy set has highlights."""
    folder, matt = made(balls, "--material", "varied"), made(balls)
    scene = tool.scene_of(balls)
    for index, frame in enumerate(seen(tool, folder, balls, None)):
        roughness, inside = layer(folder, "roughness", index, "Y")
        points = ls.Mesh(frame.position[inside], [[0, 1, 2]], frame.normal[inside])
        expected = tool.roughness_of(ls.MeshInstance(points), scene)
        assert (
            np.median(np.abs(roughness[inside][:, 0] - expected)) < 0.005
        )  # the layer is a mean over the pixel, the expected value at its centre
        assert np.ptp(roughness[inside]) > 0.3
        pair = [ls.load_image(one / "relit" / "studio" / f"r_{index:03}.png") for one in (folder, matt)]
        assert ls.metrics.psnr(*pair, region=inside) < 35.0
    assert json.loads((folder / "set.json").read_text())["specular"] == 1.0


@pytest.mark.deep
@pytest.mark.parametrize("roughness", [0.2, 0.8])
@pytest.mark.parametrize("degrees", [10.0, 75.0])
def test_dielectric_material_made_for_mitsuba_matches_the_gltf_specification(
    tool: ModuleType, roughness: float, degrees: float
) -> None:
    """Importance sampling estimates the same reflectance."""
    if importlib.util.find_spec("mitsuba") is None:
        pytest.skip("needs Mitsuba")
    try:
        mi = tool.load_mitsuba()
    except ImportError:
        pytest.skip("needs a libLLVM that Mitsuba accepts")
    tool.mitsuba_gltf.register(mi)
    base = np.array([0.8, 0.5, 0.2])
    bsdf = mi.load_dict(
        {
            "type": "gltf_dielectric",
            "base_color": {"type": "rgb", "value": base.tolist()},
            "roughness": {"type": "uniform", "value": roughness},
        }
    )
    count = 1 << 18
    numbers = np.random.default_rng(4).random((5, count)).astype(np.float32)
    height, azimuth = numbers[0], 2.0 * np.pi * numbers[1]
    out = np.stack(
        [np.sqrt(1.0 - height**2) * np.cos(azimuth), np.sqrt(1.0 - height**2) * np.sin(azimuth), height], axis=1
    )
    view, up = np.array([np.sin(np.radians(degrees)), 0.0, np.cos(np.radians(degrees))]), np.array([0.0, 0.0, 1.0])
    interaction = mi.SurfaceInteraction3f()
    interaction.wi = mi.Vector3f(*map(float, view))
    seen_along = mi.Vector3f(*(mi.Float(column) for column in out.astype(np.float32).T.copy()))
    value = np.array(bsdf.eval(mi.BSDFContext(), interaction, seen_along, mi.Bool(True))).T
    half = (view + out) / np.linalg.norm(view + out, axis=1, keepdims=True)
    mirrored = oracle.schlick([0.04], 1.0, np.sum(view * half, axis=1))
    alpha = roughness**2
    facets = oracle.ggx(oracle.angle(up, half), alpha) * oracle.smith(oracle.angle(up, view), alpha)
    facets *= oracle.smith(oracle.angle(up, out), alpha) / (4.0 * view[2] * height)
    expected = height[:, None] * ((1.0 - mirrored) * base / np.pi + mirrored * facets[:, None])
    np.testing.assert_allclose(value, expected, rtol=2e-3, atol=1e-5)
    chance = mi.Point2f(mi.Float(numbers[3]), mi.Float(numbers[4]))
    _, weight = bsdf.sample(mi.BSDFContext(), interaction, mi.Float(numbers[2]), chance, mi.Bool(True))
    np.testing.assert_allclose(np.array(weight).mean(axis=1), 2.0 * np.pi * expected.mean(axis=0), rtol=0.02)


@pytest.mark.deep
@pytest.mark.data
def test_textures_have_equal_orientation_in_mitsuba_and_lumisplat(tool, made, data_dir: Path) -> None:
    """Compares a textured duck in both renderers."""
    duck = data_dir / "meshes" / "Duck.glb"
    folder = made(duck)
    for index, frame in enumerate(seen(tool, folder, duck, "environment")):
        albedo, inside = layer(folder, "albedo", index, "RGB")
        assert frame.albedo is not None
        assert ls.metrics.psnr(np.clip(frame.albedo, 0.0, 1.0), albedo, region=inside) > 45.0
        rendered_image = ls.load_image(folder / "test" / f"r_{index:03}.png")
        assert ls.metrics.psnr(frame.pixels_srgb()[..., :3], rendered_image, region=inside) > 38.0
