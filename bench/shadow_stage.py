"""What deep shadow maps are measured on: a figure that walks past a wall under one lamp at a time.

The truth is that of Mir et al. 2026, section 4.2: shadow rays of the figure's own animated mesh, at each pixel's point
of the floor or the wall, to a lamp without extent. What is measured is a raster picture of the floor's and the wall's
Gaussians in shades of their shadow strength, 1 - T, without the figure.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

import lumisplat as ls
from bench.walker import write_walker

SIZE = 1.2
"""Metres a unit of the figure's file: 1.7 m tall."""
SOLES = 0.027
"""Height of its origin at which the lower foot stands on the floor, metres."""
SPEED = 1.2
"""Metres per second: feet stay about where they touch the floor."""
SPAN = 1.93
"""Two steps of each foot, seconds."""
LAMPS = ((1.4, 2.7, 2.4), (-2.2, 2.6, 1.6), (0.2, 2.9, 3.0))
"""Ceiling lamps, 2.6 to 2.9 m high and 2.5 to 3.5 m away, metres."""
RADIUS = 2.0
"""Pixels count whose points are this near to the figure's centre along both axes of the floor, metres (section 3.2)."""
LEFT, RIGHT, BACK, FRONT, TOP = -3.0, 3.0, -1.5, 2.0, 2.6
"""The floor, and the wall on its far side, metres, y up."""


@dataclass(frozen=True)
class Shot:
    """One moment under one lamp."""

    name: str
    casters: ls.SplatInstance
    lamp: np.ndarray
    truth: np.ndarray
    """Shadow strength of the mesh, 0 or 1, shape (H, W)."""
    region: np.ndarray
    """Pixels that are compared, shape (H, W)."""


@dataclass(frozen=True)
class Stage:
    """The figure's Gaussians and those of floor and wall, and the view of them."""

    casters: int = 100_000
    receivers: int = 400_000
    width: int = 1280
    height: int = 720
    device: str = "cpu"
    """Where its shadows and pictures are computed."""

    @cached_property
    def camera(self) -> ls.Camera:
        """From the front, above eye level."""
        return ls.Camera.look_at(
            (0.4, 2.6, 4.6), (0.0, 0.55, -0.5), (0.0, 1.0, 0.0), width=self.width, height=self.height, fov_y=0.75
        )

    @cached_property
    def scenery(self) -> ls.Gaussians:
        """Floor and wall."""
        return floor_and_wall(self.receivers)

    @cached_property
    def coarse_scenery(self) -> ls.Gaussians:
        """The same of fewer, wider Gaussians."""
        return floor_and_wall(self.receivers // 16)

    @cached_property
    def figure(self) -> ls.RiggedGaussians:
        """The one that walks, at rest."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "walker.glb"
            write_walker(path)
            return ls.bind_gaussians(ls.avatars.load_rig(path), self.casters)

    @cached_property
    def points(self) -> np.ndarray:
        """What pixels' centres show of floor and wall, NaN where neither, shape (H, W, 3)."""
        camera = self.camera
        world_from_camera = np.linalg.inv(camera.camera_from_world)
        x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
        y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
        grid = np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], axis=-1)
        eye, away = world_from_camera[:3, 3], grid @ world_from_camera[:3, :3].T
        with np.errstate(divide="ignore"):
            floor = eye - away * (eye[1] / away[..., 1:2])
            wall = eye + away * ((BACK - eye[2]) / away[..., 2:])
        on_floor = (floor[..., 2] >= BACK) & (floor[..., 2] < FRONT) & (away[..., 1] < 0.0)
        points = np.where(on_floor[..., None], floor, wall)
        seen = (points[..., 0] > LEFT) & (points[..., 0] < RIGHT) & (points[..., 1] < TOP) & (points[..., 1] > -1e-6)
        return np.where(seen[..., None], points, np.nan)

    def shots(self, frames: int) -> list[Shot]:
        """The walk, ``frames`` moments of it, each under the next lamp."""
        turned = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)  # It looks along z in its file, and walks along x.
        start, end = (-0.5 * SPEED * SPAN, SOLES, 0.0), (0.5 * SPEED * SPAN, SOLES, 0.0)
        path = ls.Keyframes([0.0, SPAN], [start, end], [turned, turned], [SIZE, SIZE])
        times = (np.arange(frames) + 0.5) / frames * SPAN
        return [
            self._shot(f"{number:02d}", time, path.at(time), np.array(LAMPS[number % len(LAMPS)]))
            for number, time in enumerate(times)
        ]

    def _shot(self, name: str, time: float, world_from_figure: np.ndarray, lamp: np.ndarray) -> Shot:
        rig = self.figure.rig
        clip_time = time % rig.duration()
        mesh = ls.MeshInstance(rig.pose(clip_time), world_from_figure)
        casters = ls.SplatInstance(self.figure.at(clip_time), world_from_figure)
        points = self.points.reshape(-1, 3)
        seen = np.isfinite(points[:, 0])
        offset = lamp - points[seen]
        truth = np.zeros(len(points), np.float32)
        distance = np.linalg.norm(offset, axis=1)
        truth[seen] = 1.0 - ls.transmittance(
            ls.Scene(meshes=[mesh]), points[seen], offset, distance, device=self.device
        )
        center = mesh.mesh.positions.mean(axis=0) @ world_from_figure[:3, :3].T + world_from_figure[:3, 3]
        near = np.abs(points - center)[:, [0, 2]].max(axis=1) <= RADIUS  # NaN is not.
        shape = (self.height, self.width)
        return Shot(name, casters, lamp, truth.reshape(shape), near.reshape(shape))

    def picture(
        self, scenery: ls.Gaussians, transmittance: np.ndarray, pipeline: ls.Pipeline = ls.Pipeline.RASTER
    ) -> np.ndarray:
        """Shadow strength as a pipeline shows it, shape (H, W)."""
        gray = ((0.5 - transmittance) * 2.0 * np.sqrt(np.pi))[:, None, None]  # Over Y_00, in degree 0.
        shaded = replace(scenery, sh=np.repeat(gray, 3, axis=2))
        config = ls.RenderConfig(pipeline=pipeline)
        return ls.render(ls.Scene(splats=[shaded]), self.camera, config, device=self.device).color[..., 0]


def floor_and_wall(count: int) -> ls.Gaussians:
    """So many Gaussians on the floor and the wall behind it."""
    floor = [[LEFT, 0.0, BACK], [LEFT, 0.0, FRONT], [RIGHT, 0.0, FRONT], [RIGHT, 0.0, BACK]]
    wall = [[LEFT, 0.0, BACK], [RIGHT, 0.0, BACK], [RIGHT, TOP, BACK], [LEFT, TOP, BACK]]
    quad = np.array([[0, 1, 2], [0, 2, 3]])
    return ls.gaussians_from_mesh(ls.Mesh(np.array(floor + wall), np.concatenate([quad, quad + 4])), count)
