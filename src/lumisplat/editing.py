"""Edits captures: cropping, decimating, cleaning, levelling, selecting."""

from lumisplat.scene.editing.decimate import decimate
from lumisplat.scene.editing.levelling import UpEstimate, find_up, level
from lumisplat.scene.editing.select import crop, remove_floaters, select
from lumisplat.scene.editing.transform import limit_sh_degree, merge, transform
from lumisplat.scene.ops.colors import scale_light
from lumisplat.scene.ops.neighbours import sort_morton
from lumisplat.scene.ops.normals import estimate_normals, smooth_normals

__all__ = [
    "UpEstimate",
    "crop",
    "decimate",
    "estimate_normals",
    "find_up",
    "level",
    "limit_sh_degree",
    "merge",
    "remove_floaters",
    "scale_light",
    "select",
    "smooth_normals",
    "sort_morton",
    "transform",
]
