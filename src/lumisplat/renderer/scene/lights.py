"""Light tables on the device, written every frame; only the environment map is cached."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.constants import (
    ENVIRONMENT_SHARE_STEPS,
    LIGHT_POWER_MAX,
    LUMINANCE,
    SPAWN_ERROR,
    SPAWN_SLENDER,
    TRANSFORM_MAX,
)
from lumisplat.device.light.light import (
    LIGHT_DIRECTIONAL,
    LIGHT_DISK,
    LIGHT_ENVIRONMENT,
    LIGHT_HEADLIGHT,
    LIGHT_POINT,
    LIGHT_RECT,
    LIGHT_SPOT,
)
from lumisplat.device.structs.shading import EmitterData, EmitterTriangle, EnvironmentData, LightData
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.math.color import decode_srgb
from lumisplat.math.transforms import rotation_matrix
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.struct_tables import table_dtype
from lumisplat.scene.camera import Camera
from lumisplat.scene.lights import (
    AimedLight,
    AreaLight,
    Light,
    LightDirectional,
    LightDisk,
    LightEnvironment,
    LightPoint,
    LightRect,
    LightSphere,
    LightSpot,
    PlacedLight,
    RoundLight,
)
from lumisplat.scene.materials import MaterialPbr, WrapPair, wraps_of
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.ops.surface_points import wrapped
from lumisplat.scene.scene import MeshInstance, Scene

ENVIRONMENT_SHARE_MIN = 4
"""Smallest sampling probability of an environment map's row or texel that is not black, in units of
1 / `ENVIRONMENT_SHARE_STEPS`."""

WHITE = np.ones((1, 1, 3), dtype=np.float32)
"""White image of one pixel, for an environment of constant colour."""
_KINDS: dict[type, int] = {
    LightPoint: LIGHT_POINT,
    LightSphere: LIGHT_POINT,
    LightSpot: LIGHT_SPOT,
    LightDirectional: LIGHT_DIRECTIONAL,
    LightRect: LIGHT_RECT,
    LightDisk: LIGHT_DISK,
}
"""Integer by which kernels recognise each light class; a class that is not listed is an environment."""


class LightTable:
    """Table of the scene's lights on the device, one row per enabled light."""

    def __init__(self) -> None:
        self.lights: DeviceArray
        """`LightData` of the enabled lights in the scene's order; at least one row, even without lights. Written by
        ``sync``."""
        self.count = 0
        """Number of enabled lights."""
        self.environment = EnvironmentData()
        self.names: tuple[str, ...] = ()
        """Distinct names of the enabled lights: the name in the scene, else ``light`` and the index in the scene."""
        self._image: FloatArray | None = None
        self._brightest = 1.0
        self._mean = np.ones(3)

    def sync(
        self, scene: Scene, camera: Camera, buffers: Buffers, *, is_lit: bool = True, has_headlight: bool | None = None
    ) -> None:
        """Writes the lights of a scene.

        Args:
            scene: The scene with the lights.
            camera: The camera, at whose eye the headlight is.
            buffers: Holds the arrays; the same object in every call.
            is_lit: Whether the frame is lit; if not, no lights are written.
            has_headlight: Whether to write a headlight instead of the lights; None: yes if the frame is lit and the
                scene has no lights.
        """
        lights = [(number, light) for number, light in enumerate(scene.lights) if light.enabled and is_lit]
        self.names = _distinct([(light.name or f"light{number}", number) for number, light in lights])
        table = light_table([light for _, light in lights])
        if is_lit and not scene.lights if has_headlight is None else has_headlight:
            self.names, table = ("headlight",), headlight_table(camera)
        self.count = len(table)
        self.lights = buffers.upload("lights", LightData, table if self.count else np.zeros(1, table.dtype))
        environment = next((light for _, light in lights if isinstance(light, LightEnvironment)), None)
        self._sync_environment(environment, buffers)

    def _sync_environment(self, light: LightEnvironment | None, buffers: Buffers) -> None:
        data = self.environment
        image = WHITE if light is None or light.image is None else light.image
        if image is not self._image and (light is not None or self._image is None):
            self._image = None  # a failed upload does not count as finished
            self._upload(image, buffers)
            self._image = image
        data.exists = int(light is not None)
        data.mean = 0.0
        if light is not None:
            wxyz = np.asarray(light.rotation_wxyz, dtype=np.float64)
            power = np.minimum(power_of(light), LIGHT_POWER_MAX / self._brightest)
            data.visible = int(light.visible)
            data.world_from_environment = wp.mat33(*rotation_matrix(wxyz).ravel())
            data.power = wp.vec3(*power)
            data.mean = float(np.minimum(power * self._mean, LIGHT_POWER_MAX) @ np.array(LUMINANCE))

    def _upload(self, image: npt.NDArray[np.floating], buffers: Buffers) -> None:
        data = self.environment
        data.height, data.width = image.shape[:2]
        rows, columns = environment_cdfs(image)
        for name, dtype, values in (
            ("texels", wp.vec3, image.reshape(-1, 3)),
            ("row_ends", wp.float32, rows),
            ("column_ends", wp.float32, columns.reshape(-1)),
        ):
            setattr(data, name, buffers.upload(f"environment.{name}", dtype, np.ascontiguousarray(values)))
        self._brightest = max(1.0, float(image.max()))
        self._mean = mean_radiance(image)


