"""Warnings about lighting, each logged once per renderer."""

from __future__ import annotations

import logging

import numpy as np
import warp as wp

from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.downloads import HostCopy
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.scene import Scene

_log = logging.getLogger("lumisplat")
_noise_log = logging.getLogger("lumisplat.noise")  # a separate logger, so that it can be silenced on its own


class LightWarnings:
    """Warns of lights with too few samples, of missed noise levels, and of open refractive meshes: once of each."""

    def __init__(self) -> None:
        self._unentered: HostCopy | None = None
        self._checked: object = None
        """Meshes for which the host has waited for `warn_of_media`."""
        self._has_warned_of_noise = self._has_warned_of_noise_level = self._has_warned_of_media = False

    def warn_of_noise(self, plan: FramePlan, samples: int) -> None:
        """Warns if the number of samples is lower than the frame's randomly sampled lights need."""
        if plan.noise_sources and samples < plan.samples_wanted and not self._has_warned_of_noise:
            self._has_warned_of_noise = True
            _noise_log.warning(
                "light from %s is noisy with %d %s a pixel: set samples to at least %d, or denoise",
                " and ".join(plan.noise_sources),
                samples,
                "sample" if samples == 1 else "samples",
                plan.samples_wanted,
            )

    def warn_of_noise_level(self, warning: str | None) -> None:
        """Logs the first warning about a frame whose samples did not reach the requested noise level."""
        if warning is not None and not self._has_warned_of_noise_level:
            self._has_warned_of_noise_level = True
            _log.warning("%s", warning)

    def warn_of_media(self, plan: FramePlan, scene: Scene, buffers: Buffers, launcher: Launcher) -> None:
        """Warns if rays of the last sample left the inside of a mesh without having entered the mesh.

        Waits for the device only in the first frame of the meshes; later frames may warn two frames late.
        """
        if not plan.has_media or self._has_warned_of_media:
            return
        source = buffers.get("wave.unentered", wp.int32, len(scene.meshes))
        if self._unentered is None or self._unentered.source is not source:
            self._unentered = HostCopy(source)
        self._unentered.update()
        meshes = [id(instance.mesh) for instance in scene.meshes]
        if meshes != self._checked:
            launcher.mark()()
            self._checked = meshes
        unentered = self._unentered.values
        if unentered.any():
            self._has_warned_of_media = True
            number = int(np.argmax(unentered))
            name = scene.meshes[number].name or scene.meshes[number].mesh.name
            _log.warning(
                "rays leave the inside of %s without entering it: unless the camera is inside, a transmissive mesh "
                "must be closed and face outwards, or be thin_walled",
                f"mesh '{name}'" if name else f"meshes[{number}]",
            )
