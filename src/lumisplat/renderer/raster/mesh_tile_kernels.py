"""Nearest mesh surface at each pixel centre, on CPUs. One item is one tile, in rows of 16 pixels."""

import warp as wp

from lumisplat.device.camera.pixels import (
    TILE,
    RowFloats,
    TileFloats,
    TileInts,
    image_index,
    picture_index,
    tile_corner,
)
from lumisplat.device.mesh.triangle_raster import depth_at, has_alpha, pixel_meets
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import RasterMeshes, Triangle

# The loop over a row must stay a loop for the vectoriser, as in splat_tile_kernels.
wp.set_module_options({"enable_backward": False, "max_unroll": 4, "fuse_fp": False})


@wp.kernel
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
                        if pixel_meets(triangle, ray, picture_index(view, left + x, top + y), scene):
                            winner[i] = index
                            nearest[i] = z
    for y in range(wp.min(TILE, view.top + view.height - top)):
        for x in range(wp.min(TILE, view.left + view.width - left)):
            pixel = image_index(view, left + x, top + y)
            depth_out[pixel] = nearest[y * TILE + x]
            triangle_out[pixel] = winner[y * TILE + x]
