"""Builds scenes and rays for the ray tracer, and lists the frames on which tracer and oracle must agree."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import numpy as np

from lumisplat.config import Antialiasing, HitDistance, NormalMethod, Pipeline, RenderConfig, TraceConfig
from lumisplat.demo.shapes import icosphere
from lumisplat.scene.camera import Camera, CameraModel
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance
from support.oracles.mirror_oracle import Ray
from support.oracles.raster_oracle import normalized
from support.scenes.raster_scenes import (
    checker_quad,
    front_camera,
    octahedron,
    one_gaussian,
    opposed_sheets,
    quad,
    random_gaussians,
    similarity,
)

GLASS = MaterialPbr(base_color=(1.0, 1.0, 1.0), roughness=0.0, transmission=1.0)
MIRROR = MaterialPbr(base_color=(1.0, 1.0, 1.0), roughness=0.0, metallic=1.0)
AXIS = Ray(np.zeros(3), np.array([0.0, 0.0, 1.0]))
"""Optical axis of ``front_camera``."""


def small_camera(width: int = 28, height: int = 21, focal: float = 26.0, **changes: object) -> Camera:
    """Returns ``front_camera`` with few pixels."""
    return front_camera(width, height, focal, **changes)


def side_camera(offset: tuple[float, float, float] = (0.0, 0.0, 0.0), width: int = 28, height: int = 21) -> Camera:
    """Returns a camera that looks from the side at the point 4 units in front of ``front_camera``."""
    eye, target = np.add((2.5, -1.5, 0.5), offset), np.add((0.0, 0.0, 4.0), offset)
    return Camera.look_at(eye, target, (0.0, -1.0, 0.0), width=width, height=height, fov_y=0.8)


def trace_config(
    background: tuple[float, float, float] | None = (0.0, 0.0, 0.0), bounces: int = 3, **changes: object
) -> RenderConfig:
    """Returns settings of a traced frame whose hits are ordered by peaks; ``changes`` as for ``changed_rays``."""
    trace = TraceConfig(hit_distance=HitDistance.PEAK)
    config = RenderConfig(
        pipeline=Pipeline.TRACE, background=background, lighting=False, max_bounces=bounces, trace=trace
    )
    return changed_rays(config, **changes)


def changed_rays(config: RenderConfig, **changes: object) -> RenderConfig:
    """Replaces fields of ``TraceConfig``, of ``ResponseConfig`` or, if neither has the field, of the config itself."""
    groups = {name: {field.name for field in fields(getattr(config, name))} for name in ("trace", "response")}
    for key, value in changes.items():
        name = next((name for name, keys in groups.items() if key in keys), None)
        change = {key: value} if name is None else {name: replace(getattr(config, name), **{key: value})}
        config = replace(config, **change)
    return config


def random_ray(rng: np.random.Generator) -> Ray:
    """Returns a ray through the neighbourhood of (0, 0, 4)."""
    origin = rng.normal(0.0, 2.0, 3)
    return Ray(origin, normalized(np.array([0.0, 0.0, 4.0]) + rng.normal(0.0, 0.8, 3) - origin))


def ball(
    material: MaterialPbr, radius: float = 1.0, center: tuple[float, float, float] = (0, 0, 4), detail: int = 2
) -> MeshInstance:
    """Returns a smooth sphere of 20 * 4^detail triangles."""
    unit = icosphere(1.0, subdivisions=detail)
    mesh = Mesh(unit.positions, unit.indices, unit.normals, material=material)
    return MeshInstance(mesh, similarity(scale=radius, offset=center))


def slab(z: float, thickness: float, material: MaterialPbr, half: float = 50.0, tilt: float = 0.0) -> Mesh:
    """Returns two parallel faces that both face outwards."""
    front, back = quad(z, half, tilt), quad(z + thickness, half, tilt)
    return Mesh(
        np.concatenate([front.positions, back.positions]),
        np.concatenate([front.indices, back.indices[:, ::-1] + 4]),
        material=material,
    )


def copies(count: int, seed: int, opacity: tuple[float, float] = (0.02, 0.2)) -> Gaussians:
    """Returns Gaussians that differ only in colour and opacity, so that every ray hits all of them at one distance."""
    one = one_gaussian((0.1, -0.2, 4.0), (0.7, 0.4, 0.2), rotation=(0.9, 0.3, -0.2, 0.1))
    rng = np.random.default_rng(seed)
    same = {name: np.repeat(values, count, axis=0) for name, values in one.arrays().items()}
    same |= {"opacities": rng.uniform(*opacity, count), "sh": rng.uniform(-1.2, 1.6, (count, 1, 3))}
    return replace(one, **same)


def flattened(gaussians: Gaussians, axes: int, scale: float = 1e-6) -> Gaussians:
    """Shrinks Gaussians along some of their axes to nearly no extent."""
    scales = gaussians.scales.copy()
    scales[:, :axes] = scale
    return replace(gaussians, scales=scales)


def moved(scene: Scene, offset: tuple[float, float, float]) -> Scene:
    """Translates all instances of a scene."""
    shift = similarity(offset=offset)
    return Scene(
        tuple(replace(one, world_from_object=shift @ one.transform) for one in scene.splats),
        tuple(replace(one, world_from_object=shift @ one.transform) for one in scene.meshes),
    )


@dataclass(frozen=True)
class Case:
    """A traced frame whose name states its purpose."""

    name: str
    scene: Scene
    camera: Camera = field(default_factory=small_camera)
    config: RenderConfig = field(default_factory=trace_config)


def placed_scene() -> Scene:
    """Returns two instances of one set, and an instance of another set."""
    asset = random_gaussians(111, count=60, degree=3, center=(0.0, 0.0, 0.0), extent=(0.8, 0.8, 0.8))
    return Scene(
        [
            SplatInstance(asset, similarity((1.0, 2.0, 0.5), 1.1, 0.9, (-0.8, 0.1, 4.0))),
            SplatInstance(asset, similarity((0.0, 1.0, 0.0), 2.5, 1.4, (0.9, -0.2, 4.6))),
            SplatInstance(random_gaussians(112, count=40, degree=1)),
        ]
    )


def mirror_scene() -> Scene:
    """Returns a mirror with Gaussians in front of it, and Gaussians behind the camera that the mirror shows."""
    behind = random_gaussians(162, 80, degree=2, center=(0.0, 0.0, -3.0), extent=(2.0, 1.5, 1.0))
    return Scene([random_gaussians(161, 60, degree=1), behind], [quad(5.0, 1.5, tilt=0.1, material=MIRROR)])


def glass_scene(material: MaterialPbr = GLASS) -> Scene:
    """Returns a glass ball with Gaussians inside, around and behind."""
    inside = random_gaussians(163, 40, degree=1, extent=(0.5, 0.5, 0.5), scale_range=(0.02, 0.1))
    around = random_gaussians(164, 80, degree=1, center=(0.0, 0.0, 5.5), extent=(2.0, 1.5, 1.0))
    return Scene([inside, around], [ball(material)])


def cases() -> list[Case]:
    """Returns the frames on which tracer and oracle must agree."""
    return [*_gaussian_cases(), *_setting_cases(), *_mesh_cases(), *_smooth_cases()]


def _gaussian_cases() -> list[Case]:
    plain = random_gaussians(101, degree=1)
    around = random_gaussians(103, 500, degree=1, center=(0.0, 0.0, 0.0), extent=(2.0, 2.0, 2.0))
    huge = random_gaussians(105, 12, extent=(500.0, 500.0, 500.0), scale_range=(1e3, 1e6))
    needles = random_gaussians(106, 80, scale_range=(0.001, 0.8))
    thin = replace(plain, scales=plain.scales * (1.0, 1e-14, 1e-14))
    dense = random_gaussians(108, 1000, degree=1, scale_range=(0.05, 0.2))
    hundred = copies(100, 109)
    halves = [hundred.subset(np.arange(50, 100)), hundred.subset(np.arange(50))]
    offset = (1000.0, -500.0, 250.0)
    return [
        *(Case(f"sh{degree}", Scene([random_gaussians(90 + degree, degree=degree)])) for degree in range(4)),
        *(
            Case(f"kernel degree {degree}", Scene([replace(random_gaussians(94 + degree), kernel_degree=degree)]))
            for degree in range(6)
        ),
        Case("from the side", Scene([random_gaussians(102, degree=3)]), side_camera()),
        Case("off-centre lens", Scene([plain]), small_camera(37, 31, fx=30.0, fy=45.0, cx=12.3, cy=19.7)),
        Case("orthographic", Scene([plain]), small_camera(fx=7.0, fy=8.0, model=CameraModel.ORTHOGRAPHIC)),
        Case("fisheye", Scene([around]), small_camera(fx=8.0, fy=7.0, near=0.2, model=CameraModel.FISHEYE)),
        Case("one pixel", Scene([plain]), small_camera(1, 1, 1.0)),
        Case("one row", Scene([plain]), small_camera(61, 1, 37.0)),
        Case("a hundred at one distance", Scene([hundred])),
        Case("at one distance in two instances", Scene([*halves, plain])),
        Case("opaque ones at one distance", Scene([copies(40, 110, (0.3, 1.0))])),
        Case("around the camera", Scene([around]), small_camera(near=0.2)),
        Case("around the camera, no near plane", Scene([around]), small_camera(near=1e-6)),
        Case("flat", Scene([flattened(random_gaussians(104, 200, scale_range=(0.1, 0.5)), 1)])),
        Case("thinner than float32", Scene([plain, flattened(random_gaussians(104, 200), 2)])),
        Case("needles thinner than float32's products", Scene([thin])),
        Case("huge", Scene([huge])),
        Case("huge and small", Scene([plain, huge]), side_camera()),
        Case("needles", Scene([needles])),
        Case("dense", Scene([dense])),
        Case("instances", placed_scene(), side_camera()),
        Case("far away", moved(Scene([plain], [quad(4.3, 0.7)]), offset), side_camera(offset=offset)),
        Case("normals cancel", Scene([opposed_sheets()])),
        Case("too faint", Scene([random_gaussians(113, 20), replace(plain, opacities=np.full(150, 0.0039))])),
        Case("nothing", Scene()),
    ]


def _setting_cases() -> list[Case]:
    plain, placed = Scene([random_gaussians(121, degree=1)]), placed_scene()
    linear = Scene([replace(random_gaussians(122), kernel_degree=0)])
    crossing = Scene([random_gaussians(123)], [quad(4.0, 1.2, tilt=0.9)])
    around = Scene([random_gaussians(103, 500, degree=1, center=(0.0, 0.0, 0.0), extent=(2.0, 2.0, 2.0))])
    fisheye = small_camera(fx=8.0, fy=7.0, near=0.2, model=CameraModel.FISHEYE)
    needles = Scene([random_gaussians(106, 80, scale_range=(0.001, 0.8))])
    far = Scene([random_gaussians(107, 400, center=(0.0, 0.0, 60.0), extent=(20.0, 20.0, 20.0))])
    hull, ellipsoid, mean = HitDistance.HULL, NormalMethod.ELLIPSOID, HitDistance.MEAN
    both = {"hit_distance": hull, "normal_method": ellipsoid}
    return [
        Case("kernel degree set", placed, side_camera(), trace_config(kernel_degree=4)),
        Case("least response", plain, config=trace_config(min_response=0.0113)),
        Case("least response, large", plain, config=trace_config(min_response=0.3)),
        Case("least response, plain", plain, config=trace_config(min_response=0.3, adaptive_clamping=False)),
        Case("least response, linear", linear, config=trace_config(min_response=0.1)),
        Case("hull", plain, config=trace_config(hit_distance=hull)),
        Case("hull, linear", linear, config=trace_config(hit_distance=hull)),
        Case("hull, instances", placed, side_camera(), trace_config(hit_distance=hull)),
        Case("hull, mesh", crossing, side_camera(), trace_config(hit_distance=hull)),
        Case("hull, least response", plain, config=trace_config(hit_distance=hull, min_response=0.2)),
        Case("mean", plain, config=trace_config(hit_distance=mean)),
        Case("mean, linear", linear, config=trace_config(hit_distance=mean)),
        Case("mean, instances", placed, side_camera(), trace_config(hit_distance=mean)),
        Case("mean, mesh", crossing, side_camera(), trace_config(hit_distance=mean)),
        Case("mean, mirror", mirror_scene(), config=trace_config(hit_distance=mean)),
        Case("mean, around the camera", around, small_camera(near=0.2), trace_config(hit_distance=mean)),
        Case("mean, passes of 4", placed, side_camera(), trace_config(hit_distance=mean, hits_per_pass=4)),
        Case("antialiased", Scene([replace(plain.splats[0].gaussians, antialiased=True)]), config=trace_config()),
        Case("antialiasing on", plain, config=trace_config(antialiasing=Antialiasing.ON)),
        Case("no dilation", plain, config=trace_config(dilation=0.0)),
        Case("wide dilation", needles, config=trace_config(dilation=8.0)),
        Case("wide dilation, mirror", mirror_scene(), config=trace_config(dilation=8.0)),
        Case("wide dilation, fisheye", around, fisheye, trace_config(dilation=8.0)),
        Case("wide dilation, small in the image", far, config=trace_config(dilation=8.0, hit_distance=mean)),
        Case("ellipsoid normals", plain, config=trace_config(normal_method=ellipsoid)),
        Case("ellipsoid normals, instances", placed, side_camera(), trace_config(kernel_degree=3, **both)),
        Case("flat, ellipsoid normals", Scene([flattened(random_gaussians(104, 100), 1)]), config=trace_config(**both)),
        Case("degree cut", Scene([random_gaussians(124, degree=3)]), config=trace_config(sh_degree=1)),
        Case("other thresholds", plain, config=trace_config(transmittance_min=0.05, depth_iso_transmittance=0.3)),
        Case("to the end", Scene([random_gaussians(125, 800)]), config=trace_config(transmittance_min=0.0)),
        *(Case(f"passes of {k}", placed, side_camera(), trace_config(hits_per_pass=k)) for k in (4, 8, 32)),
        Case("white background", plain, config=trace_config((1.0, 0.9, 0.8))),
        Case("transparent", plain, config=trace_config(None)),
    ]


def _mesh_cases() -> list[Case]:
    splats = random_gaussians(141, degree=1)
    textured = MeshInstance(checker_quad(0.0), similarity((0.3, 1.0, 0.2), 0.5, 1.1, (0.2, 0.0, 4.0)))
    sheared = similarity(offset=(0.1, 0.1, 4.2)) @ np.array(
        [[1.0, 0.4, 0.0, 0.0], [0.0, 0.7, 0.0, 0.0], [0.0, 0.2, 1.3, 0.0], [0.0, 0.0, 0.0, 1.0]]
    )
    flipped = sheared @ np.diag([-1.0, 1.0, 1.0, 1.0])
    smooth = octahedron((0.0, 0.0, 0.0), 1.0)
    stack = [quad(5.0), octahedron((0.2, 0.1, 3.6), 0.7), quad(4.2, 0.5, -0.8)]
    return [
        Case("mesh behind", Scene([splats], [quad(6.0, 2.0)])),
        Case("mesh in front", Scene([splats], [quad(2.4, 0.47)])),
        Case("mesh crossing", Scene([splats], [quad(4.0, 1.2, tilt=0.9)]), side_camera()),
        Case("mesh smooth", Scene([splats], [octahedron((0.0, 0.0, 4.0), 1.0)]), side_camera()),
        Case("mesh textured", Scene([random_gaussians(142, 60)], [textured])),
        Case("mesh sheared", Scene([], [MeshInstance(smooth, sheared)])),
        Case("mesh mirrored by its placement", Scene([], [MeshInstance(smooth, flipped)])),
        Case("mesh across the near plane", Scene([], [quad(0.3, 2.0, tilt=-1.0)]), small_camera(near=0.25)),
        Case("meshes and splats", Scene([splats], stack), side_camera()),
    ]


def _smooth_cases() -> list[Case]:
    splats = random_gaussians(165, 80, degree=1, center=(0.0, 0.0, 5.5), extent=(2.0, 1.5, 1.0))
    behind = random_gaussians(162, 80, degree=2, center=(0.0, 0.0, -3.0), extent=(2.0, 1.5, 1.0))
    gold = MaterialPbr(base_color=(1.0, 0.7, 0.3), roughness=0.0, metallic=1.0)
    lacquer = MaterialPbr(base_color=(0.6, 0.1, 0.2), roughness=0.0, specular=0.7)
    tinted = MaterialPbr(base_color=(0.4, 0.8, 0.6), roughness=0.0, transmission=0.8, ior=1.33)
    mixed = MaterialPbr(base_color=(0.5, 0.8, 0.3), roughness=0.0, transmission=0.6, metallic=0.4, ior=1.8)
    corner = [quad(5.0, 3.0, tilt=1.0, material=MIRROR), quad(5.0, 3.0, tilt=-1.0, material=gold)]
    world = (0.3, 0.5, 0.9)
    upside_down = similarity(offset=(0.0, 0.0, 8.0)) @ np.diag([1.0, 1.0, -1.0, 1.0])
    return [
        Case("mirror", mirror_scene()),
        Case("mirror at 45 degrees", Scene([random_gaussians(166, degree=3, center=(3.0, 0.0, 4.0))], corner[:1])),
        Case("mirrors in a corner", Scene([splats, behind], corner), config=trace_config(world, 6)),
        Case("no bounces", mirror_scene(), config=trace_config(world, 0)),
        Case("gold", Scene([splats, behind], [ball(gold)]), config=trace_config(world)),
        Case("lacquer", Scene([splats, behind], [ball(lacquer)]), config=trace_config(world)),
        Case("glass slab", Scene([splats], [slab(3.5, 0.4, GLASS, 1.0, 0.5)]), config=trace_config(world)),
        Case("glass ball", glass_scene(), config=trace_config(world)),
        Case("glass ball, one bounce", glass_scene(), config=trace_config(world, 1)),
        Case("glass ball, six bounces", glass_scene(tinted), side_camera(), trace_config(world, 6)),
        Case("mixed ball", glass_scene(mixed), config=trace_config(world, hit_distance=HitDistance.HULL)),
        Case("flat glass", Scene([splats], [octahedron_of(GLASS)]), side_camera(), trace_config(world, 5)),
        Case("glass turned over", Scene([splats], [MeshInstance(slab(3.5, 0.4, tinted, 1.0, 0.5), upside_down)])),
        Case("inside glass", Scene([splats], [slab(-1.0, 4.0, tinted, 5.0)]), config=trace_config(world)),
    ]


def octahedron_of(material: MaterialPbr) -> Mesh:
    """Returns eight flat triangles around (0, 0, 4)."""
    smooth = octahedron((0.0, 0.0, 4.0), 1.0, material=material)
    return replace(smooth, normals=None)


def stochastic_cases() -> list[Case]:
    """Returns the frames on which the stochastic strategies must converge to the sorted result."""
    wide = random_gaussians(171, 150, degree=1, scale_range=(0.1, 0.4))
    camera = small_camera(16, 12, 15.0)
    side = side_camera(width=16, height=12)
    world = (0.3, 0.5, 0.9)
    linear = replace(wide, kernel_degree=0)
    # Rays hit these Gaussians before and after the mirror; the random numbers of both hits must be independent.
    seen_twice = Scene(
        [random_gaussians(173, 80, degree=1, center=(0.0, 0.0, 3.0), extent=(1.5, 1.2, 1.0), scale_range=(0.1, 0.4))],
        [quad(4.5, 6.0, material=MIRROR)],
    )
    return [
        Case("overlapping", Scene([wide]), camera),
        Case("passes of 4", Scene([wide]), camera, trace_config(world, hits_per_pass=4)),
        Case("at one distance", Scene([copies(60, 172)]), camera),
        Case("instances", placed_scene(), side, trace_config(world, hits_per_pass=4)),
        Case("linear, hull", Scene([linear]), side, trace_config(hit_distance=HitDistance.HULL)),
        Case("mesh", Scene([wide], [quad(4.0, 1.2, tilt=0.9)]), camera, trace_config(world)),
        Case("mirror", seen_twice, small_camera(), trace_config(world, hits_per_pass=4)),
        Case("glass", glass_scene(), small_camera(), trace_config(world, hits_per_pass=8)),
    ]
