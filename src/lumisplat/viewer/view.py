"""``lumisplat.view``: a viewer on what a program has."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy.typing as npt

import lumisplat as ls
from lumisplat.viewer.state.session import Options, State
from lumisplat.viewer.viewer import Progress, Viewer

Viewable = ls.Scene | ls.Animation | ls.SceneDocument | ls.Gaussians | ls.Mesh | str | os.PathLike[str]
"""What `view` shows; also a list of files."""


def view(
    scene: Viewable | Sequence[str | os.PathLike[str]],
    *,
    config: ls.RenderConfig | Callable[[ls.RenderConfig], ls.RenderConfig] | None = None,
    port: int = 0,
    host: str = "127.0.0.1",
    device: str = "auto",
    height: int = 720,
    budget_ms: float = 40.0,
    up: str | npt.ArrayLike | None = None,
    drop_invalid: bool = False,
    lod: int | None = None,
    lod_budget: int | None = None,
    keep_coordinates: bool = False,
) -> Viewer:
    """Opens a page on which people fly through a scene, edit it and see it lit.

    Returns at once; the page is served until the viewer is closed or the program ends::

        viewer = ls.view(scene)
        print(viewer.url)
        viewer.wait()

    Args:
        scene: What is seen: a scene, an animation, a document, an asset, or a file or several of these.
        config: Settings of frames; None: those of the scene file, else ``Pipeline.HYBRID`` if the scene has lights or
            is of meshes alone, and as captured otherwise. A function makes them of those.
        port: Port to listen on; 0: a free one.
        host: Address to listen on. Others than a loopback address let other machines in, if they have the token.
        device: As of `lumisplat.create_renderer`.
        height: Rows of frames of views at rest, 90 to 2160.
        budget_ms: Milliseconds that a frame of a view that moves may take, 10 to 500: fewer Gaussians are drawn first,
            then fewer pixels.
        up: Up of files that do not say it; None: as of `lumisplat.Scene`.
        drop_invalid: Of files, as of `lumisplat.load`.
        lod: Of streamed SOGs, as of `lumisplat.load`.
        lod_budget: Of streamed SOGs, ``budget`` of `lumisplat.load`.
        keep_coordinates: Of files, as of `lumisplat.SceneDocument.open`.

    Raises:
        ConfigError: ``height`` or ``budget_ms`` is out of its range.
        MissingFileError: None of the files is there. What else is wrong with files is told on the page.
        MissingExtraError: The extra ``view`` is not installed.
        DeviceError: The port cannot be opened.
    """

    def load(progress: Progress) -> State:
        loading = partial(ls.load, drop_invalid=drop_invalid, lod=lod, budget=lod_budget)
        document = _document(scene, up, loading, progress, keep_coordinates=keep_coordinates)
        if isinstance(config, ls.RenderConfig):
            return State(document, config)
        settings = document.config
        if "render" not in document.top and document.scene().is_lit_by_default:
            settings = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID)
        return State(document, settings if config is None else config(settings))

    given = {"--drop-invalid": drop_invalid or None, "--lod ": lod, "--lod budget=": lod_budget}
    words = (name if value is True else f"{name}{value}" for name, value in given.items() if value is not None)
    options = Options(height=height, budget_ms=budget_ms, loading=tuple(words))
    _refuse_missing(scene)
    return Viewer(load, host=host, port=port, device=device, options=options)


def _refuse_missing(scene: Any) -> None:
    """Raises a MissingFileError if files are to be seen of which none is there."""
    files: list[Any] = list(cast("list[Any]", scene)) if isinstance(scene, list | tuple) else [scene]
    paths = [Path(os.fspath(file)) for file in files if isinstance(file, str | os.PathLike)]
    if paths and len(paths) == len(files) and not any(path.exists() for path in paths):
        raise ls.MissingFileError(paths[0], "no such file")


def _document(
    scene: Any, up: Any, loading: Callable[..., Any], progress: Progress, *, keep_coordinates: bool
) -> ls.SceneDocument:
    """The document of what is to be seen."""
    if isinstance(scene, ls.SceneDocument):
        return scene
    if not isinstance(scene, str | os.PathLike | list | tuple):
        return ls.SceneDocument.of(scene)

    def load(path: Path, **levels: int | None) -> Any:
        return loading(path, progress=partial(progress, f"loading {path.name}"), **levels)

    return ls.SceneDocument.open(cast(Any, scene), load, up=up, keep_coordinates=keep_coordinates)
