"""Missing files: every loader raises an error that is also Python's FileNotFoundError."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import lumisplat as ls

LOADERS: dict[str, Callable[[Path], Any]] = {
    "a.ply": ls.load,
    "a.spz": ls.load,
    "a.glb": ls.load,
    "meta.json": ls.load,
    "a.toml": ls.load,
    "b.toml": ls.load_config,
    "c.toml": ls.load_animation,
    "cameras.json": ls.load_cameras,
    "camera_path.json": ls.io.load_camera_path,
    "a.png": ls.load_image,
    "a.hdr": ls.io.load_radiance,
    "b.glb": ls.avatars.load_rig,
    "smpl.npz": ls.avatars.load_rig,
    "frames": lambda folder: ls.io.load_sequence(folder, 24.0),
    "map.npz": lambda path: ls.DeepShadowMap.load(path, device="cpu"),
}


@pytest.mark.parametrize("name", LOADERS)
@pytest.mark.parametrize("kind", [FileNotFoundError, ls.FormatError, ls.errors.MissingFileError])
def test_every_loader_raises_file_not_found_for_a_missing_file(
    tmp_path: Path, name: str, kind: type[Exception]
) -> None:
    """The error is also a FormatError; its message and its ``path`` name the file."""
    with pytest.raises(kind, match=r": no such (file|folder)$") as caught:
        LOADERS[name](tmp_path / name)
    assert isinstance(caught.value, ls.errors.MissingFileError) and caught.value.path == str(tmp_path / name)


def test_unreadable_existing_files_are_not_reported_as_missing(tmp_path: Path) -> None:
    """Damaged files and folders raise a FormatError that is no OSError."""
    (tmp_path / "a.ply").write_bytes(b"ply")
    for path in (tmp_path / "a.ply", tmp_path):
        with pytest.raises(ls.FormatError) as caught:
            ls.load(path)
        assert not isinstance(caught.value, OSError)


def test_missing_file_errors_survive_pickling(tmp_path: Path) -> None:
    """Worker processes raise missing file errors; message and path survive."""
    with pytest.raises(ls.errors.MissingFileError) as raised:
        ls.load(tmp_path / "none.ply")
    error = pickle.loads(pickle.dumps(raised.value))
    assert type(error) is ls.errors.MissingFileError
    assert (str(error), error.path) == (str(raised.value), str(tmp_path / "none.ply"))
