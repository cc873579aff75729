"""Why albedos of a trained room are wrong: the truth in place of one cause after the other.

``python -m bench.room_causes SET CAPTURE.ply`` takes a set of tools/make_relightable_room.py and a capture that was
trained on it, after ``python -m bench.known_room SET MESH...``, whose room of a known shape has the true albedo,
normals and light. It prints a JSON object a row, with the figures of `lumisplat evaluate --materials`: materials
without highlights, as the set's are. ``--relit`` relights some of them as well.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

import lumisplat as ls
from bench.known_room import OUT, lamps, lit_by
from bench.timing import parser, quiet_warp
from lumisplat.constants import SH_C0
from lumisplat.constants.delight import PAIRS, RADIANCE_LEAST
from lumisplat.io.training_images.loading import load_photographs
from lumisplat.math.arrays import Doubles, FloatArray, Rows
from lumisplat.math.color import albedo_in_range, decode_srgb
from lumisplat.relighting.delight.albedo_fit import AlikeAlbedos, Light, SkyCells, albedo_pairs, first_light
from lumisplat.relighting.delight.delight import filled, is_white, lamps_of
from lumisplat.relighting.delight.incident import IncidentRays
from lumisplat.relighting.delight.neighbours import Smoother, neighbours_of
from lumisplat.relighting.evaluation import LayerRenderer, SeenView, albedo_scale, measured, normal_figures, with_albedo
from lumisplat.relighting.irradiance import median_outgoing
from lumisplat.relighting.relightable_set import RelightableSet
from lumisplat.scene.ops.normals import estimate_normals

NEAR = 0.2
"""Gaussians farther from all surfaces float, metres."""
LAMP_MARGIN = 0.15
"""White Gaussians within so much of a lamp are its own, metres."""
SEEN_WITHIN = 0.08
"""A Gaussian is seen in a pixel whose depth is that of the Gaussian but for so much, metres."""

Row = tuple[str, ls.Gaussians, Light | None, bool]
"""What was replaced by the truth, the capture with materials, lamps that were found, and whether it is relit."""


@dataclass(frozen=True)
class Truth:
    """The room of a known shape, and what is true where Gaussians of a capture are nearest to it."""

    folder: Path
    room: ls.Gaussians
    irradiance: Doubles
    """Over pi, of each of its Gaussians, shape (N, 3)."""

    @classmethod
    def of(cls, folder: Path) -> Truth:
        """What bench.known_room has left."""
        room, captured = ls.load(OUT / "true.ply"), ls.load(OUT / "captured.ply")
        assert isinstance(room, ls.Gaussians) and isinstance(captured, ls.Gaussians) and room.albedo is not None
        radiance = decode_srgb(np.clip(0.5 + SH_C0 * captured.sh[: room.count, 0], 0.0, 1.0)).astype(np.float64)
        return cls(folder, room, radiance / np.maximum(room.albedo.astype(np.float64), 1e-3))

    def nearest(self, capture: ls.Gaussians) -> tuple[Doubles, Rows]:
        """How far each Gaussian is from the surfaces, metres, and of which of the room's it is nearest."""
        distance, rows = cKDTree(self.room.means).query(capture.means)
        return distance, rows

    def lamp_rows(self, capture: ls.Gaussians, white: np.ndarray) -> Rows:
        """The lamp that white Gaussians are of, -1: none, shape (N,)."""
        found = np.full(capture.count, -1)
        for number, lamp in enumerate(lit_by(self.folder)):
            u, v, away = np.array(lamp.edge_u), np.array(lamp.edge_v), capture.means - np.array(lamp.position)
            facing = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
            beyond = [np.abs(away @ edge) / np.linalg.norm(edge) - 0.5 * np.linalg.norm(edge) for edge in (u, v)]
            beside = np.max([*beyond, np.abs(away @ facing)], axis=0)
            found[white & (beside < LAMP_MARGIN)] = number
        return found

    def radiances(self) -> Doubles:
        """Of the lamps, shape (L, 3)."""
        return np.array([lamp.intensity * np.array(lamp.color) for lamp in lit_by(self.folder)])

    def figures(self, capture: ls.Gaussians, device: str) -> dict[str, Any]:
        """Of albedo and normals."""
        truth, layers = RelightableSet.open(self.folder), LayerRenderer.of(with_albedo(capture), device)
        seen: list[SeenView] = []
        for view in truth.views:
            found = layers.draw(view.camera)
            pairs = {name: (found[name], truth.layer(name, view)) for name in ("albedo", "normal")}
            seen.append(SeenView(view.name, truth.region(view), pairs, {}))
        scale = albedo_scale(seen)
        views = [measured(view, scale)[0] for view in seen]
        return {
            "albedo": round(float(np.mean([view.albedo_psnr for view in views])), 1),
            "albedo_as_it_is": round(float(np.mean([view.albedo_psnr_unscaled for view in views])), 1),
            "scale": [round(factor, 2) for factor in scale],
            "normals": [round(value, 1) for value in normal_figures(seen)],
        }


