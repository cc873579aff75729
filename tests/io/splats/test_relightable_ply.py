"""PLY files of trainers of relightable captures, packed by hand, and how they differ from those of Lumisplat."""

from __future__ import annotations

import logging
import struct
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from support.files.splat_files import capture, load_gaussians, parse_ply
from support.kinds import present

GEOMETRY = {"x": 1.0, "y": 2.0, "z": 3.0, "opacity": 0.5, "scale_0": -1.0, "scale_1": -2.0, "scale_2": -3.0}
ROTATION = {"rot_0": 1.0, "rot_1": 0.0, "rot_2": 0.0, "rot_3": 0.0}
SH = {"f_dc_0": 0.1, "f_dc_1": 0.2, "f_dc_2": 0.3, **{f"f_rest_{i}": 0.01 * i for i in range(45)}}
NORMAL = {"nx": 0.0, "ny": -2.0, "nz": 0.0}
INCIDENTS = {f"incidents_dc_{i}": 0.5 for i in range(3)} | {f"incidents_rest_{i}": 0.1 for i in range(45)}
VISIBILITY = {"visibility_dc_0": 0.7} | {f"visibility_rest_{i}": 0.1 for i in range(15)}


def sigmoid(x: float) -> float:
    """Computes the logistic function."""
    return 1.0 / (1.0 + float(np.exp(-x)))


def part(*names: str) -> dict[str, float]:
    """Selects columns of `GEOMETRY`."""
    return {name: GEOMETRY[name] for name in names}


def scales() -> dict[str, float]:
    """Returns the scale columns."""
    return part("scale_0", "scale_1", "scale_2")


def base_color(*raw: float) -> dict[str, float]:
    """Returns R3DG's base colour columns."""
    return {f"base_color_{i}": value for i, value in enumerate(raw)}


def r3dg_row(color: tuple[float, float, float], roughness: float) -> dict[str, float]:
    """Returns a row of R3DG's second stage: 130 columns in order."""
    row = part("x", "y", "z") | NORMAL | SH | part("opacity") | scales() | ROTATION
    return row | base_color(*color) | {"roughness": roughness} | INCIDENTS | VISIBILITY


def gs_ir_row(albedo: tuple[float, float, float], roughness: float, metallic: float) -> dict[str, float]:
    """Returns a row of GS-IR: 67 columns in order."""
    row = part("x", "y", "z") | SH | part("opacity") | {"normal_0": 0.0, "normal_1": 0.0, "normal_2": 4.0}
    row |= {f"albedo_{i}": value for i, value in enumerate(albedo)} | {"roughness": roughness, "metallic": metallic}
    return row | scales() | ROTATION


def write(path: Path, *rows: dict[str, float], comment: str = "") -> Path:
    """Writes a little-endian float PLY, byte by byte."""
    lines = ["ply", "format binary_little_endian 1.0", *([f"comment {comment}"] if comment else [])]
    lines += [f"element vertex {len(rows)}", *(f"property float {name}" for name in rows[0]), "end_header"]
    body = b"".join(struct.pack("<f", value) for row in rows for value in row.values())
    path.write_bytes("\n".join([*lines, ""]).encode() + body)
    return path


def test_fixture_rows_of_r3dg_and_gs_ir_plys_have_as_many_columns_as_real_files() -> None:
    """R3DG writes 130 columns and GS-IR 67."""
    assert (len(r3dg_row((0, 0, 0), 0)), len(gs_ir_row((0, 0, 0), 0, 0))) == (130, 67)


@pytest.mark.parametrize(
    ("color", "roughness"),
    [((0.0, 0.25, 1.0), 0.5), ((-3.0, 0.0, 40.0), -2.0)],
    ids=["all raw values within 0..1", "any raw values"],
)
def test_r3dg_albedo_roughness_and_normals_are_decoded(
    tmp_path: Path, color: tuple[float, float, float], roughness: float
) -> None:
    """Albedo is 0.77 sigmoid + 0.03, roughness 0.9 sigmoid + 0.09, and normals have any length."""
    loaded = load_gaussians(write(tmp_path / "point_cloud.ply", r3dg_row(color, roughness)))
    expected = [0.77 * sigmoid(raw) + 0.03 for raw in color]
    np.testing.assert_allclose(present(loaded.albedo), [expected], rtol=1e-6)
    np.testing.assert_allclose(present(loaded.roughness), [0.9 * sigmoid(roughness) + 0.09], rtol=1e-6)
    np.testing.assert_array_equal(present(loaded.normals), [[0, -1, 0]])
    assert loaded.metallic is None
    np.testing.assert_allclose(loaded.opacities, sigmoid(0.5), rtol=1e-6)
    np.testing.assert_allclose(loaded.scales, np.exp([[-1.0, -2.0, -3.0]]), rtol=1e-6)
    np.testing.assert_allclose(loaded.sh[0, 1], [0.0, 0.15, 0.3], rtol=1e-6)  # channel-major


