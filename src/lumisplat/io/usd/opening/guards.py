"""What is checked before the library opens a file: counts that would exhaust memory, and files that it names.

The library reads every layer that a layer names, wherever it lies, and believes the counts in its binary files.
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lumisplat.constants.usd import USD_LAYERS_MAX
from lumisplat.errors import FormatError
from lumisplat.io.files.references import referenced_file
from lumisplat.io.files.source import check_regular
from lumisplat.io.usd.library import pxr
from lumisplat.io.usd.opening.crate import MAGIC, check_crate


def check_layers(path: Path, text: str) -> None:
    """Checks a file and all layers that it is composed of.

    Args:
        path: The file.
        text: A path of it that is UTF-8, as the library needs.

    Raises:
        FormatError: A layer claims more content than it can hold, is no regular file, or is named by a path that leaves
            the folder of ``path``, which is not allowed.
    """
    px, home = pxr(), path.parent
    waiting, seen = [path], {os.path.abspath(path)}
    while waiting:
        if len(seen) > USD_LAYERS_MAX:
            raise FormatError(path, f"is composed of more than {USD_LAYERS_MAX:,} layers")
        file = waiting.pop()
        if not file.exists():
            continue  # composed without it; a remark says so
        _check_file(file)
        layer = px.Sdf.Layer.FindOrOpen(text if file is path else os.fspath(file))
        if layer:
            layer.Reload()  # one that something still holds may have changed since
        for name in _named_layers(layer) if layer else ():
            found = px.Sdf.ComputeAssetPathRelativeToLayer(layer, name)
            if px.Ar.IsPackageRelativePath(found):
                found = px.Ar.SplitPackageRelativePathOuter(found)[0]
            checked = referenced_file(path, found or name, home)
            if os.path.abspath(checked) not in seen:
                seen.add(os.path.abspath(checked))
                waiting.append(checked)


def _named_layers(layer: Any) -> Iterator[str]:
    """The layers that a layer names: sublayers, references, payloads, and clips of values."""
    yield from (str(name) for name in layer.GetCompositionAssetDependencies() if name)
    clips: list[Any] = []

    def collect(at: Any) -> None:
        spec = layer.GetPrimAtPath(at) if at.IsPrimPath() else None
        if spec and spec.HasInfo("clips"):
            clips.append(spec.GetInfo("clips"))

    layer.Traverse(pxr().Sdf.Path.absoluteRootPath, collect)
    for sets in clips:
        for clip in sets.values():
            named = [*clip.get("assetPaths", ()), clip.get("manifestAssetPath"), clip.get("templateAssetPath")]
            yield from (str(getattr(name, "path", name)) for name in named if name)


def _check_file(path: Path) -> None:
    """Checks one file of layers.

    Raises:
        FormatError: It is no regular file, or claims more content than it can hold.
    """
    check_regular(path, path.stat())
    with path.open("rb") as file:
        head = file.read(8)
        if head == MAGIC:
            check_crate(path, file, path.stat().st_size)
    if head.startswith(b"PK"):
        with zipfile.ZipFile(path) as package:
            for entry in package.infolist():
                stored = entry.compress_type == zipfile.ZIP_STORED
                if stored and entry.filename.lower().endswith((".usd", ".usdc")):
                    with package.open(entry) as file:
                        check_crate(path, file, entry.file_size)
