"""The samples of one frame, shared by several processes (docs/adr/0072-parts-of-pictures.md#samples)."""

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
"""Samples of a frame that one process adds up where several share it; frames that are shared depend on it by rounding.
A power of two, as points of Sobol sequences are well spread in such numbers."""


def sample_blocks(renderer: Renderer, scene: Scene) -> list[range]:
    """The numbers of a frame's samples in blocks of 32, which several processes may share.

    Raises:
        ConfigError: Frames of the scene have no samples, or their number is not known before.
        SceneError: The scene is none.
    """
    check_scene(scene)
    plan = FramePlan.of(renderer.config, scene)
    check_blocks(renderer.config, plan)
    starts = range(0, plan.samples, SAMPLES_PER_BLOCK)
    return [range(start, min(start + SAMPLES_PER_BLOCK, plan.samples)) for start in starts]


def render_samples(
    renderer: Renderer, scene: Scene, camera: Camera, samples: range, *, progress: Progress | None = None
) -> SamplePart:
    """Some of the samples of a frame, added up.

    Args:
        renderer: Renders them.
        scene: As of `lumisplat.Renderer.render`.
        camera: Likewise.
        samples: Their numbers, one of `lumisplat.farm.sample_blocks`.
        progress: As of `lumisplat.Renderer.render`.

    Raises:
        ConfigError: As of `lumisplat.farm.sample_blocks`, or the samples are no block of them.
        DeviceError: As of `lumisplat.Renderer.render`.
        SceneError: Likewise.
    """
    if len(samples) < 1 or samples.start < 0 or samples.step != 1:
        raise ConfigError(f"samples is {samples}, expected a block of them, such as range(0, 32)")
    part = SamplePart(samples.start, len(samples), camera.image_size, {}, {})
    frame = renderer.render_part(scene, camera, part, progress=progress)
    held = {name: np.array(words) for name, words in (frame.accumulated or {}).items()}
    seen = {
        "depth": frame.depth,
        "normal": frame.normal,
        "gaussian": frame.gaussian_index,
        "instance": frame.instance_index,
    }
    return replace(part, accumulated=held, surfaces=seen if samples.start == 0 else {})


def merge_samples(renderer: Renderer, scene: Scene, camera: Camera, parts: Iterable[SamplePart]) -> Frame:
    """The frame of all its samples: the same to the bit, whichever processes have made its parts.

    It is nearly that of `lumisplat.Renderer.render`, which adds the same samples up without blocks: some pixels differ
    by rounding.

    Args:
        renderer: Of the same settings as those that have made the parts.
        scene: As of `lumisplat.farm.render_samples`.
        camera: Likewise.
        parts: In their order, from sample 0 on; they may be loaded one by one.

    Raises:
        ConfigError: They do not follow each other, or are of another frame.
        DeviceError: As of `lumisplat.Renderer.render`.
        SceneError: Likewise.
    """
    whole = merged(parts)
    wanted = sample_blocks(renderer, scene)[-1].stop
    if whole.size != camera.image_size or whole.count != wanted:
        raise ConfigError(
            f"the parts are {whole.count} samples of a frame of {whole.size[0]} x {whole.size[1]}, expected "
            f"{wanted} of {camera.image_size[0]} x {camera.image_size[1]}"
        )
    return renderer.render_part(scene, camera, whole)