def power_of(light: Light) -> Doubles:
    """Returns the light's colour times intensity, in the unit of its type, by channel, shape (3,)."""
    return np.minimum(np.array(light.color) * light.intensity, LIGHT_POWER_MAX)


def light_table(lights: list[Light]) -> np.ndarray:
    """Returns one row of LightData for each light."""
    table = np.zeros(len(lights), dtype=table_dtype(LightData))
    for row, light in zip(np.split(table, len(lights)) if lights else [], lights, strict=True):
        row["kind"] = _KINDS.get(type(light), LIGHT_ENVIRONMENT)
        row["power"] = power_of(light)
        row["casts_shadow"] = light.casts_shadow
        row["visible"] = isinstance(light, AreaLight) and light.visible
        reach = math.inf
        if isinstance(light, PlacedLight):
            row["position"] = np.clip(light.position, -TRANSFORM_MAX, TRANSFORM_MAX)
        else:
            reach = light.shadow_distance
        if isinstance(light, AimedLight):
            row["direction"] = light.direction
        if isinstance(light, RoundLight):
            row["radius"] = min(light.radius, TRANSFORM_MAX)
        if isinstance(light, LightPoint | LightSpot):
            reach = light.range
        row["range"] = reach if reach < TRANSFORM_MAX else math.inf

        match light:
            case LightSpot(inner_angle=inner, outer_angle=outer):
                row["inner"], row["outer"] = (2.0 * math.sin(0.5 * angle) ** 2 for angle in (inner, outer))
            case LightDirectional(angle=angle):
                row["radius"] = angle
            case LightSphere():
                candela = math.pi * min(light.radius, TRANSFORM_MAX) ** 2 * power_of(light)
                row["power"] = np.minimum(candela, LIGHT_POWER_MAX)
            case LightRect():
                normal = light.area_vector
                row["direction"] = normal / np.linalg.norm(normal)
                row["edge_u"], row["edge_v"] = np.clip((light.edge_u, light.edge_v), -TRANSFORM_MAX, TRANSFORM_MAX)
            case _:
                pass
    return table


def headlight_table(camera: Camera) -> np.ndarray:
    """Returns the LightData row of a light at the camera's eye that makes a white surface facing it look white."""
    table = np.zeros(1, dtype=table_dtype(LightData))
    table["kind"] = LIGHT_HEADLIGHT
    table["position"] = camera.eye
    table["power"] = math.pi
    table["range"] = math.inf
    return table


def mean_radiance(image: npt.NDArray[np.floating]) -> Doubles:
    """Returns the mean radiance of an environment map over all directions, by channel, shape (3,)."""
    edges = np.cos(np.linspace(0.0, np.pi, len(image) + 1))
    means: Doubles = 0.5 * ((edges[:-1] - edges[1:]) @ image.mean(axis=1, dtype=np.float64))
    return means


def environment_cdfs(image: npt.NDArray[np.floating]) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Returns the CDF over the rows of an environment map, (H,), and over the texels within each row, (H, W).

    A texel's probability is the mean luminance of the interpolated image over the texel, times the texel's solid angle.
    A black row has probability 0; in a black image, all rows have probability 0.
    """
    luminance = image @ np.array(LUMINANCE, dtype=np.float32)
    across = _cell_means(np.pad(luminance, ((0, 0), (1, 1)), mode="wrap").T).T
    mean = _cell_means(np.pad(across, ((1, 1), (0, 0)), mode="edge"))
    edges = np.cos(np.linspace(0.0, np.pi, len(image) + 1))
    rows = cumulative_distribution(mean.sum(axis=1, dtype=np.float64) * (edges[:-1] - edges[1:]))
    return rows, np.stack([cumulative_distribution(row) for row in mean])


def _cell_means(padded: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Returns, for each texel, half the mean of an image that is linearly interpolated along its first axis.

    ``padded`` has one more texel at both ends of that axis. The mean is 3/4 of the texel's value plus 1/8 of each
    neighbour's. Halving avoids overflow of float32 sums.
    """
    parts = padded * np.float32(1.0 / 16.0)
    return parts[:-2] + parts[2:] + 6.0 * parts[1:-1]


