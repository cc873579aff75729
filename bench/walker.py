"""A walking figure for benchmarks: the head and the animated skeleton of walk.glb, with a body around its bones.

The file of `../shared/data` animates a whole skeleton, legs and arms included, but holds the mesh of a head and neck
alone. `write_walker` adds closed, tapered capsules that follow one bone each, and writes all of it as one skinned mesh.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bench.presets import DATA

if TYPE_CHECKING:
    import pygltflib

SOURCE = DATA / "avatars" / "walk.glb"
SIDES, RINGS = 24, 6
"""Corners of a ring of a capsule, and rings of each of its round ends."""


class Bone(NamedTuple):
    """A capsule from one joint to another, in the file's units (the figure is 1.4 tall)."""

    joint: str
    """The joint that it follows."""
    end: str
    radius: float
    end_radius: float


MIDDLE = (
    Bone("C_spine0001", "C_spine0006", 0.125, 0.12),
    Bone("C_spine0006", "C_neck0001", 0.12, 0.06),
)
LIMBS = (
    Bone("clavicle", "armUpper0001", 0.075, 0.055),
    Bone("armUpper0001", "armLower0001", 0.05, 0.038),
    Bone("armLower0001", "hand0001", 0.036, 0.027),
    Bone("hand0001", "handMiddle0002", 0.03, 0.025),
    Bone("handMiddle0002", "handMiddle0004", 0.015, 0.012),
    Bone("handPointer0002", "handPointer0004", 0.013, 0.011),
    Bone("handThumb0001", "handThumb0003", 0.016, 0.012),
    Bone("legUpper0001", "legLower0001", 0.085, 0.055),
    Bone("legLower0001", "foot0001", 0.052, 0.036),
    Bone("foot0001", "foot0002", 0.042, 0.035),
)
BONES = (
    *MIDDLE,
    *(bone._replace(joint=f"{side}_{bone.joint}", end=f"{side}_{bone.end}") for side in "LR" for bone in LIMBS),
)


def write_walker(path: Path) -> None:
    """Writes the figure as a glTF binary file."""
    import pygltflib

    source = pygltflib.GLTF2.load(str(SOURCE))
    file = _Buffers(source)
    rest = rest_poses(source)
    names = {node.name: number for number, node in enumerate(source.nodes)}
    skin = source.skins[0]
    primitive = source.meshes[0].primitives[0]
    positions = [file.read(primitive.attributes.POSITION)]
    joints = [file.read(primitive.attributes.JOINTS_0).astype(np.uint16)]
    weights = [file.read(primitive.attributes.WEIGHTS_0).astype(np.float32)]
    indices = [file.read(primitive.indices).reshape(-1, 3).astype(np.uint32)]
    unposed = list(file.read(skin.inverseBindMatrices).reshape(-1, 4, 4))
    assert skin.joints is not None
    for bone in BONES:
        first, last = (names[f"{name}_bind_JNT"] for name in (bone.joint, bone.end))
        points, faces = capsule(rest[first][:3, 3], rest[last][:3, 3], bone.radius, bone.end_radius)
        indices.append((faces + sum(map(len, positions))).astype(np.uint32))
        positions.append(points.astype(np.float32))
        joints.append(np.tile(np.array([len(skin.joints), 0, 0, 0], np.uint16), (len(points), 1)))
        weights.append(np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (len(points), 1)))
        skin.joints.append(first)
        unposed.append(np.linalg.inv(rest[first]).T.astype(np.float32))  # glTF stores columns.
    primitive.attributes = pygltflib.Attributes(
        POSITION=file.add(np.concatenate(positions), "VEC3", bounds=True),
        JOINTS_0=file.add(np.concatenate(joints), "VEC4"),
        WEIGHTS_0=file.add(np.concatenate(weights), "VEC4"),
    )
    primitive.indices = file.add(np.concatenate(indices).reshape(-1), "SCALAR")
    primitive.material, primitive.targets = None, []
    skin.inverseBindMatrices = file.add(np.stack(unposed).reshape(-1, 16), "MAT4")
    source.materials, source.textures, source.images, source.samplers = [], [], [], []
    source.meshes[0].weights = []
    for animation in source.animations or []:  # Morph weights go: the mesh has lost its targets.
        animation.channels = [
            one for one in animation.channels or [] if one.target is None or one.target.path != "weights"
        ]
    file.store()
    source.save_binary(str(path))


