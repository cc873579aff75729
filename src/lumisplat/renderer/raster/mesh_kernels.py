"""Kernels that rasterise triangles: they project triangles, then find and shade the nearest at each pixel's centre."""

import warp as wp

from lumisplat.device.camera.pixels import (
    TILE,
    RowFloats,
    TileFloats,
    TileInts,
    full_image_index,
    full_pixel_of_index,
    full_pixel_of_ray,
    image_index,
    is_in_window,
    tile_corner,
)
from lumisplat.device.math.color import encode_srgb_color
from lumisplat.device.mesh.mesh_surface import surface_color, surface_normal
from lumisplat.device.mesh.triangle_raster import (
    barycentric,
    depth_at,
    has_alpha,
    pixel_passes_alpha_test,
    setup_triangle,
    triangle_box,
)
from lumisplat.device.splat.blending import instance_of, pixel_ray
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import MeshPixels, RasterMeshes, TileRect, Triangle
from lumisplat.device.structs.rays import MeshHits, RayData
from lumisplat.device.structs.scene import MeshData, MeshInstanceData

OPTIONS = {"enable_backward": False, "fuse_fp": False}
wp.set_module_options(OPTIONS)

NOTHING = wp.constant(wp.int64(2**63 - 1))
"""Largest packed value (depth and triangle index in one integer). It means that no triangle covers the pixel."""
INDEX_BITS = wp.constant(wp.int64(32))


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
    """Projects a triangle of a mesh instance to the image. One thread per triangle.

    Mesh instances are numbered after the splat instances.
    """
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


# The nearest triangles on CPUs: one item is one tile, in rows of 16 pixels.

TILES = wp.get_module(f"{__name__}.tiles")
# The loop over a row must stay a loop for the vectoriser, as in `tile_walk` of device/splat/compositor.py.
wp.set_module_options(OPTIONS | {"max_unroll": 4}, TILES)


@wp.kernel(module=TILES)
def raster_tiles(
    start: int,
    camera: wp.array[CameraData],
    scene: RasterMeshes,
    triangles: wp.array[Triangle],
    tile_starts: wp.array[int],
    tile_triangles: wp.array[int],
    depth_out: wp.array[float],
    triangle_out: wp.array[int],
):
    """Per tile: finds the nearest triangle at each of its pixels; of equally near triangles, the first wins."""
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
        is_whole = not has_alpha(triangle, scene)
        first = wp.max(int(triangle.row_first) - top, 0)
        end = wp.min(int(triangle.row_last) - top + 1, TILE)
        for y in range(first, end):
            ray_y = (float(top + y) + 0.5 - view.raster_center[1]) / view.focal[1]
            row0 = triangle.edge0[1] * ray_y + triangle.edge0[2]
            row1 = triangle.edge1[1] * ray_y + triangle.edge1[2]
            row2 = triangle.edge2[1] * ray_y + triangle.edge2[2]
            row_normal = triangle.normal[1] * ray_y + triangle.normal[2]
            if is_whole:
                for x in range(TILE):
                    i = y * TILE + x
                    e0 = triangle.edge0[0] * ray_x[x] + row0
                    e1 = triangle.edge1[0] * ray_x[x] + row1
                    e2 = triangle.edge2[0] * ray_x[x] + row2
                    z = triangle.plane / (triangle.normal[0] * ray_x[x] + row_normal)
                    inside = wp.min(e0, wp.min(e1, e2)) >= 0.0
                    z = wp.where(inside, z, wp.where(wp.max(e0, wp.max(e1, e2)) <= 0.0, z, 0.0))
                    z = wp.where(z > view.near, z, wp.inf)
                    winner[i] = wp.where(z < nearest[i], index, winner[i])
                    nearest[i] = wp.min(z, nearest[i])
            else:
                for x in range(wp.min(TILE, view.left + view.width - left)):
                    i = y * TILE + x
                    ray = wp.vec3(ray_x[x], ray_y, 1.0)
                    z = depth_at(triangle, ray)
                    if z > view.near and z < nearest[i]:
                        if pixel_passes_alpha_test(triangle, ray, full_image_index(view, left + x, top + y), scene):
                            winner[i] = index
                            nearest[i] = z
    for y in range(wp.min(TILE, view.top + view.height - top)):
        for x in range(wp.min(TILE, view.left + view.width - left)):
            pixel = image_index(view, left + x, top + y)
            depth_out[pixel] = nearest[y * TILE + x]
            triangle_out[pixel] = winner[y * TILE + x]


