"""Rasterises frames in float64 NumPy, as an oracle for the rasteriser; written from the papers, not from the kernels.

Every step is a small function that can be read next to its equation: EWA projection (Zwicker et al. 2001), spherical
harmonics, brute-force triangle visibility (Olano and Greer 1997), and front-to-back blending (Kerbl et al. 2023).

The oracle also reports where float32 may disagree: ``band`` marks the pixels with a decision so close that rounding may
flip it; ``tie`` marks those of them at which the whole colour may change (a depth order, a triangle's edge), while
thresholds of alpha or transmittance change the colour by 1/255.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np

from lumisplat.config import Antialiasing, HitDistance, NormalMethod, RasterConfig, RenderConfig
from lumisplat.constants import ALPHA_MAX, ALPHA_MIN, JACOBIAN_CLAMP, NORMAL_DEGENERATE
from lumisplat.device.gaussian.particle import SURFACE_DEPTH_SCALES
from lumisplat.device.splat.projection import COVARIANCE_2D_DET_MIN
from lumisplat.math.color import decode_srgb, encode_srgb
from lumisplat.renderer.raster.set_order_kernels import AHEAD_SPLATS
from lumisplat.scene.camera import Camera
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

BAND = 2e-3
"""Relative distance from thresholds within which float32 may decide differently; BAND_DEPTH is that between depths."""
BAND_DEPTH = 2e-5
UNSEEN = -1e9
"""Key of a splat at pixels where it is not visible."""


@dataclass
class Splats:
    """Projected Gaussians of all instances, front to back."""

    mean_px: np.ndarray  # (N, 2)
    covariance_px: np.ndarray  # (N, 2, 2), dilated
    opacity: np.ndarray  # (N,), compensated
    color: np.ndarray  # (N, 3)
    depth_z: np.ndarray  # (N,), of the mean
    mean_camera: np.ndarray  # (N, 3)
    canonical: np.ndarray  # (N, 3, 3), canonical space from camera space
    unit: np.ndarray  # (N, 3, 3), from camera space to where the Gaussian, widened to a pixel, ends at the unit sphere
    widest: np.ndarray  # (N,), the largest scale
    normal: np.ndarray  # (N, 3), world, towards the eye
    gaussian_index: np.ndarray  # (N,)
    instance_index: np.ndarray  # (N,)
    capture: np.ndarray  # (N,), equal for the instances of one capture


@dataclass
class Fragments:
    """Closest triangle at every pixel."""

    depth_z: np.ndarray  # (H, W), inf where no triangle is
    color: np.ndarray  # (H, W, 3), display-referred
    normal: np.ndarray  # (H, W, 3), world, towards the viewer
    instance_index: np.ndarray  # (H, W), -1 where no triangle is
    band: np.ndarray  # (H, W)


def render(scene: Scene, camera: Camera, config: RenderConfig | None = None) -> dict[str, np.ndarray]:
    """Renders a frame; the keys are those of ``Frame``, ``band`` and ``tie``."""
    config = config or RenderConfig()
    splats = project(scene, camera, config.raster)
    fragments = rasterize_meshes(scene, camera)
    merges = config.trace.hit_distance is HitDistance.PEAK
    ellipsoids = config.trace.normal_method is NormalMethod.ELLIPSOID
    frame = composite(splats, fragments, camera, config.raster, merges=merges, ellipsoids=ellipsoids)
    if config.background is not None:
        frame["color"] = frame["color"] + (1.0 - frame["alpha"])[..., None] * np.asarray(config.background)
    return frame


# --- Camera ---


def pixel_rays(camera: Camera) -> np.ndarray:
    """Returns camera-space directions with z = 1 through the pixel centres, shape (H, W, 3)."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    return np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], axis=-1)


