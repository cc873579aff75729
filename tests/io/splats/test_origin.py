"""Captures in map coordinates: files, edits and scenes preserve their float64 origin."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.cli import main

UTM = (500123.0, 5400987.0, 312.0)
NAMES = (
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)


def capture(origin: tuple[float, float, float] = UTM) -> ls.Gaussians:
    """Returns small Gaussians around an origin."""
    rng = np.random.default_rng(5)
    return ls.Gaussians(
        means=rng.normal(size=(60, 3)),
        rotations_wxyz=rng.normal(size=(60, 4)),
        scales=rng.uniform(0.02, 0.06, (60, 3)),
        opacities=rng.uniform(0.3, 0.9, 60),
        sh=rng.normal(size=(60, 1, 3)),
        origin=origin,
    )


def write_doubles(path: Path, gaussians: ls.Gaussians, shift: np.ndarray) -> Path:
    """Writes a capture as surveying programs do: positions are doubles in map coordinates."""
    types = [(name, "<f8" if name in "xyz" else "<f4") for name in NAMES]
    rows = np.zeros(gaussians.count, types)
    logits = np.log(gaussians.opacities) - np.log1p(-gaussians.opacities)
    columns = (gaussians.means + shift, gaussians.sh[:, 0], logits[:, None], np.log(gaussians.scales))
    for name, values in zip(NAMES, np.hstack([*columns, gaussians.rotations_wxyz]).T, strict=True):
        rows[name] = values
    lines = [f"property {'double' if name in 'xyz' else 'float'} {name}" for name in NAMES]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *lines, "end_header", ""]
    path.write_bytes("\n".join(header).encode() + rows.tobytes())
    return path


def in_world(gaussians: ls.Gaussians) -> np.ndarray:
    """Returns means in the capture's absolute coordinates, float64."""
    return gaussians.means.astype(np.float64) + gaussians.origin


def test_ascii_ply_in_map_coordinates_keeps_all_digits(tmp_path: Path) -> None:
    """Programs write map coordinates with all digits, although the header calls them float."""
    near = capture((0.0, 0.0, 0.0))
    columns = (near.means + np.array(UTM), near.sh[:, 0], np.zeros((60, 1)), np.log(near.scales), near.rotations_wxyz)
    header = ["ply", "format ascii 1.0", "element vertex 60", *(f"property float {name}" for name in NAMES)]
    lines = [" ".join(f"{value:.6f}" for value in row) for row in np.hstack(columns)]
    (tmp_path / "far.ply").write_text("\n".join([*header, "end_header", *lines, ""]))
    far = ls.load(tmp_path / "far.ply")
    assert isinstance(far, ls.Gaussians)
    np.testing.assert_allclose(in_world(far), near.means + np.array(UTM), atol=1e-6, rtol=0)


