"""Gaussian PLY: files of trainers, in any order and number type."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.errors import FormatError
from lumisplat.io.splats.splat_ply import antialiased_from_comments
from support.files.splat_files import capture, load_gaussians, parse_ply, ply_header
from support.kinds import present

NAMES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
NAMES += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
ROW = [1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 0.0, -1.0, -2.0, -3.0, 2.0, 0.0, 0.0, 0.0]


def write(path: Path, names: list[str], rows: list[list[float]], comments: str = "") -> Path:
    """A float PLY of the given columns."""
    header = ply_header(len(rows), names).replace(b"element", comments.encode() + b"element", 1)
    path.write_bytes(header + np.array(rows, dtype="<f4").tobytes())
    return path


def test_values_by_hand(tmp_path: Path) -> None:
    """Exponential of scales, sigmoid of the opacity, wxyz normalised, positions as they are."""
    one = load_gaussians(write(tmp_path / "one.ply", NAMES, [ROW]))
    np.testing.assert_array_equal(one.means, [[1, 2, 3]])
    np.testing.assert_allclose(one.scales, np.exp([[-1.0, -2.0, -3.0]]), rtol=1e-6)
    np.testing.assert_array_equal(one.rotations_wxyz, [[1, 0, 0, 0]])
    assert one.opacities[0] == 0.5
    np.testing.assert_allclose(one.sh, [[[0.1, 0.2, 0.3]]], rtol=1e-6)
    assert (one.antialiased, one.comments, one.normals) == (False, (), None)


def test_f_rest_is_channel_major(tmp_path: Path) -> None:
    """f_rest_0..K-1 are the red coefficients, then green, then blue."""
    path = write(tmp_path / "sh1.ply", NAMES + [f"f_rest_{i}" for i in range(9)], [ROW + list(range(9))])
    np.testing.assert_array_equal(load_gaussians(path).sh[0, 1:], [[0, 3, 6], [1, 4, 7], [2, 5, 8]])


@pytest.mark.parametrize("seed", range(3))
def test_property_order_is_free(tmp_path: Path, seed: int) -> None:
    """Shuffled columns, with unknown ones among them, give the same capture."""
    ls.save(tmp_path / "plain.ply", capture(20, degree=3))
    names, values = parse_ply((tmp_path / "plain.ply").read_bytes())
    names, values = [*names, "segment"], np.column_stack([values, np.arange(20)])
    order = np.random.default_rng(seed).permutation(len(names))
    shuffled = load_gaussians(write(tmp_path / "shuffled.ply", [names[i] for i in order], values[:, order].tolist()))
    plain = load_gaussians(tmp_path / "plain.ply")
    for field in ("means", "rotations_wxyz", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(shuffled, field), getattr(plain, field))


def test_zero_normals_are_ignored_and_real_ones_kept(tmp_path: Path) -> None:
    """INRIA fills nx, ny, nz with zeros: no normals. Anything else is normals, made unit length."""
    names = [*NAMES, "nx", "ny", "nz"]
    assert load_gaussians(write(tmp_path / "zero.ply", names, [[*ROW, 0, 0, 0]])).normals is None
    up = load_gaussians(write(tmp_path / "up.ply", names, [[*ROW, 0, 2, 0]]))
    np.testing.assert_array_equal(present(up.normals), [[0, 1, 0]])


def test_inria_reads_what_we_write(tmp_path: Path) -> None:
    """A written file has INRIA's columns in INRIA's order."""
    ls.save(tmp_path / "ours.ply", capture(5, degree=1))
    names, values = parse_ply((tmp_path / "ours.ply").read_bytes())
    rest = [f"f_rest_{i}" for i in range(9)]
    assert names == [*NAMES[:3], "nx", "ny", "nz", *NAMES[3:6], *rest, *NAMES[6:]]
    assert not values[:, 3:6].any()


@pytest.mark.parametrize(
    ("comments", "expected"),
    [
        ((), False),
        (("SplatRenderMode: mip",), True),
        (("SplatRenderMode: default",), False),
        (("  splatrendermode:  MIP ",), True),
        (("antialiased 1",), True),
        (("antialiased 0",), False),
        (("antialiased 1", "SplatRenderMode: default"), False),
        (("SplatRenderMode: default", "antialiased 1"), True),
        (("not antialiased 1", "made with care"), False),
    ],
)
def test_antialiased_comments(comments: tuple[str, ...], expected: bool) -> None:
    """Brush's and Postshot's comments are understood; the last counts; others are ignored."""
    assert antialiased_from_comments(comments) is expected


def test_comments_are_read(tmp_path: Path) -> None:
    """Comments of the header are kept, and set the flag."""
    path = write(tmp_path / "brush.ply", NAMES, [ROW], "comment Exported from Brush\ncomment SplatRenderMode: mip\n")
    loaded = load_gaussians(path)
    assert loaded.comments == ("Exported from Brush", "SplatRenderMode: mip")
    assert loaded.antialiased


def test_windows_line_ends(tmp_path: Path) -> None:
    """A header with CR LF is read."""
    path = write(tmp_path / "crlf.ply", NAMES, [ROW])
    header, body = path.read_bytes().split(b"end_header\n")
    path.write_bytes(header.replace(b"\n", b"\r\n") + b"end_header\r\n" + body)
    np.testing.assert_array_equal(load_gaussians(path).means, [[1, 2, 3]])


def test_other_elements_are_skipped(tmp_path: Path) -> None:
    """Rows before the vertices are skipped, rows after them ignored."""
    path = write(tmp_path / "extra.ply", NAMES, [ROW])
    header, body = path.read_bytes().split(b"end_header\n")
    header = header.replace(b"element vertex", b"element camera 2\nproperty double t\nelement vertex")
    header += b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_bytes(header + bytes(16) + body + b"\x03" + bytes(12))
    np.testing.assert_array_equal(load_gaussians(path).means, [[1, 2, 3]])


def test_other_elements_of_text_are_skipped(tmp_path: Path) -> None:
    """The same for a text file, in which rows are lines."""
    header = ply_header(1, NAMES, "ascii").replace(
        b"element vertex", b"element camera 2\nproperty double t\nelement vertex"
    )
    rows = "\n".join(["7", "8", " ".join(map(str, ROW)), "9 9 9"])
    (tmp_path / "extra.ply").write_bytes(header + rows.encode())
    np.testing.assert_array_equal(load_gaussians(tmp_path / "extra.ply").means, [[1, 2, 3]])


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["x", "y", "z", "red", "green", "blue"], "a point cloud, not a Gaussian capture: no opacity, scale, rotation"),
        ([n for n in NAMES if n != "opacity"], "no opacity"),
        ([n for n in NAMES if not n.startswith("rot")], "no rot_0, rot_1, rot_2, rot_3"),
        ([*NAMES, "f_rest_0", "f_rest_1"], "2 f_rest properties, expected 0, 9, 24 or 45"),
        ([*NAMES, *(f"f_rest_{i}" for i in range(72))], "SH degree 4"),
        ([*NAMES, *(f"f_rest_{i}" for i in range(1, 10))], "no f_rest_0"),
    ],
)
def test_incomplete_captures_are_refused(tmp_path: Path, names: list[str], message: str) -> None:
    """The error names the missing properties."""
    path = write(tmp_path / "partial.ply", names, [[1.0] * len(names)])
    with pytest.raises(FormatError, match=message) as error:
        ls.load(path)
    assert str(path) in str(error.value)


def test_progress_reaches_one(tmp_path: Path) -> None:
    """Progress grows to 1."""
    ls.save(tmp_path / "long.ply", capture(10_000, degree=3))
    seen: list[float] = []
    ls.load(tmp_path / "long.ply", progress=seen.append)
    assert seen == sorted(seen)
    assert len(seen) > 2
    assert seen[-1] == 1.0
