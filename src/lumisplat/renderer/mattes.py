"""Mattes of a camera: frames whose pixels' centres are moved through the pixel, and what each of them shows."""

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
"""Points along a pixel's side, which give 17 steps of an edge's coverage."""
_RANKS = 6
"""Names kept of a pixel: three groups of channels, as renderers for films write."""


def render_mattes(scene: Scene, camera: Camera, config: RenderConfig | None = None, *, device: str = "auto") -> Mattes:
    """Finds which objects and materials cover each pixel, and how much of it, for Cryptomatte in compositors.

    16 unlit frames whose pixels' centres are moved through the pixel. At each point, what stands at the frame's surface
    (see ``instance_index``) covers as much as the frame's alpha there: what lies behind translucent Gaussians has no
    share.

    Instances with one name are one object. One without a name is called by its place, ``capture 0`` or ``mesh 0``; a
    mesh's material without a name, and a capture, by the object.

    Args:
        scene: What to draw.
        camera: From where. Mattes are sharp: its aperture is not used.
        config: Settings of the frame that the mattes are for: visibility is that of its rasteriser, or of its rays with
            ``Pipeline.TRACE`` and ``PATH``. None: the defaults.
        device: As for ``create_renderer``.

    Raises:
        ConfigError: ``config`` is no RenderConfig.
        DeviceError: There is no such device, or it is out of memory.
        SceneError: As for ``Renderer.render``.
    """
    config = checked_config(config)
    pipeline = Pipeline.RASTER if config.pipeline.rasterises else Pipeline.TRACE
    config = replace(config, pipeline=pipeline, lighting=False, aovs=(), samples=None)
    renderer = create_renderer(config, device)
    instances: list[IntArray] = []
    shares: list[FloatArray] = []
    steps = (np.arange(_SIDE) + 0.5) / _SIDE - 0.5
    for down in steps:
        for right in steps:
            moved = replace(camera, cx=camera.cx - right, cy=camera.cy - down, aperture=0.0)
            frame = renderer.render(scene, moved)
            instances.append(np.asarray(frame.instance_index))
            shares.append(frame.alpha * np.float32(1.0 / _SIDE**2))
    shown, weights = np.stack(instances), np.stack(shares)
    objects, materials = _names(scene)
    return Mattes(_matte("CryptoObject", objects, shown, weights), _matte("CryptoMaterial", materials, shown, weights))


def _names(scene: Scene) -> tuple[list[str], list[str]]:
    """Names of the object and of the material of each instance, captures first, as frames count them."""
    objects = [splat.name or f"capture {index}" for index, splat in enumerate(scene.splats)]
    materials = list(objects)
    for index, mesh in enumerate(scene.meshes):
        objects.append(mesh.name or mesh.mesh.name or f"mesh {index}")
        materials.append(mesh.mesh.material.name or objects[-1])
    return objects, materials


def _matte(kind: str, names: Sequence[str], shown: IntArray, weights: FloatArray) -> Matte:
    """Sums the shares of points by name, and keeps the largest of each pixel.

    Args:
        kind: As of `Matte`.
        names: Of each instance.
        shown: Instance at each point, -1: none, shape (P, H, W).
        weights: Share of the pixel that each point covers, of the same shape.
    """
    distinct = tuple(dict.fromkeys(names))
    name_of = np.array([*map(distinct.index, names), -1], dtype=np.int32)
    found = name_of[shown]
    order = np.argsort(found, axis=0, kind="stable")
    found, weights = np.take_along_axis(found, order, 0), np.take_along_axis(weights, order, 0)
    sums = np.zeros_like(weights)
    sums[0] = weights[0]
    for point in range(1, len(found)):  # what goes on is carried along, so that the last of a run has its sum
        goes_on = found[point] == found[point - 1]
        sums[point] = weights[point] + np.where(goes_on, sums[point - 1], 0.0)
        sums[point - 1] = np.where(goes_on, 0.0, sums[point - 1])
    sums[found < 0] = 0.0
    largest = np.argsort(-sums, axis=0, kind="stable")[:_RANKS]
    shares = np.minimum(np.take_along_axis(sums, largest, 0), 1.0).astype(np.float32)
    ranks = np.where(shares > 0.0, np.take_along_axis(found, largest, 0), -1).astype(np.int32)
    return Matte(kind, distinct, ranks, shares)