# The nearest triangles on CUDA: one item is one pair of a tile and a triangle that may touch it. Pairs write to shared
# pixels by an atomic minimum of depth and index in one key. The nearest triangle wins in any order, and the first of
# equally near ones.

PAIRS = wp.get_module(f"{__name__}.pairs")
wp.set_module_options(OPTIONS, PAIRS)


@wp.func
def tile_of_pair(tile_starts: wp.array[int], pair: int) -> int:
    """Returns the tile of a (tile, triangle) pair: the last tile whose list begins at or before the pair."""
    low = int(0)
    high = int(tile_starts.shape[0] - 1)
    while high - low > 1:
        middle = (low + high) // 2
        if tile_starts[middle] <= pair:
            low = middle
        else:
            high = middle
    return low


@wp.kernel(module=PAIRS)
def clear_nearest(start: int, nearest_out: wp.array[wp.int64]):
    """Per pixel: sets its nearest triangle to `NOTHING`."""
    nearest_out[start + wp.tid()] = NOTHING


@wp.kernel(module=PAIRS)
def raster_pairs(
    start: int,
    camera: wp.array[CameraData],
    scene: RasterMeshes,
    triangles: wp.array[Triangle],
    tile_starts: wp.array[int],
    tile_triangles: wp.array[int],
    nearest_inout: wp.array[wp.int64],
):
    """Does the work of `raster_tiles` on CUDA. One thread per (tile, triangle) pair; unused pairs return at once."""
    pair = start + wp.tid()
    if pair >= tile_starts[tile_starts.shape[0] - 1]:
        return
    view = camera[0]
    corner = tile_corner(view, tile_of_pair(tile_starts, pair))
    index = tile_triangles[pair]
    triangle = triangles[index]
    is_whole = not has_alpha(triangle, scene)
    first = wp.max(int(triangle.row_first), corner[1])
    end = wp.min(wp.min(int(triangle.row_last) + 1, corner[1] + TILE), view.top + view.height)
    right = wp.min(corner[0] + TILE, view.left + view.width)
    for y in range(first, end):
        for x in range(corner[0], right):
            ray = pixel_ray(view, x, y)
            z = depth_at(triangle, ray)
            pixel = image_index(view, x, y)
            if z > view.near:
                key = (wp.int64(wp.cast(z, wp.int32)) << INDEX_BITS) | wp.int64(index)
                if key < nearest_inout[pixel] and (
                    is_whole or pixel_passes_alpha_test(triangle, ray, full_image_index(view, x, y), scene)
                ):
                    wp.atomic_min(nearest_inout, pixel, key)


@wp.kernel(module=PAIRS)
def store_nearest(start: int, nearest: wp.array[wp.int64], depth_out: wp.array[float], triangle_out: wp.array[int]):
    """Stores depth and index of the nearest triangle at a pixel. One thread per pixel."""
    pixel = start + wp.tid()
    key = nearest[pixel]
    if key == NOTHING:
        depth_out[pixel] = wp.inf
        triangle_out[pixel] = -1
    else:
        depth_out[pixel] = wp.cast(wp.int32(key >> INDEX_BITS), wp.float32)
        triangle_out[pixel] = wp.int32(key)


# Hits of rays, and colours of pixels.


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
    """Intersects a ray with the nearest triangle of its pixel. One thread per ray."""
    i = start + wp.tid()
    view = camera[0]
    hits_out.t[i] = rays.t_max[i]
    hits_out.face[i] = -1
    position = full_pixel_of_ray(view, i)
    x = position[0]
    y = position[1]
    if not is_in_window(view, x, y):
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
    """Writes the base colour (encoded for display) and the shading normal (facing the viewer) of a pixel's mesh."""
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
    at = full_pixel_of_index(view, i)
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