def normalized(vectors: np.ndarray) -> np.ndarray:
    """Returns unit vectors along the last axis; zero vectors stay zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0.0)


# --- Gaussians ---


def rotation_from_quaternion(wxyz: np.ndarray) -> np.ndarray:
    """Returns rotation matrices of unit quaternions, shape (N, 3, 3); column i is the image of axis i."""
    w, v = wxyz[:, :1, None], wxyz[:, 1:]
    zero = np.zeros(len(v))
    cross = np.stack([zero, -v[:, 2], v[:, 1], v[:, 2], zero, -v[:, 0], -v[:, 1], v[:, 0], zero], -1).reshape(-1, 3, 3)
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross  # Rodrigues, in half angles


def sh_basis(direction: np.ndarray) -> np.ndarray:
    """Returns the real SH basis up to degree 3 with the Condon-Shortley sign (-1)^m, shape (N, 16)."""
    x, y, z = direction.T
    c = np.sqrt(
        np.array([1, 3, 15, 5, 15, 35, 105, 21, 7, 105]) / (np.pi * np.array([4, 4, 4, 16, 16, 32, 4, 32, 16, 16]))
    )
    return np.stack(
        [
            c[0] * np.ones_like(x),
            -c[1] * y,
            c[1] * z,
            -c[1] * x,
            c[2] * x * y,
            -c[2] * y * z,
            c[3] * (3.0 * z**2 - 1.0),
            -c[2] * x * z,
            c[4] * (x**2 - y**2),
            -c[5] * y * (3.0 * x**2 - y**2),
            c[6] * x * y * z,
            -c[7] * y * (5.0 * z**2 - 1.0),
            c[8] * z * (5.0 * z**2 - 3.0),
            -c[7] * x * (5.0 * z**2 - 1.0),
            c[9] * z * (x**2 - y**2),
            -c[5] * x * (x**2 - 3.0 * y**2),
        ],
        axis=-1,
    )


def sh_color(instance: SplatInstance, eye: np.ndarray, degree: int) -> np.ndarray:
    """Returns the colour of every Gaussian from a world ``eye``, shape (N, 3); SH directions are in object space."""
    object_from_world = np.linalg.inv(instance.transform)
    object_eye = object_from_world[:3, :3] @ eye + object_from_world[:3, 3]
    direction = normalized(instance.gaussians.means.astype(np.float64) - object_eye)
    sh = instance.gaussians.sh.astype(np.float64)
    count = min((degree + 1) ** 2, sh.shape[1])
    return np.maximum(np.einsum("nk,nkc->nc", sh_basis(direction)[:, :count], sh[:, :count]) + 0.5, 0.0)


def world_gaussians(instance: SplatInstance) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns world means (N, 3), axes (N, 3, 3) as columns, and standard deviations (N, 3)."""
    matrix, gaussians = instance.transform, instance.gaussians
    means = gaussians.means.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    axes = (matrix[:3, :3] / instance.scale) @ rotation_from_quaternion(gaussians.rotations_wxyz.astype(np.float64))
    return means, axes, gaussians.scales.astype(np.float64) * instance.scale


def jacobian(mean_camera: np.ndarray, camera: Camera) -> np.ndarray:
    """Returns the Jacobian of the projection at each mean, clamped outside the image, shape (N, 2, 3)."""
    x, y, z = mean_camera.T
    margin_x = (JACOBIAN_CLAMP - 1.0) * 0.5 * camera.width / camera.fx
    margin_y = (JACOBIAN_CLAMP - 1.0) * 0.5 * camera.height / camera.fy
    slope_x = np.clip(x / z, -camera.cx / camera.fx - margin_x, (camera.width - camera.cx) / camera.fx + margin_x)
    slope_y = np.clip(y / z, -camera.cy / camera.fy - margin_y, (camera.height - camera.cy) / camera.fy + margin_y)
    zero = np.zeros_like(z)
    rows = [camera.fx / z, zero, -camera.fx * slope_x / z, zero, camera.fy / z, -camera.fy * slope_y / z]
    return np.stack(rows, axis=-1).reshape(-1, 2, 3)


