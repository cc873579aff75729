"""Frozen settings, one dataclass a stage. Edit with ``dataclasses.replace``."""

from __future__ import annotations

from lumisplat.config.dataset import (
    DatasetConfig,
    DatasetLights,
    DatasetObjects,
    DatasetPoses,
    PosePlaces,
)
from lumisplat.config.gaussians import (
    Antialiasing,
    GaussianSurface,
    HitDistance,
    NormalMethod,
    Projection,
    RasterConfig,
    RasterStrategy,
    ResponseConfig,
    ShadowConfig,
    ShadowMethod,
    TraceConfig,
    TraceStrategy,
)
from lumisplat.config.lighting import (
    Absorption,
    AtlasLayout,
    AvatarLightingConfig,
    DeepShadowConfig,
    DelightConfig,
    LightEstimationConfig,
    NormalEstimate,
    ReceiverSampling,
    RelightConfig,
)
from lumisplat.config.pipelines import Pipeline
from lumisplat.config.realtime import FilterConfig, ProbeConfig, RadianceCacheConfig, RealtimeConfig, RealtimeQuality
from lumisplat.config.render import (
    PathConfig,
    PathPrimary,
    RenderConfig,
    Shadows,
    ToneMap,
)
from lumisplat.config.training import Densification, LearningRates, MaterialsConfig, TrainConfig

__all__ = [
    "Absorption",
    "Antialiasing",
    "AtlasLayout",
    "AvatarLightingConfig",
    "DatasetConfig",
    "DatasetLights",
    "DatasetObjects",
    "DatasetPoses",
    "DeepShadowConfig",
    "DelightConfig",
    "Densification",
    "FilterConfig",
    "GaussianSurface",
    "HitDistance",
    "LearningRates",
    "LightEstimationConfig",
    "MaterialsConfig",
    "NormalEstimate",
    "NormalMethod",
    "PathConfig",
    "PathPrimary",
    "Pipeline",
    "PosePlaces",
    "ProbeConfig",
    "Projection",
    "RadianceCacheConfig",
    "RasterConfig",
    "RasterStrategy",
    "RealtimeConfig",
    "RealtimeQuality",
    "ReceiverSampling",
    "RelightConfig",
    "RenderConfig",
    "ResponseConfig",
    "ShadowConfig",
    "ShadowMethod",
    "Shadows",
    "ToneMap",
    "TraceConfig",
    "TraceStrategy",
    "TrainConfig",
]
