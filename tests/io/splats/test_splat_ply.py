"""Gaussian PLY: files of trainers, with columns in any order and number type."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import SH_C0
from lumisplat.errors import FormatError
from lumisplat.io.splats.splat_ply import antialiased_from_comments
from support.files.splat_files import capture, load_gaussians, parse_ply, ply_header, reencoded
from support.kinds import present

NAMES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
NAMES += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
ROW = [1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 0.0, -1.0, -2.0, -3.0, 2.0, 0.0, 0.0, 0.0]


def write(path: Path, names: list[str], rows: list[list[float]], comments: str = "") -> Path:
    """Writes a float PLY with the given columns."""
    header = ply_header(len(rows), names).replace(b"element", comments.encode() + b"element", 1)
    path.write_bytes(header + np.array(rows, dtype="<f4").tobytes())
    return path


def test_ply_packed_by_hand_is_decoded_to_scales_and_opacity(tmp_path: Path) -> None:
    """Scales are exponentials, opacity is a sigmoid, wxyz is normalised, positions are unchanged."""
    one = load_gaussians(write(tmp_path / "one.ply", NAMES, [ROW]))
    np.testing.assert_array_equal(one.means, [[1, 2, 3]])
    np.testing.assert_allclose(one.scales, np.exp([[-1.0, -2.0, -3.0]]), rtol=1e-6)
    np.testing.assert_array_equal(one.rotations_wxyz, [[1, 0, 0, 0]])
    assert one.opacities[0] == 0.5
    np.testing.assert_allclose(one.sh, [[[0.1, 0.2, 0.3]]], rtol=1e-6)
    assert (one.antialiased, one.comments, one.normals) == (False, (), None)


def test_ply_f_rest_columns_are_ordered_by_colour_channel(tmp_path: Path) -> None:
    """f_rest_0..K-1 are the K red coefficients above degree 0, then green, then blue."""
    path = write(tmp_path / "sh1.ply", NAMES + [f"f_rest_{i}" for i in range(9)], [ROW + list(range(9))])
    np.testing.assert_array_equal(load_gaussians(path).sh[0, 1:], [[0, 3, 6], [1, 4, 7], [2, 5, 8]])


@pytest.mark.parametrize("seed", range(3))
def test_order_of_ply_properties_does_not_change_the_capture(tmp_path: Path, seed: int) -> None:
    """Shuffled columns, some of them unknown, give the same capture."""
    ls.save(tmp_path / "plain.ply", capture(20, degree=3))
    names, values = parse_ply((tmp_path / "plain.ply").read_bytes())
    names, values = [*names, "segment"], np.column_stack([values, np.arange(20)])
    order = np.random.default_rng(seed).permutation(len(names))
    shuffled = load_gaussians(write(tmp_path / "shuffled.ply", [names[i] for i in order], values[:, order].tolist()))
    plain = load_gaussians(tmp_path / "plain.ply")
    for field in ("means", "rotations_wxyz", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(shuffled, field), getattr(plain, field))


def test_zero_normals_in_a_ply_count_as_no_normals(tmp_path: Path) -> None:
    """INRIA fills nx, ny, nz with zeros. Other values are normals, and are normalised."""
    names = [*NAMES, "nx", "ny", "nz"]
    assert load_gaussians(write(tmp_path / "zero.ply", names, [[*ROW, 0, 0, 0]])).normals is None
    up = load_gaussians(write(tmp_path / "up.ply", names, [[*ROW, 0, 2, 0]]))
    np.testing.assert_array_equal(present(up.normals), [[0, 1, 0]])


def test_written_ply_has_the_columns_of_inria_in_order(tmp_path: Path) -> None:
    """Columns are in INRIA's order."""
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
def test_ply_comments_of_other_trainers_set_the_antialiased_flag(comments: tuple[str, ...], expected: bool) -> None:
    """Comments of Brush and Postshot are recognised; the last one counts, other comments are ignored."""
    assert antialiased_from_comments(comments) is expected


