"""Measures `lumisplat delight` on a room of known shape, relit beside the truth (10 minutes).

``python -m bench.known_room SET MESH...`` takes a set of tools/make_relightable_room.py and its meshes, and prints a
JSON object for each of three captures, with the figures of `lumisplat evaluate --materials`. ``true`` has Gaussians on
the room's surfaces with the true albedo, the best that so many Gaussians can do. ``captured`` has the same Gaussians
with only the light of the set baked into their colours by `lumisplat bake`, degree 0. ``delighted`` is what
`lumisplat delight` finds from that. Captures and images of the worst views are written to /tmp/known_room.
"""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import lumisplat as ls
from bench.timing import parser, quiet_warp
from lumisplat.math.arrays import FloatArray

OUT = Path("/tmp/known_room")
FIGURE_DENSITY = 3.0
"""Gaussians per area on figures, relative to walls."""
MATT = ls.MaterialPbr(specular=0.0, roughness=1.0)
WHITE = 0.5 / 0.28209479177387814
"""SH coefficient of degree 0 of display white."""


def main() -> None:
    """Makes the captures and compares them."""
    given = parser("known_room", __doc__)
    given.add_argument("set", type=Path, help="set of tools/make_relightable_room.py")
    given.add_argument("meshes", type=Path, nargs="+", help="meshes in the room")
    given.add_argument("--count", type=int, default=20_000, help="Gaussians")
    given.add_argument("--samples", type=int, default=16, help="paths per pixel of relit frames")
    options = given.parse_args()
    quiet_warp()
    OUT.mkdir(exist_ok=True)
    true = room(options)
    compare("true", true, options)
    captured = ls.merge([baked(true, options), *light_splats(options.set)])
    compare("captured", captured, options)
    begun = time.process_time()
    found = ls.inverse.estimate_materials(captured, device=options.device)
    print(json.dumps({"delight_cpu_seconds": round(time.process_time() - begun, 1), "remarks": found.remarks}))
    compare("delighted", found.gaussians, options)


def room(options: Any) -> ls.Gaussians:
    """Returns Gaussians on all surfaces of the room, with its true albedo."""
    from make_relightable_room import room_numbered, surfaces  # pyright: ignore[reportMissingImports]

    number = json.loads((options.set / "set.json").read_text())["room"]
    placed = surfaces(room_numbered(number), options.meshes)
    shares = np.array([area(mesh) * (FIGURE_DENSITY if is_figure else 1.0) for mesh, is_figure in placed])
    counts = np.maximum(options.count * shares / shares.sum(), 50).astype(int)
    return ls.merge(
        [
            ls.gaussians_from_mesh(mesh, int(n), seed)
            for seed, ((mesh, _), n) in enumerate(zip(placed, counts, strict=True))
        ]
    )


def area(mesh: ls.Mesh) -> float:
    """Returns the area of all triangles."""
    a, b, c = (mesh.positions[mesh.indices[:, k]] for k in range(3))
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def lights_of(folder: Path) -> tuple[Any, ...]:
    """Returns the lights of the images."""
    scene = ls.load(folder / "lamps.toml")
    assert isinstance(scene, ls.Scene)
    return scene.lights


def baked(true: ls.Gaussians, options: Any) -> ls.Gaussians:
    """Returns the Gaussians with baked light in their colours, and without materials."""
    scene = ls.Scene([ls.SplatInstance(true, material=MATT)], lights=lights_of(options.set))
    config = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=8)
    made = ls.bake(scene, degree=0, directions=16, config=config, device=options.device).splats[0].gaussians
    return replace(made, normals=None)


def light_splats(folder: Path) -> list[ls.Gaussians]:
    """Returns white Gaussians at the lights."""
    made: list[ls.Gaussians] = []
    for light in lights_of(folder):
        u, v = np.array(light.edge_u), np.array(light.edge_v)
        corner = np.array(light.position) - 0.5 * (u + v)
        quad: FloatArray = np.stack([corner, corner + u, corner + u + v, corner + v]).astype(np.float32)
        glowing = ls.gaussians_from_mesh(ls.Mesh(quad, np.array([(0, 1, 2), (0, 2, 3)], np.int32)), 300)
        white = np.full((glowing.count, 1, 3), WHITE, np.float32)
        made.append(replace(glowing, sh=white, normals=None, albedo=None, roughness=None, metallic=None))
    return made


def compare(name: str, capture: ls.Gaussians, options: Any) -> None:
    """Writes a capture and prints its scores."""
    ls.save(OUT / f"{name}.ply", capture)
    begun = time.process_time()
    result = ls.inverse.evaluate_materials(capture, options.set, samples=options.samples, device=options.device)
    figures: dict[str, Any] = {
        "capture": name,
        "gaussians": capture.count,
        "albedo": round(result.albedo_psnr, 2),
        "albedo_as_it_is": round(result.albedo_psnr_unscaled, 2),
        "scale": [round(factor, 3) for factor in result.albedo_scale],
        "normals": [round(result.normal_mean, 1), round(result.normal_median, 1)],
        "relit": {light: [round(value, 3) for value in figures] for light, figures in result.relit.items()},
        "cpu_seconds": round(time.process_time() - begun, 1),
    }
    print(json.dumps(figures), flush=True)
    worst = min(result.views, key=lambda view: view.albedo_psnr)
    from lumisplat.io.images.texture import write_png

    rows = [np.concatenate(pair, axis=1) for pair in worst.pictures.values()]
    write_png(OUT / f"{name}.png", np.concatenate(rows, axis=0))


if __name__ == "__main__":
    main()
