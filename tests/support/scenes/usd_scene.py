"""Builds a scene with everything that OpenUSD can store."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import lumisplat as ls
from lumisplat.scene.lights import Light
from lumisplat.scene.primitives import box, sphere
from support.files.splat_files import capture


def materials() -> list[ls.MaterialPbr]:
    """Returns materials with constants only, with textures everywhere, glass, and two kinds of alpha.

    All state colour, metalness and roughness, as files do.
    """
    rng = np.random.default_rng(3)
    plain, alpha = (rng.integers(0, 256, (4, 6, k), dtype=np.uint8) for k in (3, 4))
    return [
        ls.MaterialPbr(
            name="numbers",
            base_color=(0.8, 0.1, 0.2),
            metallic=0.3,
            roughness=0.4,
            ior=1.33,
            clearcoat=0.5,
            clearcoat_roughness=0.1,
            emissive=(0.1, 2.0, 0.3),
        ),
        ls.MaterialPbr(
            name="textures",
            base_color=(0.5, 0.6, 0.7),
            base_color_texture=alpha,
            alpha_mode="mask",  # pyright: ignore[reportArgumentType]
            alpha=0.9,
            alpha_cutoff=0.4,
            metallic=0.7,
            roughness=0.9,
            metallic_roughness_texture=plain,
            normal_texture=plain,
            occlusion_texture=plain,
            occlusion_strength=0.6,
            emissive=(1.5, 0.2, 0.1),
            emissive_texture=plain,
            double_sided=False,
            clearcoat=0.4,
            clearcoat_texture=plain,
            clearcoat_roughness=0.3,
            clearcoat_roughness_texture=plain,
            wrap_u=ls.TextureWrap.CLAMP,
        ),
        ls.MaterialPbr(name="glass", base_color=(0.9, 1.0, 1.0), metallic=0.0, roughness=0.0, transmission=0.9),
        ls.MaterialPbr(name="frost", base_color=(0.7, 0.8, 0.9), metallic=0.0, roughness=0.3, transmission=0.9),
        ls.MaterialPbr(
            name="veil",
            base_color=(1.0, 1.0, 1.0),
            base_color_texture=alpha,
            metallic=0.0,
            roughness=0.6,
            alpha_mode=ls.AlphaMode.BLEND,
            alpha=0.5,
        ),
    ]


def lights() -> list[Light]:
    """Returns lights of every type, some twice with other options."""
    sky = np.random.default_rng(4).random((8, 16, 3)).astype(np.float32)
    return [
        ls.LightPoint((1, 2, 3), (1, 0.5, 0.2), 10.0, name="point"),
        ls.LightPoint((1, 2, 3), intensity=7.0, radius=0.1, range=20.0, casts_shadow=False, name="bulb"),
        ls.LightSpot((0, 1, 2), (1, 2, -3), (1, 1, 1), 5.0, inner_angle=0.3, outer_angle=0.7, name="spot"),
        ls.LightDirectional((1, -2, 0.5), (1, 0.9, 0.8), 3.0, 0.00465, shadow_distance=12.0, name="sun"),
        ls.LightSphere((3, 2, 1), 0.25, (1, 0, 1), 40.0, visible=False, name="ball"),
        ls.LightRect((0, 3, 0), (1, 0, 0.5), (0, 0.5, 1), (1, 1, 1), 12.0, name="skewed"),
        ls.LightRect((0, 3, 0), target=(0, 0, 0.3), size=(1, 2), intensity=3.0, enabled=False, name="panel"),
        ls.LightEnvironment(sky, (1, 0.9, 0.8), 1.5, rotation_wxyz=(0.5, 0.5, -0.5, 0.5), visible=False, name="sky"),
        ls.LightDisk((1, 4, -2), (0.5, -2, 1), 0.75, (1, 0.5, 0.25), 9.0, visible=False, name="disk"),
    ]


def full_scene(up: str | tuple[float, float, float]) -> ls.Scene:
    """Returns captures (two share Gaussians, one is relit), meshes (three share one mesh) and lights."""
    rng = np.random.default_rng(5)
    shared, made = capture(40, 2), materials()
    columns = {"albedo": rng.random((30, 3)), "roughness": rng.random(30), "normals": rng.normal(size=(30, 3))}
    relit = replace(capture(30, 1), **columns)
    ball, crate = sphere(0.3, rows=6), replace(box(0.5), material=made[1])
    stretched = np.eye(4)
    stretched[:3] = [(1.0, 0.2, 0.0, 1.0), (0.0, 1.0, 0.0, 2.0), (0.0, 0.0, -2.0, 3.0)]
    colors = rng.random((ball.vertex_count, 3))
    return ls.Scene(
        [
            ls.SplatInstance(shared, name="a capture", position=(0, 1, 0), rotation_degrees=(10, 20, 30), scale_by=2.0),
            ls.SplatInstance(shared, name="a capture", position=(0, 2, 0)),
            ls.SplatInstance(relit, name="relit", material=made[0], sh_degree=1),
        ],
        [
            *(
                ls.MeshInstance(replace(ball, material=m), name=f"{m.name} ball", position=(k, 0, 0))
                for k, m in enumerate(made)
            ),
            ls.MeshInstance(replace(ball, material=made[1], colors=colors), name="painted"),
            *(ls.MeshInstance(crate, name=f"crate {k}", position=(k, -1, 0)) for k in range(2)),
            ls.MeshInstance(crate, stretched, name="crate 2"),
        ],
        lights(),
        up=up,
    )
