"""Captures in blocks as commands show them: each view with the blocks that it sees."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import lumisplat as ls
from lumisplat.cli.input.loading import block_folder

_log = logging.getLogger("lumisplat")


@dataclass
class BlockViews:
    """A capture in blocks, of which each view loads what it sees; what the last one saw is kept."""

    index: ls.BlockIndex
    pixels: float
    """As of `lumisplat.visible_blocks`."""
    preview: ls.Scene
    """Some of its Gaussians, to see where it is."""
    _parts: list[ls.BlockPart] = field(default_factory=list["ls.BlockPart"], init=False)
    _scene: ls.Scene | None = field(default=None, init=False)

    def scene(self, camera: ls.Camera, release: Callable[[], None]) -> ls.Scene:
        """What a camera sees; of lenses other than pinholes, everything.

        Args:
            camera: The view.
            release: Lets go of what the last view saw, before something else is loaded.

        Raises:
            FormatError: A block cannot be read, or all of them do not fit into memory.
        """
        parts = self._seen(camera)
        if self._scene is None or parts != self._parts:
            self._scene = None
            release()
            shown = [replace(self.preview.splats[0], gaussians=ls.load_blocks(self.index, parts))] if parts else []
            self._parts, self._scene = parts, replace(self.preview, splats=shown)
        return self._scene

    def _seen(self, camera: ls.Camera) -> list[ls.BlockPart]:
        try:
            return ls.visible_blocks(self.index, camera, pixels=self.pixels)
        except ls.SceneError:  # a lens that sees around corners
            return ls.all_blocks(self.index)


def block_views(
    paths: Sequence[Path],
    config: ls.RenderConfig,
    pixels: float | None,
    *,
    lit: bool,
    whole: str = "",
    upright: Callable[[ls.Scene], ls.Scene],
) -> BlockViews | None:
    """What shows a capture in blocks view by view; None: there is none, or all of it is needed, which a line says.

    Args:
        paths: The files of the scene.
        config: The settings of frames.
        pixels: Of ``--lod pixels=``.
        lit: Whether lights are added to the scene.
        whole: An option that needs the whole capture, if it is given.
        upright: Gives a scene its up.

    Raises:
        ConfigError: ``pixels`` is given without a capture in blocks, or is negative.
        FormatError: Its index cannot be read.
    """
    folders = [folder for path in paths if (folder := block_folder(path)) is not None]
    if pixels is not None and not pixels >= 0.0:
        raise ls.ConfigError(f"--lod pixels={pixels:g}, expected 0 or more")
    if not folders:
        if pixels is not None:
            raise ls.ConfigError("--lod pixels= is of captures in blocks, which lumisplat blocks makes")
        return None
    needs = [
        "other files of the scene" * (len(paths) > 1),
        f"--pipeline {config.pipeline.value}" * config.pipeline.spawns_rays,
        "--set raster.projection=unscented" * (config.raster.projection is ls.Projection.UNSCENTED),
        "light" * (lit or config.lighting is True),
        whole,
    ]
    needed = next((one for one in needs if one), "")
    if needed:
        if pixels is not None:
            raise ls.ConfigError(f"--lod pixels= and {needed} do not go together: all of the capture is loaded")
        _log.warning(
            "%s: all of it is loaded, for %s: only unlit, rasterised pictures of it alone load what they see",
            folders[0],
            needed,
        )
        return None
    index = ls.open_blocks(folders[0])
    preview = ls.Scene(splats=[ls.SplatInstance(ls.thin_blocks(index))])
    return BlockViews(index, pixels or 0.0, upright(preview))
