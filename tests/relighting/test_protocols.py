"""`evaluate_published` finds no error in the truth itself, and scores known changes as the benchmarks' authors do."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.inverse import Benchmark, PublishedFigures, evaluate_published
from lumisplat.relighting import protocols
from support.files.published_files import RELIT, write_orb, write_synthetic4relight, write_tensoir
from support.files.relightable_files import painted_ball

Made = tuple[Path, Path | None]


def make(benchmark: Benchmark, folder: Path, ball: ls.Gaussians) -> Made:
    """Writes a set of a benchmark; returns its folder and that of the lights."""
    if benchmark is Benchmark.TENSOIR:
        return write_tensoir(folder / "ball", ball, folder / "lights"), folder / "lights"
    if benchmark is Benchmark.ORB:
        return write_orb(folder, ball), None
    made = write_synthetic4relight(folder / "ball", ball, folder / "lights")
    return made, None if benchmark is Benchmark.NERF_SYNTHETIC else folder / "lights"


def score(
    benchmark: Benchmark, made: Made, ball: ls.Gaussians, samples: int = 4, *, denoise: bool = False
) -> PublishedFigures:
    """Evaluates a capture on the CPU."""
    config = replace(RELIT, samples=samples)
    return evaluate_published(ball, made[0], benchmark, lights=made[1], config=config, denoise=denoise, device="cpu")


@pytest.fixture(scope="module")
def ball() -> ls.Gaussians:
    """Returns a capture with albedo, roughness and normals."""
    return painted_ball()


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory, ball: ls.Gaussians) -> Callable[[Benchmark], Made]:
    """Returns a function that writes the set of a benchmark once."""
    made: dict[Benchmark, Made] = {}

    def of(benchmark: Benchmark) -> Made:
        if benchmark not in made:
            made[benchmark] = make(benchmark, tmp_path_factory.mktemp(benchmark.value), ball)
        return made[benchmark]

    return of


@pytest.mark.parametrize("benchmark", list(Benchmark))
def test_the_truth_itself_has_no_error_but_noise_and_that_of_eight_bits(
    benchmark: Benchmark, sets: Callable[[Benchmark], Made], ball: ls.Gaussians
) -> None:
    """Axes of cameras, environments and normals, colour spaces and files are those of each benchmark."""
    found = score(benchmark, sets(benchmark), ball, samples=16)
    assert found.views == 2 and found.remarks == ()
    np.testing.assert_allclose(found.albedo_scale, 1.0, atol=1e-3)
    for name, value in found.figures.items():
        if "psnr" in name:
            # R3DG blends edges of relit images twice, which is much in an image of 32 pixels.
            blends_twice = benchmark is Benchmark.SYNTHETIC4RELIGHT
            assert value > (45.0 if "relit" not in name else 30.0 if blends_twice else 35.0), name
        elif "ssim" in name:
            assert value > (0.94 if "relit" in name else 0.999), name
        else:
            assert value < (0.3 if "mae" in name else 1e-4), name
    lights = {
        Benchmark.TENSOIR: {"bridge", "city", "fireplace", "forest", "night"},
        Benchmark.SYNTHETIC4RELIGHT: {"envmap6", "envmap12"},
        Benchmark.ORB: {"ball_scene002", "ball_scene003"},
        Benchmark.NERF_SYNTHETIC: set[str](),
    }
    assert {name.partition("/")[2] for name in found.figures if "/" in name} == lights[benchmark]


def test_tensoir_scales_albedo_before_it_is_compared_and_relit(
    sets: Callable[[Benchmark], Made], ball: ls.Gaussians
) -> None:
    """An albedo that is wrong by a factor per channel counts as right, one that is wrong in places does not."""
    assert ball.albedo is not None
    made, factors = sets(Benchmark.TENSOIR), np.array([0.5, 0.8, 0.9], np.float32)
    right = score(Benchmark.TENSOIR, made, ball).figures
    dark = score(Benchmark.TENSOIR, made, replace(ball, albedo=ball.albedo * factors))
    np.testing.assert_allclose(dark.albedo_scale, 1.0 / factors, rtol=5e-3)
    assert dark.figures["albedo_psnr"] > 40.0
    assert dark.figures["relit_psnr"] == pytest.approx(right["relit_psnr"], abs=0.5)
    grey = score(Benchmark.TENSOIR, made, replace(ball, albedo=np.full_like(ball.albedo, 0.4))).figures
    assert grey["albedo_psnr"] < 30.0 and grey["relit_psnr"] < right["relit_psnr"] - 3.0


def test_errors_of_known_size_are_measured(sets: Callable[[Benchmark], Made], ball: ls.Gaussians) -> None:
    """Normals turned by 10 degrees, roughness raised by 0.1, and colours raised by 0.1, over the object alone."""
    assert ball.normals is not None
    assert ball.roughness is not None
    turn = np.array(
        [[np.cos(np.pi / 18), 0, np.sin(np.pi / 18)], [0, 1, 0], [-np.sin(np.pi / 18), 0, np.cos(np.pi / 18)]]
    )
    changed = replace(ball, normals=ball.normals @ turn.T, roughness=ball.roughness + 0.1, sh=ball.sh + 0.1 / 0.2820948)
    tensoir = score(Benchmark.TENSOIR, sets(Benchmark.TENSOIR), changed).figures
    # A normal at height y of the disc turns by sqrt(1 - y^2) of 10 degrees: 8 / (3 pi) on average, and y^2 is 1 / 4.
    assert tensoir["normal_mae_object"] == pytest.approx(10.0 * 8.0 / (3.0 * np.pi), rel=0.08)
    assert tensoir["normal_mae"] < 0.7 * tensoir["normal_mae_object"]
    made = sets(Benchmark.SYNTHETIC4RELIGHT)
    other = score(Benchmark.SYNTHETIC4RELIGHT, made, changed).figures
    alphas = [view.alpha() for view in ls.io.load_training_images(made[0]).held_out]
    covered = np.mean([np.mean(alpha**2) for alpha in alphas if alpha is not None])
    assert other["roughness_mse"] == pytest.approx(0.01 * covered, rel=0.01)
    assert other["novel_psnr"] == pytest.approx(-10.0 * np.log10(0.01 * covered), abs=0.2)
    orb = score(Benchmark.ORB, sets(Benchmark.ORB), changed).figures
    assert orb["normal_cosine"] == pytest.approx(0.82 * (1.0 - np.cos(np.pi / 18)), rel=0.2)


def test_sets_are_trained_on_the_images_of_their_folders(sets: Callable[[Benchmark], Made]) -> None:
    """Folders of single views are read like others, with the cameras' names."""
    images = ls.io.load_training_images(sets(Benchmark.TENSOIR)[0])
    assert [view.name for view in images.training] == ["train_000", "train_001"]
    assert [view.name for view in images.held_out] == ["test_000", "test_001"]
    assert images.training[0].path.name == "rgba_sunset_000.png"
    alpha = images.training[0].alpha()
    assert alpha is not None
    assert 0.1 < alpha.mean() < 0.9


