"""Skins meshes in float64, vertex by vertex, with SciPy's rotations and none of the package's code."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from support.files.rig_files import JOINT_NODES, TubeRig


def track_value(times: np.ndarray, values: np.ndarray, interpolation: str, path: str, time: float) -> np.ndarray:
    """Returns the value of a channel at a time; quaternions are xyzw."""
    times, values = np.asarray(times, float), np.asarray(values, float)
    time = float(np.clip(time, times[0], times[-1]))
    if interpolation == "STEP":
        return values[np.flatnonzero(times <= time)[-1]]
    if interpolation == "CUBICSPLINE":
        reached, keys, left = values.reshape(len(times), 3, -1).swapaxes(0, 1)
        k = min(int(np.flatnonzero(times <= time)[-1]), len(times) - 2)
        spline = CubicHermiteSpline(times[k : k + 2], keys[k : k + 2], np.array([left[k], reached[k + 1]]))
        value = spline(time)
        return value / np.linalg.norm(value) if path == "rotation" else value
    if path == "rotation":
        return Slerp(times, Rotation.from_quat(values))(time).as_quat()
    return np.array([np.interp(time, times, column) for column in values.T])


def world_matrices(rig: TubeRig, clip: str | None, time: float) -> list[np.ndarray]:
    """Returns ``world_from_node`` of all nodes."""
    local = []
    for node in rig.nodes:
        parts = {"translation": [0, 0, 0], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1]} | node
        local.append({name: np.asarray(parts[name], float) for name in ("translation", "rotation", "scale")})
    for node, path, times, values, *interpolation in rig.clips[clip] if clip else ():
        if path != "weights":
            local[node][path] = track_value(times, values, interpolation[0] if interpolation else "LINEAR", path, time)
    parents = {child: index for index, node in enumerate(rig.nodes) for child in node.get("children", ())}
    matrices = []
    for index, parts in enumerate(local):
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_quat(parts["rotation"]).as_matrix() @ np.diag(parts["scale"])
        matrix[:3, 3] = parts["translation"]
        # The files list parents first.
        matrices.append(matrices[parents[index]] @ matrix if index in parents else matrix)
    return matrices


def posed(rig: TubeRig, clip: str | None, time: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns positions and unit normals of all vertices in float64."""
    world = world_matrices(rig, clip, time)
    assert rig.normals is not None and rig.joints is not None and rig.weights is not None
    bind = rig.joint_from_bind
    if bind is None:
        bind = np.tile(np.eye(4), (3, 1, 1))
        bind[:, 1, 3] = (0.0, -1.0, -2.0)
    joint_matrices = [world[node] @ np.asarray(matrix, float) for node, matrix in zip(JOINT_NODES, bind, strict=True)]
    positions, normals = np.empty(rig.positions.shape), np.empty(rig.positions.shape)
    for v, (position, normal) in enumerate(zip(rig.positions, rig.normals, strict=True)):
        weights = rig.weights[v].astype(float) / rig.weights[v].astype(float).sum()
        matrix = np.zeros((4, 4))
        for joint, weight in zip(rig.joints[v], weights, strict=True):
            matrix += weight * joint_matrices[joint]
        positions[v] = (matrix @ [*position.astype(float), 1.0])[:3]
        turned = np.linalg.inv(matrix[:3, :3]).T @ normal.astype(float)
        normals[v] = turned / np.linalg.norm(turned)
    return positions, normals
