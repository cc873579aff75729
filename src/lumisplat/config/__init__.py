"""Frozen settings, one dataclass a stage. Edit with ``dataclasses.replace``."""

from __future__ import annotations

from lumisplat.config.avatars import AvatarLightingConfig, LightEstimationConfig
from lumisplat.config.checks import check_enum, check_flag, check_kind, check_range, check_whole
from lumisplat.config.relighting import NormalEstimate, RelightConfig
from lumisplat.config.render import (
    AOVS,
    Antialiasing,
    HitDistance,
    NormalMethod,
    Pipeline,
    RasterConfig,
    RasterStrategy,
    RenderConfig,
    ShadowConfig,
    ShadowMethod,
    Shadows,
    ToneMap,
    TraceConfig,
    TraceStrategy,
)
from lumisplat.config.shadow_maps import Absorption, AtlasLayout, DeepShadowConfig, ReceiverSampling

__all__ = [
    "AOVS",
    "Absorption",
    "Antialiasing",
    "AtlasLayout",
    "AvatarLightingConfig",
    "DeepShadowConfig",
    "HitDistance",
    "LightEstimationConfig",
    "NormalEstimate",
    "NormalMethod",
    "Pipeline",
    "RasterConfig",
    "RasterStrategy",
    "ReceiverSampling",
    "RelightConfig",
    "RenderConfig",
    "ShadowConfig",
    "ShadowMethod",
    "Shadows",
    "ToneMap",
    "TraceConfig",
    "TraceStrategy",
    "check_enum",
    "check_flag",
    "check_kind",
    "check_range",
    "check_whole",
]
