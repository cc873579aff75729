"""Loads rigs of all formats, with motion from other files."""

from __future__ import annotations

import logging
import shlex
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy.typing as npt

from lumisplat.config.checks import suggestion
from lumisplat.errors import FormatError, SceneError
from lumisplat.io.files.source import PathLike, parsing
from lumisplat.io.gltf.animation import read_motion as read_gltf_motion, read_rig as read_gltf_rig
from lumisplat.io.rigs.amass import BodyPoses, read_body_poses
from lumisplat.io.rigs.body_model import SMPL, SMPLH, SMPLX, BodyModel, read_body_model
from lumisplat.io.rigs.bvh import read_bvh
from lumisplat.scene.animation.retargeting import retarget
from lumisplat.scene.animation.rig import Clip, Rig

_log = logging.getLogger("lumisplat")

GLTF_FILES = (".glb", ".gltf", ".vrm", ".vrma")
"""Extensions of rigs and motions that are glTF; .vrm and .vrma are GLB."""
BODY_FILES = (".npz",)
"""Extensions of body models of the SMPL family."""
_RIGS = ".glb, .gltf, .vrm, or .npz of SMPL, SMPL-H, SMPL-X, FLAME"
_MOTIONS = ".npz of AMASS, .bvh, .glb, .gltf or .vrma"
_LISTED = 6
"""Log lines name at most this many joints."""
_SAME_SHAPES = ("SMPL", "SMPL-H")
"""Models with the same shape space: coefficients of one fit the other."""

_TO_GLB = (
    "import bpy, sys; bpy.ops.wm.read_factory_settings(use_empty=True); "
    "bpy.ops.import_scene.fbx(filepath=sys.argv[-2]); bpy.ops.export_scene.gltf(filepath=sys.argv[-1])"
)
"""Program for Blender that converts FBX to GLB; its arguments are the names of both files."""
_TORCH = (".pt", ".pth", ".ckpt")
SAVED = 'save its Gaussians by ls.save("avatar.ply", ls.Gaussians(...)) in the program that made it'
"""Advice about files of Python programs, for error messages."""


