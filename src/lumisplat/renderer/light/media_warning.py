"""A log line about meshes that let light in, but do not close around it."""

from __future__ import annotations

import logging

import numpy as np
import warp as wp

from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.runtime.buffers import Buffers
from lumisplat.scene.scene import Scene

_log = logging.getLogger("lumisplat")


class MediaWarning:
    """Logs it once a renderer."""

    def __init__(self) -> None:
        self._has_warned = False

    def warn_of(self, plan: FramePlan, scene: Scene, buffers: Buffers) -> None:
        """Logs which mesh the rays of the last sample have left that had not entered it."""
        if not plan.has_media or self._has_warned:
            return
        is_left = buffers.get("wave.unentered", wp.int32, len(scene.meshes)).numpy()
        if is_left.any():
            self._has_warned = True
            number = int(np.argmax(is_left))
            name = scene.meshes[number].name or scene.meshes[number].mesh.name
            _log.warning(
                "the inside of %s is left without being entered: unless the camera is within it, a mesh that transmits "
                "must be closed and face outwards, or be thin_walled",
                f"mesh '{name}'" if name else f"meshes[{number}]",
            )
