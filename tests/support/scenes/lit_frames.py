"""Makes a lit frame by formula, without a renderer: a white ball on a captured floor, with every optional layer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lumisplat.config import RenderConfig, ToneMap
from lumisplat.frame.frame import Frame
from lumisplat.math.color import decode_srgb
from lumisplat.math.tone_map import captured_radiance
from lumisplat.scene.camera import Camera
from lumisplat.scene.ops.views import world_rays

LIGHTS = {"key": (np.array([2.0, 3.0, 1.0]), 60.0), "": (np.array([-4.0, 2.0, 2.0]), 12.0)}
"""Position and intensity in candela of each light, by name."""
BALL, RADIUS = np.array([0.0, 1.0, 6.0]), 1.0


def ball_frame(
    width: int = 48,
    height: int = 27,
    background: tuple[float, float, float] | None = (0.25, 0.5, 0.75),
    tone_map: ToneMap = ToneMap.NONE,
    exposure: float = 0.0,
) -> Frame:
    """Makes the frame of a ball on the floor y = 0; a captured veil covers half of the ball.

    Pixels above the floor are empty.
    """
    camera = Camera.look_at((0.0, 2.0, 0.0), (0.0, 1.0, 6.0), width=width, height=height)
    camera = replace(camera, exposure=exposure)
    origins, directions = world_rays(camera)
    to_ball = _ball_distance(origins, directions)
    to_floor = np.where(directions[..., 1] < -1e-6, -2.0 / np.minimum(directions[..., 1], -1e-6), np.inf)
    to_floor[to_floor > 14.0] = np.inf
    depth = np.minimum(to_ball, to_floor)
    ball, floor = np.isfinite(to_ball), (to_floor < to_ball) & np.isfinite(to_floor)
    point = origins + np.where(np.isfinite(depth), depth, 0.0)[..., None] * directions
    normal = np.where(ball[..., None], (point - BALL) / RADIUS, np.where(floor[..., None], (0.0, 1.0, 0.0), 0.0))

    veil = 0.5 * (ball & (point[..., 0] < 0.0))
    tiles = 0.5 + 0.3 * np.sign(np.sin(3.0 * point[..., :1]) * np.sin(3.0 * point[..., 2:]))
    alpha = (ball | floor).astype(np.float32)
    own = np.where(floor[..., None], tiles * (0.9, 0.7, 0.5), 0.0) + veil[..., None] * (0.3, 0.6, 0.4)
    own_weight = floor + veil
    under = np.zeros(3) if background is None else np.array(background)
    captured = own + (1.0 - alpha)[..., None] * under
    weight = own_weight + (0.0 if background is None else 1.0 - alpha)

    albedo = np.where(ball[..., None], (0.8, 0.8, 0.8), decode_srgb(own))
    direct, shadow = [], []
    for position, candela in LIGHTS.values():
        to_light = position - point
        distance = np.linalg.norm(to_light, axis=-1, keepdims=True)
        cosine = np.maximum((normal * to_light / distance).sum(axis=-1, keepdims=True), 0.0)
        direct.append((1.0 - veil)[..., None] * albedo / np.pi * cosine * candela / distance**2)
        blocked = np.isfinite(_ball_distance(point, to_light / distance)) & floor
        shadow.append(np.where(blocked, 0.0, 1.0)[..., None] * np.ones(3))
    # Each light has a limited reach, so that its light is exactly 0 on part of the floor.
    reach = [np.linalg.norm(point, axis=-1) < 8.0, ball]
    direct = [part * (inside & (ball | floor))[..., None] for part, inside in zip(direct, reach, strict=True)]
    light = sum(d * s for d, s in zip(direct, shadow, strict=True))

    images = {"captured": captured, "captured_weight": weight, "light": light, "albedo": albedo}
    images |= {"emission": captured_radiance(own, own_weight), "reflection": 0.1 * ball[..., None] * np.ones(3)}
    images |= {"hits": np.where(floor, 4.0 * depth, np.where(veil > 0.0, 3.0, 0.0)), "depth": depth, "normal": normal}
    images |= {"light_direct": np.stack(direct), "light_shadow": np.stack(shadow), "alpha": alpha}
    images["color"] = captured_radiance(captured, weight) + light
    images["variance"] = 0.01 * images["color"] ** 2
    images = {name: np.asarray(image, np.float32) for name, image in images.items()}
    frame = Frame(
        color=images["color"],
        alpha=images["alpha"],
        depth=images["depth"],
        normal=images["normal"],
        gaussian_index=np.where(floor, (point[..., 0] * 8).astype(int) % 97, -1).astype(np.int32),
        instance_index=np.where(ball, 1, np.where(floor, 0, -1)).astype(np.int32),
        camera=camera,
        color_space="linear",
        background=background,
        samples=1,
        config=RenderConfig(background=background, tone_map=tone_map),
        light_names=tuple(LIGHTS),
        sample_count=np.where(ball, 9, 4).astype(np.int32),
    )
    return replace(frame, **images)


def unlit(frame: Frame) -> Frame:
    """Returns the unlit frame of the same captures."""
    lit_only = dict.fromkeys(("captured", "captured_weight", "light"))
    return replace(frame, color=frame.captured, color_space="srgb", **lit_only)


def _ball_distance(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Returns the distance at which rays enter the ball, inf where they miss."""
    offset = BALL - origins
    middle = (offset * directions).sum(axis=-1)
    inside = middle**2 - (offset**2).sum(axis=-1) + RADIUS**2
    return np.where((inside > 0.0) & (middle > 0.0), middle - np.sqrt(np.maximum(inside, 0.0)), np.inf)
