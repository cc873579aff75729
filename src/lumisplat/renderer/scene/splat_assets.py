"""The Gaussian sets of a scene on the device: uploaded once, and kept while scenes hold the same objects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumisplat.device.structs.scene import GaussianData
from lumisplat.renderer.scene.upload import upload_array, upload_gaussians
from lumisplat.runtime.buffers import DeviceArray, bytes_of
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.scene import Scene


@dataclass(frozen=True, slots=True)
class SplatAsset:
    """A Gaussian set on the device, and its instances."""

    gaussians: Gaussians
    data: GaussianData
    instance_ids: DeviceArray
    """Indices of its splat instances, on the device."""

    @property
    def placed_count(self) -> int:
        """Gaussians over all of its instances."""
        return self.gaussians.count * self.instance_ids.shape[0]

    @property
    def bytes(self) -> int:
        """Memory of its arrays, bytes."""
        d = self.data
        return bytes_of(d.means, d.rotations, d.scales, d.opacities, d.sh)


def sync_splat_assets(scene: Scene, held: list[SplatAsset], device: str) -> list[SplatAsset]:
    """The assets of a scene, in the order of their first instances.

    Args:
        scene: The scene whose instances place them.
        held: Assets on the device; those no longer placed are removed from the list, and their memory freed, before
            others are uploaded: the peak is one scene, not both.
        device: Warp device name.
    """
    numbers: dict[int, list[int]] = {}
    for number, instance in enumerate(scene.splats):
        numbers.setdefault(id(instance.gaussians), []).append(number)
    held[:] = [asset for asset in held if id(asset.gaussians) in numbers]
    data = {id(asset.gaussians): asset.data for asset in held}
    assets: list[SplatAsset] = []
    for key, placed in numbers.items():
        gaussians = scene.splats[placed[0]].gaussians
        on_device = data[key] if key in data else upload_gaussians(gaussians, device)
        assets.append(SplatAsset(gaussians, on_device, upload_array(np.array(placed, np.int32), device)))
    return assets
