"""The deep Gaussian shadow map of a light."""

from __future__ import annotations


class DeepShadowMap:
    """How much of a light passes casters, tabulated by direction and distance."""
