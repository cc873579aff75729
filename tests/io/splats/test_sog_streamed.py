"""Reading of streamed SOG at a level and within a budget, and of .splat."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.errors import FormatError, SceneError
from lumisplat.scene.gaussians import Gaussians
from support.files.splat_files import capture, load_gaussians, rows_of_level, sog_files, splat_rows, streamed, unpacked
from support.kinds import expect_kind


def test_sog_leaves_that_lack_the_chosen_level_load_their_next_coarser_level(tmp_path: Path) -> None:
    """Level 0 is the whole finest capture; coarser captures have no SH here."""
    path = streamed(tmp_path)
    finest, middle, coarsest = (load_gaussians(tmp_path / name) for name in ("0_0", "1_0", "2_0"))
    for source in (path, tmp_path):
        np.testing.assert_array_equal(expect_kind(Gaussians, ls.load(source)).means, finest.means)
    one = expect_kind(Gaussians, ls.load(path, lod=1))
    np.testing.assert_array_equal(one.means, np.concatenate([middle.means, coarsest.means[5:]]))
    np.testing.assert_array_equal(one.sh[:20], middle.sh)
    np.testing.assert_array_equal(one.sh[20:, :1], coarsest.sh[5:])
    np.testing.assert_array_equal(one.sh[20:, 1:], 0.0)
    np.testing.assert_array_equal(expect_kind(Gaussians, ls.load(path, lod=2)).means, coarsest.means)


@pytest.mark.parametrize(("budget", "count"), [(10**6, 50), (50, 50), (49, 23), (23, 23), (22, 8), (8, 8), (7, 8)])
def test_gaussian_budget_of_load_selects_the_finest_sog_level_within_it(
    tmp_path: Path, budget: int, count: int, caplog: pytest.LogCaptureFixture
) -> None:
    """A log line names the level; if no level is small enough, the coarsest is read, and the line says so."""
    assert expect_kind(Gaussians, ls.load(streamed(tmp_path), budget=budget)).count == count
    (line,) = caplog.messages
    assert line.endswith(f"level {(50, 23, 8).index(count)} (of 0 to 2) is loaded, with {count} Gaussians")
    assert ("no level has as few as 7: " in line) == (budget == 7)


def test_environment_capture_of_streamed_sog_is_in_every_level(tmp_path: Path) -> None:
    """The metadata name one further capture, whose Gaussians are added at each level."""
    unpacked(tmp_path / "sky", sog_files(capture(11), linear=False))
    path = streamed(tmp_path, environment="sky/meta.json")
    assert expect_kind(Gaussians, ls.load(path, lod=2)).count == 8 + 11


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"lodLevels": 0}, "has 0 levels"),
        ({"lodLevels": 10**9}, "has 1000000000 levels"),
        ({"tree": {}}, "zero Gaussians at level 0"),
        ({"tree": {"lods": {}}}, "a leaf has no level"),
        ({"tree": {"lods": {"0": rows_of_level(3, 0, 1)}}}, "has 3 levels and 3 captures"),
        ({"tree": {"lods": {"7": rows_of_level(0, 0, 1)}}}, "damaged: a leaf has level 7"),
        ({"tree": {"lods": {"0": rows_of_level(0, -1, 1)}}}, "damaged: a leaf has level 0"),
        ({"tree": {"lods": {"0": rows_of_level(0, 40, 11)}}}, "rows 40 to 51 of 0_0/meta.json, which holds 50"),
        ({"tree": {"children": [{"lods": {"0": rows_of_level(0, 0, 50)}}] * 9}}, "overlaps another leaf"),
        ({"tree": None}, "damaged, or not a streamed SOG"),
        (
            {
                "filenames": ["0_0/meta.json", "./0_0/../0_0/meta.json"],
                "tree": {"children": [{"lods": {"0": rows_of_level(file, 0, 50)}} for file in (0, 1)]},
            },
            "overlaps another leaf",
        ),
        ({"filenames": ["../../x/meta.json"] * 3}, "not in its folder"),
        ({"filenames": ["gone/meta.json"] * 3}, "no such file"),
    ],
)
def test_damaged_lod_meta_json_of_streamed_sog_is_refused(
    tmp_path: Path, changed: dict[str, Any], message: str
) -> None:
    """The one-line error names the fault."""
    with pytest.raises(FormatError, match=message) as error:
        ls.load(streamed(tmp_path, **changed))
    assert "\n" not in str(error.value)


def test_error_for_an_unknown_level_of_streamed_sog_states_the_valid_range(tmp_path: Path) -> None:
    """The message names level 0 as the finest and level 2 as the coarsest."""
    with pytest.raises(FormatError, match=r"has no level 3: its levels are 0 \(finest\) to 2"):
        ls.load(streamed(tmp_path), lod=3)


@pytest.mark.parametrize("count", [60, pytest.param(2000, marks=pytest.mark.deep)])
def test_streamed_sog_with_mutated_lod_meta_json_either_loads_or_is_refused(tmp_path: Path, count: int) -> None:
    """Characters are changed, or the end is lost; errors are one line."""
    path = streamed(tmp_path)
    original = path.read_bytes()
    rng = np.random.default_rng(5)
    for _ in range(count):
        data = bytearray(original)
        for position in rng.integers(0, len(data), 3):
            data[position] = rng.integers(32, 127)
        path.write_bytes(data if rng.random() < 0.8 else data[: rng.integers(1, len(data))])
        try:
            ls.load(path, drop_invalid=True)
        except SceneError as error:
            assert "\n" not in str(error)


@pytest.mark.data
def test_levels_of_downloaded_playbot_scene_match_its_metadata(data_dir: Path) -> None:
    """PlayCanvas's scene has the counts of its tree at the finest level; coarser levels fill the same volume."""
    folder = data_dir / "splats" / "playbot"
    some = expect_kind(Gaussians, ls.load(folder, budget=20_000))
    other = expect_kind(Gaussians, ls.load(folder / "lod-meta.json", lod=4))
    assert (some.count, other.count) == (8_406, 8_406)
    low, high = some.bounds()
    bound = json.loads((folder / "lod-meta.json").read_text())["tree"]["bound"]
    assert (low > np.array(bound["min"]) - 0.05).all() and (high < np.array(bound["max"]) + 0.05).all()


def test_colours_and_rotations_read_from_splat_files_have_8_bits_of_precision(tmp_path: Path) -> None:
    """Positions and scales of a .splat are exact; colours, opacities and rotations have 8 bits."""
    base = capture(100, 0)
    (tmp_path / "a.splat").write_bytes(splat_rows(base))
    loaded = load_gaussians(tmp_path / "a.splat")
    np.testing.assert_array_equal(loaded.means, base.means)
    np.testing.assert_array_equal(loaded.scales, base.scales)
    np.testing.assert_allclose(loaded.opacities, base.opacities, atol=0.5001 / 255)
    np.testing.assert_allclose(loaded.sh, base.sh, atol=0.5001 / 255 / 0.28209)
    cosines = np.abs(np.einsum("ij,ij->i", loaded.rotations_wxyz, base.rotations_wxyz))
    assert cosines.min() > 1 - 2 * (1 / 128) ** 2  # four components, each half a step off, or a whole one at 1


def test_splat_file_with_a_partial_row_is_refused(tmp_path: Path) -> None:
    """The size is not a multiple of 32 bytes."""
    (tmp_path / "a.splat").write_bytes(splat_rows(capture(3, 0))[:-1])
    with pytest.raises(FormatError, match="95 bytes are not a multiple of 32 per Gaussian"):
        ls.load(tmp_path / "a.splat")