def test_captures_in_map_coordinates_get_a_float64_origin(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Positions keep their precision, and a log line reports the origin; doubles near zero get no origin."""
    near = capture((0.0, 0.0, 0.0))
    far = ls.load(write_doubles(tmp_path / "far.ply", near, np.array(UTM)))
    assert isinstance(far, ls.Gaussians) and any(far.origin)
    np.testing.assert_allclose(in_world(far), near.means + np.array(UTM), atol=2e-7, rtol=0)
    assert "far.ply: positions are relative to an origin" in caplog.text and "convert --translate=" in caplog.text
    caplog.clear()
    same = ls.load(write_doubles(tmp_path / "near.ply", near, np.zeros(3)))
    assert isinstance(same, ls.Gaussians) and not any(same.origin) and not caplog.text
    np.testing.assert_array_equal(same.means, near.means)


def test_capture_instance_without_a_position_is_placed_at_the_captures_map_origin(tmp_path: Path) -> None:
    """Scenes and scene files leave the capture at its origin if no key states a position."""
    far = capture()
    for instance in (ls.SplatInstance(far), ls.Scene([far]).splats[0], ls.SplatInstance(far, scale_by=2.0)):
        np.testing.assert_array_equal(instance.transform[:3, 3], UTM)
    np.testing.assert_array_equal(ls.SplatInstance(far, position=(1, 2, 3)).transform[:3, 3], (1, 2, 3))
    np.testing.assert_array_equal(ls.SplatInstance(far, np.eye(4)).transform, np.eye(4))
    ls.save(tmp_path / "far.ply", far)
    (tmp_path / "scene.toml").write_text('[[splats]]\npath = "far.ply"\n')
    scene = ls.load(tmp_path / "scene.toml")
    assert isinstance(scene, ls.Scene)
    np.testing.assert_allclose(scene.splats[0].world_means, far.means + np.array(UTM), atol=1e-6, rtol=0)


def test_frame_of_a_capture_in_map_coordinates_equals_that_of_one_near_the_origin(tmp_path: Path) -> None:
    """Camera and capture are both in map coordinates."""
    near = capture((0.0, 0.0, 0.0))
    far = ls.load(write_doubles(tmp_path / "far.ply", near, np.array(UTM)))
    here = ls.load(write_doubles(tmp_path / "near.ply", near, np.zeros(3)))
    assert isinstance(far, ls.Gaussians) and isinstance(here, ls.Gaussians)
    eye = np.array([3.0, 2.0, 4.0])
    frames = [
        ls.render(ls.Scene([one]), ls.Camera.look_at(eye + at, at, width=48, height=32), device="cpu")
        for one, at in ((here, np.zeros(3)), (far, np.array(UTM)))
    ]
    assert frames[0].alpha.max() > 0.5
    np.testing.assert_allclose(frames[1].color, frames[0].color, atol=1e-3)


@pytest.mark.parametrize("name", ["x.ply", "x.compressed.ply", "x.glb", "x.usdc"])
def test_saved_files_preserve_the_float64_origin_of_a_capture(tmp_path: Path, name: str) -> None:
    """A comment or the transform of a node stores the origin exactly; saving twice does not repeat the comment."""
    if name.endswith("usdc"):
        pytest.importorskip("pxr")
    far = replace(capture(), origin=(500123.125, 5400987.1, 312.0))
    ls.save(tmp_path / name, far)
    loaded = ls.load(tmp_path / name)
    assert isinstance(loaded, ls.Gaussians) and any(loaded.origin)
    assert loaded.origin == far.origin or not name.endswith("ply")
    assert not any("origin" in line for line in loaded.comments)
    world = in_world(loaded)
    middle = (far.means + np.array(far.origin)).mean(axis=0)
    np.testing.assert_allclose(world.mean(axis=0), middle, atol=1e-2 if "compressed" in name else 1e-6, rtol=0)


@pytest.mark.parametrize("name", ["x.spz", "x.sog"])
def test_formats_that_cannot_store_an_origin_log_a_warning(
    tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    """The stored positions stay relative to the origin."""
    ls.save(tmp_path / name, capture())
    assert "cannot store the origin of the capture, 500123 5400987 312" in caplog.text
    loaded = ls.load(tmp_path / name)
    assert isinstance(loaded, ls.Gaussians) and np.abs(loaded.means).max() < 10.0


@pytest.mark.parametrize("numbers", ["1 2", "a b c", "1 2 nan", "", "1e400 0 0"])
def test_invalid_origin_comment_of_a_ply_is_logged_and_ignored(
    tmp_path: Path, numbers: str, caplog: pytest.LogCaptureFixture
) -> None:
    """The comment does not hold three finite numbers."""
    near = capture((0.0, 0.0, 0.0))
    ls.save(tmp_path / "x.ply", replace(near, comments=("lumisplat origin_of_nothing",)))
    data = (tmp_path / "x.ply").read_bytes()
    (tmp_path / "x.ply").write_bytes(
        data.replace(b"lumisplat origin_of_nothing", f"lumisplat origin  {numbers}".encode())
    )
    loaded = ls.load(tmp_path / "x.ply")
    assert isinstance(loaded, ls.Gaussians) and not any(loaded.origin)
    assert not numbers or "its origin is not three numbers" in caplog.text


def test_edits_of_a_capture_in_map_coordinates_match_equal_edits_in_float64() -> None:
    """Translation, rotation, scaling, cropping, selection and merging match the same edits in float64."""
    far, wide = capture(), in_world(capture())
    moved = ls.transform(far, scale=2.0, rotation_degrees=(0, 0, 90), translation=(1.0, 2.0, 3.0))
    expected = 2.0 * wide @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1.0]]) + (1.0, 2.0, 3.0)
    np.testing.assert_allclose(in_world(moved), expected, atol=1e-5, rtol=0)
    home = ls.transform(far, translation=-np.array(UTM))
    assert not any(home.origin)
    np.testing.assert_array_equal(home.means, far.means)
    low, high = np.array(UTM) - 0.5, np.array(UTM) + 0.5
    inside = ((wide >= low) & (wide <= high)).all(axis=1)
    np.testing.assert_array_equal(ls.editing.crop(far, box=(low, high)).means, far.means[inside])
    ball = np.linalg.norm(wide - UTM, axis=1) <= 0.8
    np.testing.assert_array_equal(ls.editing.crop(far, sphere=(UTM, 0.8)).means, far.means[ball])
    both = ls.merge([far, replace(far, origin=(UTM[0] + 10.0, *UTM[1:]))])
    np.testing.assert_allclose(in_world(both)[60:, 0] - in_world(both)[:60, 0], 10.0, atol=1e-5)
    near = ls.merge([replace(far, origin=(UTM[0] + 300.0, *UTM[1:])), far])
    np.testing.assert_allclose(in_world(near), np.concatenate([wide + np.array((300.0, 0.0, 0.0)), wide]), atol=1e-4)
    with pytest.raises(ls.SceneError, match="units apart cannot be merged"):
        ls.merge([capture((0.0, 0.0, 0.0)), far])


def test_blocks_command_refuses_a_capture_with_a_map_origin(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Blocks store absolute float32 positions, which would round positions in map coordinates; convert moves them."""
    ls.save(tmp_path / "far.ply", capture())
    assert main(["blocks", str(tmp_path / "far.ply"), "-o", str(tmp_path / "far.blocks")]) == 2
    log_line = capsys.readouterr().err
    move = re.search(r"convert (--translate=-500123\S+) moves the capture to zero", log_line)
    assert move and not (tmp_path / "far.blocks").exists()
    assert main(["convert", str(tmp_path / "far.ply"), str(tmp_path / "near.ply"), move[1]]) == 0
    assert main(["blocks", str(tmp_path / "near.ply"), "-o", str(tmp_path / "near.blocks")]) == 0


def test_info_prints_the_map_origin_of_a_capture_and_convert_can_remove_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """``info`` has a row and a JSON key for the origin; ``convert --translate`` moves the capture to zero."""
    ls.save(tmp_path / "far.ply", capture())
    assert main(["info", str(tmp_path / "far.ply")]) == 0
    assert "500123 5400987 312" in capsys.readouterr().out
    assert main(["info", str(tmp_path / "far.ply"), "--json"]) == 0
    assert '"origin"' in capsys.readouterr().out
    move = ",".join(f"{-value:g}" if value == 312.0 else f"{-value:.0f}" for value in UTM)
    assert main(["convert", str(tmp_path / "far.ply"), "-o", str(tmp_path / "near.ply"), f"--translate={move}"]) == 0
    near = ls.load(tmp_path / "near.ply")
    assert isinstance(near, ls.Gaussians) and not any(near.origin)
    np.testing.assert_array_equal(near.means, capture().means)


def test_writing_blocks_of_map_coordinates_warns_of_rounding(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Blocks store absolute float32 positions; captures near zero cause no warning."""
    near = capture((0.0, 0.0, 0.0))
    for name, shift in (("far", np.array(UTM)), ("near", np.zeros(3))):
        stream = ls.io.stream_ply(write_doubles(tmp_path / f"{name}.ply", near, shift))
        ls.io.write_blocks(tmp_path / name, stream, cell=8.0)
        assert ("blocks store positions in float32, here in steps of 0.5" in caplog.text) is (name == "far")
        caplog.clear()