@pytest.mark.parametrize(
    ("benchmark", "lost", "problem"),
    [
        (Benchmark.TENSOIR, "test_001/albedo.png", "no such file: the published set has it"),
        (Benchmark.TENSOIR, "test_001/rgba_sunset.png", "no image of the training light: expected rgba.png"),
        (Benchmark.TENSOIR, "../lights/city.hdr", "no such file"),
        (Benchmark.SYNTHETIC4RELIGHT, "test/001_rough.png", "no such file"),
        (Benchmark.SYNTHETIC4RELIGHT, "test_rli/envmap12_000.png", "no such file"),
        (Benchmark.ORB, "test_mask/0001.png", "no such file"),
        (Benchmark.ORB, "transforms_novel.json", "no such file"),
    ],
)
def test_a_file_that_a_set_lacks_is_named(
    benchmark: Benchmark,
    lost: str,
    problem: str,
    *,
    sets: Callable[[Benchmark], Made],
    tmp_path: Path,
    ball: ls.Gaussians,
) -> None:
    """An incomplete set is refused before anything is rendered."""
    made, lights = sets(benchmark)
    root = made.parent.parent if benchmark is Benchmark.ORB else made.parent
    shutil.copytree(root, tmp_path / "copy")
    folder = tmp_path / "copy" / made.relative_to(root)
    (folder / lost).unlink()
    with pytest.raises(ls.FormatError, match=problem):
        score(benchmark, (folder, None if lights is None else tmp_path / "copy" / lights.relative_to(root)), ball)


def test_folders_of_another_layout_are_refused(tmp_path: Path, ball: ls.Gaussians) -> None:
    """The line says which files the benchmark has, or that it has no relit images."""
    with pytest.raises(ls.FormatError, match=r"has no test_000/metadata.json: expected a folder for each view"):
        score(Benchmark.TENSOIR, (tmp_path, None), ball)
    with pytest.raises(ls.FormatError, match=r"is evaluated without other light: NeRF-Synthetic has no relit images"):
        score(Benchmark.NERF_SYNTHETIC, (tmp_path, tmp_path), ball)


def test_denoising_lowers_the_error_of_relit_images(sets: Callable[[Benchmark], Made], ball: ls.Gaussians) -> None:
    """One sample per pixel, of materials that are the truth: all error is noise."""
    pytest.importorskip("mitsuba_oidn", reason="the extra denoise is not installed")
    made = sets(Benchmark.TENSOIR)
    noisy, smooth = (score(Benchmark.TENSOIR, made, ball, 1, denoise=denoise).figures for denoise in (False, True))
    assert smooth["relit_psnr"] > noisy["relit_psnr"] + 2.0
    assert smooth["albedo_psnr"] == noisy["albedo_psnr"]


def test_relit_images_are_paths_that_blend_albedo_as_training_images_by_default(
    sets: Callable[[Benchmark], Made], ball: ls.Gaussians, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Particle paths would show each Gaussian's own albedo, which no image was trained for (decision 0124)."""
    used: list[ls.RenderConfig] = []
    create = protocols.create_renderer
    monkeypatch.setattr(
        protocols, "create_renderer", lambda config, device: used.append(config) or create(config, device)
    )
    folder, lights = sets(Benchmark.SYNTHETIC4RELIGHT)
    evaluate_published(ball, folder, Benchmark.SYNTHETIC4RELIGHT, lights=lights, samples=1, device="cpu")
    (config,) = used
    assert config.pipeline is ls.Pipeline.PATH and config.path.primary is ls.config.PathPrimary.ISO