def test_ply_of_the_first_r3dg_release_is_decoded(tmp_path: Path) -> None:
    """This release has metallic, and its albedo, roughness and metallic are sigmoids without an offset."""
    row = r3dg_row((0.0, 0.25, 1.0), 0.5)
    columns = list(row)
    columns.insert(columns.index("roughness") + 1, "metallic")
    loaded = load_gaussians(write(tmp_path / "first.ply", {name: row.get(name, 0.75) for name in columns}))
    np.testing.assert_allclose(present(loaded.albedo), [[0.5, sigmoid(0.25), sigmoid(1.0)]], rtol=1e-6)
    np.testing.assert_allclose(present(loaded.roughness), [sigmoid(0.5)], rtol=1e-6)
    np.testing.assert_allclose(present(loaded.metallic), [sigmoid(0.75)], rtol=1e-6)


def test_first_stage_ply_of_r3dg_has_normals_but_no_materials(tmp_path: Path) -> None:
    """R3DG trains materials in its second stage."""
    row = part("x", "y", "z") | NORMAL | SH | part("opacity") | scales() | ROTATION
    loaded = load_gaussians(write(tmp_path / "stage1.ply", row))
    np.testing.assert_array_equal(present(loaded.normals), [[0, -1, 0]])
    assert loaded.albedo is None


@pytest.mark.parametrize(
    ("albedo", "roughness", "metallic"),
    [((1.0, 1.0, 1.0), 1.0, 1.0), ((0.0, 0.25, 1.0), 0.5, 0.75), ((-3.0, 0.0, 9.0), -2.0, -7.0)],
    ids=["untrained", "all raw values within 0..1", "any raw values"],
)
def test_gs_ir_albedo_roughness_and_metallic_are_decoded(
    tmp_path: Path, albedo: tuple[float, float, float], roughness: float, metallic: float
) -> None:
    """All three are sigmoids although the columns have Lumisplat's names; the columns of normals are normal_0..2."""
    loaded = load_gaussians(write(tmp_path / "gs_ir.ply", gs_ir_row(albedo, roughness, metallic)))
    np.testing.assert_allclose(present(loaded.albedo), [[sigmoid(raw) for raw in albedo]], rtol=1e-6)
    np.testing.assert_allclose(present(loaded.roughness), [sigmoid(roughness)], rtol=1e-6)
    np.testing.assert_allclose(present(loaded.metallic), [sigmoid(metallic)], rtol=1e-6)
    np.testing.assert_array_equal(present(loaded.normals), [[0, 0, 1]])


def test_materials_read_from_plys_of_other_trainers_are_saved_as_linear_values(tmp_path: Path) -> None:
    """A PLY saved by Lumisplat preserves the materials, and a comment marks them as linear."""
    first = load_gaussians(write(tmp_path / "theirs.ply", r3dg_row((0.0, 0.25, 1.0), 0.5)))
    ls.save(tmp_path / "ours.ply", first)
    again = load_gaussians(tmp_path / "ours.ply")
    ls.save(tmp_path / "twice.ply", again)
    assert load_gaussians(tmp_path / "twice.ply").comments == ("lumisplat materials linear",)
    for field in ("normals", "albedo", "roughness"):
        np.testing.assert_array_equal(getattr(again, field), getattr(first, field))


def test_ply_of_a_capture_without_materials_has_no_material_comment(tmp_path: Path) -> None:
    """The header of the saved PLY has no comments."""
    ls.save(tmp_path / "plain.ply", capture(3))
    assert load_gaussians(tmp_path / "plain.ply").comments == ()


def unmarked(path: Path, roughness: np.ndarray) -> Path:
    """Writes a Lumisplat file with materials, without the comment."""
    ls.save(path, capture(4, roughness=roughness))
    path.write_bytes(path.read_bytes().replace(b"comment lumisplat materials linear\n", b""))
    return path


def test_materials_of_older_lumisplat_plys_without_comment_are_read(tmp_path: Path) -> None:
    """Columns that only Lumisplat writes are accepted if all values are within 0..1."""
    path = unmarked(tmp_path / "old.ply", np.linspace(0.0, 1.0, 4))
    assert load_gaussians(path).comments == ()
    np.testing.assert_allclose(present(load_gaussians(path).roughness), np.linspace(0.0, 1.0, 4), atol=1e-7)


