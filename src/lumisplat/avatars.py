"""Rigged avatars made of Gaussians, and their relighting by a captured scene."""

from lumisplat.io.load_save import load_bound_gaussians, load_motion, load_rig
from lumisplat.relighting.actors import shadow_strength, shadowed
from lumisplat.relighting.avatar_lighter import AvatarLighter
from lumisplat.relighting.capture_measures import estimate_capture_gain
from lumisplat.relighting.probe import EnvironmentProbe
from lumisplat.relighting.probe_transfer import relight
from lumisplat.scene.animation.actors import Actor
from lumisplat.scene.animation.rig import Rig
from lumisplat.scene.animation.rigged_gaussians import RiggedGaussians, bind_gaussians

__all__ = [
    "Actor",
    "AvatarLighter",
    "EnvironmentProbe",
    "Rig",
    "RiggedGaussians",
    "bind_gaussians",
    "estimate_capture_gain",
    "load_bound_gaussians",
    "load_motion",
    "load_rig",
    "relight",
    "shadow_strength",
    "shadowed",
]