def cumulative_distribution(weights: npt.NDArray[np.floating]) -> npt.NDArray[np.float32]:
    """Returns a CDF whose steps are exact in float32; every weight above 0 gets a probability above 0."""
    total = float(weights.sum(dtype=np.float64))
    if total == 0.0:
        return np.zeros(len(weights), dtype=np.float32)
    least = ENVIRONMENT_SHARE_MIN / ENVIRONMENT_SHARE_STEPS
    ends = np.cumsum(np.where(weights > 0.0, np.maximum(weights / total, least), 0.0), dtype=np.float64)
    return (np.rint(ends / ends[-1] * ENVIRONMENT_SHARE_STEPS) / ENVIRONMENT_SHARE_STEPS).astype(np.float32)


def _distinct(names: list[tuple[str, int]]) -> tuple[str, ...]:
    used: set[str] = set()
    result: list[str] = []
    for name, number in names:
        unique = name
        while unique in used:
            unique = f"{unique}_{number}"
        used.add(unique)
        result.append(unique)
    return tuple(result)


_INSIDE = np.array([[1, 1, 1], [4, 1, 1], [1, 4, 1], [1, 1, 4]]) / np.array([[3], [6], [6], [6]])
"""Barycentric coordinates of the four points of a triangle at which an emissive texture is averaged."""
_DARK_FRACTION = 0.05
"""Lowest luminance assumed when a triangle with an emissive texture is sampled, as a fraction of the luminance of the
mesh's brightest triangle. The few texels that are read may miss bright spots."""


class Emitters:
    """The emissive triangles of a scene on the device, uploaded when they change."""

    def __init__(self) -> None:
        self.data = EmitterData()
        self._key: object = None

    def sync(self, scene: Scene, buffers: Buffers) -> None:
        """Writes the table of a scene's emissive triangles, if they have changed since the last call."""
        emitters = [(number, instance) for number, instance in enumerate(scene.meshes) if is_emitter(instance)]
        transforms = [(number, id(instance.mesh), instance.transform.tobytes()) for number, instance in emitters]
        key = transforms, len(scene.meshes)
        if key == self._key:
            return
        self._key, data = None, self.data  # a failed upload does not count as finished
        first = np.full(max(len(scene.meshes), 1), -1, np.int32)
        first[[number for number, _ in emitters]] = np.cumsum([0, *(i.mesh.face_count for _, i in emitters)])[:-1]
        powers = [powers_of(instance) for _, instance in emitters]
        power = np.concatenate(powers) if powers else np.zeros(0)
        numbers = np.repeat([number for number, _ in emitters], [len(values) for values in powers]).astype(np.int32)
        data.first = buffers.upload("emitters.first", wp.int32, first)
        data.power = float(min(power.sum(), LIGHT_POWER_MAX))
        ends = cumulative_distribution(power) if data.power > 0.0 else np.zeros(0, np.float32)
        data.ends = buffers.upload("emitters.ends", wp.float32, ends)
        data.instances = buffers.upload("emitters.instances", wp.int32, numbers)
        tables = [triangles_of(instance) for _, instance in emitters]
        rows = np.concatenate(tables) if tables else np.zeros(0, table_dtype(EmitterTriangle))
        data.triangles = buffers.upload("emitters.triangles", EmitterTriangle, rows)
        if data.power > 0.0:
            centers = np.concatenate([_centers(instance) for _, instance in emitters])
            center = np.average(centers, axis=0, weights=power)
            data.center = wp.vec3(*center)
            spread = np.average(((centers - center) ** 2).sum(axis=1), weights=power)
            data.radius = float(np.sqrt(spread + _mean_area(emitters)))
        self._emitters = [
            instance for _, instance in emitters
        ]  # kept alive, so that no other mesh gets one of their ids
        self._key = key


def is_emitter(instance: MeshInstance) -> bool:
    """Returns whether a mesh instance has a material that emits light."""
    return instance.mesh.material.is_emissive


