"""Nearest mesh surface at each pixel centre.

``project_triangles``: one item is one triangle of one instance. ``raster_tiles`` (CPU): one item is one tile, rows of
16 pixels as in the splat compositor. ``raster_pixels`` (CUDA): one item is one pixel, one block is one tile.
``shade_pixels``: one item is one pixel; colour and normal of what was hit. ``find_ray_hits``: one item is one ray.
"""

import warp as wp

from lumisplat.device.camera.ray_blocks import pixel_of_ray
from lumisplat.device.camera.tiles import TILE, TILE_PIXELS, RowFloats, TileFloats, TileInts, tile_corner, tile_pixel
from lumisplat.device.gaussian.compositing import instance_of, pixel_ray
from lumisplat.device.math.color import encode_srgb_color
from lumisplat.device.mesh.mesh_surface import surface_color, surface_normal
from lumisplat.device.mesh.triangle_raster import barycentric, setup_triangle, triangle_box
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import MeshPixels, TileRect, Triangle
from lumisplat.device.structs.rays import MeshHits, RayData
from lumisplat.device.structs.scene import MeshData, MeshInstanceData

wp.set_module_options({"enable_backward": False, "max_unroll": 4, "fuse_fp": False})


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
        x0 = wp.clamp(wp.floor(box[0]) - 1.0, 0.0, float(view.width))
        y0 = wp.clamp(wp.floor(box[1]) - 1.0, 0.0, float(view.height))
        x1 = wp.clamp(wp.ceil(box[2]) + 1.0, 0.0, float(view.width))
        y1 = wp.clamp(wp.ceil(box[3]) + 1.0, 0.0, float(view.height))
        if x0 < x1 and y0 < y1:
            triangle.row_first = wp.uint16(y0)
            triangle.row_last = wp.uint16(y1 - 1.0)
            rect.x0 = wp.int16(int(x0) // TILE)
            rect.y0 = wp.int16(int(y0) // TILE)
            rect.x1 = wp.int16((int(x1) - 1) // TILE + 1)
            rect.y1 = wp.int16((int(y1) - 1) // TILE + 1)
    triangles_out[i] = triangle
    rects_out[i] = rect


@wp.kernel
def raster_tiles(
    start: int,
    camera: wp.array[CameraData],
    triangles: wp.array[Triangle],
    tile_starts: wp.array[int],
    tile_triangles: wp.array[int],
    depth_out: wp.array[float],
    triangle_out: wp.array[int],
):
    """Depth test of a tile's triangles, in order: of equally near ones, the first is kept."""
    tile = start + wp.tid()
    view = camera[0]
    corner = tile_corner(view, tile)
    left = corner[0]
    top = corner[1]
    nearest = TileFloats(wp.inf)
    winner = TileInts(-1)
    ray_x = RowFloats(0.0)
    for x in range(TILE):
        ray_x[x] = (float(left + x) + 0.5 - view.raster_center[0]) / view.focal[0]
    for j in range(tile_starts[tile], tile_starts[tile + 1]):
        index = tile_triangles[j]
        triangle = triangles[index]
        first = wp.max(int(triangle.row_first) - top, 0)
        end = wp.min(int(triangle.row_last) - top + 1, TILE)
        for y in range(first, end):
            ray_y = (float(top + y) + 0.5 - view.raster_center[1]) / view.focal[1]
            row0 = triangle.edge0[1] * ray_y + triangle.edge0[2]
            row1 = triangle.edge1[1] * ray_y + triangle.edge1[2]
            row2 = triangle.edge2[1] * ray_y + triangle.edge2[2]
            row_normal = triangle.normal[1] * ray_y + triangle.normal[2]
            for x in range(TILE):
                i = y * TILE + x
                e0 = triangle.edge0[0] * ray_x[x] + row0
                e1 = triangle.edge1[0] * ray_x[x] + row1
                e2 = triangle.edge2[0] * ray_x[x] + row2
                z = triangle.plane / (triangle.normal[0] * ray_x[x] + row_normal)
                z = wp.where(wp.min(e0, wp.min(e1, e2)) >= 0.0, z, wp.where(wp.max(e0, wp.max(e1, e2)) <= 0.0, z, 0.0))
                z = wp.where(z > view.near, z, wp.inf)
                winner[i] = wp.where(z < nearest[i], index, winner[i])
                nearest[i] = wp.min(z, nearest[i])
    for y in range(wp.min(TILE, view.height - top)):
        for x in range(wp.min(TILE, view.width - left)):
            pixel = (top + y) * view.width + left + x
            depth_out[pixel] = nearest[y * TILE + x]
            triangle_out[pixel] = winner[y * TILE + x]


@wp.kernel
def raster_pixels(
    start: int,
    camera: wp.array[CameraData],
    triangles: wp.array[Triangle],
    tile_starts: wp.array[int],
    tile_triangles: wp.array[int],
    depth_out: wp.array[float],
    triangle_out: wp.array[int],
):
    """Item = tile * 256 + pixel of the tile; the arithmetic of ``raster_tiles``."""
    i = start + wp.tid()
    view = camera[0]
    tile = i // TILE_PIXELS
    position = tile_pixel(view, i)
    x = position[0]
    y = position[1]
    if x >= view.width or y >= view.height:
        return
    ray = pixel_ray(view, x, y)
    nearest = float(wp.inf)
    winner = int(-1)
    for j in range(tile_starts[tile], tile_starts[tile + 1]):
        index = tile_triangles[j]
        triangle = triangles[index]
        e0 = triangle.edge0[0] * ray[0] + (triangle.edge0[1] * ray[1] + triangle.edge0[2])
        e1 = triangle.edge1[0] * ray[0] + (triangle.edge1[1] * ray[1] + triangle.edge1[2])
        e2 = triangle.edge2[0] * ray[0] + (triangle.edge2[1] * ray[1] + triangle.edge2[2])
        if wp.min(e0, wp.min(e1, e2)) >= 0.0 or wp.max(e0, wp.max(e1, e2)) <= 0.0:
            z = triangle.plane / (triangle.normal[0] * ray[0] + (triangle.normal[1] * ray[1] + triangle.normal[2]))
            if z > view.near and z < nearest:
                nearest = z
                winner = index
    depth_out[y * view.width + x] = nearest
    triangle_out[y * view.width + x] = winner


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
    position = pixel_of_ray(view.width, i)
    x = position[0]
    y = position[1]
    if x >= view.width or y >= view.height:
        return
    pixel = y * view.width + x
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
    ray = pixel_ray(view, i % view.width, i // view.width)
    weights = barycentric(triangle, ray)
    corners = meshes.indices[triangle.face]
    color = surface_color(instance, meshes, corners, weights)
    normal = surface_normal(instance, meshes, corners, weights)
    if wp.dot(normal, view.world_from_camera * ray) > 0.0:
        normal = -normal
    pixels_out.instance[i] = triangle.instance
    pixels_out.color[i] = encode_srgb_color(color)
    pixels_out.normal[i] = normal
