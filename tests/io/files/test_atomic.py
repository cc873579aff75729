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


def test_atomic_write_leaves_only_the_finished_file(tmp_path: Path) -> None:
    """The file appears when the ``with`` block ends, in a folder made for it."""
    target = tmp_path / "new" / "deep" / "file.spz"
    with atomic_write(target) as temporary:
        temporary.write_text("done")
        assert temporary.suffix == ".spz"
        assert temporary.parent == target.parent
        assert not target.exists()
    assert target.read_text() == "done"
    assert list(target.parent.iterdir()) == [target]


def test_failed_atomic_write_removes_the_folders_it_created(tmp_path: Path) -> None:
    """Folders stay if they existed before or if another process has written to them meanwhile."""
    (tmp_path / "old").mkdir()
    with pytest.raises(FormatError), atomic_write(tmp_path / "old" / "new" / "deep" / "a.ply"):
        raise OSError(28, "No space left on device")
    assert list(tmp_path.rglob("*")) == [tmp_path / "old"]
    with pytest.raises(FormatError), atomic_write(tmp_path / "new" / "deep" / "a.ply") as temporary:
        (temporary.parents[1] / "used").write_text("by others")
        raise OSError(28, "No space left on device")
    assert sorted((tmp_path / "new").iterdir()) == [tmp_path / "new" / "used"]


@pytest.mark.parametrize("name", ["meta.json", "lod-meta.json"])
def test_failed_write_of_several_files_leaves_none_of_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """If one of the files cannot be written, the files written before are removed; unrelated files stay."""
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


def test_errors_of_writing_that_lack_an_error_number_suggest_a_full_disk(tmp_path: Path) -> None:
    """NumPy raises an error without a number if a full disk truncates an array."""
    message = "cannot be written: 400 requested and 16 written: is the disk full"
    with pytest.raises(FormatError, match=message), atomic_write(tmp_path / "a.npy"):
        raise OSError("400 requested and 16 written")
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(os.name != "posix", reason="elsewhere folders have no descriptors")
def test_atomic_write_syncs_file_before_rename_and_folder_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a power cut, either the old or the new file exists."""
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
def test_failed_atomic_write_keeps_the_existing_file(tmp_path: Path, failure: type[BaseException]) -> None:
    """After any exception in the ``with`` block the old file is intact, and the temporary file is removed."""
    target = tmp_path / "file.ply"
    target.write_text("old")
    with pytest.raises((failure, FormatError)), atomic_write(target) as temporary:
        temporary.write_text("half")
        raise failure
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_saving_to_the_path_of_a_folder_is_refused(tmp_path: Path) -> None:
    """The refusal comes before any file is written."""
    (tmp_path / "out.ply").mkdir()
    with pytest.raises(FormatError, match=r"out\.ply: is a folder"):
        ls.save(tmp_path / "out.ply", capture(3))


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.spz"])
def test_every_capture_writer_reports_an_unwritable_parent_folder(tmp_path: Path, name: str) -> None:
    """The parent of the output path is a file."""
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(FormatError, match="cannot be written"):
        ls.save(tmp_path / "file" / name, capture(3))
    assert (tmp_path / "file").read_text() == "in the way"


def test_save_with_an_unknown_extension_lists_the_supported_ones(tmp_path: Path) -> None:
    """The error of ``save`` names the extensions of captures."""
    with pytest.raises(FormatError, match=r"unknown extension '\.xyz', expected \.ply"):
        ls.save(tmp_path / "out.xyz", capture(3))
    assert not list(tmp_path.iterdir())


def test_error_for_saving_a_scene_as_ply_lists_the_formats_that_store_scenes(tmp_path: Path) -> None:
    """A PLY file stores only Gaussians."""
    with pytest.raises(FormatError, match=r"stores only Gaussians: save scenes and meshes as \.glb, \.gltf"):
        ls.save(tmp_path / "out.ply", cast(Any, ls.Scene()))


def test_atomic_write_to_a_symbolic_link_writes_its_target(tmp_path: Path) -> None:
    """The link stays; the target is written in the target's folder, whether it exists or not."""
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


def test_saving_to_a_named_pipe_is_refused(tmp_path: Path) -> None:
    """Only regular files are replaced."""
    os.mkfifo(tmp_path / "pipe.ply")
    with pytest.raises(FormatError, match=r"pipe\.ply: is a device, a pipe or a socket"):
        ls.save(tmp_path / "pipe.ply", capture(3))
    assert (tmp_path / "pipe.ply").is_fifo()


def test_temporary_files_of_killed_writers_are_removed(tmp_path: Path) -> None:
    """The next process that writes into the folder removes temporary files, except those still being written."""
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


def test_error_for_arguments_of_save_in_the_wrong_order_explains_their_order() -> None:
    """The message says that the path comes first."""
    with pytest.raises(ConfigError, match=r"save\(path, asset\): the path comes first, got Mesh"):
        ls.save(cast(Any, ls.box()), cast(Any, "box.glb"))
    with pytest.raises(ConfigError, match=r"save_cameras\(path, cameras\): the path comes first, got list"):
        ls.save_cameras(cast(Any, [ls.Camera.look_at((0, 0, 3), (0, 0, 0))]), cast(Any, "cameras.json"))
