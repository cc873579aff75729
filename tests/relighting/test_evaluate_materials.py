"""`evaluate_materials` measures known changes of a data set made from the capture itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.io.images.texture import write_png
from lumisplat.math.color import decode_srgb, encode_srgb
from support.files.relightable_files import (
    CONFIG,
    painted_ball,
    panorama,
    read_layer,
    write_layer,
    write_radiance,
    write_relightable_set,
)

NAMES = ("r_002", "r_003")


@pytest.fixture(scope="module")
def ball() -> ls.Gaussians:
    """Returns a capture with albedo, roughness and normals."""
    return painted_ball()


@pytest.fixture
def folder(tmp_path: Path, ball: ls.Gaussians) -> Path:
    """Returns the folder of a data set with the capture as ground truth."""
    return write_relightable_set(tmp_path / "set", ball)


def evaluate(ball: ls.Gaussians, folder: Path, environment: np.ndarray | None = None) -> ls.inverse.MaterialEvaluation:
    """Evaluates a capture against a data set on the CPU."""
    return ls.inverse.evaluate_materials(ball, folder, environment=environment, config=CONFIG, device="cpu")


def region(folder: Path, view: str) -> np.ndarray:
    """Returns the mask of pixels that the ball covers by at least half."""
    images = {image.name: image for image in ls.io.load_training_images(folder).held_out}
    alpha = images[view].alpha()
    assert alpha is not None
    return alpha >= 0.5


def test_material_evaluation_of_the_ground_truth_itself_has_no_error(folder, ball):
    """All metrics are perfect, and the result has one image for each layer and light of each view."""
    result = evaluate(ball, folder, panorama())
    np.testing.assert_allclose(result.albedo_scale, 1.0, atol=1e-6)
    assert result.albedo_psnr > 100.0 and result.albedo_psnr_unscaled > 100.0 and result.albedo_psnr_linear > 100.0
    assert result.normal_mean < 1e-3 and result.normal_median < 1e-3 and result.roughness_rmse < 1e-6
    assert result.environment_psnr > 100.0
    assert result.relit["dusk"].psnr > 55.0 and result.relit["dusk"].ssim > 0.999 and result.relit["dusk"].flip < 0.01
    assert result.remarks == () and [view.name for view in result.views] == list(NAMES)
    view = result.views[0]
    assert list(view.pictures) == ["albedo", "normal", "roughness", "relit/dusk"]
    inside = region(folder, view.name)
    assert view.coverage == pytest.approx(inside.mean()) and 0.1 < view.coverage < 0.9
    truth = encode_srgb(read_layer(folder, "albedo", view.name))
    np.testing.assert_allclose(view.pictures["albedo"][1][inside], truth[inside], atol=1e-6)
    assert not view.pictures["albedo"][0][~inside].any()
    assert "albedo_psnr=" in repr(result) and "dusk" in repr(result)


def test_relit_images_of_jittered_samples_match_the_ground_truth_with_over_55_db_psnr(folder, ball):
    """Samples average light, but their rays pass through pixel centres, as in training."""
    spread = replace(CONFIG, jitter=True)
    result = ls.inverse.evaluate_materials(ball, folder, config=spread, device="cpu")
    assert result.relit["dusk"].psnr > 55.0


def test_material_evaluation_jitters_rays_to_a_capture_only_if_it_is_antialiased(folder, ball):
    """Rays with a footprint pass through pixel centres; rays of antialiased captures have none and are jittered."""
    spread = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, samples=4)
    assert spread.jitter
    for capture, is_spread in ((ball, False), (replace(ball, antialiased=True), True)):
        by_default, central = (
            ls.inverse.evaluate_materials(capture, folder, config=config, device="cpu").relit["dusk"]
            for config in (spread, replace(spread, jitter=False))
        )
        assert (by_default != central) == is_spread


def test_material_evaluation_recovers_the_albedo_scale_of_each_channel(folder, ball):
    """One factor per channel is fitted to all views; the unscaled PSNR measures the error without factors, in sRGB."""
    factors = np.array([0.5, 0.9, 1.6])
    expected = []
    for view in NAMES:
        albedo, inside = read_layer(folder, "albedo", view), region(folder, view)
        write_layer(folder, "albedo", view, factors * albedo)
        difference = encode_srgb(factors * albedo[inside]) - encode_srgb(albedo[inside])
        expected.append(-10.0 * np.log10(np.mean(difference**2)))
    result = evaluate(ball, folder)
    np.testing.assert_allclose(result.albedo_scale, factors, rtol=1e-5)
    assert result.albedo_psnr > 90.0
    assert result.albedo_psnr_unscaled == pytest.approx(np.mean(expected), abs=1e-3)
    assert result.albedo_psnr_unscaled < 25.0
    assert result.relit["dusk"].psnr < 35.0, "the relit images use the unscaled albedo"


def test_material_evaluation_gives_the_expected_metrics_for_known_errors_of_layers(folder, ball):
    """Displayed albedo is off by 0.1 in one of two views, roughness by 0.1, relit images by 0.05."""
    inside = region(folder, NAMES[0])
    displayed = encode_srgb(read_layer(folder, "albedo", NAMES[0]))
    sign = np.where(np.random.default_rng(0).random(displayed.shape) < 0.5, -0.1, 0.1)
    write_layer(folder, "albedo", NAMES[0], decode_srgb(displayed + sign))
    for view in NAMES:
        write_layer(folder, "roughness", view, read_layer(folder, "roughness", view) + 0.1)
        path = folder / "relit" / "dusk" / f"{view}.png"
        write_png(path, np.clip(ls.load_image(path) + 0.05, 0.0, 1.0))
    result = evaluate(ball, folder)
    assert result.views[0].albedo_psnr_unscaled == pytest.approx(20.0, abs=0.01)
    assert result.views[1].albedo_psnr_unscaled > 100.0
    linear = result.views[0].pictures["albedo"]
    np.testing.assert_allclose(np.abs(linear[0] - linear[1])[inside].max(), 0.1, atol=0.03)
    assert result.roughness_rmse == pytest.approx(0.1, abs=1e-4)
    assert result.relit["dusk"].psnr == pytest.approx(-20.0 * np.log10(0.05), abs=0.3)


def test_normals_rotated_by_10_degrees_give_an_error_of_10_degrees(folder, ball):
    """Normals of one of two views are rotated; the mean over the views is weighted by their covered pixels."""
    normal = read_layer(folder, "normal", NAMES[0])
    side = np.cross(normal, (0.3, 0.5, 0.8))
    side /= np.maximum(np.linalg.norm(side, axis=-1, keepdims=True), 1e-6)
    write_layer(folder, "normal", NAMES[0], np.cos(np.radians(10.0)) * normal + np.sin(np.radians(10.0)) * side)
    result = evaluate(ball, folder)
    assert result.views[0].normal_mean == pytest.approx(10.0, abs=1e-2)
    assert result.views[0].normal_median == pytest.approx(10.0, abs=1e-2)
    counts = [region(folder, view).sum() for view in NAMES]
    assert result.normal_mean == pytest.approx(10.0 * counts[0] / sum(counts), abs=1e-2)


def test_pixels_outside_the_object_change_no_metric_of_the_material_evaluation(folder, ball):
    """Random values outside the object change nothing; random values inside it randomise all metrics."""
    before = evaluate(ball, folder)
    rng = np.random.default_rng(1)

    def randomise(where: np.ndarray, view: str) -> None:
        for name in ("albedo", "normal", "roughness"):
            layer = read_layer(folder, name, view)
            write_layer(folder, name, view, np.where(where[..., None], rng.random(layer.shape), layer))
        path = folder / "relit" / "dusk" / f"{view}.png"
        image = ls.load_image(path)
        write_png(path, np.where(where[..., None], rng.random(image.shape), image))

    for view in NAMES:
        randomise(~region(folder, view), view)
    after = evaluate(ball, folder)
    names = ("albedo_scale", "albedo_psnr", "normal_mean", "normal_median", "roughness_rmse")
    assert [getattr(after, name) for name in names] == [getattr(before, name) for name in names]
    assert after.relit["dusk"].psnr == before.relit["dusk"].psnr
    assert after.relit["dusk"].ssim == pytest.approx(
        before.relit["dusk"].ssim, abs=0.02
    )  # SSIM windows across the edge differ
    randomise(region(folder, NAMES[0]), NAMES[0])
    wrong_inside = evaluate(ball, folder)
    assert (
        wrong_inside.views[0].albedo_psnr < 20.0
        and wrong_inside.normal_mean > 10.0
        and wrong_inside.roughness_rmse > 0.1
    )
    assert wrong_inside.relit["dusk"].psnr < 40.0


def test_material_evaluation_relights_with_the_specular_strength_of_the_data_set(folder, ball):
    """A data set with ``specular`` 0 is relit without highlights."""
    (folder / "set.json").write_text('{"specular": 0.0}')
    assert evaluate(ball, folder).relit["dusk"].psnr < 50.0


def test_material_evaluation_uses_captured_colours_if_the_capture_has_no_albedo(folder, ball):
    """The mean captured colours are decoded to linear albedo, and a remark reports the missing layers."""
    bare = replace(ball, albedo=None, normals=None, roughness=None)
    bare = replace(bare, sh=np.concatenate([bare.sh, np.full((bare.count, 3, 3), 0.05)], axis=1))
    result = evaluate(bare, folder)
    captured = decode_srgb(np.clip(0.5 + 0.28209479 * bare.sh[:, 0], 0.0, 1.0))
    explicit = evaluate(replace(bare, albedo=captured), folder)
    assert result.albedo_psnr == pytest.approx(explicit.albedo_psnr, abs=1e-3) and result.albedo_psnr < 60.0
    assert np.isnan(result.roughness_rmse)
    assert [line.split(":")[0] for line in result.remarks] == [
        "the capture has no albedo",
        "the capture has no normals",
        "the capture has no roughness",
    ]
    assert explicit.remarks == result.remarks[1:]


def test_material_evaluation_reports_missing_ground_truth_and_computes_the_rest(folder, ball):
    """Without truth for roughness and relit images, their metrics are missing, and albedo is still measured."""
    for path in (folder / "truth" / "roughness").iterdir():
        path.unlink()
    (folder / "truth" / "roughness").rmdir()
    (folder / "relit" / "dusk.exr").unlink()
    result = evaluate(ball, folder)
    assert np.isnan(result.roughness_rmse) and np.isnan(result.environment_psnr) and result.relit == {}
    assert result.albedo_psnr > 100.0
    assert [line.split(":")[0] for line in result.remarks] == ["no ground truth for roughness", "nothing is relit"]


def test_progress_of_the_material_evaluation_covers_layers_and_relit_images(folder, ball):
    """Progress goes from 0 to 1 for layers and for relit images."""
    stored: list[tuple[str, float]] = []
    ls.inverse.evaluate_materials(ball, folder, config=CONFIG, device="cpu", progress=lambda *now: stored.append(now))
    assert stored[0] == ("comparing layers", 0.0) and stored[-1] == ("relighting", 1.0)
    assert [done for label, done in stored if label == "relighting"] == sorted(
        done for label, done in stored if label == "relighting"
    )


def rename(folder: Path, name: str) -> None:
    """Renames a file of the data set, so that it is missing."""
    (folder / name).rename(folder / "elsewhere")


def small_layer(folder: Path, name: str) -> None:
    """Writes a ground-truth layer of another size."""
    write_layer(folder, name, NAMES[0], np.zeros((8, 8, 3)))


def not_finite(folder: Path, name: str) -> None:
    """Writes a ground-truth layer of NaN."""
    write_layer(folder, name, NAMES[0], np.full((32, 32, 3), np.nan))


@pytest.mark.parametrize(
    ("spoil", "name", "problem"),
    [
        (rename, "truth/albedo/r_002.exr", "truth/albedo/r_002.exr: no such file: the data set is incomplete"),
        (rename, "relit/dusk/r_003.png", "relit/dusk/r_003.png: no such file: the data set is incomplete"),
        (rename, "environment.exr", "environment.exr: no such file: the data set is incomplete"),
        (rename, "transforms_test.json", "has no transforms_test.json with the cameras of the ground truth"),
        (small_layer, "albedo", "r_002.exr: has 8 x 8 pixels, expected the 32 x 32 of"),
        (not_finite, "normal", "r_002.exr: has values that are not finite"),
    ],
)
def test_material_evaluation_refuses_incomplete_data_sets_and_names_the_file(folder, ball, spoil, name, problem):
    """The message is one line that names the file."""
    spoil(folder, name)
    with pytest.raises(ls.FormatError) as caught:
        evaluate(ball, folder, panorama())
    assert problem in str(caught.value) and "\n" not in str(caught.value)


def test_material_evaluation_refuses_invalid_folders_captures_and_environments(tmp_path, ball, folder):
    """Missing folders, a broken set.json, images without ground truth and invalid arguments are refused."""
    with pytest.raises(ls.FormatError, match="no such folder"):
        evaluate(ball, tmp_path / "nowhere")
    (folder / "set.json").write_text('{"specular": 3}')
    with pytest.raises(ls.FormatError, match=r"set\.json: has specular 3, expected a number in 0\.\.1"):
        evaluate(ball, folder)
    (folder / "set.json").write_text("{")
    with pytest.raises(ls.FormatError, match=r"set\.json: cannot be read as JSON"):
        evaluate(ball, folder)
    rename(folder, "truth")
    (folder / "relit" / "dusk.exr").unlink()
    with pytest.raises(ls.FormatError, match="has neither truth/albedo"):
        evaluate(ball, folder)
    with pytest.raises(ls.SceneError, match="gaussians is str"):
        ls.inverse.evaluate_materials("capture.ply", folder)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ls.SceneError, match="environment has negative values"):
        evaluate(ball, folder, -panorama())
    with pytest.raises(ls.SceneError, match=r"environment has shape \(4, 4\)"):
        evaluate(ball, folder, np.zeros((4, 4)))


def test_material_evaluation_compares_environments_after_scaling_each_channel(folder, ball):
    """An environment twice as bright and redder is equal; a rotated one is not."""
    assert evaluate(ball, folder, panorama() * (2.5, 2.0, 2.0)).environment_psnr > 100.0
    write_radiance(folder / "environment.exr", np.roll(panorama(), 8, axis=1))
    assert evaluate(ball, folder, panorama()).environment_psnr < 30.0
