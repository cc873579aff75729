"""Tests ``lumisplat shadowmap``: captures with shadows, maps as files, and mistakes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from support.files.cli_files import Workspace

LIGHT = "0,0,-6"


@pytest.fixture
def work(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Workspace:
    """Returns a folder with a capture around z = 4 and a small mesh before it."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    workspace = Workspace(tmp_path, capsys)
    (tmp_path / "mesh.obj").write_text("v -0.3 -0.3 1\nv 0.3 -0.3 1\nv 0 0.3 1\nf 1 2 3\n")
    return workspace


def run(work: Workspace, *args: str) -> tuple[int, str, str]:
    """Casts the mesh's shadow onto the capture."""
    outcome = work.run(
        "shadowmap", "@mesh.obj", "--onto", "@capture.ply", "--keep-coordinates", "--device", "cpu", *args
    )
    return outcome.status, outcome.out, outcome.err


def test_shadowmap_saves_a_capture_with_shadows(work: Workspace) -> None:
    """Gaussians behind the mesh are darker and others unchanged; the meshes that cast shadows are not saved."""
    status, out, err = run(work, "--light", LIGHT, "--direct", "1", "-o", "@dark.ply")
    assert (status, err) == (0, "")
    before, after = ls.load(work.path("capture.ply")), ls.load(work.path("dark.ply"))
    assert isinstance(before, ls.Gaussians) and isinstance(after, ls.Gaussians)
    shadow = ls.DeepShadowMap.build(ls.load(work.path("mesh.obj")), (0, 0, -6), before, device="cpu")
    light = shadow.transmittance_of(before)
    assert 0 < (light < 0.5).sum() < before.count
    expected = ls.avatars.shadowed(before, [ls.LightPoint((0, 0, -6))], light[None], 1.0)
    np.testing.assert_array_equal(after.sh, expected.sh)
    np.testing.assert_array_equal(after.sh[light == 1.0], before.sh[light == 1.0])
    assert f"{(light < 1.0).sum()} of {before.count} Gaussians are in shadow" in out


def test_shadowmap_saves_a_shadow_map_as_npz(work: Workspace) -> None:
    """The .npz equals the library's shadow map with the same settings."""
    status, out, err = run(work, "--sun", "0,0,1", "--resolution", "128", "--strength", "2", "-o", "@sun.npz")
    assert (status, err) == (0, "")
    assert "bins of" in out
    shadow = ls.DeepShadowMap.load(work.path("sun.npz"), device="cpu")
    assert (shadow.config.resolution, shadow.config.strength) == (128, 2.0)
    capture = ls.load(work.path("capture.ply"))
    assert isinstance(capture, ls.Gaussians)
    assert shadow.transmittance_of(capture).min() < 0.5


def test_shadowmap_with_drop_invalid_leaves_out_invalid_gaussians(work: Workspace) -> None:
    """The option, which the refusal names, works for the capture and for casters."""
    data = bytearray(work.path("capture.ply").read_bytes())
    data[-4:] = np.float32(np.nan).tobytes()
    work.path("nan.ply").write_bytes(data)
    args = ("shadowmap", "@nan.ply", "--onto", "@nan.ply", "--light", LIGHT, "-o", "@dark.ply", "--device", "cpu")
    refused = work.run(*args)
    assert refused.status == 2 and "--drop-invalid" in refused.err
    assert work.run(*args, "--drop-invalid").status == 0
    dark = ls.load(work.path("dark.ply"))
    assert isinstance(dark, ls.Gaussians) and dark.count == 59


@pytest.mark.parametrize(
    ("args", "problem"),
    [
        (("--light", "1,2", "-o", "@a.ply"), "--light is '1,2'"),
        (("--light", "nan,2,3", "-o", "@a.ply"), "--light is 'nan,2,3', expected finite numbers"),
        (("--sun", "0,0,inf", "-o", "@a.ply"), "--sun is '0,0,inf', expected finite numbers"),
        (("--sun", "0,0,0", "-o", "@a.ply"), "needs a direction or a target"),
        (("--sun", "0,0,1", "--light", LIGHT, "-o", "@a.ply"), "choose one"),
        (
            ("--light", LIGHT, "-o", "@a.png"),
            "a.png: expected .ply, .compressed.ply, .spz, or .npz for the map; images",
        ),
        (("--light", LIGHT, "-o", "@a.ply", "--cameras", "@cameras.json"), "--cameras writes images, expected .png"),
        (("--light", LIGHT, "-o", "@a.png", "--cameras", "@cameras.json"), "2 images do not fit into one file"),
        (("--light", LIGHT, "-o", "@a", "--cameras", "@cameras.json", "--direct", "1"), "--direct needs a capture"),
        (("--light", LIGHT, "--light", "0,0,9", "-o", "@a.npz"), "a map needs one light, got 2"),
        (("--light", LIGHT, "--direct", "0.5", "-o", "@a.npz"), "--direct needs a capture as output"),
        (("--light", LIGHT, "--resolution", "100", "-o", "@a.ply"), "resolution is 100"),
        (("--light", LIGHT, "--onto", "@mesh.obj", "-o", "@a.ply"), "mesh.obj: is not a capture"),
    ],
)
def test_shadowmap_command_reports_mistakes_of_the_user_in_one_line(
    work: Workspace, args: tuple[str, ...], problem: str
) -> None:
    """Each mistake ends with status 2, and leaves no file."""
    before = work.files()
    status, out, err = run(work, *args)
    assert (status, out) == (2, "")
    assert problem in err and err.count("\n") == 1
    assert work.files() == before


