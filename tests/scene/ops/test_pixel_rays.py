"""World-space pixel rays equal those of the ray tracer, and their hit positions lie on surfaces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lumisplat.scene.camera import Camera, CameraModel
from lumisplat.scene.ops.views import world_rays
from support.oracles.camera_oracle import camera_rays
from support.scenes.lit_frames import BALL, RADIUS, ball_frame


def camera(model: CameraModel = CameraModel.PINHOLE, **changes: object) -> Camera:
    """Returns a camera with an oblique view and an off-centre principal point."""
    base = Camera.look_at((1.0, -2.0, 3.0), (0.5, 0.4, 8.0), (0.1, 1.0, 0.2), width=12, height=9, model=model)
    return replace(base, cx=4.5, cy=5.25, **changes)


def shuttered(model: CameraModel) -> Camera:
    """Returns a camera that rotates and moves while its rows are exposed."""
    end = camera(model).camera_from_world @ Camera.look_at((0.3, 0.0, 0.1), (1.0, 0.2, 3.0)).camera_from_world
    return camera(model, camera_from_world_end=end)


@pytest.mark.parametrize("model", list(CameraModel))
@pytest.mark.parametrize("moving", [False, True])
def test_world_space_pixel_rays_equal_the_rays_of_the_ray_tracer(model: CameraModel, moving: bool) -> None:
    """The oracle of the ray tracer covers all camera models, and a rolling shutter with one pose per row."""
    view = shuttered(model) if moving else camera(model)
    origins, directions, _ = camera_rays(view, jitter=False)
    found = world_rays(view)
    seen = np.isfinite(directions).all(axis=2)
    np.testing.assert_allclose(found[0][seen], origins[seen], atol=1e-9)
    np.testing.assert_allclose(found[1][seen], directions[seen], atol=1e-9)
    if moving:
        assert np.abs(found[1] - world_rays(camera(model))[1]).max() > 0.1


def test_fisheye_pixels_more_than_180_degrees_off_axis_have_no_direction() -> None:
    """Pixels more than 180 degrees off the axis have direction zero."""
    view = camera(CameraModel.FISHEYE, fx=1.5, fy=1.5)
    blind = ~view.ray_directions().any(axis=2)
    assert blind.any() and not blind.all()
    assert not world_rays(view)[1][blind].any()


def test_position_layer_of_a_frame_lies_on_the_visible_surfaces() -> None:
    """Positions lie on the ball or on the floor, and are zero where nothing is visible."""
    frame = ball_frame()
    position = frame.position
    assert position.dtype == np.float32
    ball, floor = frame.instance_index == 1, frame.instance_index == 0
    np.testing.assert_allclose(np.linalg.norm(position[ball] - BALL, axis=1), RADIUS, atol=1e-5)
    np.testing.assert_allclose(position[floor][:, 1], 0.0, atol=1e-5)
    assert not position[~ball & ~floor].any() and (~ball & ~floor).any()
