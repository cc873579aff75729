"""Ray traces the demo room with a glass ball, a polished brass knot and a jewel through a lens."""

from __future__ import annotations

from dataclasses import replace

import lumisplat as ls

SMOOTH = {
    "striped glass": {"base_color": (0.97, 0.99, 0.98), "transmission": 1.0, "base_color_texture": None},
    "brass": {"base_color": (0.95, 0.78, 0.42), "metallic": 1.0},
    "aquamarine": {"base_color": (0.75, 0.93, 1.0), "transmission": 1.0, "ior": 1.58},
}


def smooth(instance: ls.MeshInstance) -> ls.MeshInstance:
    """Returns the object polished, without the baked daylight of its vertex colours."""
    mesh = instance.mesh
    if instance.name not in SMOOTH:
        return instance
    material = replace(mesh.material, roughness=0.0, **SMOOTH[instance.name])
    return replace(instance, mesh=replace(mesh, material=material, colors=None))


def main(width: int = 320, samples: int = 4) -> None:
    """Writes out/mirror_and_glass.png, in focus on the jewel."""
    scene = ls.demo_scene()
    scene = replace(scene, meshes=[smooth(instance) for instance in scene.meshes])
    camera = ls.Camera.look_at(
        eye=(0.35, 0.8, 1.75),
        target=(-0.62, 0.4, -0.1),
        width=width,
        height=round(0.5625 * width),
        fov_y=0.55,
        aperture=0.012,
        focus_distance=1.9,
    )
    # Mirrors show the background where the room is open.
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, samples=samples, max_bounces=8, background=(0.78, 0.82, 0.84))
    ls.render(scene, camera, config).save("out/mirror_and_glass.png")


if __name__ == "__main__":
    main()