def rest_poses(source: pygltflib.GLTF2) -> np.ndarray:
    """World transforms of all nodes as the file places them, shape (N, 4, 4)."""
    parents = {child: number for number, node in enumerate(source.nodes) for child in node.children or []}
    found: dict[int, np.ndarray] = {}

    def world(number: int) -> np.ndarray:
        if number not in found:
            node, matrix = source.nodes[number], np.eye(4)
            x, y, z, w = node.rotation or (0.0, 0.0, 0.0, 1.0)
            cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            matrix[:3, :3] = (np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross) * (node.scale or (1.0, 1.0, 1.0))
            matrix[:3, 3] = node.translation or (0.0, 0.0, 0.0)
            found[number] = world(parents[number]) @ matrix if number in parents else matrix
        return found[number]

    return np.stack([world(number) for number in range(len(source.nodes))])


def capsule(start: np.ndarray, end: np.ndarray, radius: float, end_radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Points and triangles of a tapered tube with round ends, counter-clockwise seen from outside."""
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    turn = np.arange(SIDES) * 2.0 * np.pi / SIDES
    around = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(axis, side)
    rise = np.linspace(0.0, 0.5 * np.pi, RINGS, endpoint=False)
    rings = [start + radius * (np.cos(a) * around - np.sin(a) * axis) for a in rise[::-1]]
    rings += [end + end_radius * (np.cos(a) * around + np.sin(a) * axis) for a in rise]
    points = np.concatenate([*rings, [start - radius * axis, end + end_radius * axis]])
    corner = np.arange(SIDES)
    after = (corner + 1) % SIDES
    faces: list[np.ndarray] = []
    for ring in range(len(rings) - 1):
        low, high = ring * SIDES, (ring + 1) * SIDES
        faces.append(np.stack([low + corner, low + after, high + after], axis=1))
        faces.append(np.stack([low + corner, high + after, high + corner], axis=1))
    last = (len(rings) - 1) * SIDES
    faces.append(np.stack([after, corner, np.full(SIDES, len(points) - 2)], axis=1))
    faces.append(np.stack([last + corner, last + after, np.full(SIDES, len(points) - 1)], axis=1))
    return points, np.concatenate(faces)


class _Buffers:
    """Reads accessors of a file and appends new ones."""

    def __init__(self, source: pygltflib.GLTF2) -> None:
        blob = source.binary_blob()
        assert blob is not None
        self.source = source
        self.bytes = bytearray(blob)

    def read(self, index: int | None) -> np.ndarray:
        assert index is not None
        accessor = self.source.accessors[index]
        assert accessor.bufferView is not None and accessor.count is not None
        assert accessor.componentType is not None and accessor.type is not None
        view = self.source.bufferViews[accessor.bufferView]
        kind = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}[accessor.componentType]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor.type]
        size = np.dtype(kind).itemsize
        start = (view.byteOffset or 0) + (accessor.byteOffset or 0)
        step = view.byteStride or width * size
        return np.ndarray((accessor.count, width), kind, bytes(self.bytes), start, (step, size)).copy()

    def add(self, values: np.ndarray, kind: str, *, bounds: bool = False) -> int:
        import pygltflib

        code = {"uint16": 5123, "uint32": 5125, "float32": 5126}[values.dtype.name]
        self.bytes += bytes(-len(self.bytes) % 4)
        view = pygltflib.BufferView(buffer=0, byteOffset=len(self.bytes), byteLength=values.nbytes)
        self.bytes += np.ascontiguousarray(values).tobytes()
        self.source.bufferViews.append(view)
        accessor = pygltflib.Accessor(
            bufferView=len(self.source.bufferViews) - 1,
            componentType=code,
            count=len(values),
            type=kind,
            min=values.min(axis=0).tolist() if bounds else None,
            max=values.max(axis=0).tolist() if bounds else None,
        )
        self.source.accessors.append(accessor)
        return len(self.source.accessors) - 1

    def store(self) -> None:
        self.source.set_binary_blob(bytes(self.bytes))
        self.source.buffers[0].byteLength = len(self.bytes)
