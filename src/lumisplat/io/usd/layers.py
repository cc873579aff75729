"""Files that a stage is composed of, found without composing it: the library reads whatever a layer names."""

from __future__ import annotations

import codecs
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lumisplat.errors import FormatError
from lumisplat.io.files.source import check_regular, leaves_folder, parsing, read_text, referenced_file
from lumisplat.io.usd.library import pxr
from lumisplat.io.usd.process import grant

USD_LAYERS_MAX = 10_000
"""Most layers of a stage."""


def check_layers(path: Path, text: str) -> list[Any]:
    """Checks a file and all layers that it is composed of, each before it is opened, and returns layers to hold.

    The library finds these as long as they are held, and would refuse their files: text with a byte order mark.

    Args:
        path: The file.
        text: A path of it that is UTF-8, as the library needs.

    Raises:
        FormatError: A layer is no regular file, is named by a path that leaves the folder of ``path``, which is not
            allowed, or by an expression or with arguments, so that nobody knows which file is meant.
    """
    px, home = pxr(), path.parent
    waiting, seen, held = [path], {os.path.abspath(path)}, list[Any]()
    while waiting:
        if len(seen) > USD_LAYERS_MAX:
            raise FormatError(path, f"is composed of more than {USD_LAYERS_MAX:,} layers")
        file = waiting.pop()
        if not file.exists():
            continue  # composed without it; a remark says so
        check_regular(file, file.stat())
        grant(file)
        name = text if file is path else os.fspath(file)
        if (layer := _marked_layer(file, name)) is not None:
            held.append(layer)
        else:
            layer = px.Sdf.Layer.FindOrOpen(name)
        if not layer:
            continue
        for name in _named_by(layer):
            named = _named_file(path, layer, name, home)
            if os.path.abspath(named) not in seen:
                seen.add(os.path.abspath(named))
                waiting.append(named)
        for name in _packages_of_assets(layer):
            package = _named_file(path, layer, name, home)
            if package.exists():
                check_regular(package, package.stat())
    return held


def _marked_layer(file: Path, name: str) -> Any | None:
    """Returns the layer of a text that begins with a byte order mark, which the library does not read; None for others.

    Raises:
        FormatError: The text is none.
    """
    px = pxr()
    with open(file, "rb") as stream:
        if not stream.read(3).startswith((codecs.BOM_UTF8, codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            return None
    with parsing(file, "a USD file"):
        text = read_text(file)
    layer = px.Sdf.Layer.New(px.Sdf.FileFormat.FindById("usda"), os.path.abspath(name))
    layer.ImportFromString(text)
    return layer


def _named_file(path: Path, layer: Any, name: str, home: Path) -> Path:
    """The file that a layer names, or the package in which that is; arguments as of `check_layers`.

    Raises:
        FormatError: As of `check_layers`.
    """
    px = pxr()
    if px.Sdf.VariableExpression.IsExpression(name):
        raise FormatError(
            path, f"names a file by the expression {name[:200]}: usdcat --flatten writes it without expressions"
        )
    name, arguments = px.Sdf.Layer.SplitIdentifier(name)
    if arguments:
        raise FormatError(path, f"names the layer {name[:200]!r} with arguments, which are not read")
    found = px.Sdf.ComputeAssetPathRelativeToLayer(layer, name)
    if px.Ar.IsPackageRelativePath(found):
        found = px.Ar.SplitPackageRelativePathOuter(found)[0]
    return referenced_file(path, found or name, home)


def check_loaded(path: Path) -> None:
    """Checks that the library has opened no layer outside of a file's folder, as values are read at last.

    Raises:
        FormatError: It has, which is not allowed.
    """
    px = pxr()
    for layer in px.Sdf.Layer.GetLoadedLayers():
        name = str(layer.realPath)
        if px.Ar.IsPackageRelativePath(name):
            name = px.Ar.SplitPackageRelativePathOuter(name)[0]
        if name and leaves_folder(path, Path(name)):
            raise FormatError(path, f"names {name[:200]!r}, which is not in its folder")


def _named_by(layer: Any) -> Iterator[str]:
    """The layers that a layer names: sublayers, references, payloads, and clips of values, in variants, too."""
    yield from (str(name) for name in layer.GetCompositionAssetDependencies() if name)
    clips: list[Any] = []

    def collect(at: Any) -> None:
        spec = layer.GetPrimAtPath(at) if at.IsPrimPath() or at.IsPrimVariantSelectionPath() else None
        if spec and spec.HasInfo("clips"):
            clips.append(spec.GetInfo("clips"))

    layer.Traverse(pxr().Sdf.Path.absoluteRootPath, collect)
    for sets in clips:
        for clip in sets.values():
            named = [*clip.get("assetPaths", ()), clip.get("manifestAssetPath"), clip.get("templateAssetPath")]
            yield from (str(getattr(name, "path", name)) for name in named if name)


def _packages_of_assets(layer: Any) -> Iterator[str]:
    """The values of a layer that name files in packages, or files by expressions: the library opens these itself."""
    px, values = pxr(), list[Any]()

    def collect(at: Any) -> None:
        spec = layer.GetAttributeAtPath(at) if at.IsPropertyPath() else None
        if spec and str(spec.typeName).startswith("asset"):
            values.append(spec.default)
            values.extend(layer.QueryTimeSample(at, code) for code in layer.ListTimeSamplesForPath(at))

    layer.Traverse(px.Sdf.Path.absoluteRootPath, collect)
    for value in values:
        for asset in [value] if isinstance(value, px.Sdf.AssetPath) else value or ():
            name = str(getattr(asset, "path", asset))
            if px.Sdf.VariableExpression.IsExpression(name) or px.Ar.IsPackageRelativePath(name):
                yield name
