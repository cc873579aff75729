"""Triangles seen along pixel rays, without clipping (Olano and Greer 1997)."""

import warp as wp

from lumisplat.device.structs import CameraData, Triangle

# Fused multiply-adds would break cross(a, b) == -cross(b, a), and with it the watertightness of shared edges.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def setup_triangle(v0: wp.vec3, v1: wp.vec3, v2: wp.vec3) -> Triangle:
    """Edge functions of a camera-space triangle, two-sided."""
    triangle = Triangle()
    edge0 = wp.cross(v1, v2)
    volume = wp.dot(v0, edge0)
    side = wp.sign(volume)
    triangle.edge0 = side * edge0
    triangle.edge1 = side * wp.cross(v2, v0)
    triangle.edge2 = side * wp.cross(v0, v1)
    triangle.volume = wp.abs(volume)
    return triangle


@wp.func
def barycentric(triangle: Triangle, ray: wp.vec3) -> wp.vec3:
    """Perspective-correct coordinates of the point that a ray through the triangle meets."""
    weights = wp.vec3(wp.dot(triangle.edge0, ray), wp.dot(triangle.edge1, ray), wp.dot(triangle.edge2, ray))
    return weights / (weights[0] + weights[1] + weights[2])


@wp.func
def triangle_box(camera: CameraData, v0: wp.vec3, v1: wp.vec3, v2: wp.vec3) -> wp.vec4:
    """Pixel box (x0, y0, x1, y1) that contains the triangle's image; everything where it crosses the near plane."""
    if wp.min(v0[2], wp.min(v1[2], v2[2])) < camera.near:
        return wp.vec4(0.0, 0.0, float(camera.width), float(camera.height))
    p0 = wp.vec2(v0[0] / v0[2], v0[1] / v0[2])
    p1 = wp.vec2(v1[0] / v1[2], v1[1] / v1[2])
    p2 = wp.vec2(v2[0] / v2[2], v2[1] / v2[2])
    low = wp.min(p0, wp.min(p1, p2))
    high = wp.max(p0, wp.max(p1, p2))
    return wp.vec4(
        low[0] * camera.focal[0] + camera.center[0],
        low[1] * camera.focal[1] + camera.center[1],
        high[0] * camera.focal[0] + camera.center[0],
        high[1] * camera.focal[1] + camera.center[1],
    )