def test_ply_comments_are_loaded_and_set_the_antialiased_flag(tmp_path: Path) -> None:
    """The comment of Brush, "SplatRenderMode: mip", means antialiased."""
    path = write(tmp_path / "brush.ply", NAMES, [ROW], "comment Exported from Brush\ncomment SplatRenderMode: mip\n")
    loaded = load_gaussians(path)
    assert loaded.comments == ("Exported from Brush", "SplatRenderMode: mip")
    assert loaded.antialiased


def test_ply_header_with_windows_line_ends_is_read(tmp_path: Path) -> None:
    """The header has CR LF line ends."""
    path = write(tmp_path / "crlf.ply", NAMES, [ROW])
    header, body = path.read_bytes().split(b"end_header\n")
    path.write_bytes(header.replace(b"\n", b"\r\n") + b"end_header\r\n" + body)
    np.testing.assert_array_equal(load_gaussians(path).means, [[1, 2, 3]])


def test_binary_ply_elements_other_than_vertices_are_skipped(tmp_path: Path) -> None:
    """Rows before the vertices are skipped, rows after them ignored."""
    path = write(tmp_path / "extra.ply", NAMES, [ROW])
    header, body = path.read_bytes().split(b"end_header\n")
    header = header.replace(b"element vertex", b"element camera 2\nproperty double t\nelement vertex")
    header += b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_bytes(header + bytes(16) + body + b"\x03" + bytes(12))
    np.testing.assert_array_equal(load_gaussians(path).means, [[1, 2, 3]])


def test_text_ply_elements_other_than_vertices_are_skipped(tmp_path: Path) -> None:
    """Each row is a line."""
    header = ply_header(1, NAMES, "ascii").replace(
        b"element vertex", b"element camera 2\nproperty double t\nelement vertex"
    )
    rows = "\n".join(["7", "8", " ".join(map(str, ROW)), "9 9 9"])
    (tmp_path / "extra.ply").write_bytes(header + rows.encode())
    np.testing.assert_array_equal(load_gaussians(tmp_path / "extra.ply").means, [[1, 2, 3]])


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["x", "y", "z", "red", "green", "blue"], "a point cloud, not a Gaussian capture: it has no opacity"),
        ([n for n in NAMES if n != "opacity"], "no opacity"),
        ([n for n in NAMES if not n.startswith("rot")], "no rot_0, rot_1, rot_2, rot_3"),
        ([*NAMES, "f_rest_0", "f_rest_1"], "2 f_rest properties, expected 0, 9, 24 or 45"),
        ([*NAMES, *(f"f_rest_{i}" for i in range(72))], "SH degree 4"),
        ([*NAMES, *(f"f_rest_{i}" for i in range(1, 10))], "no f_rest_0"),
    ],
)
def test_error_for_a_ply_capture_with_missing_properties_names_them(
    tmp_path: Path, names: list[str], message: str
) -> None:
    """A point cloud, or a capture without an opacity, rotation or SH, lacks properties."""
    path = write(tmp_path / "partial.ply", names, [[1.0] * len(names)])
    with pytest.raises(FormatError, match=message) as error:
        ls.load(path)
    assert str(path) in str(error.value)


def test_progress_of_loading_a_ply_rises_to_one(tmp_path: Path) -> None:
    """Reported fractions never decrease."""
    ls.save(tmp_path / "long.ply", capture(10_000, degree=3))
    reported: list[float] = []
    ls.load(tmp_path / "long.ply", progress=reported.append)
    assert reported == sorted(reported)
    assert len(reported) > 2
    assert reported[-1] == 1.0


def _columns(gaussians: ls.Gaussians, folder: Path) -> tuple[list[str], np.ndarray]:
    """Returns property names and rows of a capture's file."""
    ls.save(folder / "plain.ply", gaussians)
    names, values = parse_ply((folder / "plain.ply").read_bytes())
    return names, np.array(values)


