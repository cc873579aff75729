"""`evaluate_materials` accepts data sets lit by local lights, and its relit images have little noise by default."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.io.images.texture import write_png
from lumisplat.relighting.evaluation import over_black, relit_scene
from support.files.relightable_files import painted_ball, panorama, write_radiance, write_relightable_set

LIGHTS_TOML = """
[[lights]]
type = "rect"
position = [0.0, 3.0, 0.0]
edge_u = [1.0, 0.0, 0.0]
edge_v = [0.0, 0.0, 1.0]
intensity = 8.0

[[lights]]
type = "sphere"
position = [2.0, 0.5, 3.0]
color = [1.0, 0.6, 0.3]
intensity = 20.0
radius = 0.2
"""
LIGHTS = (
    ls.LightRect((0.0, 3.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), intensity=8.0),
    ls.LightSphere((2.0, 0.5, 3.0), color=(1.0, 0.6, 0.3), intensity=20.0, radius=0.2),
)
HYBRID = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, shadows=ls.Shadows.SOFT)
PATH = ls.RenderConfig(pipeline=ls.Pipeline.PATH)


@pytest.fixture(scope="module")
def ball() -> ls.Gaussians:
    """Returns a capture with albedo, roughness and normals."""
    return painted_ball()


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, ball: ls.Gaussians) -> Path:
    """Writes a data set lit by local lights, with the capture as ground truth, and returns its folder."""
    folder = write_relightable_set(tmp_path_factory.mktemp("sets") / "set", ball)
    (folder / "relit" / "dusk.exr").unlink()
    (folder / "environment.exr").rename(folder / "lamps.toml")
    (folder / "relit" / "dusk.toml").write_text(LIGHTS_TOML)
    render_truth(
        folder, ball, LIGHTS, replace(PATH, samples=64, jitter=False)
    )  # through pixel centres, as captures are relit
    return folder


@pytest.fixture
def folder(tmp_path: Path, made: Path) -> Path:
    """Returns a copy of the data set that a test may change."""
    return shutil.copytree(made, tmp_path / "set")


def render_truth(folder: Path, ball: ls.Gaussians, lights: tuple, config: ls.RenderConfig) -> None:
    """Renders the ground-truth images of the light "dusk" into the data set."""
    renderer = ls.create_renderer(replace(config, background=None), "cpu")
    scene = relit_scene(ball, lights, (1.0, 1.0, 1.0), 0.5)
    for view in ls.io.load_training_images(folder).held_out:
        write_png(folder / "relit" / "dusk" / f"{view.name}.png", over_black(renderer, scene, view.camera))


def relit(result: ls.inverse.MaterialEvaluation) -> np.ndarray:
    """Returns the capture's relit images of all views under the light "dusk", shape (views, H, W, 3)."""
    return np.stack([view.pictures["relit/dusk"][0] for view in result.views])


def test_material_evaluation_relights_the_capture_by_the_lights_of_a_scene_file(folder, ball):
    """By default, 64 paths per pixel reach 55 dB; a moved light lowers the result below 30 dB."""
    assert ls.inverse.evaluate_materials(ball, folder, device="cpu").relit["dusk"].psnr > 55.0
    direct = ls.inverse.evaluate_materials(ball, folder, config=HYBRID, samples=4, device="cpu")
    assert 20.0 < direct.relit["dusk"].psnr < 55.0
    (folder / "relit" / "dusk.toml").write_text(LIGHTS_TOML.replace("[2.0, 0.5, 3.0]", "[-2.0, 0.5, -3.0]"))
    assert ls.inverse.evaluate_materials(ball, folder, samples=4, device="cpu").relit["dusk"].psnr < 30.0


def test_material_evaluation_compares_no_environment_for_scenes_with_local_lights(folder, ball):
    """A remark gives the reason, and all other metrics are computed."""
    result = ls.inverse.evaluate_materials(ball, folder, environment=panorama(), samples=1, device="cpu")
    assert np.isnan(result.environment_psnr) and result.albedo_psnr > 100.0
    assert result.remarks == (f"the estimated environment is not compared: local lights lit the images of {folder}",)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ('[[splats]]\npath = "ball.ply"\n', "is named in a light file of a data set, expected"),
        ("[[lights]]\ntype = 'rect'\n", "dusk.toml"),
        ("", "dusk.toml"),
    ],
)
def test_material_evaluation_refuses_a_light_file_that_has_more_than_lights(folder, ball, text, problem):
    """The message is one line that names the file."""
    ls.save(folder / "relit" / "ball.ply", ball)
    (folder / "relit" / "dusk.toml").write_text(text)
    with pytest.raises(ls.FormatError) as caught:
        ls.inverse.evaluate_materials(ball, folder, samples=1, device="cpu")
    assert problem in str(caught.value) and "\n" not in str(caught.value)


def test_masked_pixels_change_no_metric_of_the_material_evaluation(folder, ball):
    """Wrong pixels where a mask is black change no metric."""
    before = ls.inverse.evaluate_materials(ball, folder, samples=4, device="cpu")
    text = (folder / "transforms_test.json").read_text()
    for view in ls.io.load_training_images(folder).held_out:
        mask = np.ones((32, 32, 3), np.float32)
        mask[12:18, 10:20] = 0.0
        write_png(folder / "truth" / f"{view.name}.png", mask)
        line = f'"file_path": "./test/{view.name}"'
        assert line in text
        text = text.replace(line, f'{line}, "mask_path": "./truth/{view.name}.png"')
    (folder / "transforms_test.json").write_text(text)
    masked = ls.inverse.evaluate_materials(ball, folder, samples=4, device="cpu")
    assert 0.0 < masked.views[0].coverage < before.views[0].coverage
    for view in masked.views:
        assert not view.region[12:18, 10:20].any()
        path = folder / "relit" / "dusk" / f"{view.name}.png"
        image = ls.load_image(path).copy()
        image[12:18, 10:20] = 1.0
        write_png(path, image)
    assert (
        ls.inverse.evaluate_materials(ball, folder, samples=4, device="cpu").relit["dusk"].psnr
        == masked.relit["dusk"].psnr
    )


def test_default_samples_of_relit_images_raise_their_psnr_by_6_db_over_few_samples(folder, ball):
    """With three small lights in a dark environment, 64 samples are the default, also for a config without samples."""
    file = np.full((16, 32, 3), 0.05, np.float32)
    file[4, 3], file[6, 17], file[3, 25] = 60.0, 40.0, 50.0
    (folder / "relit" / "dusk.toml").unlink()
    write_radiance(folder / "relit" / "dusk.exr", file)
    render_truth(folder, ball, (ls.LightEnvironment(file, visible=False),), replace(HYBRID, samples=256))
    default = ls.inverse.evaluate_materials(ball, folder, device="cpu")
    few = ls.inverse.evaluate_materials(ball, folder, config=replace(HYBRID, samples=8), device="cpu")
    print("PSNR with 64 samples:", default.relit["dusk"].psnr, "dB; with 8:", few.relit["dusk"].psnr, "dB")
    assert default.relit["dusk"].psnr > few.relit["dusk"].psnr + 6.0, (
        "eight times as many samples reduce noise by less than 6 dB"
    )
    for config, samples in ((HYBRID, None), (replace(HYBRID, samples=8), 64)):
        same = ls.inverse.evaluate_materials(ball, folder, config=config, samples=samples, device="cpu")
        np.testing.assert_array_equal(relit(same), relit(default))
