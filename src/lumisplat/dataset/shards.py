"""Shards of WebDataset: tar files whose members belong together by the first part of their names."""

from __future__ import annotations

import io
import tarfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from lumisplat.dataset.files import view_name
from lumisplat.errors import FormatError
from lumisplat.io.files.atomic import atomic_write

SHARD_FOLDER = "shards"


def write_shards(folder: Path, records: Sequence[Mapping[str, Any]], views: int) -> list[Path]:
    """Writes the views of each part into shards ``train-000000.tar`` and so on, the same bytes each time.

    A view has the members ``view_000012.png``, ``view_000012.depth.npy`` and so on, ``view_000012.json`` last. Shards
    that are there from before and have no views any more are removed.

    Args:
        folder: The data set's.
        records: What is known of the views, in order.
        views: How many views a shard has, at most.

    Raises:
        FormatError: A file cannot be read or written.
    """
    shards: list[Path] = []
    for split in ("train", "val", "test"):
        chosen = [record for record in records if record["split"] == split]
        for number, first in enumerate(range(0, len(chosen), views)):
            path = folder / SHARD_FOLDER / f"{split}-{number:06d}.tar"
            with atomic_write(path) as temporary:
                _write_shard(temporary, folder, chosen[first : first + views])
            shards.append(path)
    remove_shards(folder, shards)
    return shards


def remove_shards(folder: Path, kept: Sequence[Path]) -> None:
    """Removes shards that are of views from before."""
    for path in (folder / SHARD_FOLDER).glob("*-??????.tar"):
        if path not in kept:
            with suppress(OSError):
                path.unlink()


def _write_shard(path: Path, folder: Path, records: Sequence[Mapping[str, Any]]) -> None:
    """Writes one tar file, without times and owners."""
    with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as tar:
        for record in records:
            for member, file in _members(folder, record).items():
                try:
                    content = file.read_bytes()
                except OSError as error:
                    raise FormatError(file, f"cannot be read: {error.strerror or error}") from None
                entry = tarfile.TarInfo(member)
                entry.size, entry.mode = len(content), 0o644
                tar.addfile(entry, io.BytesIO(content))


def _members(folder: Path, record: Mapping[str, Any]) -> dict[str, Path]:
    """The files of a view by the names of members: the layer and the extension follow the view's name."""
    name, files = view_name(record["view"]), record["files"]
    members: dict[str, Path] = {}
    for layer, file in files.items():
        suffix = Path(file).suffix
        members[f"{name}{suffix}" if layer == "color" else f"{name}.{layer}{suffix}"] = folder / file
    members[f"{name}.json"] = folder / "views" / f"{name}.json"
    return members
