"""Arrays for the derivatives by the Gaussians of an asset."""

from __future__ import annotations

import warp as wp

from lumisplat.device.structs.gradients import GaussianGradient
from lumisplat.renderer.scene.assets import SplatAsset
from lumisplat.runtime.buffers import Buffers


def gradient_of_asset(buffers: Buffers, asset: SplatAsset, number: int) -> GaussianGradient:
    """Arrays with undefined contents.

    Args:
        buffers: Hold them.
        asset: The Gaussians.
        number: The asset's, in the scene.
    """
    get, count = buffers.get, asset.gaussians.count
    out = GaussianGradient()
    out.means = get(f"backward.means{number}", wp.vec3, count)
    out.rotations = get(f"backward.rotations{number}", wp.quat, count)
    out.scales = get(f"backward.scales{number}", wp.vec3, count)
    out.opacities = get(f"backward.opacities{number}", wp.float32, count)
    out.sh_count = asset.data.sh_count
    out.sh = get(f"backward.sh{number}", wp.vec3, count * out.sh_count)
    return out