def powers_of(instance: MeshInstance) -> Doubles:
    """Returns the approximate luminance times area of each of an instance's F triangles, shape (F,)."""
    mesh, material = instance.mesh, instance.mesh.material
    emitted = np.array(material.emissive, np.float64)
    if not isinstance(material, MaterialPbr):
        emitted = emitted + np.array(material.ambient)
    brightness = np.full(mesh.face_count, float(emitted @ np.array(LUMINANCE)))
    texture = material.emissive_texture if isinstance(material, MaterialPbr) else None
    if texture is not None and mesh.uvs is not None:
        brightness *= _texture_means(mesh, texture, wraps_of(material, "emissive_texture"))
    return brightness * _areas(instance)


def triangles_of(instance: MeshInstance) -> npt.NDArray[np.void]:
    """Returns an instance's F triangles for light sampling, with bounds of their rounding errors, shape (F,)."""
    corners = _corners(instance)
    edges = corners[:, 1:] - corners[:, :1]
    across = np.cross(edges[:, 0], edges[:, 1])
    area = np.linalg.norm(across, axis=1)
    area[area < np.finfo(np.float32).tiny] = np.inf  # such a triangle has no power and no plane to offset points from
    error = _rounding_error(instance, across / area[:, None])
    # Lengths of the sides opposite the corners.
    sides = np.linalg.norm(np.stack([edges[:, 1] - edges[:, 0], edges[:, 1], edges[:, 0]], axis=1), axis=2)
    longest = sides.max(axis=1)
    error += SPAWN_ERROR / 16.0 * longest * np.minimum(longest**2 / area, SPAWN_SLENDER)
    rows = np.zeros(len(corners), table_dtype(EmitterTriangle))
    rows["corner"], rows["edge1"], rows["edge2"], rows["across"] = corners[:, 0], edges[:, 0], edges[:, 1], across
    rows["lift"] = error / area
    # A corner's height over the opposite side is twice the area over that side.
    rows["inside"] = np.minimum(2.0 * (error / area)[:, None] * sides, 0.25)
    return rows


def _rounding_error(instance: MeshInstance, normals: Doubles) -> Doubles:
    """Returns how far rounding may move a hit off each of F triangles' planes, (F,); see ``spawn_point``."""
    world_from_object = instance.transform[:3, :3]
    local = instance.mesh.positions.astype(np.float64)[instance.mesh.indices]
    offsets = local @ world_from_object.T
    # The largest coordinates of a triangle are those of its corners.
    sizes = 2.0 * np.abs(instance.transform[:3, 3]) + np.abs(offsets).max(axis=1)
    sizes += np.abs(local).max(axis=1) @ np.abs(world_from_object).T
    local_sizes = np.abs(local[:, 0]) + np.abs(local[:, 1:] - local[:, :1]).sum(axis=1)
    local_sizes += np.abs(offsets).max(axis=1) @ np.abs(np.linalg.inv(world_from_object)).T
    error: Doubles = (np.abs(normals) * sizes).sum(axis=1) + (np.abs(normals @ world_from_object) * local_sizes).sum(
        axis=1
    )
    return SPAWN_ERROR * error


def _texture_means(mesh: Mesh, texture: npt.NDArray[np.uint8], wraps: WrapPair) -> Doubles:
    """Returns the luminance of a texture, averaged over some points of each of F triangles, shape (F,)."""
    assert mesh.uvs is not None
    points = np.einsum("pc,fcx->fpx", _INSIDE, mesh.uvs[mesh.indices])
    height, width = texture.shape[:2]
    columns, rows = (
        np.minimum(wrapped(points[..., k], wraps[k]) * size, size - 1).astype(int)
        for k, size in ((0, width), (1, height))
    )
    luminance = decode_srgb(texture[rows, columns, :3].astype(np.float64) / 255.0) @ np.array(LUMINANCE)
    means: Doubles = luminance.mean(axis=1)
    return np.maximum(means, _DARK_FRACTION * means.max(initial=0.0))


def _corners(instance: MeshInstance) -> Doubles:
    """Returns the world-space corners of an instance's F triangles, shape (F, 3, 3)."""
    world = instance.mesh.positions.astype(np.float64) @ instance.transform[:3, :3].T + instance.transform[:3, 3]
    corners: Doubles = world[instance.mesh.indices]
    return corners


def _areas(instance: MeshInstance) -> Doubles:
    corners = _corners(instance)
    edges = corners[:, 1:] - corners[:, :1]
    return 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)


def _centers(instance: MeshInstance) -> Doubles:
    return _corners(instance).mean(axis=1)


def _mean_area(emitters: list[tuple[int, MeshInstance]]) -> float:
    """Returns the mean area of all triangles of emissive mesh instances."""
    return float(np.concatenate([_areas(instance) for _, instance in emitters]).mean())
