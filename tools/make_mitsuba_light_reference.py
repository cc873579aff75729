"""Writes tests/reference/mitsuba_light_*.npz: lit meshes by Mitsuba's path tracer.

The references have direct light only: Mitsuba's integrator ``path`` of depth 2, on the scenes of
tests/support/scenes/light_scenes.py. Mirrors and glass are followed here with its materials, along every specular path.
Mitsuba's shadow rays end at glass, where ours go on; pixels that this affects are marked as not compared.

Scenes without random light have rays through the pixel centres; in others, pixels are means over their area. Needs the
extra ``bench`` and no LLVM; a quarter of an hour on two cores::

    pip install -e '.[bench]' && python tools/make_mitsuba_light_reference.py [NAME...]
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(REPOSITORY / "tests")]

import lumisplat as ls  # noqa: E402
from support.oracles.raster_oracle import rotation_from_quaternion  # noqa: E402
from support.scenes.light_scenes import SUN, LightScene, directions_of, environment_radiance, light_scenes  # noqa: E402

SAMPLES = 16384
"""Stratified samples of random light, which leave about 0.2 % of noise."""
DEPTH = 12
"""Largest number of specular bounces of a ray."""
SKY_SIZE = (1024, 2048)
"""Texels of the environment, enough that their interpolation does not matter."""


def main(names: list[str]) -> None:
    """Renders and stores the named scenes, or all."""
    import mitsuba as mi  # pyright: ignore[reportMissingImports]

    mi.set_variant("scalar_rgb")
    for name, one in light_scenes().items():
        if names and name not in names:
            continue
        scene = mi.load_dict(describe(mi, one))
        check_sky(mi, scene, one)
        compared = interior(mi, scene, one.camera)
        if one.shadows is ls.Shadows.SOFT:
            image = np.array(mi.render(scene, seed=mi.UInt32(1)))[..., :3]
        else:
            image, certain = central(mi, scene, one)
            compared &= certain
        path = REPOSITORY / "tests" / "reference" / f"mitsuba_light_{name}.npz"
        stored = {"image": image.astype(np.float16), "compared": compared, "made_with": f"mitsuba {mi.__version__}"}
        np.savez_compressed(path, **stored)
        print(f"{path}: {path.stat().st_size:,} bytes, {compared.mean():.0%} compared", flush=True)


def describe(mi: Any, one: LightScene) -> dict:
    """Returns Mitsuba's scene dictionary."""
    parts: dict = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sensor": sensor_of(mi, one.camera, SAMPLES),
    }
    parts |= {f"mesh{i}": mesh_of(mi, instance.mesh) for i, instance in enumerate(one.scene.meshes)}
    return parts | {f"light{i}": light_of(mi, light) for i, light in enumerate(one.scene.lights)}


def sensor_of(mi: Any, camera: ls.Camera, samples: int) -> dict:
    """Returns Mitsuba's sensor for a camera; its cameras look along +z with x to the left."""
    to_world = camera.world_from_camera.copy()
    to_world[:, :2] *= -1.0
    film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}}
    return {
        "type": "perspective",
        "fov": float(np.degrees(camera.fov_y)),
        "fov_axis": "y",
        "to_world": mi.ScalarTransform4f(to_world),
        "film": film | {"component_format": "float32"},
        "sampler": {"type": "multijitter", "sample_count": samples},
    }


def mesh_of(mi: Any, mesh: ls.Mesh) -> Any:
    """Returns Mitsuba's mesh in world space with its material and emission."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(material_of(mesh.material))
    if any(mesh.material.emissive):
        radiance = {"type": "rgb", "value": list(mesh.material.emissive)}
        properties["emitter"] = mi.load_dict({"type": "area", "radiance": radiance})
    smooth = mesh.normals is not None
    made = mi.Mesh(mesh.name, mesh.vertex_count, mesh.face_count, props=properties, has_vertex_normals=smooth)
    values = mi.traverse(made)
    values["vertex_positions"] = mesh.positions.ravel()
    values["faces"] = mesh.indices.ravel().astype(np.uint32)
    if mesh.normals is not None:
        values["vertex_normals"] = mesh.normals.ravel()
    values.update()
    return made


def material_of(material: Any) -> dict:
    """Returns Mitsuba's BSDF for a material; only materials that Mitsuba has are allowed."""
    if material.mesh_metallic == 1.0 and material.mesh_color == (1.0, 1.0, 1.0):
        kind = {"type": "conductor"}
        if material.mesh_roughness > 0.0:
            kind = {"type": "roughconductor", "distribution": "ggx", "alpha": material.mesh_roughness**2}
        return kind | {"material": "none"}
    if material.transmission == 1.0 and material.mesh_color == (1.0, 1.0, 1.0):
        kind = {"type": "dielectric"}
        if material.mesh_roughness > 0.0:
            kind = {"type": "roughdielectric", "distribution": "ggx", "alpha": material.mesh_roughness**2}
        return kind | {"int_ior": material.ior, "ext_ior": 1.0}
    assert material.specular == 0.0 == material.mesh_metallic, "Mitsuba has no such material"
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(material.mesh_color)}}


