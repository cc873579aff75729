"""Inverse rendering: materials of captures and images, and the lights of a scene."""

from lumisplat.config import DelightConfig
from lumisplat.relighting.capture_measures import surface_remark
from lumisplat.relighting.delight import MaterialEstimate, delight, estimate_materials
from lumisplat.relighting.evaluation import MaterialEvaluation, MaterialView, RelitFigures, evaluate_materials
from lumisplat.relighting.fitting.fit_lights import fit_lights
from lumisplat.relighting.fitting.results import FittedView, LightFit
from lumisplat.relighting.light_estimation import LightEstimate, estimate_lights
from lumisplat.relighting.protocols import Benchmark, PublishedFigures, check_published, evaluate_published
from lumisplat.relighting.published_sets import write_orb_images
from lumisplat.relighting.sun_estimation import SunEstimate, estimate_sun
from lumisplat.training.find_materials import FoundMaterials, find_materials

__all__ = [
    "Benchmark",
    "DelightConfig",
    "FittedView",
    "FoundMaterials",
    "LightEstimate",
    "LightFit",
    "MaterialEstimate",
    "MaterialEvaluation",
    "MaterialView",
    "PublishedFigures",
    "RelitFigures",
    "SunEstimate",
    "check_published",
    "delight",
    "estimate_lights",
    "estimate_materials",
    "estimate_sun",
    "evaluate_materials",
    "evaluate_published",
    "find_materials",
    "fit_lights",
    "surface_remark",
    "write_orb_images",
]
