"""What ``lumisplat info --json`` says about files: plain values under keys that stay (docs/guide/captures.md)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any, cast

import lumisplat as ls

if TYPE_CHECKING:
    from lumisplat.scene.lights import Light
    from lumisplat.scene.materials import Material

Facts = dict[str, Any]


def capture_facts(gaussians: ls.Gaussians) -> Facts:
    """A capture, in its own coordinates."""
    import numpy as np

    arrays = gaussians.arrays()
    return {
        "gaussians": gaussians.count,
        "sh_degree": gaussians.sh_degree,
        "bounds": _box(gaussians.bounds()),
        "origin": list(gaussians.origin),
        "scale_percentiles": [float(value) for value in np.percentile(gaussians.scales, (1, 50, 99))],
        "opacity_histogram": np.histogram(gaussians.opacities, bins=10, range=(0.0, 1.0))[0].tolist(),
        "memory_bytes": sum(array.nbytes for array in arrays.values()),
        "antialiased": gaussians.antialiased,
        "kernel_degree": gaussians.kernel_degree,
        "up": _plain(gaussians.up),
        "first_view": None if gaussians.first_view is None else _plain(gaussians.first_view.eye.tolist()),
        "also_has": [name for name in ("normals", "albedo", "roughness", "metallic", "incident") if name in arrays],
        "comments": list(gaussians.comments),
    }


def block_facts(index: ls.BlockIndex) -> Facts:
    """A capture in blocks, from its index alone."""
    low, high = index.bounds
    levels = max(len(block.levels) for block in index.blocks)
    return {
        "gaussians": index.count,
        "sh_degree": math.isqrt(index.sh_count) - 1,
        "bounds": _box((low.min(axis=0), high.max(axis=0))),
        "blocks": len(index.blocks),
        "level_gaussians": [
            sum(block.levels[min(level, len(block.levels) - 1)].count for block in index.blocks)
            for level in range(levels)
        ],
        "antialiased": index.antialiased,
    }


def mesh_facts(mesh: ls.Mesh) -> Facts:
    """A mesh, in its own coordinates."""
    return {
        "vertices": mesh.vertex_count,
        "faces": mesh.face_count,
        "bounds": _box(mesh.bounds()),
        "origin": list(mesh.origin),
        "has": [name for name in ("normals", "uvs", "colors") if getattr(mesh, name) is not None],
        "black_vertices": black_share(mesh),
        "material": mesh.material.name,
        "inside": _inside(mesh.material),
    }


def _inside(material: Material) -> Facts | None:
    """The medium of a mesh that lets light in; None: it has none."""
    if getattr(material, "transmission", 0.0) <= 0.0:
        return None
    names = ("thin_walled", "attenuation_color", "attenuation_distance", "ior", "priority")
    return {name: _plain(getattr(material, name)) for name in names}


def black_share(mesh: ls.Mesh) -> float:
    """Share of the vertices whose colour is black, 0..1: such a mesh is black, whatever lights it."""
    return 0.0 if mesh.colors is None else float((mesh.colors.max(axis=1) < 0.5 / 255.0).mean())


def scene_facts(scene: ls.Scene, cameras: Sequence[ls.Camera]) -> Facts:
    """A scene: instances with their boxes in the world, lights and cameras."""
    return {
        "bounds": _box(scene.bounds()) if scene.splats or scene.meshes else None,
        "captures": [
            {"name": one.name, "placed": _box(one.bounds()), **capture_facts(one.gaussians)} for one in scene.splats
        ],
        "meshes": [
            {"name": one.name or one.mesh.name, "placed": _box(one.bounds()), **mesh_facts(one.mesh)}
            for one in scene.meshes
        ],
        "lights": [light_facts(light) for light in scene.lights],
        "cameras": camera_facts(cameras) if cameras else None,
    }


def animation_facts(animation: ls.Animation) -> Facts:
    """The actors of a scene and the length of their animation, seconds."""
    return {
        "fps": animation.fps,
        "frames": animation.frame_count,
        "duration": animation.duration,
        "actors": [actor_facts(actor) for actor in animation.actors],
    }


def actor_facts(actor: ls.Actor) -> Facts:
    """An actor: what it is, and how it moves."""
    rig, motion, subject = actor.rig, actor.motion, actor.subject
    is_sequence = isinstance(subject, ls.GaussianSequence)
    return {
        "name": actor.name,
        "kind": type(subject).__name__,
        "clip": None if rig is None else actor.clip or next(iter(rig.clips), None),
        "clips": [] if rig is None else list(rig.clips),
        "clip_duration": actor.own_duration or None,
        "fps": subject.fps if is_sequence else None,
        "frames": subject.frame_count if is_sequence else None,
        "loop": actor.loop,
        "speed": actor.speed,
        "keyframes": 0 if motion is None else motion.count,
        "keyframes_end": None if motion is None else motion.duration,
        "casts_shadow": actor.casts_shadow,
        "relight": actor.relight,
        "placed_at_start": [_box(instance.bounds()) for instance in actor.at(0.0)],
    }


def light_facts(light: Light) -> Facts:
    """A light: its kind and all its settings but images."""
    named = {field.name: getattr(light, field.name) for field in fields(light) if field.name != "image"}
    return {"kind": type(light).__name__.removeprefix("Light").lower(), **{k: _plain(v) for k, v in named.items()}}


def camera_facts(cameras: Sequence[ls.Camera]) -> Facts:
    """All cameras of a file."""
    import numpy as np

    eyes = np.array([camera.eye for camera in cameras])
    return {
        "count": len(cameras),
        "sizes": sorted({(camera.width, camera.height) for camera in cameras}),
        "models": list(dict.fromkeys(camera.model.value for camera in cameras)),
        "distortions": list(dict.fromkeys(camera.distortion for camera in cameras)),
        "positions": _box((eyes.min(axis=0), eyes.max(axis=0))),
        "names": [camera.name for camera in cameras],
    }


def radiance_facts(image: Any) -> Facts:
    """An image of radiance."""
    return {
        "width": int(image.shape[1]),
        "height": int(image.shape[0]),
        "mean": [float(value) for value in image.mean(axis=(0, 1), dtype=float)],
        "largest": float(image.max()),
    }


def _box(corners: tuple[Any, Any]) -> list[list[float]]:
    """Two corners; -0 becomes 0."""
    return [[float(value) + 0.0 for value in corner] for corner in corners]


def _plain(value: Any) -> Any:
    """A value as JSON holds it; infinity is None."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return [*cast("tuple[Any, ...]", value)] if isinstance(value, tuple) else value
