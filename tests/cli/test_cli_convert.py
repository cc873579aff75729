"""Tests ``lumisplat convert``: its edits, their order, and its output."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.cli.commands.convert import _target_count, _value_ranges
from support.files.cli_files import Workspace


@pytest.fixture
def work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Workspace:
    """Returns a folder with a capture of 60 Gaussians."""
    return Workspace(tmp_path, capsys)


def same(first: ls.Gaussians, second: ls.Gaussians) -> None:
    """Asserts that all arrays are equal within the rounding of a PLY."""
    assert first.arrays().keys() == second.arrays().keys()
    for name, values in first.arrays().items():
        np.testing.assert_allclose(values, second.arrays()[name], rtol=2e-6, atol=2e-6)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ("--box -1 -1 3 1 1 5", lambda g: ls.editing.crop(g, box=((-1, -1, 3), (1, 1, 5)))),
        ("--sphere 0 0 4 1.5 --outside", lambda g: ls.editing.crop(g, sphere=((0, 0, 4), 1.5), outside=True)),
        (
            "--keep opacity=0.3.. --keep x=-1..0.5 --keep scale_max=..0.2",
            lambda g: ls.editing.select(g, opacity=(0.3, None), x=(-1, 0.5), scale_max=(None, 0.2)),
        ),
        ("--floaters 5", lambda g: ls.editing.remove_floaters(g, 5)),
        ("--decimate 20", lambda g: ls.editing.decimate(g, 20)),
        ("--decimate 25%", lambda g: ls.editing.decimate(g, 15)),
        ("--morton", ls.editing.sort_morton),
        (
            "--scale 2 --rotate 180 0 90 --translate 1 -2 3",
            lambda g: ls.transform(g, scale=2, rotation_degrees=(180, 0, 90), translation=(1, -2, 3)),
        ),
        # Edits are applied in the order of the help, so the sphere is in coordinates of the file.
        (
            "--translate 50 0 0 --decimate 10 --sphere 0 0 4 1.5",
            lambda g: ls.transform(
                ls.editing.decimate(ls.editing.crop(g, sphere=((0, 0, 4), 1.5)), 10), translation=(50, 0, 0)
            ),
        ),
    ],
)
def test_each_edit_option_of_convert_gives_the_capture_of_its_library_function(
    work: Workspace, options: str, expected: Callable[[ls.Gaussians], ls.Gaussians]
) -> None:
    """The written capture equals the function's result."""
    outcome = work.run("convert", "@capture.ply", "@out.ply", *options.split())
    assert (outcome.status, outcome.err) == (0, "")
    same(work.capture("out.ply"), expected(work.capture("capture.ply")))


def test_convert_joins_several_captures_in_order(work: Workspace) -> None:
    """All files before ``-o`` are joined."""
    capture = work.capture("capture.ply")
    ls.save(work.path("other.ply"), ls.transform(capture, translation=(5, 0, 0)))
    outcome = work.run("convert", "@capture.ply", "@other.ply", "@capture.ply", "-o", "@all.ply")
    assert outcome.status == 0
    assert "all.ply: 180 Gaussians" in outcome.out
    same(work.capture("all.ply").subset(np.arange(60, 120)), work.capture("other.ply"))


def test_convert_prints_the_effect_of_each_edit(work: Workspace) -> None:
    """The output has a line for each option that changed the count, and one for the file."""
    lines = work.run(
        "convert", "@capture.ply", "-o", "@a.ply", "--sphere", "0", "0", "4", "1.5", "--decimate", "10"
    ).out
    first, second, last = lines.splitlines()
    inside = ls.editing.crop(work.capture("capture.ply"), sphere=((0, 0, 4), 1.5)).count
    assert (first, second) == (f"--sphere: 60 -> {inside} Gaussians", f"--decimate: {inside} -> 10 Gaussians")
    assert last.startswith(str(work.path("a.ply"))) and "10 Gaussians, SH degree 0, " in last
    one = work.run("convert", "@capture.ply", "-o", "@b.ply", "--decimate", "1").out
    assert "--decimate: 60 -> 1 Gaussian\n" in one and "1 Gaussian, SH degree 0, " in one


