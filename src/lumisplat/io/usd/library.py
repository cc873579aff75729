"""Wraps usd-core: its modules, its messages, its errors, and the files that it may open.

usd-core opens every file that a layer names. Lumisplat therefore finds and checks all layers of a stage before usd-core
composes the stage.
"""

from __future__ import annotations

import codecs
import logging
import os
import re
import shlex
import zipfile
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from lumisplat.errors import FormatError, MissingExtraError
from lumisplat.io.files.native import silenced_native_output
from lumisplat.io.files.source import (
    PathLike,
    check_regular,
    leaves_folder,
    parsing,
    read_text,
    readable,
    referenced_file,
)
from lumisplat.io.usd.process import request_access

USD_LAYERS_MAX = 10_000
"""Largest number of layers of a stage."""

_MODULES = ("Ar", "Gf", "Sdf", "Tf", "Usd", "UsdGeom", "UsdLux", "UsdRender", "UsdShade", "UsdVol", "Vt")
_REASON_MAX = 160
"""Largest number of characters of usd-core's error text that an error message quotes."""

_INTERNAL = re.compile(r"pxrInternal_\w+?__(::)?")
"""Matches prefixes of usd-core's internal C++ namespaces, which are removed from its error messages."""

_log = logging.getLogger("lumisplat")


@cache
def pxr() -> Any:
    """Returns usd-core's modules as attributes, such as ``pxr().UsdGeom``; usd-core has no type stubs.

    Raises:
        MissingExtraError: usd-core is not installed.
    """
    try:
        return SimpleNamespace(**{name: import_module(f"pxr.{name}") for name in _MODULES})
    except ImportError:
        raise MissingExtraError("USD", "usd") from None


@contextmanager
def reading_usd(path: PathLike) -> Generator[None]:
    """Silences usd-core inside the block, and turns its errors into one `FormatError` about ``path``.

    Standard output and error are redirected inside the block. Log lines of Lumisplat are therefore emitted after the
    block.

    Raises:
        FormatError: The content cannot be read.
    """
    with _log_deferred(), parsing(path, "a USD file"), silenced_native_output(), readable(path):
        try:
            yield
        except FormatError:
            raise
        except (pxr().Tf.ErrorException, RuntimeError, zipfile.BadZipFile) as error:
            raise FormatError(path, f"damaged, or not a USD file{_reason(error, path)}") from error


@contextmanager
def writing_usd(path: PathLike) -> Generator[None]:
    """Silences usd-core inside the block, as `reading_usd` does; errors of usd-core become failures to write ``path``.

    Raises:
        FormatError: The file cannot be written.
    """
    with _log_deferred(), silenced_native_output():
        try:
            yield
        except (pxr().Tf.ErrorException, RuntimeError) as error:
            raise FormatError(path, f"cannot be written{_reason(error, path)}") from error


def _reason(error: Exception, path: PathLike) -> str:
    """Returns ": " and usd-core's error text on one line, without internal C++ names and without the file's path."""
    first: object = error.args[0] if error.args else ""
    text = " ".join(str(getattr(first, "commentary", first)).split())
    for name in (os.path.abspath(path), os.fspath(path)):
        text = text.replace(f"<{name}>", name).replace(name, "it")
    text = _INTERNAL.sub("", text).replace("Failed to open layer @it@", "")
    at = re.match(r"(?:it)?:(\d+):\d+: (.*)", text)
    if at:
        does_not_parse = at[2].startswith("parse error")
        text = f"line {at[1]}: " + ("it, or the block that starts there, cannot be parsed" if does_not_parse else at[2])
    return f": {text[:_REASON_MAX]}" if text else ""


@contextmanager
def _log_deferred() -> Generator[None]:
    """Collects Lumisplat's log records inside the block, and emits them at its end."""
    records: list[logging.LogRecord] = []

    def hold(record: logging.LogRecord) -> bool:
        records.append(record)
        return False

    _log.addFilter(hold)
    try:
        yield
    finally:
        _log.removeFilter(hold)
        for record in records:
            _log.handle(record)


