"""Frozen settings, one dataclass a stage. Edit with ``dataclasses.replace``."""

from __future__ import annotations

from lumisplat.config.avatars import AvatarLightingConfig, LightEstimationConfig
from lumisplat.config.checks import check_flag, check_kind, check_range, check_whole, choices, enum_member, listed_names
from lumisplat.config.dataset import (
    DATASET_LAYERS,
    DatasetConfig,
    DatasetLights,
    DatasetObjects,
    DatasetPoses,
    PosePlaces,
)
from lumisplat.config.materials import MaterialsConfig
from lumisplat.config.paths import PathConfig, PathPrimary
from lumisplat.config.pipelines import Integrator, Pipeline, Visibility
from lumisplat.config.probes import ProbeConfig
from lumisplat.config.raster import Antialiasing, GaussianSurface, Projection, RasterConfig, RasterStrategy
from lumisplat.config.rays import (
    HitDistance,
    NormalMethod,
    ResponseConfig,
    ShadowConfig,
    ShadowMethod,
    TraceConfig,
    TraceStrategy,
)
from lumisplat.config.realtime import FilterConfig, RadianceCacheConfig, RealtimeConfig, RealtimeQuality
from lumisplat.config.relighting import DelightConfig, NormalEstimate, RelightConfig
from lumisplat.config.render import (
    AOVS,
    EVERY_FRAME,
    PATH_AOVS,
    PATH_PARTS,
    REALTIME_AOVS,
    RenderConfig,
    Shadows,
    ToneMap,
)
from lumisplat.config.shadow_maps import Absorption, AtlasLayout, DeepShadowConfig, ReceiverSampling
from lumisplat.config.training import Densification, LearningRates, TrainConfig

__all__ = [
    "AOVS",
    "DATASET_LAYERS",
    "EVERY_FRAME",
    "PATH_AOVS",
    "PATH_PARTS",
    "REALTIME_AOVS",
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
    "Integrator",
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
    "Visibility",
    "check_flag",
    "check_kind",
    "check_range",
    "check_whole",
    "choices",
    "enum_member",
    "listed_names",
]
