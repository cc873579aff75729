"""Output appears complete or not at all."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any, cast

import pytest

import lumisplat as ls
from lumisplat.errors import ConfigError, FormatError
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


def test_failures_leave_no_folder_that_was_made_for_the_file(tmp_path: Path) -> None:
    """But those that were there, or that somebody has used meanwhile."""
    (tmp_path / "old").mkdir()
    with pytest.raises(FormatError), atomic_write(tmp_path / "old" / "new" / "deep" / "a.ply"):
        raise OSError(28, "No space left on device")
    assert list(tmp_path.rglob("*")) == [tmp_path / "old"]
    with pytest.raises(FormatError), atomic_write(tmp_path / "new" / "deep" / "a.ply") as temporary:
        (temporary.parents[1] / "used").write_text("by others")
        raise OSError(28, "No space left on device")
    assert sorted((tmp_path / "new").iterdir()) == [tmp_path / "new" / "used"]


@pytest.mark.parametrize("name", ["meta.json", "lod-meta.json"])
def test_folders_that_are_not_finished_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Of a format of many files none is left where one of them cannot be written; others there stay."""
    folder = tmp_path / "new" / "deep"
    replace, done = os.replace, list[Path]()

    def failing(source: Path, to: Path) -> None:
        if len(done) == 2:
            raise OSError(28, "No space left on device")
        done.append(to)
        replace(source, to)

    monkeypatch.setattr(os, "replace", failing)
    with pytest.raises(FormatError, match="No space left on device"):
        ls.save(folder / name, capture(40))
    assert len(done) == 2 and not list(tmp_path.iterdir())
    done.clear()
    folder.mkdir(parents=True)
    (folder / "notes.txt").write_text("by others")
    with pytest.raises(FormatError, match="No space left on device"):
        ls.save(folder / name, capture(40))
    assert list(folder.iterdir()) == [folder / "notes.txt"]


def test_errors_without_a_number_are_of_the_disk(tmp_path: Path) -> None:
    """As NumPy's of an array that a full disk cuts off."""
    message = "cannot be written: 400 requested and 16 written: is the disk full"
    with pytest.raises(FormatError, match=message), atomic_write(tmp_path / "a.npy"):
        raise OSError("400 requested and 16 written")
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(os.name != "posix", reason="elsewhere folders have no descriptors")
def test_the_disk_has_a_file_before_it_has_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And the folder after: a power cut leaves the file of before, or that of now."""
    target = tmp_path / "file.ply"
    done: list[tuple[str, int, int]] = []
    fsync, replace = os.fsync, os.replace

    def syncing(descriptor: int) -> None:
        told = os.fstat(descriptor)
        done.append(("sync", told.st_ino, told.st_size if stat.S_ISREG(told.st_mode) else -1))
        fsync(descriptor)

    def replacing(source: Path, to: Path) -> None:
        done.append(("name", os.stat(source).st_ino, 4))
        replace(source, to)

    monkeypatch.setattr(os, "fsync", syncing)
    monkeypatch.setattr(os, "replace", replacing)
    with atomic_write(target) as temporary:
        temporary.write_text("done")
    file, folder = target.stat().st_ino, tmp_path.stat().st_ino
    assert done == [("sync", file, 4), ("name", file, 4), ("sync", folder, -1)]


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
    with pytest.raises(FormatError, match=r"stores only Gaussians: save scenes and meshes as \.glb, \.gltf"):
        ls.save(tmp_path / "out.ply", cast(Any, ls.Scene()))


def test_symbolic_links_stay(tmp_path: Path) -> None:
    """The file that a link leads to is written, in its own folder, whether it is there or not."""
    shelf, link = tmp_path / "shelf", tmp_path / "link.ply"
    shelf.mkdir()
    link.symlink_to(shelf / "real.ply")
    for content in ("first", "second"):
        with atomic_write(link) as temporary:
            assert temporary.parent == shelf
            temporary.write_text(content)
        assert link.is_symlink()
        assert (shelf / "real.ply").read_text() == content
    link.unlink()
    link.symlink_to(link)
    with pytest.raises(FormatError, match="link that leads to itself"), atomic_write(link):
        pass


def test_pipes_are_refused(tmp_path: Path) -> None:
    """What is no regular file is neither replaced nor written to."""
    os.mkfifo(tmp_path / "pipe.ply")
    with pytest.raises(FormatError, match=r"pipe\.ply: is a device, a pipe or a socket"):
        ls.save(tmp_path / "pipe.ply", capture(3))
    assert (tmp_path / "pipe.ply").is_fifo()


def test_leftovers_of_killed_processes_go(tmp_path: Path) -> None:
    """The next process that writes into the folder removes them, but no file that is still being written."""
    program = """
import os, signal, sys, time
from lumisplat.io.files.atomic import atomic_write
with atomic_write(sys.argv[1]) as temporary:
    temporary.write_text("half")
    print("written", flush=True)
    sys.stdin.read()
"""
    writer = [sys.executable, "-c", program]
    popen = partial(subprocess.Popen, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    with popen([*writer, str(tmp_path / "killed.ply")]) as killed, popen([*writer, str(tmp_path / "slow.ply")]) as slow:
        for process in (killed, slow):
            assert process.stdout is not None
            process.stdout.readline()
        killed.kill()
        killed.wait()
        own = tmp_path / ".notes.0123456789ab.txt"
        own.write_text("a hidden file of the user")
        assert len(list(tmp_path.iterdir())) == 3
        save = [sys.executable, "-c", program, str(tmp_path / "next.ply")]
        subprocess.run(save, stdin=subprocess.DEVNULL, capture_output=True, check=True)
        left = {path.name.split(".")[1] for path in tmp_path.iterdir() if path.name.startswith(".")}
        assert left == {"slow", "notes"}
        slow.communicate("")
    assert {path.name for path in tmp_path.iterdir()} == {own.name, "slow.ply", "next.ply"}


def test_swapped_arguments_are_named() -> None:
    """The path comes first, and who begins with the asset is told so."""
    with pytest.raises(ConfigError, match=r"save\(path, asset\): the path comes first, got Mesh"):
        ls.save(cast(Any, ls.box()), cast(Any, "box.glb"))
    with pytest.raises(ConfigError, match=r"save_cameras\(path, cameras\): the path comes first, got list"):
        ls.save_cameras(cast(Any, [ls.Camera.look_at((0, 0, 3), (0, 0, 0))]), cast(Any, "cameras.json"))
