"""Any file name that the system allows works in every reader and writer."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.errors import FormatError
from lumisplat.io.images.exr import write_exr
from support.files.splat_files import capture

FOREIGN = os.fsdecode(b"fa\xe7ade")
"""A Latin-1 name, as in old archives, which is not valid UTF-8."""
FACES = "\N{GRINNING FACE}" * 60
"""A name of 240 bytes."""


def _camera() -> ls.Camera:
    return ls.Camera.look_at((0, 0, -3), (0, 0, 0), (0, -1, 0), width=8, height=6)


def _picture(path: Path) -> None:
    write_exr(path, {name: np.ones((6, 8), np.float32) for name in "RGB"})


ROUND_TRIPS: dict[str, tuple[Callable[[Path], object], Callable[[Path], object]]] = {
    ".ply": (lambda path: ls.save(path, capture(3)), ls.load),
    ".compressed.ply": (lambda path: ls.save(path, capture(3)), ls.load),
    ".spz": (lambda path: ls.save(path, capture(3)), ls.load),
    ".exr": (_picture, ls.io.load_radiance),
    ".json": (lambda path: ls.save_cameras(path, [_camera()]), ls.load_cameras),
    ".toml": (lambda path: ls.save_config(path, ls.RenderConfig()), ls.load_config),
    ".webp": (lambda path: ls.save_animation(path, [np.zeros((8, 8, 3))] * 2, 10.0), ls.load_image),
}


@pytest.mark.parametrize("stem", [FOREIGN, FACES, "plain"], ids=["latin-1", "emoji", "plain"])
@pytest.mark.parametrize("suffix", ROUND_TRIPS)
def test_every_format_accepts_any_file_name_the_system_allows(tmp_path: Path, stem: str, suffix: str) -> None:
    """The folder's name is also not UTF-8, and no other file is left behind."""
    write, read = ROUND_TRIPS[suffix]
    path = tmp_path / FOREIGN / f"{stem}{suffix}"
    write(path)
    assert list(path.parent.iterdir()) == [path]
    read(path)


@pytest.mark.parametrize("name", ["null\0.ply", "half\ud800.ply"], ids=["null", "surrogate"])
def test_file_names_with_nul_or_surrogates_give_a_clear_error(tmp_path: Path, name: str) -> None:
    """Writing and reading give the same error."""
    with pytest.raises(FormatError, match="no file can have this name"):
        ls.save(tmp_path / name, capture(3))
    with pytest.raises(FormatError):
        ls.load(tmp_path / name)


@pytest.mark.parametrize(
    "read", [ls.load, ls.load_cameras, ls.load_image, ls.avatars.load_rig, lambda path: ls.io.load_sequence(path, 5.0)]
)
def test_reading_a_too_long_file_name_gives_a_format_error(tmp_path: Path, read: Callable[[Path], object]) -> None:
    """The name is longer than the file system allows."""
    with pytest.raises(FormatError, match=r"File name too long|no such f"):  # Python 3.14 reports the file as missing
        read(tmp_path / f"{'x' * 300}.glb")


def test_reading_a_damaged_exr_prints_nothing_but_the_error(tmp_path: Path) -> None:
    """OpenEXR's C++ code prints to both standard streams, which the reader silences."""
    _picture(tmp_path / "sky.exr")
    stored = (tmp_path / "sky.exr").read_bytes()
    (tmp_path / "sky.exr").write_bytes(stored[: len(stored) // 2])
    program = "import sys, lumisplat as ls\ntry: ls.io.load_radiance(sys.argv[1])\nexcept ls.FormatError as e: print(e)"
    command = [sys.executable, "-c", program, os.fspath(tmp_path / "sky.exr")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == (f"{tmp_path}/sky.exr: damaged, or not an EXR file\n", "")