def light_of(mi: Any, light: Any, radiance_of: Callable[[np.ndarray], np.ndarray] = environment_radiance) -> dict:
    """Returns Mitsuba's emitter for a light; the image of an environment is that of ``radiance_of``."""
    power = {"type": "rgb", "value": [light.intensity * c for c in light.color]}
    if isinstance(light, ls.LightPoint):
        made = {"type": "point", "position": list(light.position), "intensity": power}
    elif isinstance(light, ls.LightSpot):
        ends = {"origin": list(light.position), "target": list(np.add(light.position, light.direction))}
        angles = np.degrees([light.inner_angle, light.outer_angle])
        made = {"type": "spot", "intensity": power, "beam_width": angles[0], "cutoff_angle": angles[1]}
        made["to_world"] = mi.ScalarTransform4f().look_at(**ends, up=[0.0, 0.0, 1.0])
    elif isinstance(light, ls.LightDirectional):
        made = {"type": "directional", "direction": list(light.direction), "irradiance": power}
    elif isinstance(light, ls.LightSphere):
        made = {"type": "sphere", "center": list(light.position), "radius": light.radius}
        made["emitter"] = {"type": "area", "radiance": power}
    elif isinstance(light, ls.LightRect):
        u, v = 0.5 * np.array(light.edge_u), 0.5 * np.array(light.edge_v)
        matrix = np.eye(4)  # From the square -1..1 that faces +z.
        matrix[:3] = np.stack([u, v, np.cross(u, v), np.array(light.position)], axis=1)
        made = {"type": "rectangle", "to_world": mi.ScalarTransform4f(matrix)}
        made["emitter"] = {"type": "area", "radiance": power}
    elif isinstance(light, ls.LightDisk):
        ends = {"origin": list(light.position), "target": list(np.add(light.position, light.direction))}
        placed = mi.ScalarTransform4f().look_at(**ends, up=[0.0, 0.0, 1.0])
        made = {"type": "disk", "to_world": placed @ mi.ScalarTransform4f().scale([light.radius] * 3)}
        made["emitter"] = {"type": "area", "radiance": power}
    elif light.image is None:
        made = {"type": "constant", "radiance": power}
    else:
        # Its first column looks along -z, and its first and last rows are the poles.
        height, width = SKY_SIZE
        u = (np.arange(width) + 0.5) / width
        v = np.arange(height)[:, None] / (height - 1)
        texels = radiance_of(directions_of(u + 0.5, v)) * power["value"]
        matrix = np.eye(4)
        matrix[:3, :3] = world_from_sky(light)
        made = {"type": "envmap", "bitmap": mi.Bitmap(texels.astype(np.float32))}
        made["to_world"] = mi.ScalarTransform4f(matrix)
    return made


def world_from_sky(light: ls.LightEnvironment) -> np.ndarray:
    """Returns the rotation of an environment, shape (3, 3)."""
    return rotation_from_quaternion(np.array([light.rotation_wxyz]))[0]


def check_sky(mi: Any, scene: Any, one: LightScene) -> None:
    """Raises an AssertionError unless Mitsuba's environment has the intended radiance in all directions."""
    light = one.scene.lights[0]
    if not isinstance(light, ls.LightEnvironment) or light.image is None:
        return
    directions = np.random.default_rng(0).normal(size=(500, 3))
    directions[:100] = world_from_sky(light) @ (np.array(SUN) / np.linalg.norm(SUN)) + 0.02 * directions[:100]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for direction in directions:
        interaction = mi.SurfaceInteraction3f()
        interaction.wi = mi.Vector3f(*(-direction))
        seen = np.array(scene.environment().eval(interaction))
        meant = environment_radiance(direction @ world_from_sky(light)) * light.color * light.intensity
        np.testing.assert_allclose(seen, meant, rtol=0.01, atol=1e-3)


