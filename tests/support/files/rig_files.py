"""Builds a small rig by hand: a tube along y with three joints, and clips of every kind."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from support.files.gltf_writer import Gltf

RINGS, SIDES, HEIGHT, RADIUS = 13, 10, 3.0, 0.25
JOINT_NODES = (2, 3, 4)
"""Nodes of the joints, each one unit above its parent joint; node 1 is the parent of the lowest, node 0 has the mesh.
"""


def tube() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns positions (V, 3), outward normals (V, 3) and counter-clockwise triangles (F, 3) of a tube, y = 0 to 3."""
    angle = 2.0 * np.pi * np.arange(SIDES) / SIDES
    height = np.linspace(0.0, HEIGHT, RINGS)
    normals = np.tile(np.stack([np.cos(angle), np.zeros(SIDES), -np.sin(angle)], axis=1), (RINGS, 1))
    positions = RADIUS * normals + np.repeat(height, SIDES)[:, None] * (0.0, 1.0, 0.0)
    ring, side = (part.ravel() for part in np.mgrid[: RINGS - 1, :SIDES])
    a, b = ring * SIDES + side, ring * SIDES + (side + 1) % SIDES
    triangles = np.concatenate([np.stack([a, b, b + SIDES], 1), np.stack([a, b + SIDES, a + SIDES], 1)])
    return positions.astype(np.float32), normals.astype(np.float32), triangles.astype(np.uint16)


def tube_weights(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns joints (V, 4) and weights (V, 4): each joint moves its unit of height, with smooth transitions."""
    closeness = np.clip(1.25 - np.abs(positions[:, 1:2] - (0.5, 1.5, 2.5)), 0.0, None) ** 2
    weights = closeness / closeness.sum(axis=1, keepdims=True)
    joints = np.tile(np.array([0, 1, 2, 0], np.uint8), (len(positions), 1))
    return joints, np.pad(weights, ((0, 0), (0, 1))).astype(np.float32)


@dataclass
class TubeRig:
    """Content of a glTF file with the rig; tests change the content before they write the file."""

    positions: np.ndarray = field(default_factory=lambda: tube()[0])
    normals: np.ndarray | None = field(default_factory=lambda: tube()[1])
    triangles: np.ndarray = field(default_factory=lambda: tube()[2])
    joints: np.ndarray | None = field(default_factory=lambda: tube_weights(tube()[0])[0])
    weights: np.ndarray | None = field(default_factory=lambda: tube_weights(tube()[0])[1])
    joint_from_bind: np.ndarray | None = None
    clips: dict[str, list[tuple]] = field(default_factory=dict)
    """Tracks of each clip: (node, path, times, values, interpolation), with values as glTF stores them."""
    nodes: list[dict] = field(default_factory=lambda: [
        {"mesh": 0, "skin": 0, "name": "tube"},
        {"name": "root", "children": [2]},
        {"name": "hip", "children": [3]},
        {"name": "knee", "children": [4], "translation": [0.0, 1.0, 0.0]},
        {"name": "foot", "translation": [0.0, 1.0, 0.0]},
    ])  # fmt: skip
    targets: list[np.ndarray] = field(default_factory=list)
    attributes: dict[str, np.ndarray] = field(default_factory=dict)
    material: dict = field(default_factory=lambda: {
        "name": "skin", "pbrMetallicRoughness": {"baseColorFactor": [0.8, 0.4, 0.2, 1.0], "metallicFactor": 0.0}
    })  # fmt: skip

    def gltf(self) -> Gltf:
        """Returns the content as a glTF document."""
        gltf = Gltf()
        arrays = {"POSITION": self.positions, **self.attributes}
        if self.normals is not None:
            arrays["NORMAL"] = self.normals
        if self.joints is not None:
            for k in range(0, self.joints.shape[1], 4):
                arrays[f"JOINTS_{k // 4}"] = np.ascontiguousarray(self.joints[:, k : k + 4])
        if self.weights is not None:
            for k in range(0, self.weights.shape[1], 4):
                arrays[f"WEIGHTS_{k // 4}"] = np.ascontiguousarray(self.weights[:, k : k + 4])
        primitive: dict = {"attributes": {name: gltf.accessor(array) for name, array in arrays.items()}}
        primitive["indices"] = gltf.accessor(self.triangles.reshape(-1))
        primitive["material"] = gltf.add("materials", **self.material)
        if self.targets:
            primitive["targets"] = [{"POSITION": gltf.accessor(offsets)} for offsets in self.targets]
        gltf.add("meshes", primitives=[primitive], name="tube")
        for node in self.nodes:
            gltf.add("nodes", **node)
        if any("skin" in node for node in self.nodes):
            matrices = self.joint_from_bind
            if matrices is None:
                matrices = np.tile(np.eye(4, dtype=np.float32), (3, 1, 1))
                matrices[:, 1, 3] = (0.0, -1.0, -2.0)
            gltf.add("skins", joints=list(JOINT_NODES), inverseBindMatrices=gltf.accessor(matrices))
        for name, tracks in self.clips.items():
            samplers, channels = [], []
            for node, path, times, values, *interpolation in tracks:
                samplers.append({
                    "input": gltf.accessor(np.asarray(times, np.float32)),
                    "output": gltf.accessor(np.asarray(values, np.float32)),
                    "interpolation": interpolation[0] if interpolation else "LINEAR",
                })  # fmt: skip
                channels.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": path}})
            gltf.add("animations", name=name, samplers=samplers, channels=channels)
        return gltf

    def write(self, path: Path) -> Path:
        """Writes the content as a GLB file. Returns the path."""
        path.write_bytes(self.gltf().glb())
        return path


def quaternion_xyzw(axis: tuple[float, float, float], degrees: float) -> list[float]:
    """Returns the quaternion (x, y, z, w), as glTF stores it, of a rotation about an axis."""
    half = np.radians(degrees) / 2.0
    return [*(np.sin(half) * np.asarray(axis, float) / np.linalg.norm(axis)), float(np.cos(half))]


BEND = [(3, "rotation", [0.0, 1.0], [quaternion_xyzw((0, 0, 1), 0.0), quaternion_xyzw((0, 0, 1), 70.0)])]
"""Clip that bends the knee by 70 degrees within a second."""
CARRY = [
    (1, "translation", [0.0, 2.0], [[0.0, 0.0, 0.0], [4.0, 0.0, 2.0]]),
    (1, "rotation", [0.0, 2.0], [quaternion_xyzw((1, 2, 3), 0.0), quaternion_xyzw((1, 2, 3), 120.0)]),
]
"""Clip that moves and rotates the whole rig rigidly."""
VANISH = [(1, "scale", [0.0, 1.0], [[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]])]
"""Clip that shrinks the rig to nothing within a second."""
