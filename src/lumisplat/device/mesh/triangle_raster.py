"""Rasterisation of triangles along pixel rays, without clipping (Olano and Greer 1997).

See docs/method/rasterisation.md#meshes. Kernels that call these functions compile without fused multiply-adds
(``fuse_fp``), which would make an edge depend on the order of a subtraction and let shared edges leak.
"""

import warp as wp

from lumisplat.device.math.random import sample_key_of
from lumisplat.device.mesh.mesh_surface import passes_alpha_test
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import RasterMeshes, Triangle
from lumisplat.device.structs.scene import ALPHA_OPAQUE


@wp.func
def comes_first(a: wp.vec3, b: wp.vec3) -> bool:
    """Returns whether point ``a`` precedes point ``b`` in lexicographic order."""
    if a[0] != b[0]:
        return a[0] < b[0]
    if a[1] != b[1]:
        return a[1] < b[1]
    return a[2] < b[2]


@wp.func
def edge_function(a: wp.vec3, b: wp.vec3) -> wp.vec3:
    """Returns ``cross(a, b)`` of two corners of a triangle, accurate relative to their difference.

    The plain cross product would cancel for corners that are close to each other and far from the eye. Both triangles
    of an edge start from the corner that is first in lexicographic order, so that their edge functions are exact
    negatives of each other.
    """
    if comes_first(a, b):
        return wp.cross(a, b - a)
    return -wp.cross(b, a - b)


@wp.func
def setup_triangle(v0: wp.vec3, v1: wp.vec3, v2: wp.vec3) -> Triangle:
    """Prepares a triangle, given by its camera-space corners, for rasterisation: edge functions and plane."""
    triangle = Triangle()
    triangle.edge0 = edge_function(v1, v2)
    triangle.edge1 = edge_function(v2, v0)
    triangle.edge2 = edge_function(v0, v1)
    triangle.normal = wp.cross(v1 - v0, v2 - v0)
    triangle.plane = wp.dot(triangle.normal, v0)
    return triangle


@wp.func
def barycentric(triangle: Triangle, ray: wp.vec3) -> wp.vec3:
    """Returns the perspective-correct barycentric weights of the point where a camera-space ray hits the triangle."""
    weights = wp.vec3(wp.dot(triangle.edge0, ray), wp.dot(triangle.edge1, ray), wp.dot(triangle.edge2, ray))
    return weights / (weights[0] + weights[1] + weights[2])


@wp.func
def depth_at(triangle: Triangle, ray: wp.vec3) -> float:
    """Returns the view depth of the triangle on a ray through a pixel centre; 0 where the ray misses it."""
    e0 = triangle.edge0[0] * ray[0] + (triangle.edge0[1] * ray[1] + triangle.edge0[2])
    e1 = triangle.edge1[0] * ray[0] + (triangle.edge1[1] * ray[1] + triangle.edge1[2])
    e2 = triangle.edge2[0] * ray[0] + (triangle.edge2[1] * ray[1] + triangle.edge2[2])
    if wp.min(e0, wp.min(e1, e2)) >= 0.0 or wp.max(e0, wp.max(e1, e2)) <= 0.0:
        return triangle.plane / (triangle.normal[0] * ray[0] + (triangle.normal[1] * ray[1] + triangle.normal[2]))
    return 0.0


@wp.func
def project_point(camera: CameraData, point: wp.vec3) -> wp.vec2:
    """Returns the pixel coordinates of a camera-space point in front of the eye."""
    return wp.vec2(
        camera.focal[0] * point[0] / point[2] + camera.raster_center[0],
        camera.focal[1] * point[1] / point[2] + camera.raster_center[1],
    )


@wp.func
def grow_box(box: wp.vec4, camera: CameraData, a: wp.vec3, b: wp.vec3) -> wp.vec4:
    """Extends a pixel box (x0, y0, x1, y1) by corner ``a`` of a triangle, if the corner is beyond the near plane.

    If the edge from ``a`` to ``b`` crosses the near plane, the box is extended by the crossing point.
    """
    if a[2] >= camera.near:
        p = project_point(camera, a)
        box = wp.vec4(wp.min(box[0], p[0]), wp.min(box[1], p[1]), wp.max(box[2], p[0]), wp.max(box[3], p[1]))
    if (a[2] < camera.near) != (b[2] < camera.near):
        cut = wp.lerp(a, b, (camera.near - a[2]) / (b[2] - a[2]))
        p = project_point(camera, wp.vec3(cut[0], cut[1], camera.near))
        box = wp.vec4(wp.min(box[0], p[0]), wp.min(box[1], p[1]), wp.max(box[2], p[0]), wp.max(box[3], p[1]))
    return box


@wp.func
def triangle_box(camera: CameraData, v0: wp.vec3, v1: wp.vec3, v2: wp.vec3) -> wp.vec4:
    """Returns the pixel box (x0, y0, x1, y1) of a triangle's part beyond the near plane; x0 > x1: there is none."""
    box = wp.vec4(wp.inf, wp.inf, -wp.inf, -wp.inf)
    box = grow_box(box, camera, v0, v1)
    box = grow_box(box, camera, v1, v2)
    return grow_box(box, camera, v2, v0)


# --- Triangles with alpha ---


@wp.func
def has_alpha(triangle: Triangle, scene: RasterMeshes) -> bool:
    """Returns whether the material of a triangle has an alpha mode other than opaque."""
    return scene.instances[triangle.instance - scene.splat_instance_count].alpha.mode != ALPHA_OPAQUE


@wp.func
def pixel_passes_alpha_test(triangle: Triangle, ray: wp.vec3, pixel: int, scene: RasterMeshes) -> bool:
    """Returns whether a triangle's alpha lets a pixel show it, at the point where the pixel's camera-space ray hits."""
    sample = scene.sample[0]
    key = sample_key_of(pixel, sample.index, sample.seed)
    instance = scene.instances[triangle.instance - scene.splat_instance_count]
    return passes_alpha_test(instance, scene.meshes, triangle.face, barycentric(triangle, ray), key)
