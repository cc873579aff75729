"""Tests files of reports, which are replaced whole or not at all."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import lumisplat as ls
from lumisplat.cli.output import comparisons
from lumisplat.cli.output.comparisons import write_comparison, write_json
from support.files.small_disks import small_disk

NOISE = np.random.default_rng(0).random((60, 40, 3))
SMALL = np.zeros((4, 4, 3))


def test_former_report_files_stay_unchanged_if_the_disk_is_full(tmp_path: Path) -> None:
    """No partial or temporary file is left."""
    with small_disk(tmp_path / "disk", "16k") as disk:
        write_json(disk / "report.json", {"psnr": 31.0})
        write_comparison(disk / "door.png", [(SMALL, SMALL)])
        with pytest.raises(ls.FormatError, match=r"report\.json: cannot be written: No space left on device"):
            write_json(disk / "report.json", {"psnr": list(range(4000))})
        with pytest.raises(ls.FormatError, match=r"door\.png: cannot be written: No space left on device"):
            write_comparison(disk / "door.png", [(NOISE, NOISE[::-1])])
        assert sorted(os.listdir(disk)) == ["door.png", "report.json"]
        assert json.loads((disk / "report.json").read_text()) == {"psnr": 31.0}
        with Image.open(disk / "door.png") as image:
            assert image.size == (12, 4)


def test_temporary_file_of_a_running_report_writer_is_not_removed_by_other_writers(tmp_path: Path) -> None:
    """Writers remove temporary files of killed runs in their folder, but not those of running processes."""
    with comparisons._replaced(tmp_path / "report.json") as temporary:
        temporary.write_text("{}")
        ls.save(tmp_path / "other.ply", ls.gaussians_from_mesh(ls.plane(1.0, 1.0), 4))
    assert sorted(os.listdir(tmp_path)) == ["other.ply", "report.json"]


def test_written_reports_replace_earlier_ones(tmp_path: Path) -> None:
    """A path that is no folder is reported."""
    for psnr in (31.0, 32.0):
        write_json(tmp_path / "report.json", {"psnr": psnr})
    assert json.loads((tmp_path / "report.json").read_text()) == {"psnr": 32.0}
    assert os.listdir(tmp_path) == ["report.json"]
    with pytest.raises(ls.FormatError, match="cannot be written: Not a directory"):
        write_json(tmp_path / "report.json" / "b.json", {})