def refuse_foreign(path: PathLike) -> None:
    """Raises `FormatError` for formats of avatars that are not read, with what to do instead.

    Args:
        path: The file; only its extension matters, except that errors name it.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".fbx":
        files = " ".join(shlex.quote(str(file)) for file in (path, path.with_suffix(".glb")))
        command = f'blender --background --python-expr "{_TO_GLB}" -- {files}'
        raise FormatError(path, f"is FBX, which is not read: convert it by {command}")
    if suffix == ".pkl":
        command = f"{shlex.quote(sys.executable)} -m lumisplat.io.rigs.convert_pickle {shlex.quote(str(path))}"
        told = f"convert a body model (SMPL) to .npz by {command} ; of an avatar, {SAVED}"
        raise FormatError(path, f"is a pickle, which is not read: {told}")
    if suffix in _TORCH:
        raise FormatError(path, f"is a file of PyTorch, which is not read: {SAVED}")


def load_rig(
    path: PathLike,
    *,
    motion: PathLike | None = None,
    betas: npt.ArrayLike | None = None,
    expression: npt.ArrayLike | None = None,
    vertex_colors: bool = True,
    joints: Mapping[str, str] | None = None,
) -> Rig:
    """Loads a rig; see `lumisplat.avatars.load_rig`, and `load_motion` for ``joints``."""
    path = Path(path)
    suffix = path.suffix.lower()
    refuse_foreign(path)
    if joints and motion is None:
        raise SceneError("joints are those of a motion, but there is no motion")
    if suffix == ".bvh":
        if motion is not None:
            raise FormatError(path, f'is a motion without a body: load_rig("walker.glb", motion="{path.name}")')
        skeleton, clip = read_bvh(path)
        return Rig(skeleton, (), (clip,))
    if suffix not in (*GLTF_FILES, *BODY_FILES):
        raise FormatError(path, f"unknown extension {path.suffix!r} of a rig, expected {_RIGS}")
    is_gltf = suffix in GLTF_FILES
    if is_gltf and (betas is not None or expression is not None):
        raise FormatError(path, "has no betas or expression: they shape a body model (SMPL), a .npz")
    poses = None
    if is_gltf:
        rig = read_gltf_rig(path, vertex_colors)
    else:
        model = read_body_model(path)
        if motion is not None and Path(motion).suffix.lower() == ".npz":
            poses = read_body_poses(Path(motion))
            betas = _betas_of(model, poses) if betas is None else betas
        with parsing(path, "a body model (SMPL)"):
            rig = model.rig(betas, expression)
    return rig if motion is None else load_motion(motion, rig, path.name, poses, joints)


def load_motion(
    path: PathLike,
    rig: Rig,
    name: str = "the rig",
    poses: BodyPoses | None = None,
    joints: Mapping[str, str] | None = None,
) -> Rig:
    """Returns a rig with the clips of a motion file first; see `lumisplat.avatars.load_motion`.

    Args:
        path: The motion file.
        rig: The rig.
        name: Name of the rig in messages.
        poses: Content of the file, if it holds AMASS poses and is already read.
        joints: Names in SMPL of joints of the motion or the rig, by their names there.
    """
    path = Path(path)
    if path.suffix.lower() in (".pkl", *_TORCH):
        poses_file = 'np.savez("walk.npz", poses=..., trans=..., mocap_framerate=30.0)'
        raise FormatError(path, f"is not read as a motion: save its poses of SMPL in Python by {poses_file}")
    refuse_foreign(path)
    if path.suffix.lower() == ".npz":
        if joints:
            raise SceneError(f"joints applies to other motions than {path.name}, whose joints have the names of SMPL")
        if rig.skeleton.names not in (SMPL, SMPLH, SMPLX):
            raise FormatError(path, f"moves bodies (.npz of SMPL, SMPL-H or SMPL-X), but {name} is none")
        clips = ((poses or read_body_poses(path)).clip(rig.skeleton),)
    else:
        clips = _fitted(path, rig, name, joints or {})
    named = {clip.name for clip in clips}
    return replace(rig, animations=(*clips, *(clip for clip in rig.animations if clip.name not in named)))


def _betas_of(model: BodyModel, poses: BodyPoses) -> npt.ArrayLike | None:
    """Returns the shape of a motion's body for a model with the same shapes, logged; None for other models."""
    if not poses.betas.size:
        return None
    if poses.name != model.name and not {poses.name, model.name} <= set(_SAME_SHAPES):
        _log.warning("%s: its betas are of %s, and do not shape %s: %s", poses.path, poses.name, model.name, model.path)
        return None
    betas = poses.betas[: model.shapes.shape[2]]
    _log.warning("%s: is shaped by %d betas of %s, as betas are not given", model.path, betas.size, poses.path.name)
    return betas


def _fitted(path: Path, rig: Rig, name: str, joints: Mapping[str, str]) -> tuple[Clip, ...]:
    """Returns the clips of a BVH or glTF file, fitted to a rig; logs which joints do not move."""
    suffix = path.suffix.lower()
    if suffix in GLTF_FILES:
        source, clips = read_gltf_motion(path)
    elif suffix == ".bvh":
        source, clip = read_bvh(path)
        clips = (clip,)
    else:
        raise FormatError(path, f"unknown extension {path.suffix!r} of a motion, expected {_MOTIONS}")
    names = [one for one in (*source.names, *rig.skeleton.names) if one]
    for own, joint in joints.items():
        for key, known in ((own, names), (joint, (*SMPL, *SMPLX))):
            if key not in known:
                raise SceneError(f"joints has unknown {key!r}, {suggestion(key, known)}")
    with parsing(path, "a motion of a human"):
        try:
            done = [retarget(source, clip, rig, joints) for clip in clips]
        except SceneError as error:
            raise FormatError(path, f"does not fit {name}: {error}") from None
    first = done[0]
    notes = [
        "poses are relative to its first frame, because it does not stand at rest" * first.from_first_frame,
        _listed("these of its joints move nothing", first.unmatched),
        _listed(f"these of {name} rest", first.resting),
    ]
    if any(notes):
        _log.warning("%s: %s", path, "; ".join(note for note in notes if note))
    return tuple(one.clip for one in done)


def _listed(what: str, names: list[str]) -> str:
    """Returns a note that names up to six joints and counts the others; empty without any."""
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return f"{what}: {', '.join(names[:_LISTED])}{more}" if names else ""