def pixel_variance(mean_camera: np.ndarray, camera: Camera) -> np.ndarray:
    """Returns the squared width of a pixel at each mean, by its solid angle, shape (N,)."""
    z, distance = mean_camera[:, 2], np.linalg.norm(mean_camera, axis=1)
    return z**3 / (camera.fx * camera.fy * distance)


def project_instance(instance: SplatInstance, number: int, camera: Camera, config: RasterConfig) -> Splats:
    """Returns the visible Gaussians of one instance, in the order of the asset."""
    means, axes, scales = world_gaussians(instance)
    view = camera.camera_from_world
    mean_camera = means @ view[:3, :3].T + view[:3, 3]
    kept = np.flatnonzero(mean_camera[:, 2] > camera.near)
    means, axes, scales, mean_camera = means[kept], axes[kept], scales[kept], mean_camera[kept]

    spread = jacobian(mean_camera, camera) @ view[:3, :3] @ axes * scales[:, None, :]  # J W R S
    sharp = spread @ spread.transpose(0, 2, 1)
    dilated = sharp + config.dilation * np.eye(2)
    opacity = instance.gaussians.opacities[kept].astype(np.float64)
    antialiased = instance.gaussians.antialiased
    widened = axes / np.hypot(scales, np.sqrt(config.dilation * pixel_variance(mean_camera, camera))[:, None])[:, None]
    reach = np.sqrt(2.0 * np.log(np.maximum(opacity / ALPHA_MIN, 1.0)))
    if config.antialiasing is Antialiasing.ON or (config.antialiasing is Antialiasing.AUTO and antialiased):
        widened = axes / scales[:, None, :]
        opacity = opacity * np.sqrt(np.maximum(np.linalg.det(sharp) / np.linalg.det(dilated), 0.0))

    x, y, z = mean_camera.T
    to_eye = camera.eye - means
    inverse_covariance = (axes / scales[:, None, :] ** 2) @ axes.transpose(0, 2, 1)
    splats = Splats(
        mean_px=np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=-1),
        covariance_px=dilated,
        opacity=opacity,
        color=sh_color(instance, camera.eye, config.sh_degree)[kept],
        depth_z=z,
        mean_camera=mean_camera,
        canonical=(view[:3, :3] @ axes / scales[:, None, :]).transpose(0, 2, 1),
        unit=(view[:3, :3] @ widened).transpose(0, 2, 1) / np.maximum(reach, 1e-9)[:, None, None],
        widest=scales.max(axis=1),
        normal=normalized(np.einsum("nij,nj->ni", inverse_covariance, to_eye)),
        gaussian_index=kept,
        instance_index=np.full(len(kept), number),
        capture=np.full(len(kept), id(instance.gaussians)),
    )
    return rows(splats, (np.linalg.det(dilated) > COVARIANCE_2D_DET_MIN) & (opacity >= ALPHA_MIN))


def rows(splats: Splats, selection: np.ndarray) -> Splats:
    """Returns the selected splats (by a mask or indices)."""
    return Splats(**{name: values[selection] for name, values in vars(splats).items()})


def project(scene: Scene, camera: Camera, config: RasterConfig) -> Splats:
    """Returns all visible Gaussians of a scene, front to back; equal depths keep the order of the scene."""
    parts = [project_instance(instance, i, camera, config) for i, instance in enumerate(scene.splats)]
    if not parts:
        empty = np.zeros(0)
        return Splats(**{field.name: empty for field in fields(Splats)})
    joined = Splats(**{name: np.concatenate([vars(part)[name] for part in parts]) for name in vars(parts[0])})
    return rows(joined, np.argsort(joined.depth_z, kind="stable"))


# --- Meshes ---