def delighted(
    capture: ls.Gaussians,
    device: str,
    *,
    truth: Truth | None = None,
    normals: FloatArray | None = None,
    power: bool = False,
) -> tuple[ls.Gaussians, Light]:
    """A room without its light as `estimate_materials` finds it, and the lamps.

    Args:
        capture: With captured colours.
        device: That traces.
        truth: Lamps are where it says; None: as found.
        normals: In place of those that are found.
        power: Whether lamps are as bright as the truth's, too.
    """
    capture = replace(capture, normals=normals)
    renderer = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.TRACE, lighting=False), device)
    rays, near = IncidentRays(capture, renderer, 0), neighbours_of(capture)
    facing, _ = rays.facing(estimate_normals(capture).astype(np.float64), near, True, known=normals is not None)
    white, outgoing = is_white(capture, facing), median_outgoing(capture, facing)
    groups = lamps_of(capture, white) if truth is None else truth.lamp_rows(capture, white)
    smoother, cells = Smoother.of(near, facing, groups), SkyCells.even(12)
    incident = smoother.incident(rays.incident(facing, groups, cells, lambda _label, _share: None))
    cells, incident = cells.of(np.empty(0, int)), replace(incident, sky=incident.sky[:, :0])
    pairs = albedo_pairs(near, np.flatnonzero(~white), PAIRS, np.random.default_rng([0, 5]))
    if truth is not None and power:
        light = Light(np.zeros((0, 3)), truth.radiances())
    else:
        light = AlikeAlbedos(outgoing, incident, pairs, cells).solved(first_light(outgoing, incident))
    irradiance = incident.total(light.sky, light.lamps)
    albedo = filled(outgoing / np.maximum(irradiance, RADIANCE_LEAST), irradiance, near)
    return painted(capture, albedo, facing), light


def painted(capture: ls.Gaussians, albedo: Doubles, normals: Doubles) -> ls.Gaussians:
    """A capture with matt materials."""
    return replace(
        capture,
        albedo=albedo_in_range(albedo).astype(np.float32),
        normals=normals.astype(np.float32),
        roughness=np.ones(capture.count, np.float32),
    )


def known_shape(truth: Truth, capture: ls.Gaussians | None, device: str) -> ls.Gaussians:
    """Gaussians on the true surfaces in the colours of photographs, or of what a capture shows by their cameras."""
    room = ls.merge(
        [replace(truth.room, albedo=None, roughness=None, metallic=None, normals=None), *lamps(truth.folder)]
    )
    views = load_photographs(truth.folder).training
    colors = np.full((len(views), room.count, 3), np.nan)
    for colored, view in zip(colors, views, strict=True):
        camera = view.camera
        shown = view.pixels() if capture is None else ls.render(ls.Scene([capture]), camera, device=device).color
        at = room.means @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
        depth = np.maximum(at[:, 2], 1e-3)
        x = np.floor(camera.fx * at[:, 0] / depth + camera.cx).astype(int)
        y = np.floor(camera.fy * at[:, 1] / depth + camera.cy).astype(int)
        rows = np.flatnonzero((at[:, 2] > 0.1) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height))
        surface = ls.render(ls.Scene([room]), camera, device=device).depth
        rows = rows[np.abs(surface[y[rows], x[rows]] - np.linalg.norm(at[rows], axis=1)) < SEEN_WITHIN]
        colored[rows] = np.clip(shown[y[rows], x[rows], :3], 0.0, 1.0)
    seen = np.flatnonzero(~np.isnan(colors[..., 0]).all(axis=0))
    medians = np.nanmedian(colors[:, seen], axis=0)
    nearest = cKDTree(room.means[seen]).query(room.means)[1]
    return replace(room, sh=((medians[nearest] - 0.5) / SH_C0)[:, None].astype(np.float32))


