"""Triangles of the raster: projected, and what they show at the pixels and rays that hit them.

``project_triangles``: one item is one triangle of one instance. ``shade_pixels``: one item is one pixel; colour and
normal of what was hit. ``find_ray_hits``: one item is one ray.
"""

import warp as wp

from lumisplat.device.camera.pixels import TILE, image_index, is_shown, seen_pixel, shown_pixel
from lumisplat.device.math.color import encode_srgb_color
from lumisplat.device.mesh.mesh_surface import surface_color, surface_normal
from lumisplat.device.mesh.triangle_raster import barycentric, setup_triangle, triangle_box
from lumisplat.device.splat.blending import instance_of, pixel_ray
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import MeshPixels, TileRect, Triangle
from lumisplat.device.structs.rays import MeshHits, RayData
from lumisplat.device.structs.scene import MeshData, MeshInstanceData

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def project_triangles(
    start: int,
    splat_instance_count: int,
    camera: wp.array[CameraData],
    instances: wp.array[MeshInstanceData],
    meshes: MeshData,
    triangles_out: wp.array[Triangle],
    rects_out: wp.array[TileRect],
):
    """Sets up the triangles of all mesh instances, which are numbered after the splat instances."""
    i = start + wp.tid()
    view = camera[0]
    number = instance_of(instances, i)
    instance = instances[number]
    face = i - instance.first
    corners = meshes.indices[instance.face_first + face]
    v0 = instance.camera_from_object * meshes.positions[corners[0]] + instance.camera_from_object_offset
    v1 = instance.camera_from_object * meshes.positions[corners[1]] + instance.camera_from_object_offset
    v2 = instance.camera_from_object * meshes.positions[corners[2]] + instance.camera_from_object_offset
    triangle = setup_triangle(v0, v1, v2)
    triangle.face = instance.face_first + face
    triangle.instance = splat_instance_count + number
    rect = TileRect()
    area = wp.length_sq(triangle.normal)
    if area > 0.0 and area < wp.inf:
        box = triangle_box(view, v0, v1, v2)
        # A pixel of slack: rounding in the projection must not lose a centre that the edge functions would accept.
        left = float(view.left)
        top = float(view.top)
        right = float(view.left + view.width)
        bottom = float(view.top + view.height)
        x0 = wp.clamp(wp.floor(box[0]) - 1.0, left, right)
        y0 = wp.clamp(wp.floor(box[1]) - 1.0, top, bottom)
        x1 = wp.clamp(wp.ceil(box[2]) + 1.0, left, right)
        y1 = wp.clamp(wp.ceil(box[3]) + 1.0, top, bottom)
        if x0 < x1 and y0 < y1:
            triangle.row_first = wp.uint16(y0)
            triangle.row_last = wp.uint16(y1 - 1.0)
            rect.x0 = wp.int16((int(x0) - view.left) // TILE)
            rect.y0 = wp.int16((int(y0) - view.top) // TILE)
            rect.x1 = wp.int16((int(x1) - 1 - view.left) // TILE + 1)
            rect.y1 = wp.int16((int(y1) - 1 - view.top) // TILE + 1)
    triangles_out[i] = triangle
    rects_out[i] = rect


@wp.kernel
def find_ray_hits(
    start: int,
    camera: wp.array[CameraData],
    splat_instance_count: int,
    triangles: wp.array[Triangle],
    triangle_of_pixel: wp.array[int],
    depth_z: wp.array[float],
    rays: RayData,
    hits_out: MeshHits,
):
    """Item = ray: its hit on the nearest triangle of its pixel."""
    i = start + wp.tid()
    view = camera[0]
    hits_out.t[i] = rays.t_max[i]
    hits_out.face[i] = -1
    position = seen_pixel(view, i)
    x = position[0]
    y = position[1]
    if not is_shown(view, x, y):
        return
    pixel = image_index(view, x, y)
    index = triangle_of_pixel[pixel]
    if index < 0:
        return
    triangle = triangles[index]
    ray = pixel_ray(view, x, y)
    weights = barycentric(triangle, ray)
    hits_out.face[i] = triangle.face
    hits_out.instance[i] = triangle.instance - splat_instance_count
    hits_out.weights[i] = wp.vec2(weights[1], weights[2])
    hits_out.t[i] = depth_z[pixel] * wp.length(ray)


@wp.kernel
def shade_pixels(
    start: int,
    camera: wp.array[CameraData],
    instances: wp.array[MeshInstanceData],
    splat_instance_count: int,
    meshes: MeshData,
    triangles: wp.array[Triangle],
    triangle_of_pixel: wp.array[int],
    pixels_out: MeshPixels,
):
    """Unlit base colour, encoded for display, and the shading normal towards the viewer."""
    i = start + wp.tid()
    pixels_out.instance[i] = -1
    pixels_out.color[i] = wp.vec3(0.0)
    pixels_out.normal[i] = wp.vec3(0.0)
    index = triangle_of_pixel[i]
    if index < 0:
        return
    view = camera[0]
    triangle = triangles[index]
    instance = instances[triangle.instance - splat_instance_count]
    at = shown_pixel(view, i)
    ray = pixel_ray(view, at[0], at[1])
    weights = barycentric(triangle, ray)
    corners = meshes.indices[triangle.face]
    color = surface_color(instance, meshes, corners, weights)
    normal = surface_normal(instance, meshes, corners, weights)
    if wp.dot(normal, view.world_from_camera * ray) > 0.0:
        normal = -normal
    pixels_out.instance[i] = triangle.instance
    pixels_out.color[i] = encode_srgb_color(color)
    pixels_out.normal[i] = normal
