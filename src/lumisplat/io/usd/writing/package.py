"""From a stage in memory to files: a layer with a folder beside it, or a package that holds both."""

from __future__ import annotations

import os
import tempfile
import zipfile
from pathlib import Path

from lumisplat.constants.usd import USD_PACKAGE_BYTES_MAX
from lumisplat.errors import FormatError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.native import utf8_path
from lumisplat.io.usd.library import pxr
from lumisplat.io.usd.writing.stage import StageWriter, folder_of


def write_files(writer: StageWriter) -> None:
    """Writes a stage; each file appears complete or not at all, the layer last.

    Raises:
        FormatError: A file cannot be written, or a package would be too large.
    """
    path = writer.path
    if path.suffix.lower() == ".usdz":
        _write_package(writer)
        return
    for name, data in writer.files.items():
        with atomic_write(path.parent / folder_of(path) / name) as temporary:
            temporary.write_bytes(data)
    with atomic_write(path) as temporary:
        _export(writer, temporary)


def _write_package(writer: StageWriter) -> None:
    path, folder_name = writer.path, folder_of(writer.path)
    with tempfile.TemporaryDirectory() as folder:
        layer = Path(folder) / f"{_plain(path.stem)}.usdc"
        _export(writer, layer)
        files = {layer: layer.name}
        for name, data in writer.files.items():
            file = Path(folder) / name
            file.write_bytes(data)
            files[file] = f"{folder_name}/{name}"
        size = sum(file.stat().st_size for file in files)
        if size > USD_PACKAGE_BYTES_MAX:
            raise FormatError(path, f"would have {size:,} bytes, more than a package can hold: write a .usdc")
        with atomic_write(path) as temporary, utf8_path(temporary) as text:
            package = pxr().Sdf.ZipFileWriter.CreateNew(text)
            for file, name in files.items():  # the first one is what a package shows
                package.AddFile(os.fspath(file), name)
            if not package.Save() or not _is_whole(temporary, len(files)):
                raise FormatError(path, "cannot be written: is the disk full?")


def _is_whole(package: Path, count: int) -> bool:
    """Whether all of a package is on the disk: the library says that it saved what a full one did not take."""
    try:
        with zipfile.ZipFile(package) as written:
            return len(written.infolist()) == count and written.testzip() is None
    except zipfile.BadZipFile:
        return False


def _export(writer: StageWriter, file: Path) -> None:
    with utf8_path(file) as text:
        if not writer.stage.GetRootLayer().Export(text):
            raise FormatError(writer.path, "cannot be written: is the disk full?")


def _plain(stem: str) -> str:
    """The name of a layer inside of a package."""
    return "".join(c if c.isascii() and (c.isalnum() or c in "_-") else "_" for c in stem)[:64] or "scene"