@pytest.mark.parametrize(
    ("row", "reason"),
    [
        ({"roughness": 0.5, "specular_0": 0.1}, "specular_0"),
        ({"roughness": 0.5, "metallic": 1.5}, "1 of 1 values of metallic are outside 0..1"),
    ],
)
def test_materials_of_unknown_trainers_are_dropped_with_the_reason(
    tmp_path: Path, row: dict[str, float], reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    """The encoding is unknown, so a log line names the reason and the comment that would declare linear values."""
    path = write(tmp_path / "unknown.ply", GEOMETRY | ROTATION | SH | row)
    with caplog.at_level(logging.WARNING, logger="lumisplat"):
        loaded = load_gaussians(path)
    assert (loaded.roughness, loaded.metallic) == (None, None)
    (message,) = [record.getMessage() for record in caplog.records]
    for words in ("unknown.ply: ", "roughness", reason, "'comment lumisplat materials linear'"):
        assert words in message


@pytest.mark.parametrize(
    ("missing", "expected"),
    [
        (("base_color_2",), "albedo left out: no base_color_2"),
        (("nx", "nz"), "normals left out: no nx, nz"),
        (("base_color_1", "base_color_2"), "albedo left out: no base_color_1, base_color_2"),
        (("roughness",), None),
    ],
)
def test_materials_with_a_missing_ply_column_are_dropped(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, missing: tuple[str, ...], expected: str | None
) -> None:
    """A log line names the missing columns; a material without any column is not mentioned."""
    row = {name: value for name, value in r3dg_row((0.0, 0.25, 1.0), 0.5).items() if name not in missing}
    with caplog.at_level(logging.WARNING, "lumisplat"):
        loaded = load_gaussians(write(tmp_path / "a.ply", row))
    logged = [record.getMessage() for record in caplog.records]
    assert logged == ([] if expected is None else [f"{tmp_path / 'a.ply'}: {expected}"])
    field = "roughness" if expected is None else expected.split()[0]
    assert getattr(loaded, field) is None


def test_ply_materials_marked_linear_but_out_of_range_are_refused(tmp_path: Path) -> None:
    """A comment marks the materials as linear, so values outside 0..1 mean damage."""
    path = write(
        tmp_path / "a.ply", GEOMETRY | ROTATION | SH | {"roughness": 2.0}, comment="lumisplat materials linear"
    )
    with pytest.raises(ls.FormatError, match=r"roughness: 1 of 1 are outside 0..1"):
        ls.load(path)


def test_error_for_nonfinite_ply_materials_names_their_columns(tmp_path: Path) -> None:
    """NaN and infinity are refused although their sigmoid would be finite."""
    bad = r3dg_row((0.0, np.inf, 0.0), np.nan)
    path = write(tmp_path / "bad.ply", r3dg_row((0, 0, 0), 0), bad)
    with pytest.raises(ls.FormatError, match=r"in base_color_1, 1 NaN or infinite values in roughness"):
        ls.load(path)
    assert load_gaussians(path, drop_invalid=True).count == 1


def flat_row(x: float, rotation: tuple[float, ...], log_scales: tuple[float, float]) -> dict[str, float]:
    """Returns a row of 2D Gaussian Splatting: 61 columns, two scales."""
    row = {"x": x, "y": 0.0, "z": 4.0, "nx": 0.0, "ny": 0.0, "nz": 0.0} | SH | {"opacity": 2.0}
    row |= {"scale_0": log_scales[0], "scale_1": log_scales[1]}
    return row | {f"rot_{i}": value for i, value in enumerate(rotation)}


def test_ply_of_2d_gaussians_gets_a_tiny_third_scale(tmp_path: Path) -> None:
    """The third axis, along which the scale is tiny, is the normal."""
    upright = flat_row(-1.0, (1, 0, 0, 0), (-2.0, -4.0))
    rotated = flat_row(1.0, (1, 1, 0, 0), (-5.0, -3.0))  # a quarter about x: z to -y
    assert len(upright) == 61
    loaded = load_gaussians(write(tmp_path / "surfels.ply", upright, rotated))
    np.testing.assert_allclose(loaded.scales[:, :2], np.exp([[-2.0, -4.0], [-5.0, -3.0]]), rtol=1e-6)
    assert (loaded.scales[:, 2] <= 0.02 * loaded.scales[:, :2].min(axis=1)).all()
    assert (loaded.scales[:, 2] > 0.0).all()
    np.testing.assert_allclose(np.abs(ls.estimate_normals(loaded)), [[0, 0, 1], [0, 1, 0]], atol=1e-6)


def test_2d_gaussians_are_saved_as_3d_gaussians(tmp_path: Path) -> None:
    """The saved PLY has scale_2, so that every reader can load it."""
    ls.save(tmp_path / "copy.ply", load_gaussians(write(tmp_path / "a.ply", flat_row(0.0, (1, 0, 0, 0), (-2, -3)))))
    assert "scale_2" in parse_ply((tmp_path / "copy.ply").read_bytes())[0]
    assert load_gaussians(tmp_path / "copy.ply").scales.min() < 0.02 * np.exp(-3)


@pytest.mark.parametrize("missing", [("scale_1",), ("scale_1", "scale_2"), ("scale_2", "rot_3")])
def test_ply_may_lack_scale_2_but_no_other_scale(tmp_path: Path, missing: tuple[str, ...]) -> None:
    """A PLY of 2D Gaussians has two scales; a PLY without scale_1 or a rotation is refused."""
    row = {name: value for name, value in (GEOMETRY | ROTATION | SH).items() if name not in missing}
    with pytest.raises(ls.FormatError, match=f"no {missing[-1] if missing[-1] != 'scale_2' else 'scale_1'}"):
        ls.load(write(tmp_path / "a.ply", row))
