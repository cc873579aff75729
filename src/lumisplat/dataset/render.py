"""A whole data set by one call."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from lumisplat.config import RenderConfig
from lumisplat.config.dataset import DatasetConfig
from lumisplat.dataset.files import view_file
from lumisplat.dataset.finish import DatasetSummary, finish_dataset
from lumisplat.dataset.views import DatasetViews
from lumisplat.errors import ConfigError
from lumisplat.renderer.checks import checked_config
from lumisplat.renderer.renderer import create_renderer
from lumisplat.scene.camera import Camera
from lumisplat.scene.scene import Scene


def render_dataset(
    scene: Scene,
    folder: str | os.PathLike[str],
    config: DatasetConfig | None = None,
    *,
    render: RenderConfig | None = None,
    cameras: Sequence[Camera] = (),
    device: str = "auto",
    progress: Callable[[float], None] | None = None,
) -> DatasetSummary:
    """Renders views of a scene from random places, in random light, with objects put into it, as training data.

    Views that are there stay, whatever they are of: ``lumisplat dataset`` checks that, and shares the work among
    processes; `DatasetViews` has the views one by one.

    Args:
        scene: The scene.
        folder: Where files go (docs/guide/dataset.md): ``images``, a folder for each layer, ``views`` with what is
            known of each, and what `finish_dataset` writes.
        config: Settings of the data set; None: the defaults.
        render: Settings of frames; None: the defaults.
        cameras: Given ones, of ``PosePlaces.CAMERAS``.
        device: As for ``create_renderer``.
        progress: Called after each view with the fraction done, 0..1.

    Raises:
        ConfigError: A setting is wrong, or ``albedo`` is wanted of views without light.
        DeviceError: There is no such device, or it is out of memory.
        FormatError: A file cannot be read or written.
        SceneError: As of `DatasetViews` and `DatasetViews.view`.
    """
    frame_config = _frame_config(checked_config(render), config or DatasetConfig())
    views = DatasetViews(scene, config, cameras=cameras, device=device)
    renderer = create_renderer(frame_config, device)
    place = Path(folder)
    for index in range(views.config.views):
        if not (place / view_file(index)).is_file():
            view = views.view(index)
            views.save(view, renderer.render(view.scene, view.camera), place)
        if progress:
            progress((index + 1) / views.config.views)
    return finish_dataset(place, views.config)


def _frame_config(render: RenderConfig, config: DatasetConfig) -> RenderConfig:
    """Settings of frames that have what the layers need.

    Raises:
        ConfigError: The pipeline is in real time: its frames follow from each other, and views do not.
    """
    if render.pipeline.is_sequence:
        raise ConfigError(
            "Pipeline.REALTIME is of frames that follow from each other, and views do not: "
            "use Pipeline.PATH or Pipeline.HYBRID"
        )
    return replace(render, aovs=(*render.aovs, "albedo")) if "albedo" in config.layers else render