@pytest.mark.parametrize("prefix", ["scalar_", "scal_", "scalar_scalar_"])
@pytest.mark.parametrize("ascii", [False, True])
def test_cloudcompare_prefixes_of_ply_properties_are_removed(tmp_path: Path, prefix: str, ascii: bool) -> None:
    """CloudCompare prefixes all field names except positions and normals; SH of degree 2 are found, too."""
    names, values = _columns(capture(40, degree=2), tmp_path)
    written = [name if name in "xyz" or name[0] == "n" else prefix + name for name in names]
    path = write(tmp_path / "cloud.ply", written, values.tolist())
    if ascii:
        path.write_bytes(reencoded(path.read_bytes(), ascii=True))
    read, plain = load_gaussians(path), load_gaussians(tmp_path / "plain.ply")
    for name, array in plain.arrays().items():
        np.testing.assert_array_equal(array, read.arrays()[name])
    if not ascii:
        (piece,) = ls.io.stream_ply(path)
        np.testing.assert_array_equal(piece.sh, plain.sh)


def test_ply_property_without_cloudcompares_prefix_overrides_the_prefixed_one(tmp_path: Path) -> None:
    """A file may have a property with and without CloudCompare's prefix."""
    read = load_gaussians(write(tmp_path / "a.ply", [*NAMES, "scalar_opacity", "scal_x"], [[*ROW, 9.0, 9.0]]))
    assert read.opacities[0] == 0.5
    np.testing.assert_array_equal(read.means, [[1, 2, 3]])


@pytest.mark.parametrize(
    ("kind", "dtype", "scale"), [("uchar", "<u1", 255), ("ushort", "<u2", 65535), ("float", "<f4", 1)]
)
def test_rgb_properties_of_a_ply_replace_missing_f_dc(tmp_path: Path, kind: str, dtype: str, scale: int) -> None:
    """Mode rgb of nerfstudio stores display-referred colours instead of SH."""
    whole = capture(40, degree=0)
    names, values = _columns(whole, tmp_path)
    indices = [k for k, name in enumerate(names) if not name.startswith("f_dc")]
    fractions = np.random.default_rng(3).uniform(0.0, 1.0, (40, 3))
    colors = (np.round(scale * fractions) if scale > 1 else fractions).astype(dtype)
    rows = np.empty(40, [(names[k], "<f4") for k in indices] + [(name, dtype) for name in ("red", "green", "blue")])
    for k in indices:
        rows[names[k]] = values[:, k]
    for k, name in enumerate(("red", "green", "blue")):
        rows[name] = colors[:, k]
    header = ply_header(40, [names[k] for k in indices]).replace(
        b"end_header",
        "\n".join(f"property {kind} {name}" for name in ("red", "green", "blue")).encode() + b"\nend_header",
    )
    (tmp_path / "rgb.ply").write_bytes(header + rows.tobytes())
    read = load_gaussians(tmp_path / "rgb.ply")
    shown = 0.5 + SH_C0 * read.sh[:, 0].astype(np.float64)
    np.testing.assert_allclose(shown, colors / float(scale), atol=1e-6)
    np.testing.assert_array_equal(read.scales, load_gaussians(tmp_path / "plain.ply").scales)
    (piece,) = ls.io.stream_ply(tmp_path / "rgb.ply")
    np.testing.assert_array_equal(piece.sh, read.sh)


