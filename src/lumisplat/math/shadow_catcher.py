"""What light that was added or blocked changes of a shadow catcher (docs/method/lighting.md#shadow-catchers)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumisplat.math.arrays import Doubles


@dataclass(frozen=True, slots=True)
class CatcherLight:
    """Irradiance of shadow catchers, arrays of one shape."""

    sent: Doubles
    """Irradiance by the scene's lights, without anything that was added."""
    change: Doubles
    """Its change by all that was added, bounced light included."""
    own_sent: Doubles
    """Irradiance by the captures around the surface, without anything that was added, as far as it was found."""
    own_change: Doubles
    """Its change by all that was added; what added surfaces emit counts here."""
    ambient: Doubles
    """Given irradiance besides that of lights; 0: what was found of the captures is all there is."""
    blocked: Doubles
    """The part of ``ambient`` that something added blocks."""
    least: Doubles
    """Lower bound of the irradiance: no surface reflects more than it receives."""

    def change_and_received(self) -> tuple[Doubles, Doubles]:
        """Returns the change of the irradiance by all that was added, and the irradiance before."""
        given, rest = self.ambient > 0.0, self.least - self.sent
        ambient = np.maximum(np.where(given, self.ambient, self.own_sent), rest)
        own_share = np.divide(ambient, self.own_sent, out=np.ones_like(rest), where=given & (self.own_sent > ambient))
        blocked = np.divide(self.blocked, self.ambient, out=np.zeros_like(rest), where=given)
        unseen = np.where(given, np.maximum(ambient - self.own_sent, 0.0), 0.0)
        return self.change + own_share * self.own_change - unseen * blocked, self.sent + ambient
