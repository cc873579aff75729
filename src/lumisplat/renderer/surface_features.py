"""View depth and normal of Gaussians as features of a differentiable frame, and the chain rule through them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.math.transforms import matrices_from_quaternions
from lumisplat.renderer.gradients.results import SetGradient, SplatGradients
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.scene import Scene, SplatInstance


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceFeatures:
    """Depths and normals of the Gaussians of a scene, which ``DifferentiableRenderer.render_features`` can show.

    A normal is the shortest axis of its Gaussian: once Gaussians are flat, that is the normal of their surface, and
    unlike the max-density plane's it does not depend on their scales, so that a loss on normals turns them and nothing
    else::

        renderer.render(scene, camera)
        surface = ls.gradients.SurfaceFeatures.of(scene, camera)
        shown = renderer.render_features(surface.values)  # weighted sums of depth, and of normals
        gradients = renderer.gradients(by_color, dL_dfeatures=by_shown)
        gradients = surface.backward(gradients)  # of means and rotations also by way of depths and normals
    """

    scene: Scene
    camera: Camera
    values: FloatArray
    """View depth of the mean, scene units, and unit normal, world space, on the side of the eye; of all Gaussians,
    instance by instance, shape (N, 4)."""

    @classmethod
    def of(cls, scene: Scene, camera: Camera) -> SurfaceFeatures:
        """Those of a scene as a camera sees it.

        Args:
            scene: The scene.
            camera: A pinhole.
        """
        parts = [np.column_stack([_depths(s, camera), _normals(s, camera) @ _turn(s).T]) for s in scene.splats]
        values = np.concatenate(parts) if parts else np.zeros((0, 4))
        return cls(scene, camera, values.astype(np.float32))

    def backward(self, gradients: SplatGradients, first: int = 0) -> SplatGradients:
        """Derivatives to which those by way of depths and normals are added.

        Depths move means and the camera's pose, normals turn Gaussians; where one flips, or another axis becomes the
        shortest, it jumps, without a derivative.

        Args:
            gradients: Of ``DifferentiableRenderer.gradients`` with ``dL_dfeatures``.
            first: Column of the features that has the depths; the normals are in the next three.
        """
        assert gradients.features is not None, "they were asked for without dL_dfeatures"
        by_values = gradients.features[:, first : first + 4].astype(np.float64)
        numbers: dict[int, int] = {}
        sets, pose, begin = list(gradients.sets), np.zeros((4, 4)), 0
        for instance in self.scene.splats:
            number = numbers.setdefault(id(instance.gaussians), len(numbers))
            by_depth, by_normal = np.split(by_values[begin : begin + instance.gaussians.count], [1], axis=1)
            begin += instance.gaussians.count
            sets[number] = _added(sets[number], instance, self.camera, by_depth, by_normal)
            pose[2, :3] += by_depth[:, 0] @ instance.world_means
            pose[2, 3] += by_depth.sum()
        total = None if gradients.camera_from_world is None else gradients.camera_from_world + pose
        return replace(gradients, sets=tuple(sets), camera_from_world=total)


def _depths(instance: SplatInstance, camera: Camera) -> Doubles:
    """View depths of the means, shape (N,)."""
    return instance.world_means @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]


def _turn(instance: SplatInstance) -> Doubles:
    """The rotation from object to world."""
    return instance.transform[:3, :3] / instance.scale


def _normals(instance: SplatInstance, camera: Camera) -> Doubles:
    """The shortest axes on the side of the eye, in object space, shape (N, 3)."""
    gaussians = instance.gaussians
    axes = matrices_from_quaternions(gaussians.rotations_wxyz)
    shortest = np.argmin(gaussians.scales, axis=1)
    normals = np.take_along_axis(axes, shortest[:, None, None], axis=2)[:, :, 0]
    to_eye = (camera.eye - instance.world_means) @ _turn(instance)
    return np.where(np.sum(normals * to_eye, axis=1, keepdims=True) < 0.0, -normals, normals)


def _added(
    gradient: SetGradient, instance: SplatInstance, camera: Camera, by_depth: Doubles, by_normal: Doubles
) -> SetGradient:
    """Derivatives by a set, and those by way of depths, (N, 1), and world normals, (N, 3), of one of its instances."""
    by_mean = by_depth * (camera.camera_from_world[2, :3] @ instance.transform[:3, :3])
    by_turn = np.cross(_normals(instance, camera), by_normal @ _turn(instance))
    by_rotation = _by_quaternion(instance.gaussians, by_turn)
    return replace(
        gradient,
        means=(gradient.means + by_mean).astype(np.float32),
        rotations_wxyz=(gradient.rotations_wxyz + by_rotation).astype(np.float32),
    )


def _by_quaternion(gaussians: Gaussians, by_turn: Doubles) -> Doubles:
    """Derivatives by unit quaternions ``q`` of what has derivatives ``t`` by small turns in object space, (N, 4).

    A turn by ``w`` moves ``q`` by half of ``(0, w) q``, so that they are ``2 (0, t) q``.
    """
    w, v = np.split(gaussians.rotations_wxyz.astype(np.float64), [1], axis=1)
    scalar = -np.sum(by_turn * v, axis=1, keepdims=True)
    return 2.0 * np.concatenate([scalar, w * by_turn + np.cross(by_turn, v)], axis=1)