def rasterize_meshes(scene: Scene, camera: Camera) -> Fragments:
    """Tests every pixel centre against every triangle; the closest beyond the near plane wins."""
    shape = (camera.height, camera.width)
    fragments = Fragments(
        np.full(shape, np.inf), np.zeros((*shape, 3)), np.zeros((*shape, 3)), np.full(shape, -1), np.zeros(shape, bool)
    )
    for number, instance in enumerate(scene.meshes, start=len(scene.splats)):
        for face in instance.mesh.indices:
            rasterize_triangle(fragments, instance, face, number, camera)
    return fragments


def rasterize_triangle(
    fragments: Fragments, instance: MeshInstance, face: np.ndarray, number: int, camera: Camera
) -> None:
    """Depth-tests one triangle, with each pixel's ray in the basis of the camera-space corners."""
    mesh, matrix, view = instance.mesh, instance.transform, camera.camera_from_world
    corners = mesh.positions[face].astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    corners_camera = corners @ view[:3, :3].T + view[:3, 3]
    if abs(np.linalg.det(corners_camera)) < 1e-14:
        return  # Seen edge-on.
    rays = pixel_rays(camera)
    weights = rays @ np.linalg.inv(corners_camera)
    total = weights.sum(axis=-1)
    depth_z = np.divide(1.0, total, out=np.zeros_like(total), where=np.abs(total) > 1e-12)
    barycentric = weights * depth_z[..., None]
    inside = (barycentric >= 0.0).all(axis=-1) & (depth_z > 0.0)
    on_edge = (np.abs(barycentric).min(axis=-1) < BAND) & (barycentric > -BAND).all(axis=-1) & (depth_z > 0.0)
    close = inside & (np.abs(depth_z - fragments.depth_z) < BAND_DEPTH * depth_z)
    at_near = inside & (np.abs(depth_z - camera.near) < BAND * camera.near)
    fragments.band |= on_edge | close | at_near

    wins = inside & (depth_z >= camera.near) & (depth_z < fragments.depth_z)
    ray_world = rays[wins] @ view[:3, :3]
    fragments.depth_z[wins] = depth_z[wins]
    fragments.color[wins] = encode_srgb(base_color(mesh, face, barycentric[wins]))
    normal = mesh_normal(instance, face, corners, barycentric[wins], ray_world)
    fragments.normal[wins] = normal
    fragments.band[wins] |= np.abs((normal * ray_world).sum(axis=-1)) < BAND  # The normal may be flipped.
    fragments.instance_index[wins] = number


def mesh_normal(
    instance: MeshInstance, face: np.ndarray, corners: np.ndarray, barycentric: np.ndarray, ray: np.ndarray
) -> np.ndarray:
    """Returns the world shading normals at P pixels, flipped against the ray, shape (P, 3)."""
    if instance.mesh.normals is None:
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])[None].repeat(len(barycentric), axis=0)
    else:
        normal = (
            barycentric @ instance.mesh.normals[face].astype(np.float64) @ np.linalg.inv(instance.transform[:3, :3])
        )
    unit = normalized(normal)
    return np.where((unit * ray).sum(axis=-1, keepdims=True) > 0.0, -unit, unit)


def base_color(mesh: Mesh, face: np.ndarray, barycentric: np.ndarray) -> np.ndarray:
    """Returns the linear base colours of meshes at P pixels, shape (P, 3)."""
    color = np.ones((len(barycentric), 3)) * mesh.material.mesh_color
    if mesh.colors is not None:
        color = color * (barycentric @ mesh.colors[face].astype(np.float64))
    texture = mesh.material.base_color_texture
    if texture is not None and mesh.uvs is not None:
        color = color * bilinear(texture, barycentric @ mesh.uvs[face].astype(np.float64))
    return color