def test_shadow_casters_of_a_scene_file_have_the_up_direction_of_the_capture(work: Workspace) -> None:
    """An up direction stated in the scene file has precedence; a line reports which is used."""
    (work.folder / "up.obj").write_text("v -0.3 0 1\nv 0.3 0 1\nv 0 2 1\nf 1 2 3\n")
    entry = '[[meshes]]\npath = "up.obj"\nupright = true\n'
    shadows: dict[str, np.ndarray] = {}
    for name, up_line, line in (
        ("own", "", "up is y-down, as in the capture"),
        ("down", 'up = "y-down"\n', "up is y-down, as in the capture"),
        ("up", 'up = "y-up"\n', "up is y-up, as their scene.toml says"),
        ("tilted", "up = [0, -3, 4]\n", "up is 0,-0.6,0.8, as their scene.toml says"),
    ):
        work.path(f"{name}.toml").write_text(up_line + entry)
        args = ("shadowmap", f"@{name}.toml", "--onto", "@capture.ply", "--light", LIGHT, "--device", "cpu")
        outcome = work.run(*args, "-o", f"@{name}.ply")
        assert outcome.status == 0, outcome.err
        assert f"casters: {line}\n" in outcome.out
        shadows[name] = work.capture(f"{name}.ply").sh
    np.testing.assert_array_equal(shadows["own"], shadows["down"])
    assert (shadows["own"] != shadows["up"]).any()


def test_shadowmap_places_casting_meshes_on_the_ground_of_the_capture(
    work: Workspace, caplog: pytest.LogCaptureFixture
) -> None:
    """``--keep-coordinates`` leaves the meshes at the coordinates of their file."""
    args = ("shadowmap", "@mesh.obj", "--onto", "@capture.ply", "--light", LIGHT, "--device", "cpu")
    put = work.run(*args, "-o", "@put.ply")
    assert put.status == 0 and "mesh.obj has no position: it stands upright on the ground" in caplog.text
    caplog.clear()
    unmoved = work.run(*args, "--keep-coordinates", "-o", "@kept.ply")
    assert unmoved.status == 0 and not caplog.text
    capture = work.capture("capture.ply")
    placed = ls.insert(ls.Scene([capture]), ls.load(work.path("mesh.obj")))  # pyright: ignore[reportArgumentType]
    lighter = ls.AvatarLighter(
        ls.Scene([capture]), [ls.LightPoint((0, 0, -6))], ls.config.AvatarLightingConfig(relight=False), device="cpu"
    )
    expected = lighter.light(list(placed.meshes)).splats[0].gaussians
    np.testing.assert_array_equal(work.capture("put.ply").sh, expected.sh)
    assert (work.capture("put.ply").sh != work.capture("kept.ply").sh).any()


def test_shadowmap_with_cameras_writes_images_of_shadow_strength_for_the_shadow_metrics(work: Workspace) -> None:
    """A pixel is 1 - T blended over the Gaussians that it shows, whatever their colours; casters are not shown."""
    status, out, err = run(work, "--light", LIGHT, "--cameras", "@cameras.json", "-o", "@strength")
    assert (status, err) == (0, "") and "shadow strength in 2 images" in out
    capture, camera = work.capture("capture.ply"), ls.load_cameras(work.path("cameras.json"))[0]
    shadow = ls.DeepShadowMap.build(ls.load(work.path("mesh.obj")), (0, 0, -6), capture, device="cpu")
    strength = (1.0 - shadow.transmittance_of(capture)).astype(np.float64)
    sh = np.repeat(((strength - 0.5) * 2.0 * np.sqrt(np.pi))[:, None, None], 3, axis=2)
    shades = replace(capture, sh=sh.astype(np.float32))
    expected = ls.render(ls.Scene([ls.SplatInstance(shades)]), camera, device="cpu").pixels_srgb()
    written = ls.load_image(work.path("strength/left.png"))
    assert expected.max() > 0.5
    np.testing.assert_allclose(written, expected, atol=1.01 / 255)
    same = work.run("metrics", "@strength/left.png", "@strength/right.png", "--metrics", "sae,sm-iou,bf", "--json")
    figures = json.loads(same.out)["mean"]
    assert figures == {"sae": 0.0, "sm-iou": 1.0, "bf": 1.0}
