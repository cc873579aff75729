"""Renders Cryptomatte coverage of a camera's pixels from frames with shifted sub-pixel positions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lumisplat.config import Pipeline, RenderConfig
from lumisplat.frame.mattes import Matte, Mattes
from lumisplat.math.arrays import FloatArray, IntArray
from lumisplat.renderer.checks import checked_config
from lumisplat.renderer.renderer import create_renderer
from lumisplat.scene.camera import Camera
from lumisplat.scene.scene import Scene

_SIDE = 4
"""Sub-pixel positions along a pixel's side; all 16 positions of a pixel give 17 levels of coverage at an edge."""
_RANKS = 6
"""Largest number of names stored per pixel: three groups of channels, as production renderers write."""


def render_mattes(scene: Scene, camera: Camera, config: RenderConfig | None = None, *, device: str = "auto") -> Mattes:
    """Renders the coverage of each pixel by objects and materials, for Cryptomatte in compositors.

    Renders 16 unlit frames, whose rays go through a 4 x 4 grid in each pixel. In each frame, the alpha of a pixel
    counts as coverage by the instance at its surface (see ``instance_index``). Surfaces behind translucent Gaussians
    get no coverage.

    Instances with the same name are one object. An instance without a name is called ``capture 0`` or ``mesh 0``, by
    its index. A mesh material without a name, and a capture's material, take the name of the object.

    Args:
        scene: The scene to render.
        camera: The camera. Mattes are sharp: its aperture is ignored.
        config: Settings of the frame that the mattes are for. As in that frame, visibility is traced for
            ``Pipeline.TRACE`` and ``PATH``, else rasterised. None: the defaults.
        device: As for ``create_renderer``.

    Raises:
        ConfigError: ``config`` is no RenderConfig.
        DeviceError: The device does not exist or is out of memory.
        SceneError: As for ``Renderer.render``.
    """
    config = checked_config(config)
    pipeline = Pipeline.RASTER if config.pipeline.rasterises else Pipeline.TRACE
    config = replace(config, pipeline=pipeline, lighting=False, aovs=(), samples=None)
    renderer = create_renderer(config, device)
    instances: list[IntArray] = []
    coverage: list[FloatArray] = []
    steps = (np.arange(_SIDE) + 0.5) / _SIDE - 0.5
    for down in steps:
        for right in steps:
            moved = replace(camera, cx=camera.cx - right, cy=camera.cy - down, aperture=0.0)
            frame = renderer.render(scene, moved)
            instances.append(np.asarray(frame.instance_index))
            coverage.append(frame.alpha * np.float32(1.0 / _SIDE**2))
    shown, weights = np.stack(instances), np.stack(coverage)
    objects, materials = _names(scene)
    return Mattes(_matte("CryptoObject", objects, shown, weights), _matte("CryptoMaterial", materials, shown, weights))


def _names(scene: Scene) -> tuple[list[str], list[str]]:
    """Returns the object names and the material names of all instances, by instance index (captures first)."""
    objects = [splat.name or f"capture {index}" for index, splat in enumerate(scene.splats)]
    materials = list(objects)
    for index, mesh in enumerate(scene.meshes):
        objects.append(mesh.name or mesh.mesh.name or f"mesh {index}")
        materials.append(mesh.mesh.material.name or objects[-1])
    return objects, materials


def _matte(kind: str, names: Sequence[str], shown: IntArray, weights: FloatArray) -> Matte:
    """Sums each name's coverage over all sub-pixel positions, and returns a matte of each pixel's largest sums.

    Args:
        kind: Name of the matte for compositors, such as ``CryptoObject``.
        names: Name of each instance.
        shown: Instance index at each of P sub-pixel positions, shape (P, H, W); -1: none.
        weights: Fraction of the pixel that each position covers, shape (P, H, W).
    """
    distinct = tuple(dict.fromkeys(names))
    name_of = np.array([*map(distinct.index, names), -1], dtype=np.int32)
    found = name_of[shown]
    order = np.argsort(found, axis=0, kind="stable")
    found, weights = np.take_along_axis(found, order, 0), np.take_along_axis(weights, order, 0)
    sums = np.zeros_like(weights)
    sums[0] = weights[0]
    for point in range(1, len(found)):  # the last entry of a run of equal names gets their sum
        continues = found[point] == found[point - 1]
        sums[point] = weights[point] + np.where(continues, sums[point - 1], 0.0)
        sums[point - 1] = np.where(continues, 0.0, sums[point - 1])
    sums[found < 0] = 0.0
    largest = np.argsort(-sums, axis=0, kind="stable")[:_RANKS]
    coverage = np.minimum(np.take_along_axis(sums, largest, 0), 1.0).astype(np.float32)
    ranks = np.where(coverage > 0.0, np.take_along_axis(found, largest, 0), -1).astype(np.int32)
    return Matte(kind, distinct, ranks, coverage)