def bilinear(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Returns linear colours at P texture coordinates ``uv``, shape (P, 3).

    Texel centres are at +0.5, the texture repeats, and texels are decoded before filtering.
    """
    height, width = texture.shape[:2]
    texels = decode_srgb(texture[..., :3] / 255.0)
    x, y = uv[:, 0] * width - 0.5, uv[:, 1] * height - 0.5
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    u, v = (x - x0)[:, None], (y - y0)[:, None]

    def texel(dx: int, dy: int) -> np.ndarray:
        return texels[(y0 + dy) % height, (x0 + dx) % width]

    return (texel(0, 0) * (1 - u) + texel(1, 0) * u) * (1 - v) + (texel(0, 1) * (1 - u) + texel(1, 1) * u) * v


# --- Blending ---


def footprint(splats: Splats, i: int, camera: Camera) -> tuple[slice, slice]:
    """Returns rows and columns of the pixel centres that the ellipse of alpha = 1/255 can reach."""
    reach = np.sqrt(2.0 * np.log(splats.opacity[i] / ALPHA_MIN) * np.diag(splats.covariance_px[i])) + 1.0
    low = np.clip(splats.mean_px[i] - reach - 0.5, 0.0, (camera.width, camera.height)).astype(int)
    high = np.clip(splats.mean_px[i] + reach + 0.5, 0.0, (camera.width, camera.height)).astype(int)
    return slice(low[1], high[1]), slice(low[0], high[0])


def response(splats: Splats, i: int, window: tuple[slice, slice]) -> np.ndarray:
    """Returns exp(-d^2 / 2) of one splat at the pixel centres of a window."""
    x = np.arange(window[1].start, window[1].stop) + 0.5 - splats.mean_px[i, 0]
    y = np.arange(window[0].start, window[0].stop)[:, None] + 0.5 - splats.mean_px[i, 1]
    (a, b), (_, c) = np.linalg.inv(splats.covariance_px[i])
    return np.exp(-0.5 * (a * x * x + 2.0 * b * x * y + c * y * y))


def depth_slopes(splats: Splats, camera: Camera) -> np.ndarray:
    """Returns slopes of view depth per pixel to the right and down, (N, 2), by linear regression in each Gaussian."""
    axes = np.linalg.inv(splats.canonical)
    in_image = jacobian(splats.mean_camera, camera) @ axes
    shared = in_image @ axes[:, 2, :, None]
    return np.asarray(np.linalg.solve(splats.covariance_px, shared)[..., 0], np.float64)


@dataclass
class Layer:
    """Splats that a window of pixels blends next: the same one in all pixels, or one for each."""

    i: np.ndarray  # () or (H, W)
    at: tuple[slice, slice]
    alpha: np.ndarray  # of the window; 0 where there is no further splat
    key: np.ndarray  # depth by which captures are merged


def layers(splats: Splats, fragments: Fragments, camera: Camera, *, merges: bool) -> Iterator[Layer]:
    """Yields splats front to back: by means or, if ``merges``, several captures merged by the depths of their surfaces.

    The depth of a capture's surface at a splat is the least at which it and the splats behind it respond most.
    """
    count = len(splats.depth_z)
    found = []
    for i in range(count):
        at = footprint(splats, i, camera)
        alpha = np.minimum(splats.opacity[i] * response(splats, i, at), ALPHA_MAX)
        found.append(Layer(np.array(i), at, alpha, splats.depth_z[i]))
    if not merges or len(np.unique(splats.capture)) < 2:
        yield from found
        return
    shape = (count, camera.height, camera.width)
    alphas, keys = np.zeros(shape), np.full(shape, UNSEEN)
    slopes = depth_slopes(splats, camera)
    for i, layer in enumerate(found):
        y, x = np.mgrid[layer.at]
        offset = np.stack([x + 0.5, y + 0.5], axis=-1) - splats.mean_px[i]
        z = splats.depth_z[i]
        reciprocal = (z - offset @ slopes[i]) / (z * z)  # linear in the image for flat Gaussians
        touches = (layer.alpha >= ALPHA_MIN) & (z < fragments.depth_z[layer.at])
        alphas[i][layer.at] = np.where(layer.alpha >= ALPHA_MIN * (1.0 - BAND), layer.alpha, 0.0)
        keys[i][layer.at] = np.where(touches, -reciprocal, UNSEEN)
    for capture in np.unique(splats.capture):
        of_it = splats.capture == capture
        keys[of_it] = np.maximum.accumulate(looking_ahead(keys[of_it]), axis=0)
    order = np.argsort(np.where(alphas > 0.0, keys, np.inf), axis=0, kind="stable")
    everywhere = (slice(0, camera.height), slice(0, camera.width))
    for rank in range(int((alphas > 0.0).sum(axis=0).max())):
        i = order[rank : rank + 1]
        yield Layer(i[0], everywhere, *(np.take_along_axis(values, i, axis=0)[0] for values in (alphas, keys)))


def looking_ahead(keys: np.ndarray) -> np.ndarray:
    """Returns the least key, (N, H, W), of each splat and of the next ones that are visible at the pixel.

    `AHEAD_SPLATS` splats count, the splat among them. Keys of splats that are not visible are ``UNSEEN``, and stay.
    """
    found, window = keys.copy(), np.full((AHEAD_SPLATS, *keys.shape[1:]), np.inf)
    for i in reversed(range(len(keys))):
        touches = keys[i] > UNSEEN
        window = np.where(touches, np.concatenate([keys[i : i + 1], window[:-1]]), window)
        found[i] = np.where(touches, window.min(axis=0), UNSEEN)
    return found


def composite(
    splats: Splats, fragments: Fragments, camera: Camera, config: RasterConfig, *, merges: bool, ellipsoids: bool
) -> dict[str, np.ndarray]:
    """Blends splats front to back, then the mesh behind them; ``ellipsoids``: with normals where rays enter them."""
    shape = (camera.height, camera.width)
    color, normal, weight = np.zeros((*shape, 3)), np.zeros((*shape, 3)), np.zeros(shape)
    transmittance, last_z = np.ones(shape), np.full(shape, -np.inf)
    done, band, tie = np.zeros(shape, bool), np.zeros(shape, bool), fragments.band.copy()
    depth_z, gaussian, instance = np.full(shape, np.inf), np.full(shape, -1), np.full(shape, -1)

    last_key, last_capture = np.zeros(shape), np.full(shape, -1)
    for layer in layers(splats, fragments, camera, merges=merges):
        i, at, alpha, z = layer.i, layer.at, layer.alpha, splats.depth_z[layer.i]
        live = ~done[at]
        touched = live & (alpha > ALPHA_MIN * (1.0 - BAND))
        after = transmittance[at] * (1.0 - alpha)
        band[at] |= touched & (
            (alpha < ALPHA_MIN * (1.0 + BAND))
            | (np.abs(after - config.transmittance_min) < BAND * config.transmittance_min)
            | (np.abs(after - config.depth_iso_transmittance) < BAND * config.depth_iso_transmittance)
        )
        follows = last_capture[at] == splats.capture[i]
        gap = np.where(follows, z - last_z[at], np.where(last_capture[at] < 0, np.inf, layer.key - last_key[at]))
        tie[at] |= touched & (np.minimum(gap, np.abs(z - fragments.depth_z[at])) < BAND_DEPTH * z)
        reached = live & (alpha >= ALPHA_MIN) & (z < fragments.depth_z[at])
        done[at] |= reached & (after <= config.transmittance_min)
        accepted = reached & ~done[at]

        share = np.where(accepted, alpha * transmittance[at], 0.0)
        color[at] += share[..., None] * splats.color[i]
        normal[at] += share[..., None] * (entry_normals(splats, i, camera)[at] if ellipsoids else splats.normal[i])
        weight[at] += share
        transmittance[at] = np.where(accepted, after, transmittance[at])
        last_z[at] = np.where(accepted, z, last_z[at])
        last_key[at] = np.where(accepted, layer.key, last_key[at])
        last_capture[at] = np.where(accepted, splats.capture[i], last_capture[at])
        surface = accepted & (after < config.depth_iso_transmittance) & (gaussian[at] < 0)
        depth_z[at] = np.where(surface, peak_depth(splats, i, camera)[at], depth_z[at])
        gaussian[at] = np.where(surface, splats.gaussian_index[i], gaussian[at])
        instance[at] = np.where(surface, splats.instance_index[i], instance[at])

    hit = np.isfinite(fragments.depth_z)
    share = np.where(hit, transmittance, 0.0)
    surface = hit & (gaussian < 0)
    depth_z = np.minimum(depth_z, fragments.depth_z)
    mean_length = np.linalg.norm(normal + share[..., None] * fragments.normal, axis=-1) / np.maximum(
        weight + share, 1e-30
    )
    depth_z = np.where(surface, fragments.depth_z, depth_z)
    return {
        "color": color + share[..., None] * fragments.color,
        "alpha": np.where(hit, 1.0, 1.0 - transmittance),
        "depth_z": depth_z,
        "depth": depth_z * np.linalg.norm(pixel_rays(camera), axis=-1),
        "normal": integrated_normal(normal + share[..., None] * fragments.normal, weight + share, camera),
        "gaussian_index": gaussian,
        "instance_index": np.where(surface, fragments.instance_index, instance),
        "tie": tie,
        "band": band | tie | (np.abs(mean_length - NORMAL_DEGENERATE) < BAND),
    }


def peak_depth(splats: Splats, i: int | np.ndarray, camera: Camera) -> np.ndarray:
    """Returns the view depth of the peak of splat ``i``, () or (H, W), on each pixel's ray, (H, W).

    It is within three scales of its mean.
    """
    rays = pixel_rays(camera)
    direction = np.einsum("...ij,...j->...i", splats.canonical[i], rays)
    mean = np.einsum("...ij,...j->...i", splats.canonical[i], splats.mean_camera[i])
    z = (direction * mean).sum(axis=-1) / (direction**2).sum(axis=-1)
    reach = SURFACE_DEPTH_SCALES * splats.widest[i] / np.linalg.norm(rays, axis=-1)
    return np.maximum(np.clip(z, splats.depth_z[i] - reach, splats.depth_z[i] + reach), camera.near)


def entry_normals(splats: Splats, i: np.ndarray, camera: Camera) -> np.ndarray:
    """Returns the world normal of splat ``i``, () or (H, W), where each pixel's ray enters its ellipsoid, (H, W, 3).

    The nearest point replaces the entry on rays that miss it.
    """
    rays = normalized(pixel_rays(camera))
    along = normalized(np.einsum("...ij,...j->...i", splats.unit[i], rays))
    start = -np.einsum("...ij,...j->...i", splats.unit[i], splats.mean_camera[i])
    across = start - (start * along).sum(axis=-1, keepdims=True) * along
    half = np.sqrt(np.maximum(1.0 - (across**2).sum(axis=-1, keepdims=True), 0.0))
    normal = normalized(np.einsum("...ji,...j->...i", splats.unit[i], across - half * along))
    return normal @ camera.camera_from_world[:3, :3]


def integrated_normal(normal_sum: np.ndarray, weight_sum: np.ndarray, camera: Camera) -> np.ndarray:
    """Returns the unit mean normal; it faces the camera where normals cancel, and is zero on empty pixels."""
    towards_camera = -normalized(pixel_rays(camera)) @ camera.camera_from_world[:3, :3]
    degenerate = np.linalg.norm(normal_sum, axis=-1) <= NORMAL_DEGENERATE * weight_sum
    normal = np.where(degenerate[..., None], towards_camera, normalized(normal_sum))
    return np.where((weight_sum > 0.0)[..., None], normal, 0.0)