def check_layers(path: Path, text: str) -> list[Any]:
    """Checks a file and all layers of its stage, each before usd-core opens it.

    Args:
        path: The file.
        text: The path of the file in UTF-8, as usd-core needs it.

    Returns:
        Layers that the caller must keep referenced. usd-core cannot open text with a byte order mark. Layers from such
        text are therefore created in memory, and usd-core finds these layers only as long as they exist.

    Raises:
        FormatError: A layer is no regular file, or its path leaves the folder of ``path`` without permission. Or the
            name of a layer does not determine a file, because it is an expression or has arguments.
    """
    px, home = pxr(), path.parent
    waiting, checked, layers = [path], {os.path.abspath(path)}, list[Any]()
    while waiting:
        if len(checked) > USD_LAYERS_MAX:
            raise FormatError(path, f"is composed of more than {USD_LAYERS_MAX:,} layers: {_flattening(path)}")
        file = waiting.pop()
        if not file.exists():
            continue  # the stage is composed without the layer, and a remark reports it
        check_regular(file, file.stat())
        request_access(file)
        name = text if file is path else os.fspath(file)
        if (layer := _marked_layer(file, name)) is not None:
            layers.append(layer)
        else:
            layer = px.Sdf.Layer.FindOrOpen(name)
        if not layer:
            continue
        for name in _layer_dependencies(layer):
            named = _named_file(path, layer, name, home)
            if os.path.abspath(named) not in checked:
                checked.add(os.path.abspath(named))
                waiting.append(named)
        for name in _asset_packages(layer):
            package = _named_file(path, layer, name, home)
            if package.exists():
                check_regular(package, package.stat())
    return layers


def _marked_layer(file: Path, name: str) -> Any | None:
    """Creates the layer of a text file that starts with a byte order mark, which usd-core itself cannot open.

    Returns None for a file without a byte order mark.

    Raises:
        FormatError: The file starts with a byte order mark, but is not text in that encoding.
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
    """Returns the file that a layer refers to by ``name``; for a file inside of a package, returns the package.

    Args:
        path: File of the stage, named in errors.
        layer: The layer that contains the reference.
        name: The reference.
        home: Folder that the file must not leave without permission.

    Raises:
        FormatError: See `check_layers`.
    """
    px = pxr()
    if px.Sdf.VariableExpression.IsExpression(name):
        raise FormatError(
            path,
            f"names a file by the expression {name[:200]}, which is not supported: {_flattening(path)}",
        )
    name, arguments = px.Sdf.Layer.SplitIdentifier(name)
    if arguments:
        raise FormatError(
            path,
            f"names the layer {name[:200]!r} with arguments, which is not supported: {_flattening(path)}",
        )
    found = px.Sdf.ComputeAssetPathRelativeToLayer(layer, name)
    if px.Ar.IsPackageRelativePath(found):
        found = px.Ar.SplitPackageRelativePathOuter(found)[0]
    return referenced_file(path, found or name, home)


def _flattening(path: Path) -> str:
    """Returns advice for error messages: the command that writes a stage as one layer, which names no others."""
    files = " ".join(shlex.quote(os.fspath(file)) for file in (path, path.with_name(f"{path.stem}_flat.usdc")))
    program = "import sys; from pxr import Usd; Usd.Stage.Open(sys.argv[1]).Export(sys.argv[2])"
    return f'flatten it by python -c "{program}" {files}'


def check_loaded(path: Path) -> None:
    """Refuses a stage for which usd-core has opened a layer outside of the folder of ``path`` without permission.

    Reading values can open further layers, so this check runs after all values are read.

    Raises:
        FormatError: There is such a layer.
    """
    px = pxr()
    for layer in px.Sdf.Layer.GetLoadedLayers():
        name = str(layer.realPath)
        if px.Ar.IsPackageRelativePath(name):
            name = px.Ar.SplitPackageRelativePathOuter(name)[0]
        if name and leaves_folder(path, Path(name)):
            raise FormatError(
                path,
                f"names {name[:200]!r}, which is not in its folder: move it there, or trust the file by "
                "--allow-outside (allow_outside=True)",
            )


def _layer_dependencies(layer: Any) -> Iterator[str]:
    """Yields the names of the layers that a layer uses as sublayers, references, payloads or clips, in any variant."""
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


def _asset_packages(layer: Any) -> Iterator[str]:
    """Yields the asset values of a layer that usd-core opens by itself: files inside packages, and expressions."""
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
