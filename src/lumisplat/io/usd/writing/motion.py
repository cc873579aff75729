"""Actors and moving cameras as time samples: one time code a frame."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lumisplat.io.usd.library import pxr
from lumisplat.io.usd.writing.assets import AssetWriter, Instance, mesh_values
from lumisplat.io.usd.writing.cameras import camera_place, camera_values, define_camera
from lumisplat.io.usd.writing.particles import particle_values
from lumisplat.io.usd.writing.stage import StageWriter, matrix
from lumisplat.scene.animation.actors import Actor, Animation
from lumisplat.scene.scene import MeshInstance

PLACE = "xformOp:transform"

_Key = tuple[str, int, int]


def write_motion(writer: StageWriter, assets: AssetWriter, animation: Animation) -> None:
    """Writes what moves in an animation, and the times of its frames.

    Transforms, and the shapes of what deforms, have a sample at each frame at which they change; between frames,
    readers interpolate them.
    """
    stage = writer.stage
    stage.SetTimeCodesPerSecond(animation.fps)
    stage.SetFramesPerSecond(animation.fps)
    stage.SetStartTimeCode(0.0)
    stage.SetEndTimeCode(animation.frame_count - 1.0)
    for actor in animation.actors:
        _write_actor(writer, assets, actor, animation)
    if animation.camera_path is not None:
        cameras = [animation.camera_path.at(float(time)) for time in animation.times]
        prim = define_camera(writer, cameras[0])
        samples = _Samples(prim)
        for frame, camera in enumerate(cameras):
            samples.add(frame, PLACE, matrix(camera_place(camera)), camera.camera_from_world.tobytes())
            for name, value in camera_values(camera).items():
                samples.add(frame, name, value, value)


@dataclass(slots=True)
class _Samples:
    """Samples of the attributes of a prim, written where values change.

    Before a change after frames without one, the old value is written again, so that it holds until there.
    """

    prim: Any
    _last: dict[str, tuple[int, Any, Any]] = field(default_factory=dict[str, "tuple[int, Any, Any]"])
    """By attribute: the frame of the last sample, its value, and what says whether another one is the same."""

    def add(self, frame: int, name: str, value: Any, mark: Any) -> None:
        """Takes the value of an attribute at a frame; equal marks mean equal values."""
        attribute = self.prim.GetAttribute(name)
        if name == PLACE and not attribute:
            attribute = pxr().UsdGeom.Xformable(self.prim).AddTransformOp().GetAttr()
        if name not in self._last:
            attribute.Set(value)
        else:
            at, before, known = self._last[name]
            if known == mark:
                return
            if at == 0:
                attribute.Set(before, 0.0)
            if at < frame - 1:
                attribute.Set(before, frame - 1.0)
            attribute.Set(value, float(frame))
        self._last[name] = frame, value, mark


def _write_actor(writer: StageWriter, assets: AssetWriter, actor: Actor, animation: Animation) -> None:
    """Writes an actor: each of its instances as a prim, with samples of its place and of its shape."""
    if not actor.casts_shadow or not actor.relight:
        writer.remarks.add("how actors are lit (relight, casts_shadow)", actor.name)
    prims: dict[_Key, _Samples] = {}
    shown: dict[_Key, Any] = {}
    for frame, time in enumerate(animation.times):
        present = dict(_keyed(actor.at(float(time))))
        for key, instance in present.items():
            if key not in prims:
                name = instance.name or actor.name or "actor"
                path = writer.path_of(name)
                prim = assets.define(path, instance)
                writer.name(prim, name)
                prims[key] = _Samples(prim)
                if frame > 0:
                    prims[key].add(0, "visibility", "invisible", "invisible")
            samples = prims[key]
            samples.add(frame, PLACE, matrix(instance.transform), instance.transform.tobytes())
            asset = instance.mesh if isinstance(instance, MeshInstance) else instance.gaussians
            if shown.get(key) is not asset:
                for name, value in _shape(instance).items():
                    samples.add(frame, name, value, np.asarray(value).tobytes())
                shown[key] = asset
        for key, samples in prims.items():
            seen = "inherited" if key in present else "invisible"
            samples.add(frame, "visibility", seen, seen)


def _keyed(instances: Iterable[Instance]) -> Iterator[tuple[_Key, Instance]]:
    """Instances by what stays of them from frame to frame: their kind, their material, and the how many-th it is."""
    counts: Counter[tuple[str, int]] = Counter()
    for instance in instances:
        own = ("mesh", id(instance.mesh.material)) if isinstance(instance, MeshInstance) else ("splats", 0)
        yield (own[0], own[1], counts[own]), instance
        counts[own] += 1


def _shape(instance: Instance) -> dict[str, Any]:
    """The values of an instance that may change with time, by attribute."""
    if not isinstance(instance, MeshInstance):
        return particle_values(instance.gaussians)
    mesh, vt = instance.mesh, pxr().Vt
    return {
        **mesh_values(mesh),
        "faceVertexCounts": vt.IntArray.FromNumpy(np.full(mesh.face_count, 3, np.int32)),
        "faceVertexIndices": vt.IntArray.FromNumpy(mesh.indices.reshape(-1)),
    }
