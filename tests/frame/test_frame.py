"""Frames: derived images, their text and their files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.math.color import decode_srgb
from support.files.image_files import read_image
from support.scenes import raster_scenes as scenes
from support.scenes.trace_scenes import GLASS, slab


@pytest.fixture(scope="module")
def frame() -> ls.Frame:
    """Returns a frame of splats and a mesh over a grey background."""
    scene = ls.Scene([scenes.random_gaussians(3, count=40)], [scenes.octahedron((0.4, 0.2, 4.0), 0.5)])
    return ls.render(
        scene, scenes.front_camera(40, 30), ls.RenderConfig(background=(0.5, 0.25, 0.125), lighting=False), device="cpu"
    )


def test_depth_z_of_a_frame_is_depth_along_the_camera_axis(frame: ls.Frame) -> None:
    """A point at distance ``depth`` along a pixel's ray has view depth ``depth_z``."""
    y, x = np.argwhere(np.isfinite(frame.depth))[0]
    camera = frame.camera
    ray = np.array([(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, 1.0])
    point = ray / np.linalg.norm(ray) * frame.depth[y, x]
    assert frame.depth_z[y, x] == pytest.approx(point[2], rel=1e-5)


def test_premultiplied_colours_of_a_frame_exclude_the_background(frame: ls.Frame) -> None:
    """``premultiplied`` equals the radiance of the same frame rendered without a background."""
    scene = ls.Scene([scenes.random_gaussians(3, count=40)], [scenes.octahedron((0.4, 0.2, 4.0), 0.5)])
    transparent = ls.render(scene, frame.camera, ls.RenderConfig(background=None, lighting=False), device="cpu")
    np.testing.assert_allclose(frame.premultiplied(), transparent.color, atol=1e-6)
    np.testing.assert_allclose(frame.premultiplied(), frame.straight() * frame.alpha[..., None], atol=1e-6)


def test_png_of_an_unlit_frame_stores_trained_colours_without_tone_mapping(frame: ls.Frame, tmp_path: Path) -> None:
    """An unlit frame is written without tone mapping: its display-referred values, rounded to 8 bits."""
    frame.save(tmp_path / "a.png")
    expected = np.floor(np.clip(frame.color, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png")["srgb"], expected)


def test_transparent_png_stores_colours_that_are_not_premultiplied(tmp_path: Path) -> None:
    """Without a background the PNG has an alpha channel, and its colours are not premultiplied."""
    scene = ls.Scene([scenes.one_gaussian(opacity=0.5, color=(0.8, 0.4, 0.2))])
    frame = ls.render(
        scene, scenes.front_camera(31, 31), ls.RenderConfig(background=None, lighting=False), device="cpu"
    )
    frame.save(tmp_path / "a.png")
    center = frame.alpha[15, 15]
    assert center == pytest.approx(0.5, abs=0.01)
    saved = read_image(tmp_path / "a.png")["srgb"][15, 15]
    np.testing.assert_allclose(saved / 255.0, (0.8, 0.4, 0.2, center), atol=0.5 / 255.0)


def test_exr_stores_linear_colours_and_every_layer_under_its_nuke_name(frame: ls.Frame, tmp_path: Path) -> None:
    """One part holds linear premultiplied RGBA and every AOV, bit for bit, under the names that Nuke reads."""
    frame.save(tmp_path / "a.exr")
    channels = read_image(tmp_path / "a.exr")
    index = {"index.gaussian", "index.instance"}
    points = {f"{layer}.{axis}" for layer in ("normal", "position") for axis in "XYZ"}
    assert channels.keys() == {"R", "G", "B", "A", "depth.Z"} | points | index
    np.testing.assert_array_equal(channels["A"], frame.alpha)
    np.testing.assert_array_equal(channels["depth.Z"], frame.depth)
    np.testing.assert_array_equal(channels["normal.Y"], frame.normal[..., 1])
    np.testing.assert_array_equal(channels["position.X"], frame.position[..., 0])
    expected = decode_srgb(frame.straight()) * frame.alpha[..., None]
    np.testing.assert_allclose(np.stack([channels[c] for c in "RGB"], axis=2), expected, atol=1e-7)


def test_frame_saved_with_a_list_of_layers_writes_exactly_those_layers(frame: ls.Frame, tmp_path: Path) -> None:
    """An EXR holds exactly the named layers, a PNG has them as images beside it, and a misspelt name writes no file."""
    frame.save(tmp_path / "a.exr", ["depth"])
    assert read_image(tmp_path / "a.exr").keys() == {"R", "G", "B", "A", "depth.Z"}
    frame.save(tmp_path / "b.png", ["normal"])
    assert {path.name for path in tmp_path.iterdir()} == {"a.exr", "b.png", "b.normal.png"}
    with pytest.raises(ls.ConfigError, match="unknown layer 'dept'"):
        frame.save(tmp_path / "c.png", ["dept"])
    assert not (tmp_path / "c.png").exists()


def test_exr_index_layers_store_4294967295_where_no_surface_is_hit(frame: ls.Frame, tmp_path: Path) -> None:
    """Without a hit, index layers hold 4294967295, as the guide says."""
    frame.save(tmp_path / "a.exr", ["instance_index"])
    index = read_image(tmp_path / "a.exr")["index.instance"]
    assert index.dtype == np.uint32
    assert (index[frame.instance_index == -1] == 4294967295).all() and (frame.instance_index == -1).any()


def test_reprs_of_frames_captures_and_meshes_contain_no_arrays(frame: ls.Frame) -> None:
    """The repr of a frame, a capture and a mesh describes them without their arrays."""
    gaussians = scenes.random_gaussians(3, count=40)
    assert len(gaussians) == 40
    low, high = (", ".join(f"{value:.4g}" for value in corner) for corner in gaussians.bounds())
    assert repr(gaussians) == f"Gaussians(count=40, sh_degree={gaussians.sh_degree}, bounds=({low})..({high}))"
    assert repr(frame) == (
        "Frame(40 x 30, name='', background=(0.5, 0.25, 0.125), raster, unlit, gaussians=40, faces=8)"
    )
    mesh = scenes.octahedron((0.4, 0.2, 4.0), 0.5)
    described = "Mesh(name='', vertices=6, faces=8, bounds=(-0.1, -0.3, 3.5)..(0.9, 0.7, 4.5), normals)"
    assert repr(mesh) == described
    placed = ls.MeshInstance(mesh, np.diag([2.0, 2.0, 2.0, 1.0]), name="top")
    assert repr(placed) == f"MeshInstance({described}, name='top', position=(0, 0, 0), scale=2)"
    scene = ls.Scene([gaussians], [mesh], [ls.LightEnvironment(image=np.ones((64, 128, 3)))])
    assert repr(scene).startswith("Scene(splats=1, gaussians=40, meshes=1, faces=8, lights=1, bounds=(")
    assert "array" not in repr(scene) + repr(scene.splats) + repr(scene.meshes)


def test_npz_files_store_every_image_of_a_frame(frame: ls.Frame, tmp_path: Path) -> None:
    """Every array survives a round trip."""
    frame.save(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as saved:
        for name, array in frame.arrays().items():
            np.testing.assert_array_equal(saved[name], array)


def test_rendering_an_object_that_is_not_a_scene_is_refused() -> None:
    """A capture in place of a scene is refused with a line that shows how to make a scene of the capture."""
    with pytest.raises(ls.SceneError, match=r"expected a Scene, got Gaussians: ls\.Scene\(splats="):
        ls.render(scenes.random_gaussians(3, count=4), scenes.front_camera(8, 8), device="cpu")  # pyright: ignore[reportArgumentType]


def test_rendering_with_an_object_that_is_not_a_camera_is_refused() -> None:
    """An object that is no camera is refused, with how to make a camera."""
    with pytest.raises(ls.SceneError, match=r"expected a Camera, got str: ls\.Camera\.look_at"):
        ls.render(ls.Scene(), "front", device="cpu")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("config", ["fast", ls.RasterConfig(), ""], ids=type)
def test_rendering_with_an_object_that_is_not_a_config_is_refused(config: Any) -> None:
    """All functions refuse an object that is no RenderConfig in the same words."""
    rays = (ls.Scene(), np.zeros((1, 3)), np.ones((1, 3)))
    view = scenes.front_camera(8, 8)
    for attempt in (
        lambda: ls.create_renderer(config, "cpu"),
        lambda: ls.render(ls.Scene(), view, config, device="cpu"),
        lambda: ls.trace_rays(*rays, config, device="cpu"),
        lambda: ls.transmittance(*rays, config=config, device="cpu"),
    ):
        with pytest.raises(ls.ConfigError, match=r"^config is .*, expected a RenderConfig$"):
            attempt()


def test_pixels_of_clear_glass_have_alpha_1_and_are_black_without_a_background() -> None:
    """Clear glass has alpha 1 although its rays pass through; without a background, clear glass is black."""
    scene = ls.Scene(meshes=[slab(3.0, 0.5, GLASS, half=9.0)])
    camera = scenes.front_camera(8, 8)
    clear, red = (
        ls.render(scene, camera, ls.RenderConfig(pipeline=ls.Pipeline.TRACE, background=b), device="cpu")
        for b in (None, (1.0, 0.0, 0.0))
    )
    np.testing.assert_array_equal(clear.alpha, 1.0)
    np.testing.assert_array_equal(clear.color, 0.0)
    assert red.color[..., 0].min() > 0.8
    hits = ls.trace_rays(scene, np.zeros((1, 3)), [(0.0, 0.0, 1.0)], device="cpu")
    assert hits.transmittance[0] == 0.0


def test_render_refuses_images_of_more_pixels_than_32_bit_indices_can_count() -> None:
    """An image too large for 32-bit indices is an error before anything is allocated."""
    with pytest.raises(ls.SceneError, match="at most 200,000,000 pixels"):
        ls.render(ls.Scene(), scenes.front_camera(65536, 65536), device="cpu")


def test_saving_a_frame_with_unknown_extension_or_layer_is_refused(frame: ls.Frame, tmp_path: Path) -> None:
    """The message lists the choices, and no file is written."""
    with pytest.raises(ls.FormatError, match=r"expected \.png, \.exr or \.npz"):
        frame.save(tmp_path / "a.jpg")
    with pytest.raises(ls.ConfigError, match="expected some of depth, normal, gaussian_index"):
        frame.layers(["shadow"])
    assert not list(tmp_path.iterdir())
