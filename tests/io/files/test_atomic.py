"""Atomic writing: output appears complete or not at all."""

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


def test_successful_write_leaves_only_the_file(tmp_path: Path) -> None:
    """The file appears when the block ends, in a folder made for it."""
    target = tmp_path / "new" / "deep" / "file.spz"
    with atomic_write(target) as temporary:
        temporary.write_text("done")
        assert temporary.suffix == ".spz"
        assert temporary.parent == target.parent
        assert not target.exists()
    assert target.read_text() == "done"
    assert list(target.parent.iterdir()) == [target]


def test_failed_write_removes_the_folders_it_made(tmp_path: Path) -> None:
    """Existing folders stay, and so do those that another process has used meanwhile."""
    (tmp_path / "old").mkdir()
    with pytest.raises(FormatError), atomic_write(tmp_path / "old" / "new" / "deep" / "a.ply"):
        raise OSError(28, "No space left on device")
    assert list(tmp_path.rglob("*")) == [tmp_path / "old"]
    with pytest.raises(FormatError), atomic_write(tmp_path / "new" / "deep" / "a.ply") as temporary:
        (temporary.parents[1] / "used").write_text("by others")
        raise OSError(28, "No space left on device")
    assert sorted((tmp_path / "new").iterdir()) == [tmp_path / "new" / "used"]


@pytest.mark.parametrize("name", ["meta.json", "lod-meta.json"])
def test_failed_multi_file_write_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """If one file of several cannot be written, the others are removed; unrelated files stay."""
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


def test_write_errors_without_errno_suggest_a_full_disk(tmp_path: Path) -> None:
    """NumPy raises such an error for an array that a full disk cuts off."""
    message = "cannot be written: 400 requested and 16 written: is the disk full"
    with pytest.raises(FormatError, match=message), atomic_write(tmp_path / "a.npy"):
        raise OSError("400 requested and 16 written")
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(os.name != "posix", reason="elsewhere folders have no descriptors")
def test_file_is_synced_before_it_is_renamed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Then the folder: after a power cut, either the old or the new file is there."""
    target = tmp_path / "file.ply"
    done: list[tuple[str, int, int]] = []
    fsync, replace = os.fsync, os.replace

    def syncing(descriptor: int) -> None:
        status = os.fstat(descriptor)
        done.append(("sync", status.st_ino, status.st_size if stat.S_ISREG(status.st_mode) else -1))
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
def test_failed_write_keeps_the_old_file(tmp_path: Path, failure: type[BaseException]) -> None:
    """Any exception in the block keeps it; the temporary file is removed."""
    target = tmp_path / "file.ply"
    target.write_text("old")
    with pytest.raises((failure, FormatError)), atomic_write(target) as temporary:
        temporary.write_text("half")
        raise failure
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_writing_to_a_folder_path_is_refused(tmp_path: Path) -> None:
    """No file is written before the refusal."""
    (tmp_path / "out.ply").mkdir()
    with pytest.raises(FormatError, match=r"out\.ply: is a folder"):
        ls.save(tmp_path / "out.ply", capture(3))


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.spz"])
def test_unwritable_parent_gives_one_error_in_every_writer(tmp_path: Path, name: str) -> None:
    """A parent that is a file."""
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(FormatError, match="cannot be written"):
        ls.save(tmp_path / "file" / name, capture(3))
    assert (tmp_path / "file").read_text() == "in the way"


def test_unknown_output_extension_lists_the_known_ones(tmp_path: Path) -> None:
    """The error of ``save`` lists the extensions."""
    with pytest.raises(FormatError, match=r"unknown extension '\.xyz', expected \.ply"):
        ls.save(tmp_path / "out.xyz", capture(3))
    assert not list(tmp_path.iterdir())


def test_saving_a_scene_as_ply_lists_the_scene_formats(tmp_path: Path) -> None:
    """A .ply stores only Gaussians."""
    with pytest.raises(FormatError, match=r"stores only Gaussians: save scenes and meshes as \.glb, \.gltf"):
        ls.save(tmp_path / "out.ply", cast(Any, ls.Scene()))


def test_symbolic_links_are_kept_and_their_target_written(tmp_path: Path) -> None:
    """The target is written in its own folder, whether it exists or not."""
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


def test_writing_to_a_pipe_is_refused(tmp_path: Path) -> None:
    """Only regular files are replaced."""
    os.mkfifo(tmp_path / "pipe.ply")
    with pytest.raises(FormatError, match=r"pipe\.ply: is a device, a pipe or a socket"):
        ls.save(tmp_path / "pipe.ply", capture(3))
    assert (tmp_path / "pipe.ply").is_fifo()


def test_leftovers_of_killed_processes_are_removed(tmp_path: Path) -> None:
    """The next process that writes into the folder removes them, except files still being written."""
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


def test_swapped_arguments_of_save_are_explained() -> None:
    """The message says that the path comes first."""
    with pytest.raises(ConfigError, match=r"save\(path, asset\): the path comes first, got Mesh"):
        ls.save(cast(Any, ls.box()), cast(Any, "box.glb"))
    with pytest.raises(ConfigError, match=r"save_cameras\(path, cameras\): the path comes first, got list"):
        ls.save_cameras(cast(Any, [ls.Camera.look_at((0, 0, 3), (0, 0, 0))]), cast(Any, "cameras.json"))
