"""OpenUSD cameras, compared with the library's own frustum."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.errors import FormatError
from support.files.usd_files import usd_core, write_usda

LENS = """float focalLength = 50
        float horizontalAperture = 40
        float verticalAperture = 20
        float2 clippingRange = (0.5, 100)
        double3 xformOp:translate = (1, 2, 3)
        uniform token[] xformOpOrder = ["xformOp:translate"]"""


def cameras(path: Path, inputs: str, head: str = 'upAxis = "Y"', **size: int) -> list[ls.Camera]:
    """Writes a stage with one camera of these inputs, and returns its cameras."""
    return ls.load_cameras(write_usda(path / "a.usda", f'def Camera "view" {{\n{inputs}\n}}', head), **size)


def test_usd_apertures_set_field_of_view_and_image_size(tmp_path: Path) -> None:
    """Apertures of 40 x 20 at focal length 50: tan(fov_y / 2) = 0.2, and the largest size within 1280 x 720."""
    (camera,) = cameras(tmp_path, LENS)
    assert (camera.width, camera.height, camera.name, camera.near) == (1280, 640, "view", 0.5)
    assert camera.fov_y == pytest.approx(2.0 * math.atan(0.2)) and camera.fx == pytest.approx(camera.fy)
    np.testing.assert_allclose(camera.eye, (1, 2, 3))
    np.testing.assert_allclose(camera.camera_from_world[:3, :3], np.diag([1.0, -1.0, -1.0]), atol=1e-12)
    (small,) = cameras(tmp_path, LENS, width=320)
    assert (small.width, small.height) == (320, 160) and small.fov_y == pytest.approx(camera.fov_y)


def test_usd_render_product_sets_the_image_size_of_its_camera(tmp_path: Path) -> None:
    """Aperture offsets move the principal point in the opposite direction."""
    shifted = f"{LENS}\nfloat horizontalApertureOffset = 4\nfloat verticalApertureOffset = 2"
    body = f"""def Camera "view" {{
        {shifted}
    }}
    def RenderProduct "picture" {{
        rel camera = </view>
        uniform int2 resolution = (400, 200)
    }}"""
    (camera,) = ls.load_cameras(write_usda(tmp_path / "a.usda", body))
    assert (camera.width, camera.height) == (400, 200)
    assert (camera.cx, camera.cy) == pytest.approx((200.0 - 40.0, 100.0 + 20.0))


def test_written_usd_cameras_match_the_frustum_of_usd_core(tmp_path: Path) -> None:
    """The image corners project to the corners of the library's frustum."""
    usd_core()
    camera = replace(
        ls.Camera.look_at((3, 2, 1), (0, 0.5, 0), width=400, height=300, fov_y=0.7, name="c"),
        fx=333.0,
        cx=150.0,
        cy=170.0,
    )
    ls.save(tmp_path / "a.usdc", ls.Scene(up="y-up"), cameras=[camera])
    stage = usd_core().Stage.Open(str(tmp_path / "a.usdc"))
    frustum = usd_core("UsdGeom").Camera(stage.GetPrimAtPath("/World/c")).GetCamera(0).frustum
    near = np.array(frustum.ComputeCorners()).reshape(8, 3)[:4]  # left bottom, right bottom, left top, right top
    inside = camera.camera_from_world @ np.concatenate([near, np.ones((4, 1))], axis=1).T
    u = camera.fx * inside[0] / inside[2] + camera.cx
    v = camera.fy * inside[1] / inside[2] + camera.cy
    np.testing.assert_allclose(np.stack([u, v], axis=1), [(0, 300), (400, 300), (0, 0), (400, 0)], atol=1e-3)


def test_usd_f_stop_focus_and_exposure_set_the_lens(tmp_path: Path) -> None:
    """Focal length 0.5 (tenths of a metre) at f-stop 2.5 is an aperture radius of 0.01 m; exposures add up."""
    thin = """float focalLength = 0.5
        float fStop = 2.5
        float focusDistance = 4
        float exposure = 1
        float exposure:iso = 400"""
    (camera,) = cameras(tmp_path, thin, 'upAxis = "Y"\nmetersPerUnit = 1')
    assert camera.aperture == pytest.approx(0.01) and camera.focus_distance == 4.0
    assert camera.exposure == pytest.approx(3.0)


def test_orthographic_usd_apertures_are_tenths_of_a_stage_unit(tmp_path: Path) -> None:
    """A stage in centimetres has apertures in millimetres."""
    (camera,) = cameras(tmp_path, f'{LENS}\ntoken projection = "orthographic"', 'upAxis = "Y"\nmetersPerUnit = 0.01')
    assert camera.model is ls.CameraModel.ORTHOGRAPHIC
    assert camera.width / camera.fx == pytest.approx(4.0 * 0.01) and camera.height / camera.fy == pytest.approx(0.02)


@pytest.mark.parametrize(
    "camera",
    [
        ls.Camera.look_at((3, 2, 1), (0, 0, 0), width=640, height=360, name="lens", aperture=0.05, focus_distance=3.0),
        ls.Camera.look_at((3, 2, 1), (0, 0, 0), width=641, height=359, name="flat", model="orthographic"),
        replace(
            ls.Camera.look_at((1, 2, 1), (0, 0, 0), width=64, height=48, name="odd"), fx=30.0, cx=5.0, exposure=-1.5
        ),
    ],
)
def test_usd_round_trip_keeps_cameras(tmp_path: Path, camera: ls.Camera) -> None:
    """Poses are exact; focal lengths are exact to 1e-7, because apertures are float32."""
    usd_core()
    ls.save(tmp_path / "a.usda", ls.Scene(up="y-up"), cameras=[camera, camera])
    first, second = ls.load_cameras(tmp_path / "a.usda")
    assert first.name == camera.name != second.name
    np.testing.assert_allclose(first.camera_from_world, camera.camera_from_world, atol=1e-12)
    for name in ("width", "height", "model", "near", "exposure"):
        assert getattr(first, name) == getattr(camera, name), name
    for name in ("fx", "fy", "cx", "cy", "aperture", "focus_distance"):
        assert getattr(first, name) == pytest.approx(getattr(camera, name), rel=2e-7), name


def test_error_for_an_invalid_usd_camera_names_the_camera(tmp_path: Path) -> None:
    """Errors are a camera without an aperture width, and an unknown projection."""
    with pytest.raises(FormatError, match=r"/view: horizontalAperture is 0, expected a length above 0"):
        cameras(tmp_path, "float horizontalAperture = 0")
    with pytest.raises(FormatError, match="projection is 'wide', expected perspective or orthographic"):
        cameras(tmp_path, 'token projection = "wide"')


def test_fisheyes_and_distortion_are_logged_as_lost_in_usd(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A fisheye is left out; a distorted camera is written without distortion."""
    usd_core()
    wide = ls.Camera.look_at((3, 2, 1), (0, 0, 0), name="wide", model="fisheye")
    bent = replace(ls.Camera.look_at((3, 2, 1), (0, 0, 0), name="bent"), distortion=(0.1, 0, 0, 0, 0, 0))
    ls.save(tmp_path / "a.usda", ls.Scene(), cameras=[wide, bent])
    assert [camera.name for camera in ls.load_cameras(tmp_path / "a.usda")] == ["bent"]
    assert "fisheye cameras (wide); lens distortion (bent)" in caplog.text
