"""Converts a mesh file, or a ring, to Gaussians, and renders both.

python examples/mesh_to_gaussians.py duck.glb
"""

from __future__ import annotations

import sys

import numpy as np

import lumisplat as ls


def ring(columns: int = 96, rows: int = 48) -> ls.Mesh:
    """Returns a torus whose vertex colours vary around it."""
    around, tube = np.meshgrid(*(2.0 * np.pi * np.arange(n) / n for n in (columns, rows)))
    reach = 1.0 + 0.4 * np.cos(tube)
    positions = np.stack([reach * np.cos(around), 0.4 * np.sin(tube), reach * np.sin(around)], axis=-1)
    colors = 0.5 + 0.4 * np.stack([np.cos(around), np.sin(around), np.sin(3.0 * tube)], axis=-1)
    vertex = np.arange(rows * columns).reshape(rows, columns)
    right, down = np.roll(vertex, -1, axis=1), np.roll(vertex, -1, axis=0)
    across = np.roll(down, -1, axis=1)
    triangles = np.stack([vertex, down, across, vertex, across, right], axis=-1).reshape(-1, 3)
    white = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0))
    return ls.Mesh(positions.reshape(-1, 3), triangles, colors=colors.reshape(-1, 3), material=white)


def main(path: str | None) -> None:
    """Writes out/mesh.png and out/gaussians.png, and out/gaussians.ply for a single mesh."""
    loaded = ls.load(path) if path else ring()
    if isinstance(loaded, ls.Gaussians):
        sys.exit(f"{path} is a capture already")
    meshes = loaded if isinstance(loaded, ls.Scene) else ls.Scene(meshes=[loaded])
    splats = ls.Scene(
        splats=[ls.SplatInstance(ls.gaussians_from_mesh(one.mesh), one.transform) for one in meshes.meshes]
    )
    print(f"{meshes.face_count:,} triangles, {splats.gaussian_count:,} Gaussians")

    low, high = meshes.bounds()
    centre, size = 0.5 * (low + high), float(np.linalg.norm(high - low))
    camera = ls.Camera.look_at(centre + size * np.array([0.6, 0.7, 0.9]), centre, width=640, height=480, fov_y=0.7)
    renderer = ls.create_renderer()
    solid, splatted = (renderer.render(scene, camera) for scene in (meshes, splats))
    solid.save("out/mesh.png")
    splatted.save("out/gaussians.png")
    if len(splats.splats) == 1:
        ls.save("out/gaussians.ply", splats.splats[0].gaussians)
    inside = solid.alpha > 0.5
    print(f"mean difference inside the silhouette: {np.abs(solid.color - splatted.color)[inside].mean():.4f}")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else None)
