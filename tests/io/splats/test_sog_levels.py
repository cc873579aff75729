"""Writing of streamed SOG: levels, leaves, and other readers."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.errors import FormatError
from lumisplat.io.splats import streamed_sog
from support.files.splat_files import capture, load_gaussians
from support.kinds import expect_kind


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limits leaves to some dozens of Gaussians, and captures to two or three leaves."""
    sizes = {"SOG_CHUNK_COUNT": 100, "SOG_CHUNK_EXTENT": 3.0, "SOG_LEAF_MIN": 40, "SOG_LEVEL_MIN": 70}
    for name, value in sizes.items():
        monkeypatch.setattr(streamed_sog, name, value)


def leaves_of(node: dict[str, Any]) -> list[dict[str, Any]]:
    """Returns the leaves below a node."""
    return [leaf for child in node["children"] for leaf in leaves_of(child)] if "children" in node else [node]


def sorted_rows(values: np.ndarray) -> np.ndarray:
    """Returns rows sorted by their values."""
    return values[np.lexsort(values.T)]


def test_finest_level_of_streamed_sog_is_the_whole_capture(tmp_path: Path) -> None:
    """Each Gaussian occurs once, with positions within a 16-bit step."""
    given = capture(300, 1)
    ls.save(tmp_path / "city" / "lod-meta.json", given)
    read = load_gaussians(tmp_path / "city")
    assert read.count == 300
    np.testing.assert_allclose(sorted_rows(read.means)[:, 2], sorted_rows(given.means)[:, 2], atol=1e-3)
    ls.save(tmp_path / "a.sog", given)
    alone = load_gaussians(tmp_path / "a.sog")
    for field in ("opacities", "scales"):
        np.testing.assert_allclose(
            np.sort(getattr(read, field), axis=0), np.sort(getattr(alone, field), axis=0), rtol=0.05
        )
    assert read.sh_degree == 1


def test_levels_of_streamed_sog_halve_the_count_over_the_same_extent(tmp_path: Path) -> None:
    """In each leaf a level has about half of the Gaussians of the next finer one.

    The file states the counts, and mean opacity is preserved.
    """
    given = capture(600, 0)
    path = tmp_path / "lod-meta.json"
    ls.save(path, given)
    meta = json.loads(path.read_text())
    assert meta["lodLevels"] == 4 == streamed_sog.level_count(600)
    levels = [expect_kind(ls.Gaussians, ls.load(path, lod=level)) for level in range(4)]
    assert [one.count for one in levels] == meta["counts"] and meta["count"] == sum(meta["counts"])
    for fine, coarse in pairwise(levels):
        assert 0.4 < coarse.count / fine.count <= 0.5
    middle = [np.average(one.means, axis=0, weights=one.opacities * one.scales.max(axis=1) ** 2) for one in levels]
    assert np.abs(middle[3] - middle[0]).max() < 0.6
    assert expect_kind(ls.Gaussians, ls.load(path, budget=levels[2].count)).count == levels[2].count


def test_leaves_of_streamed_sog_have_few_gaussians_and_lie_inside_their_parent_nodes(tmp_path: Path) -> None:
    """Each leaf has all levels, and its box contains its Gaussians."""
    ls.save(tmp_path / "lod-meta.json", capture(600, 0))
    meta = json.loads((tmp_path / "lod-meta.json").read_text())
    leaves = leaves_of(meta["tree"])
    assert len(leaves) > 4
    captures = [load_gaussians(tmp_path / name) for name in meta["filenames"]]
    assert max(one.count for one in captures) <= 100 + 100
    inside = 0
    for leaf in leaves:
        assert sorted(leaf["lods"]) == ["0", "1", "2", "3"]
        low, high = (np.array(leaf["bound"][end]) for end in ("min", "max"))
        for rows in leaf["lods"].values():
            means = captures[rows["file"]].means[rows["offset"] : rows["offset"] + rows["count"]]
            assert (means > low - 0.01).all() and (means < high + 0.01).all()
            inside += len(means)
        assert leaf["lods"]["0"]["count"] <= 100
    assert inside == meta["count"]
    top_low, top_high = (np.array(meta["tree"]["bound"][end]) for end in ("min", "max"))
    assert (top_low <= np.min([leaf["bound"]["min"] for leaf in leaves], axis=0)).all()
    assert (top_high >= np.max([leaf["bound"]["max"] for leaf in leaves], axis=0)).all()


def test_streamed_sog_stores_any_number_of_coincident_gaussians(tmp_path: Path) -> None:
    """All Gaussians, or all but one, are at one position, which no split can separate."""
    for far in (0.0, 500.0):
        means = np.zeros((260, 3))
        means[0, 1] = far
        ls.save(tmp_path / "lod-meta.json", capture(260, 0, means=means))
        assert load_gaussians(tmp_path).count == 260


def test_interrupted_write_of_streamed_sog_leaves_no_lod_meta_json(tmp_path: Path) -> None:
    """An old lod-meta.json beside new captures would be inconsistent."""
    ls.save(tmp_path / "city" / "lod-meta.json", capture(300, 0))
    shutil.rmtree(tmp_path / "city" / "1_0")
    (tmp_path / "city" / "1_0").write_text("in the way")
    with pytest.raises(FormatError, match="1_0"):
        ls.save(tmp_path / "city" / "lod-meta.json", capture(300, 0, seed=1))
    assert not (tmp_path / "city" / "lod-meta.json").exists()


def test_splat_transform_reads_the_captures_of_streamed_sog(tmp_path: Path) -> None:
    """splat-transform does not read lod-meta.json, but each SOG that the file names, with equal values."""
    command = os.environ.get("SPLAT_TRANSFORM") or shutil.which("splat-transform")
    if not command:
        pytest.skip("needs PlayCanvas's splat-transform: npm install -g @playcanvas/splat-transform@2.7.1")
    ls.save(tmp_path / "lod-meta.json", capture(300, 1))
    for name in json.loads((tmp_path / "lod-meta.json").read_text())["filenames"][:2]:
        done = subprocess.run(
            [*command.split(), tmp_path / name, tmp_path / "b.ply", "-w"], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        theirs, ours = load_gaussians(tmp_path / "b.ply"), load_gaussians(tmp_path / name)
        np.testing.assert_allclose(theirs.means, ours.means, rtol=2e-5, atol=2e-5)
        np.testing.assert_allclose(theirs.sh, ours.sh, rtol=2e-5, atol=2e-5)
