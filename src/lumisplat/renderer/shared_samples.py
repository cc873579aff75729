"""Splits the samples of one frame over several processes, and merges them.

docs/adr/0072-tiles-and-sample-blocks-match-the-frame.md#samples explains the decisions.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from lumisplat.errors import ConfigError
from lumisplat.frame.frame import Frame
from lumisplat.frame.sample_part import SamplePart, merged
from lumisplat.progress import Progress
from lumisplat.renderer.checks import check_blocks, check_scene
from lumisplat.renderer.renderer import Renderer
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.scene.camera import Camera
from lumisplat.scene.scene import Scene

SAMPLES_PER_BLOCK = 32
"""Number of consecutive samples that one process renders when several share a frame. It is a power of two, because so
many consecutive Sobol points are well distributed. Another size changes how sums are rounded."""


def sample_blocks(renderer: Renderer, scene: Scene) -> list[range]:
    """Splits the indices of a frame's samples into blocks of 32, which several processes may render.

    Raises:
        ConfigError: Frames of the scene have no samples, or the number of samples is not fixed.
        SceneError: ``scene`` is no Scene.
    """
    check_scene(scene)
    plan = FramePlan.of(renderer.config, scene)
    check_blocks(renderer.config, plan)
    starts = range(0, plan.samples, SAMPLES_PER_BLOCK)
    return [range(start, min(start + SAMPLES_PER_BLOCK, plan.samples)) for start in starts]


def render_samples(
    renderer: Renderer, scene: Scene, camera: Camera, samples: range, *, progress: Progress | None = None
) -> SamplePart:
    """Renders one block of a frame's samples, and returns their sums.

    Args:
        renderer: The renderer.
        scene: As for `lumisplat.Renderer.render`.
        camera: As for `lumisplat.Renderer.render`.
        samples: Indices of the samples, one block of `lumisplat.farm.sample_blocks`.
        progress: As for `lumisplat.Renderer.render`.

    Raises:
        ConfigError: As for `lumisplat.farm.sample_blocks`, or ``samples`` is not one of the blocks.
        DeviceError: As for `lumisplat.Renderer.render`.
        SceneError: As for `lumisplat.Renderer.render`.
    """
    if len(samples) < 1 or samples.start < 0 or samples.step != 1:
        raise ConfigError(f"samples is {samples}, expected a block of sample_blocks, such as range(0, 32)")
    part = SamplePart(samples.start, len(samples), camera.image_size, {}, {})
    frame = renderer.render_part(scene, camera, part, progress=progress)
    accumulated = {name: np.array(words) for name, words in (frame.accumulated or {}).items()}
    surfaces = {
        "depth": frame.depth,
        "normal": frame.normal,
        "gaussian": frame.gaussian_index,
        "instance": frame.instance_index,
    }
    return replace(part, accumulated=accumulated, surfaces=surfaces if samples.start == 0 else {})


def merge_samples(renderer: Renderer, scene: Scene, camera: Camera, parts: Iterable[SamplePart]) -> Frame:
    """Merges all samples of a frame into the frame, whose bits do not depend on which process rendered which part.

    The frame nearly equals the one from `lumisplat.Renderer.render`, which sums all samples without blocks: some pixels
    differ by rounding.

    Args:
        renderer: A renderer with the settings of the renderers that made the parts.
        scene: As for `lumisplat.farm.render_samples`.
        camera: As for `lumisplat.farm.render_samples`.
        parts: All parts in order, from sample 0 on; an iterator may load them one by one.

    Raises:
        ConfigError: Parts are missing or out of order, or belong to another frame.
        DeviceError: As for `lumisplat.Renderer.render`.
        SceneError: As for `lumisplat.Renderer.render`.
    """
    whole = merged(parts)
    wanted = sample_blocks(renderer, scene)[-1].stop
    if whole.size != camera.image_size or whole.count != wanted:
        raise ConfigError(
            f"the parts are {whole.count} samples of a frame of {whole.size[0]} x {whole.size[1]}, expected "
            f"{wanted} of {camera.image_size[0]} x {camera.image_size[1]}"
        )
    return renderer.render_part(scene, camera, whole)
