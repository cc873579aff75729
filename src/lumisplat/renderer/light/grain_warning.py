"""Says once which light is grainy for lack of samples, and what would help."""

from __future__ import annotations

import logging

from lumisplat.renderer.scene.frame_plan import FramePlan

_log = logging.getLogger("lumisplat.grain")  # of its own, so that it can be silenced alone


class GrainWarning:
    """Logs it once a renderer."""

    def __init__(self) -> None:
        self._has_warned = False

    def warn_of(self, plan: FramePlan, samples: int) -> None:
        """Logs that so many samples, given by the user, are few for the light of the frame."""
        if plan.grain and samples < plan.samples_wanted and not self._has_warned:
            self._has_warned = True
            _log.warning(
                "light from %s is grainy with %d %s a pixel: %d or more make it smooth, and are the default",
                " and ".join(plan.grain),
                samples,
                "sample" if samples == 1 else "samples",
                plan.samples_wanted,
            )
