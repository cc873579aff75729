"""The Gaussian sets of a scene on the device: uploaded once, and kept while scenes hold the same objects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumisplat.device.structs.scene import GaussianData
from lumisplat.device.structs.shading import SplatAttributes
from lumisplat.renderer.scene.upload import (
    are_alike,
    overwrite_gaussians,
    shares_memory,
    upload_array,
    upload_attributes,
    upload_gaussians,
)
from lumisplat.runtime.buffers import DeviceArray, bytes_of
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.scene import Scene


@dataclass(frozen=True, slots=True)
class SplatAsset:
    """A Gaussian set on the device, and its instances."""

    gaussians: Gaussians
    data: GaussianData
    attributes: SplatAttributes
    placed: tuple[int, ...]
    """Indices of its splat instances."""
    instance_ids: DeviceArray
    """The same on the device."""

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

    A set that replaces one like it, as in animations, is copied to where that was, if the device has copies at all.

    Args:
        scene: The scene whose instances place them.
        held: Assets on the device; those no longer placed are removed from the list, and their memory freed or written
            again, before others are uploaded: the peak is one scene, not both.
        device: Warp device name.
    """
    numbers: dict[int, list[int]] = {}
    for number, instance in enumerate(scene.splats):
        numbers.setdefault(id(instance.gaussians), []).append(number)
    sets = [scene.splats[placed[0]].gaussians for placed in numbers.values()]
    known = {id(asset.gaussians): asset for asset in held if id(asset.gaussians) in numbers}
    replaced = {
        id(gaussians): asset
        for asset, gaussians in zip(held, sets, strict=False)
        if not shares_memory(device)
        and not {id(asset.gaussians), id(gaussians)} & known.keys()
        and are_alike(asset.gaussians, gaussians)
    }
    held[:] = known.values()
    assets: list[SplatAsset] = []
    for gaussians, placed in zip(sets, numbers.values(), strict=True):
        asset = known.get(id(gaussians)) or replaced.pop(id(gaussians), None)
        if asset is None or asset.placed != tuple(placed):
            ids = upload_array(np.array(placed, np.int32), device)
        else:
            ids = asset.instance_ids
        data, attributes = _on_device(gaussians, asset, device)
        assets.append(SplatAsset(gaussians, data, attributes, tuple(placed), ids))
    return assets


def _on_device(gaussians: Gaussians, asset: SplatAsset | None, device: str) -> tuple[GaussianData, SplatAttributes]:
    """A set on the device: there already, copied to where the asset is that it replaces, or in new memory."""
    if asset is None:
        data = upload_gaussians(gaussians, device)
        return data, upload_attributes(gaussians, data, device)
    if asset.gaussians is not gaussians:
        overwrite_gaussians(asset.data, asset.attributes, gaussians)
    return asset.data, asset.attributes