@pytest.mark.parametrize("colors", [("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ()])
def test_rgb_colours_of_a_ply_are_read_under_any_of_three_names_and_in_capitals(
    tmp_path: Path, colors: tuple[str, ...]
) -> None:
    """Some programs write all property names in capitals."""
    if colors:
        names = [name for name in NAMES if not name.startswith("f_dc")] + list(colors)
        row = [value for name, value in zip(NAMES, ROW, strict=True) if not name.startswith("f_dc")] + [0.25, 0.5, 1.0]
        expected = (np.array([0.25, 0.5, 1.0]) - 0.5) / SH_C0
    else:
        names, row, expected = [name.upper() for name in NAMES], ROW, [0.1, 0.2, 0.3]
    read = load_gaussians(write(tmp_path / "a.ply", names, [row]))
    np.testing.assert_allclose(read.sh[0, 0], expected, rtol=1e-6)
    np.testing.assert_array_equal(read.means, [[1, 2, 3]])


def test_f_dc_of_a_ply_takes_precedence_over_rgb(tmp_path: Path) -> None:
    """Some programs add RGB colours for point cloud viewers."""
    read = load_gaussians(write(tmp_path / "a.ply", [*NAMES, "red", "green", "blue"], [[*ROW, 1.0, 1.0, 1.0]]))
    np.testing.assert_allclose(read.sh, [[[0.1, 0.2, 0.3]]], rtol=1e-6)


def _activated(folder: Path, whole: ls.Gaussians, *, scales: bool, opacities: bool, comment: str = "") -> Path:
    """Writes a file with scales or opacities instead of logarithms or logits."""
    names, values = _columns(whole, folder)
    if scales:
        values[:, [names.index(f"scale_{k}") for k in range(3)]] = whole.scales
    if opacities:
        values[:, names.index("opacity")] = whole.opacities
    return write(folder / "activated.ply", names, values.tolist(), comment)


@pytest.mark.parametrize(("scales", "opacities"), [(True, True), (False, True), (True, False)])
@pytest.mark.parametrize("opaque", [False, True])
def test_ply_that_stores_scales_and_opacities_not_logarithms_and_logits_is_recognised(
    tmp_path: Path, scales: bool, opacities: bool, opaque: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """Read as logits, all opacities would be 0.5 to 0.73; read as logarithms, all Gaussians would exceed one unit."""
    opacity = np.random.default_rng(2).uniform(0.004, 0.996, 100)
    if opaque and scales and opacities:
        opacity[:] = 1.0
    whole = capture(100, degree=0, opacities=opacity)
    path = _activated(tmp_path, whole, scales=scales, opacities=opacities)
    read = load_gaussians(path)
    np.testing.assert_allclose(read.scales, whole.scales, rtol=1e-5)
    np.testing.assert_allclose(read.opacities, whole.opacities, atol=1e-6)
    (line,) = caplog.messages
    assert ("positive scales, not logarithms" in line, "opacities of 0..1, not logits" in line) == (scales, opacities)
    (piece,) = ls.io.stream_ply(path)
    np.testing.assert_array_equal(piece.opacities, read.opacities)
    np.testing.assert_array_equal(piece.scales, read.scales)


def test_ply_comment_lumisplat_logits_overrides_the_guess_of_how_opacity_is_encoded(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The log line about the guess proposes this comment; with the comment, nothing is logged."""
    whole = capture(100, degree=0)
    path = _activated(tmp_path, whole, scales=True, opacities=True, comment="comment lumisplat logits\n")
    np.testing.assert_allclose(load_gaussians(path).scales, np.exp(whole.scales), rtol=1e-6)
    assert not caplog.records


def test_saved_ply_whose_logits_could_be_mistaken_for_opacities_has_a_comment(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Large Gaussians with logits within 0..1 survive two round trips thanks to a comment."""
    rng = np.random.default_rng(4)
    whole = capture(100, degree=0, opacities=rng.uniform(0.55, 0.7, 100), scales=rng.uniform(1.5, 3.0, (100, 3)))
    for name in ("a.ply", "b.ply"):
        ls.save(tmp_path / name, whole)
        whole = load_gaussians(tmp_path / name)
    assert whole.scales.max() < 3.01 and 0.54 < whole.opacities.min() < whole.opacities.max() < 0.71
    assert whole.comments == ("lumisplat logits",) and not caplog.records


@pytest.mark.parametrize("seed", range(20))
def test_log_scales_and_logits_of_trained_plys_are_not_mistaken_for_decoded_values(
    tmp_path: Path, seed: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Units range from millimetres to kilometres, and captures are dense or faint."""
    rng = np.random.default_rng(seed)
    count, unit = 200, 10.0 ** rng.uniform(-3, 4)
    whole = ls.Gaussians(
        unit * rng.normal(size=(count, 3)),
        rng.normal(size=(count, 4)),
        unit * np.exp(rng.normal(-4.0, 1.0, (count, 3))),
        1.0 / (1.0 + np.exp(-rng.normal(rng.uniform(-2, 3), 2.0, count))),
        np.zeros((count, 1, 3)),
    )
    ls.save(tmp_path / "a.ply", whole)
    np.testing.assert_allclose(load_gaussians(tmp_path / "a.ply").scales, whole.scales, rtol=1e-5)
    assert b"logits" not in (tmp_path / "a.ply").read_bytes()[:200]
    assert not caplog.records