def rows_of(truth: Truth, capture: ls.Gaussians, device: str) -> Iterator[Row]:
    """All of the table, one after the other."""
    assert truth.room.albedo is not None and truth.room.normals is not None
    distance, nearest = truth.nearest(capture)
    true_normals, true_albedo = truth.room.normals[nearest], truth.room.albedo[nearest].astype(np.float64)
    exact = true_normals.astype(np.float64)
    found, light = delighted(capture, device)
    facing = np.asarray(found.normals, np.float64)
    yield "nothing", found, light, True
    yield "captured colours as albedo", painted(capture, median_outgoing(capture, facing), facing), None, False
    yield "normals", *delighted(capture, device, normals=true_normals), False
    yield "where lamps are", *delighted(capture, device, truth=truth), False
    yield "lamps", *delighted(capture, device, truth=truth, power=True), False
    yield "lamps, normals", *delighted(capture, device, truth=truth, power=True, normals=true_normals), True
    irradiance = truth.irradiance[nearest]
    without = median_outgoing(capture, facing) / np.maximum(irradiance, RADIANCE_LEAST)
    yield "all light", painted(capture, without, facing), None, False
    yield "albedo", painted(capture, true_albedo, facing), None, False
    yield "albedo, normals", painted(capture, true_albedo, exact), None, True
    yield "colours alike from all sides", *delighted(ls.editing.limit_sh_degree(capture, 0), device), False
    close = np.flatnonzero(distance < NEAR)
    some = capture.subset(close)
    yield f"without {1.0 - len(close) / capture.count:.0%} that float", *delighted(some, device), False
    yield (
        "the same, lamps, normals",
        *delighted(some, device, truth=truth, power=True, normals=true_normals[close]),
        False,
    )
    yield (
        "the same, albedo, normals",
        painted(some, true_albedo[close], exact[close]),
        None,
        False,
    )
    yield "shape", *delighted(known_shape(truth, capture, device), device), True
    yield "shape, colours of photographs", *delighted(known_shape(truth, None, device), device), False


def main() -> None:
    """Measures them."""
    given = parser("room_causes", __doc__)
    given.add_argument("set", type=Path, help="of tools/make_relightable_room.py")
    given.add_argument("capture", type=Path, help="trained on it")
    given.add_argument("--relit", action="store_true", help="relight some, by 16 paths a pixel")
    options = given.parse_args()
    quiet_warp()
    truth, trained = Truth.of(options.set), ls.load(options.capture)
    assert isinstance(trained, ls.Gaussians)
    bare = replace(trained, albedo=None, normals=None, roughness=None, metallic=None)
    for name, found, light, relit in rows_of(truth, bare, options.device):
        figures = {"true": name, "gaussians": found.count, **truth.figures(found, options.device)}
        if light is not None:
            figures["lamps"] = [round(float(lamp.mean()), 1) for lamp in light.lamps]
        if relit and options.relit:
            result = ls.inverse.evaluate_materials(found, options.set, samples=16, device=options.device)
            figures["relit"] = {key: [round(value, 3) for value in values] for key, values in result.relit.items()}
        print(json.dumps(figures), flush=True)


if __name__ == "__main__":
    main()
