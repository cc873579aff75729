"""Output appears complete or not at all."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import pytest

import lumisplat as ls
from lumisplat.errors import FormatError
from lumisplat.io.files.atomic import atomic_write
from support.files.splat_files import capture


def test_success_renames(tmp_path: Path) -> None:
    """The file appears only when the block ends, in a folder made for it, and nothing else stays."""
    target = tmp_path / "new" / "deep" / "file.spz"
    with atomic_write(target) as temporary:
        temporary.write_text("done")
        assert temporary.suffix == ".spz"
        assert temporary.parent == target.parent
        assert not target.exists()
    assert target.read_text() == "done"
    assert list(target.parent.iterdir()) == [target]


@pytest.mark.parametrize("failure", [ValueError, KeyboardInterrupt, OSError])
def test_failure_leaves_the_old_file(tmp_path: Path, failure: type[BaseException]) -> None:
    """Whatever stops the block, the old content stays and the temporary file goes."""
    target = tmp_path / "file.ply"
    target.write_text("old")
    with pytest.raises((failure, FormatError)), atomic_write(target) as temporary:
        temporary.write_text("half")
        raise failure
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_a_folder_in_the_way(tmp_path: Path) -> None:
    """A folder of that name is refused before a file is written."""
    (tmp_path / "out.ply").mkdir()
    with pytest.raises(FormatError, match=r"out\.ply: is a folder"):
        ls.save(tmp_path / "out.ply", capture(3))


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.spz"])
def test_unwritable_folder(tmp_path: Path, name: str) -> None:
    """A parent that cannot be a folder is one clear error for every writer."""
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(FormatError, match="cannot be written"):
        ls.save(tmp_path / "file" / name, capture(3))
    assert (tmp_path / "file").read_text() == "in the way"


def test_unknown_output_extension(tmp_path: Path) -> None:
    """The known ones are listed."""
    with pytest.raises(FormatError, match=r"unknown extension '\.xyz', expected \.ply"):
        ls.save(tmp_path / "out.xyz", capture(3))
    assert not list(tmp_path.iterdir())


def test_only_gaussians_are_saved(tmp_path: Path) -> None:
    """The error for anything else names its type."""
    with pytest.raises(FormatError, match="only Gaussians can be saved, got Scene"):
        ls.save(tmp_path / "out.ply", cast(Any, ls.Scene()))