def test_sh_degree_option_of_convert_removes_sh_coefficients_or_pads_them_with_zeros(work: Workspace) -> None:
    """Missing degrees are padded with zeros to 62 columns, as some importers require."""
    capture = work.capture("capture.ply")
    ls.save(work.path("sh2.ply"), replace(capture, sh=np.ones((60, 9, 3))))
    assert "SH degree 1" in work.run("convert", "@sh2.ply", "@out.ply", "--sh-degree", "1").out
    assert "SH degree 3" in work.run("convert", "@capture.ply", "@out.ply", "--sh-degree", "3").out
    assert (work.folder / "out.ply").read_bytes().partition(b"end_header")[0].count(b"property float") == 62


def test_convert_with_drop_invalid_counts_the_dropped_gaussians(
    work: Workspace, caplog: pytest.LogCaptureFixture
) -> None:
    """Without ``--drop-invalid``, the file is refused."""
    data = bytearray(work.path("capture.ply").read_bytes())
    data[-4:] = np.float32(np.nan).tobytes()
    work.path("nan.ply").write_bytes(data)
    refused = work.run("convert", "@nan.ply", "@out.ply")
    assert refused.status == 2 and "1 NaN or infinite values in rot_3, in 1 of 60 Gaussians" in refused.err
    assert "out.ply" not in work.files()
    assert "59 Gaussians" in work.run("convert", "@nan.ply", "@out.ply", "--drop-invalid").out
    assert "dropped 1 of 60 Gaussians: 1 NaN or infinite values in rot_3" in caplog.text


@pytest.mark.parametrize(
    ("text", "count"), [("10", 10), ("25%", 250), ("0.01%", 1), ("12.5%", 125), ("200%", 2000), ("5000", 5000)]
)
def test_decimate_option_of_convert_accepts_counts_and_percentages(text: str, count: int) -> None:
    """At least one Gaussian remains."""
    assert _target_count(text, 1000) == count


def test_keep_option_of_convert_accepts_value_ranges_without_lower_or_upper_limit() -> None:
    """Either limit may be missing, and numbers may have any notation."""
    assert _value_ranges(["x=-1..2", "opacity=.5..", "scale_max=..1e-3"]) == {
        "x": (-1.0, 2.0),
        "opacity": (0.5, None),
        "scale_max": (None, 0.001),
    }


def test_convert_with_r3dg_columns_writes_materials_in_columns_of_r3dg(
    work: Workspace, caplog: pytest.LogCaptureFixture
) -> None:
    """Materials are read back, and the incident light with ``--incident``."""
    plain = work.capture("capture.ply")
    light = np.full((plain.count, 16, 3), 0.25)
    normals, albedo = np.tile([0.0, 0.0, 1.0], (plain.count, 1)), np.full((plain.count, 3), 0.5)
    made = replace(
        plain, normals=normals, albedo=albedo, roughness=np.full(plain.count, 1.0), metallic=None, incident=light
    )
    ls.save(work.path("made.ply"), made)
    outcome = work.run("convert", "@made.ply", "-o", "@theirs.ply", "--columns", "r3dg", "--incident")
    assert outcome.status == 0 and "roughness from 0.09 to 0.99" in caplog.text
    assert b"base_color_0" in (work.path("theirs.ply")).read_bytes()[:4000]
    loaded = ls.load(work.path("theirs.ply"), incident=True)
    assert isinstance(loaded, ls.Gaussians) and loaded.incident is not None
    np.testing.assert_array_equal(loaded.incident, light)
    assert work.run("convert", "@theirs.ply", "@ours.ply").status == 0
    back = work.capture("ours.ply")
    same(replace(back, sh=back.sh[:, : plain.sh.shape[1]]), replace(made, incident=None, roughness=back.roughness))
    for options, problem in (
        (("@made.ply", "@a.spz", "--columns", "r3dg"), "--columns r3dg needs a .ply, got"),
        (("@made.ply", "@a.compressed.ply", "--incident"), "--incident needs a .ply, got"),
        (("@capture.ply", "@a.ply", "--incident"), "has no incident light: leave out --incident"),
        (("@capture.ply", "@a.ply", "--columns", "r3dg"), "the capture has no albedo"),
    ):
        refused = work.run("convert", *options)
        assert refused.status == 2 and problem in refused.err