def rays_of(mi: Any, camera: ls.Camera) -> list[list[Any]]:
    """Returns rays through the pixel centres, row by row."""
    directions = camera.ray_directions() @ camera.world_from_camera[:3, :3].T
    origin = mi.Point3f(*camera.eye)
    return [[mi.Ray3f(origin, mi.Vector3f(*direction)) for direction in row] for row in directions]


def interior(mi: Any, scene: Any, camera: ls.Camera) -> np.ndarray:
    """Returns a mask of pixels that see one smooth surface, as all their neighbours do, shape (H, W)."""
    hits = [[scene.ray_intersect(ray) for ray in row] for row in rays_of(mi, camera)]
    normals = np.array([[np.array(hit.sh_frame.n) if hit.is_valid() else np.zeros(3) for hit in row] for row in hits])
    shapes = np.array([[hash(hit.shape) if hit.is_valid() else 0 for hit in row] for row in hits])
    inside = np.zeros(shapes.shape, dtype=bool)
    inside[1:-1, 1:-1] = True
    for rows, columns in ((0, 1), (1, 0), (1, 1), (1, -1)):
        moved = np.roll(shapes, (rows, columns), (0, 1)), np.roll(normals, (rows, columns), (0, 1))
        edge = (moved[0] != shapes) | (np.linalg.norm(moved[1] - normals, axis=2) > 0.5)
        inside &= ~edge & ~np.roll(edge, (-rows, -columns), (0, 1))
    return inside


def central(mi: Any, scene: Any, one: LightScene) -> tuple[np.ndarray, np.ndarray]:
    """Returns the radiance along rays through the pixel centres, (H, W, 3), and a mask of comparable pixels, (H, W)."""
    walk = Walk(mi, scene, one)
    pixels = [[walk.radiance(ray) for ray in row] for row in rays_of(mi, one.camera)]
    return np.array([[p[0] for p in row] for row in pixels]), np.array([[p[1] for p in row] for row in pixels])


class Walk:
    """Follows rays over mirrors and through glass, split at each surface; no light is random."""

    def __init__(self, mi: Any, scene: Any, one: LightScene) -> None:
        self.mi, self.scene, self.light = mi, scene, one.scene.lights[0]
        self.sampler = mi.load_dict({"type": "independent"})
        self.lobes = []
        for flag in (mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission):
            context = mi.BSDFContext()
            context.type_mask = int(flag)
            self.lobes.append(context)

    def radiance(self, ray: Any, weight: float = 1.0, depth: int = 0) -> tuple[np.ndarray, bool]:
        """Returns the radiance of a ray, shape (3,), and whether our shadow rays and falloffs agree with it."""
        hit = self.scene.ray_intersect(ray)
        if not hit.is_valid() or self.mi.has_flag(hit.bsdf().flags(), self.mi.BSDFFlags.Smooth):
            color = self.scene.integrator().sample(self.scene, self.sampler, self.mi.RayDifferential3f(ray))[0]
            return np.array(color), not hit.is_valid() or weight < 1e-3 or self.certain(hit)
        total, certain = np.zeros(3), True
        for context in self.lobes if depth < DEPTH else ():
            sample, share = hit.bsdf().sample(context, hit, 0.5, self.mi.Point2f(0.5, 0.5))
            share = np.array(share)
            if weight * share.max() > 1e-4:
                child = hit.spawn_ray(hit.to_world(sample.wo))
                color, sure = self.radiance(child, weight * share.max(), depth + 1)
                total, certain = total + share * color, certain and sure
        return total, certain

    def certain(self, hit: Any) -> bool:
        """Returns whether a point is neither behind glass as seen from the light, nor in the falloff of a spot."""
        if isinstance(self.light, ls.LightDirectional):
            return True
        assert not isinstance(self.light, ls.LightEnvironment)
        away = np.array(hit.p) - self.light.position
        away /= np.linalg.norm(away)
        if isinstance(self.light, ls.LightSpot):
            angle = np.arccos(np.dot(away, self.light.direction))
            return not self.light.inner_angle - 0.01 < angle < self.light.outer_angle + 0.01
        first = self.scene.ray_intersect(self.mi.Ray3f(self.mi.Point3f(*self.light.position), self.mi.Vector3f(*away)))
        return not self.mi.has_flag(first.bsdf().flags(), self.mi.BSDFFlags.DeltaTransmission)


if __name__ == "__main__":
    main(sys.argv[1:])
