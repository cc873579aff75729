"""Tests render, info, convert, bench and the help with correct arguments."""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from rich.progress import Progress

import lumisplat as ls
from lumisplat.cli import main
from lumisplat.cli.output.console import progress_bars
from support.files.cli_files import Workspace
from support.files.image_files import read_image
from support.scenes.raster_scenes import front_camera, random_gaussians


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workspace:
    """Returns a folder to run commands in; Warp's log level is restored afterwards."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    return Workspace(tmp_path, capsys)


def test_render_writes_an_image_for_each_camera(work):
    """Each camera of the file becomes an image with its name and size, equal to the library's render."""
    outcome = work.run("render", "@capture.ply", "--cameras", "@cameras.json", "-o", "@out", "--device", "cpu")
    assert (outcome.status, outcome.err) == (0, "")
    assert {path.name for path in work.path("out").iterdir()} == {"left.png", "right.png"}
    frame = ls.render(
        ls.Scene(splats=[work.capture("capture.ply")]),
        ls.load_cameras(work.path("cameras.json"))[0],
        device="cpu",
    )
    expected = (np.clip(frame.color, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
    assert np.array_equal(read_image(work.path("out/left.png"))["srgb"], expected)


def test_render_selects_cameras_by_name_and_scales_images(work):
    """``--frames`` selects by name, and one given side keeps the aspect ratio."""
    work.run("render", "@capture.ply", "--cameras", "@cameras.json", "-o", "@out", "--frames", "right", "--width", "32")
    assert {path.name for path in work.path("out").iterdir()} == {"right.png"}
    assert read_image(work.path("out/right.png"))["srgb"].shape == (24, 32, 3)


@pytest.mark.parametrize("frame", ["right", "1", "1:"])
def test_render_of_one_of_several_cameras_writes_a_single_file(work, frame):
    """``--frames`` selects the camera by name or number."""
    options = ("--cameras", "@cameras.json", "--frames", frame, "--width", "32", "--device", "cpu")
    assert work.run("render", "@capture.ply", "-o", "@one.png", *options).status == 0
    assert work.run("render", "@capture.ply", "-o", "@all", *options).status == 0
    assert work.path("one.png").read_bytes() == work.path("all/right.png").read_bytes()


def test_render_refuses_a_camera_number_out_of_range(work):
    """The message counts cameras, not frames of an animation."""
    outcome = work.run("render", "@capture.ply", "--cameras", "@cameras.json", "--frames", "2", "-o", "@one.png")
    assert outcome.status == 2
    assert outcome.err == "error: --frames is '2', and '2' is out of range: there are 2 cameras, 0-1\n"


def test_render_of_several_files_logs_that_the_cameras_in_them_are_not_used(work, caplog):
    """Cameras of a single glTF are used; beside another file, a line names the option that uses them."""
    camera = front_camera(width=16, height=12, name="inside")
    scene = ls.Scene(meshes=[ls.MeshInstance(ls.box())])
    ls.save(work.path("a.glb"), scene, cameras=[camera])
    ls.save(work.path("b.glb"), scene)
    options = ("-o", "@a.png", "--width", "16", "--device", "cpu")
    assert work.run("render", "@a.glb", "@b.glb", *options).status == 0
    name = work.path("a.glb")
    assert f"the cameras of {name} are not used beside other files: --cameras {name} uses them" in caplog.messages
    caplog.clear()
    assert work.run("render", "@a.glb", "@b.glb", "--cameras", "@a.glb", *options).status == 0
    assert work.run("render", "@a.glb", *options).status == 0
    assert "are not used" not in caplog.text


def test_render_reports_mistakes_of_a_scene_file_before_loading_captures(work, monkeypatch):
    """The scene file is read first, wherever it stands among the files."""
    work.path("lit.toml").write_text('[[lights]]\ntype = "pointt"\n')
    load = ls.load
    loaded: list[str] = []
    monkeypatch.setattr("lumisplat.load", lambda path, **options: loaded.append(path.name) or load(path, **options))
    outcome = work.run("render", "@capture.ply", "@lit.toml", "-o", "@a.png", "--device", "cpu")
    assert outcome.status == 2 and "lights[0]: type is 'pointt'" in outcome.err
    assert loaded == ["lit.toml"]


def test_render_width_and_height_apply_to_cameras_without_a_size(work):
    """The camera file gives only an angle of view."""
    pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    frame = {"file_path": "0001", "transform_matrix": pose}
    work.path("angle.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": [frame]}))
    args = ("render", "@mesh.obj", "--cameras", "@angle.json", "-o", "@a.png")
    assert "give --width and --height" in work.run(*args, "--width", "32").err
    assert work.run(*args, "--width", "32", "--height", "24").status == 0
    assert read_image(work.path("a.png"))["srgb"].shape == (24, 32, 3)


def test_option_named_set_of_render_gives_the_image_of_library_render_with_equal_settings(work):
    """The image equals that of `ls.render` with equal settings."""
    ls.save(work.path("bands.ply"), random_gaussians(2, count=40, degree=2))
    scene = ls.Scene([work.capture("bands.ply")])
    camera = ls.load_cameras(work.path("cameras.json"))[0]
    args = ("render", "@bands.ply", "--cameras", "@cameras.json", "--frames", "left", "-o", "@a.npz", "--device", "cpu")
    for options, settings in [
        (
            ("--set=raster.antialiasing=on", "--set=trace.antialiasing=on"),
            ls.RasterConfig(antialiasing=ls.config.Antialiasing.ON),
        ),
        (("--set=raster.sh_degree=0", "--set=trace.sh_degree=0"), ls.RasterConfig(sh_degree=0)),
    ]:
        assert work.run(*args, *options).status == 0
        color = read_image(work.path("a.npz"))["color"]
        expected, plain = (
            ls.render(scene, camera, ls.RenderConfig(raster=r), device="cpu").color
            for r in (settings, ls.RasterConfig())
        )
        assert np.abs(color - plain).max() > 0.01
        np.testing.assert_array_equal(color, expected)


TRACE_OPTIONS = (
    *(
        "--set=trace.strategy=stochastic-pass",
        "--samples",
        "3",
        "--set=seed=7",
        "--set=max_bounces=5",
        "--set=response.kernel_degree=4",
    ),
    *(
        "--set=response.min_response=0.0113",
        "--set=trace.hit_distance=hull",
        "--set=shadow_rays.hit_distance=hull",
        "--set=trace.normal_method=ellipsoid",
        "--set=trace.hits_per_pass=32",
    ),
    *(
        "--set=jitter=false",
        "--set=raster.sh_degree=1",
        "--set=trace.sh_degree=1",
        "--set=raster.transmittance_min=0.01",
        "--set=trace.transmittance_min=0.01",
        "--set=shadow_rays.transmittance_min=0.01",
    ),
)


def configured(work: Workspace, monkeypatch: pytest.MonkeyPatch, *args: str) -> ls.RenderConfig:
    """Returns the settings with which a command asks for its renderer; nothing is rendered."""
    configs = []

    def refuse(config: ls.RenderConfig, *_: object, **__: object) -> None:
        configs.append(config)
        raise ls.DeviceError("not today")

    monkeypatch.setattr("lumisplat.create_renderer", refuse, raising=False)
    assert work.run(*args).err.endswith("error: not today\n")
    return configs[0]


def test_ray_tracer_options_of_render_change_the_settings_of_the_ray_tracer(work, monkeypatch, caplog):
    """Each option changes its setting, in all groups of settings that have it."""
    config = configured(work, monkeypatch, "render", "@mesh.obj", "--pipeline", "trace", *TRACE_OPTIONS)
    assert config == ls.RenderConfig(
        pipeline=ls.Pipeline.TRACE,
        samples=3,
        jitter=False,
        seed=7,
        max_bounces=5,
        raster=ls.RasterConfig(sh_degree=1, transmittance_min=0.01),
        trace=ls.TraceConfig(
            strategy=ls.config.TraceStrategy.STOCHASTIC_PASS,
            hits_per_pass=32,
            hit_distance=ls.config.HitDistance.HULL,
            normal_method=ls.config.NormalMethod.ELLIPSOID,
            sh_degree=1,
            transmittance_min=0.01,
        ),
        response=ls.config.ResponseConfig(kernel_degree=4, min_response=0.0113),
        shadow_rays=ls.ShadowConfig(hit_distance=ls.config.HitDistance.HULL, transmittance_min=0.01),
    )
    assert not caplog.records


def test_default_options_of_render_and_bench_are_the_library_defaults(work, monkeypatch):
    """Defaults in --help are those of the library."""
    assert configured(work, monkeypatch, "render", "@mesh.obj") == ls.RenderConfig()
    assert configured(work, monkeypatch, "bench", "@mesh.obj") == ls.RenderConfig()


def test_bench_options_set_pipeline_and_ray_tracing_strategy(work, monkeypatch):
    """The settings of the renderer equal those of the options."""
    args = ("bench", "@mesh.obj", "--pipeline", "trace", "--set=trace.strategy=stochastic-hit")
    trace = ls.TraceConfig(strategy=ls.config.TraceStrategy.STOCHASTIC_HIT)
    assert configured(work, monkeypatch, *args) == ls.RenderConfig(pipeline=ls.Pipeline.TRACE, trace=trace)


def test_render_logs_options_without_effect(work, monkeypatch, caplog):
    """Each reason is one line, once the scene is loaded."""
    args = ("render", "@mesh.obj", "--lighting", "off", "--width", "16", "-o", "@a.png", "--device", "cpu")
    assert work.run(*args, *TRACE_OPTIONS).status == 0
    assert [line for line in caplog.messages if line.startswith("not used")] == [
        "not used: --samples, --set seed, --set jitter (used in lit frames, and by other pipelines than raster)",
        "not used: --set trace.strategy (used by the pipelines trace, hybrid, realtime)",
        "not used: --set max_bounces, --set trace.hits_per_pass, --set trace.sh_degree, --set trace.transmittance_min "
        "(used by the pipelines trace, hybrid, path, realtime)",
        "not used: --set response.kernel_degree, --set response.min_response "
        "(used where rays are traced: with shadows, or by other pipelines than raster)",
        "not used: --set shadow_rays.hit_distance, --set shadow_rays.transmittance_min "
        "(used in lit frames: add a light, or switch lighting on)",
    ]
    caplog.clear()
    timed = ("bench", "@mesh.obj", "--repeats", "1", "--width", "8", "--device", "cpu")
    assert work.run(*timed, "--set=trace.strategy=stochastic-hit").status == 0
    assert "not used: --set trace.strategy (used by the pipelines trace, hybrid, realtime)" in caplog.messages


def test_render_without_cameras_uses_a_camera_that_frames_the_whole_scene(work):
    """A capture alone gives one image of the requested size in which the capture is visible."""
    args = ("render", "@capture.ply", "-o", "@first.png", "--width", "64", "--height", "64")
    assert work.run(*args, "--device", "cpu").status == 0
    image = read_image(work.path("first.png"))["srgb"]
    assert image.shape == (64, 64, 3)
    scene = ls.Scene([work.capture("capture.ply")])
    framed = ls.render(scene, ls.frame_camera(scene, width=64, height=64), device="cpu")
    np.testing.assert_array_equal(image, (np.clip(framed.color, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8))
    assert (image > 0).any(axis=2).mean() > 0.2


@pytest.mark.parametrize(
    ("text", "corner"), [("white", (255, 255, 255)), ("#ff8000", (255, 128, 0)), ("0,0.2,1", (0, 51, 255))]
)
def test_render_background_fills_empty_pixels(work, text, corner):
    """The colour may be given in every notation."""
    args = ("render", "@mesh.obj", "--cameras", "@cameras.json", "--frames", "left", "-o", "@a.png")
    assert work.run(*args, "--background", text).status == 0
    assert tuple(read_image(work.path("a.png"))["srgb"][0, 0]) == corner


def test_render_with_transparent_background_writes_alpha(work):
    """Alpha is 0 beside the mesh, and 1 on it."""
    args = ("render", "@mesh.obj", "--cameras", "@cameras.json", "--frames", "left", "-o", "@a.png")
    work.run(*args, "--background", "transparent")
    alpha = read_image(work.path("a.png"))["srgb"][..., 3]
    assert alpha[0, 0] == 0
    assert alpha[24, 32] == 255


def test_render_writes_layers_as_files_beside_a_png(work):
    """``--aov`` writes an image for each layer."""
    args = ("render", "@mesh.obj", "--cameras", "@cameras.json", "--frames", "left", "-o", "@a.png")
    assert work.run(*args, "--aov", "depth,normal,instance_index,gaussian_index").status == 0
    # The triangle faces the camera at z = 4: its normal is (0, 0, -1), and it holds no Gaussian.
    assert tuple(read_image(work.path("a.normal.png"))["srgb"][24, 32]) == (128, 128, 0)
    assert read_image(work.path("a.depth.png"))["srgb"][24, 32].any()
    assert read_image(work.path("a.instance_index.png"))["srgb"][24, 32].any()
    assert not read_image(work.path("a.gaussian_index.png"))["srgb"].any()
    assert not read_image(work.path("a.depth.png"))["srgb"][0, 0].any()


def test_render_writes_layers_as_channels_of_an_exr(work):
    """``--aov`` writes exactly the given layers."""
    args = ("render", "@mesh.obj", "--cameras", "@cameras.json", "--frames", "left", "-o", "@out", "--format", "exr")
    assert work.run(*args, "--aov", "depth,instance_index").status == 0
    channels = read_image(work.path("out/left.exr"))
    assert set(channels) == {"R", "G", "B", "A", "depth.Z", "index.instance"}
    assert channels["depth.Z"][24, 32] == pytest.approx(4.0, abs=1e-3)
    assert np.isinf(channels["depth.Z"][0, 0])


def test_render_logs_that_an_exr_has_no_background_colour(work, caplog):
    """Without ``--background``, and with a transparent one, which hides an environment, nothing is logged."""
    args = ("render", "@mesh.obj", "--cameras", "@cameras.json", "--frames", "left", "-o", "@a.exr")
    assert work.run(*args).status == 0
    assert work.run(*args, "--background", "transparent").status == 0
    assert caplog.text == ""
    assert work.run(*args, "--background", "white").status == 0
    (line,) = [record.getMessage() for record in caplog.records]
    assert line.startswith("--background shows only in mirrors and glass: an EXR stores")


def test_render_with_stats_prints_times_of_stages_and_counts(work):
    """The stages are those of the rasteriser."""
    outcome = work.run("render", "@capture.ply", "-o", "@a.npz", "--width", "32", "--stats", "--device", "cpu")
    for word in ("project", "sort", "bin", "composite", "60", "tile pairs", "memory"):
        assert word in outcome.out
    assert "color" in read_image(work.path("a.npz"))


def test_stats_of_traced_frames_have_no_tile_counts(work):
    """Ray tracing has neither tiles nor a list of visible Gaussians."""
    args = ("@capture.ply", "--pipeline", "trace", "--device", "cpu", "--width", "32")
    for outcome in (
        work.run("render", *args, "-o", "@a.png", "--stats"),
        work.run("bench", *args, "--repeats", "1"),
    ):
        assert outcome.status == 0
        assert "Gaussians" in outcome.out and "memory" in outcome.out and "all stages" in outcome.out
        assert "tile pairs" not in outcome.out and "visible" not in outcome.out


def test_render_command_with_the_trace_pipeline_equals_library_render(work, monkeypatch):
    """The image shows glass in front of a capture; progress is reported for each sample."""
    work.path("scene.toml").write_text(
        '[[splats]]\npath = "capture.ply"\nkernel_degree = 4\n'
        '[[meshes]]\npath = "mesh.obj"\nposition = [0, 0, -2]\nupright = false\n'
        "material = { roughness = 0.0, transmission = 1.0, base_color = [1.0, 0.5, 1.0] }\n"
    )
    reports = []

    @contextmanager
    def recorded():
        yield lambda label, fraction: reports.append((label, fraction))

    monkeypatch.setattr("lumisplat.cli.commands.render.progress_bars", recorded)
    args = (
        "render",
        "@scene.toml",
        "--cameras",
        "@cameras.json",
        "--frames",
        "left",
        "-o",
        "@a.npz",
        "--device",
        "cpu",
    )
    options = ("--set=trace.strategy=stochastic-hit", "--samples", "3", "--set=seed=5")
    assert work.run(*args, "--pipeline", "trace", *options).status == 0
    trace = ls.TraceConfig(strategy=ls.config.TraceStrategy.STOCHASTIC_HIT)
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, samples=3, seed=5, trace=trace)
    scene, camera = ls.load(work.path("scene.toml")), ls.load_cameras(work.path("cameras.json"))[0]
    assert isinstance(scene, ls.Scene)
    expected = ls.render(scene, camera, config, device="cpu")
    found = read_image(work.path("a.npz"))
    np.testing.assert_array_equal(found["color"], expected.color)
    assert found["alpha"][24, 32] == 1.0 and found["instance_index"][24, 32] == 1
    traced = [fraction for label, fraction in reports if label.startswith("tracing, ")]
    assert traced == pytest.approx([1 / 3, 2 / 3, 1.0])


def test_finished_progress_bar_restarts_when_its_label_is_reported_again(monkeypatch):
    """Finished bars disappear; a bar whose label is reported again starts at zero."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    shown = []
    with progress_bars() as report:
        bars = next(cell.cell_contents for cell in report.__closure__ or () if isinstance(cell.cell_contents, Progress))
        for label, fraction in [("a", 0.0), ("b", 0.5), ("a", 1.0), ("b", 1.0), ("b", 0.25), ("c", 1.0)]:
            report(label, fraction)
            shown.append([(task.description, task.completed) for task in bars.tasks])
    assert shown == [[("a", 0.0)], [("a", 0.0), ("b", 0.5)], [("b", 0.5)], [], [("b", 0.25)], [("b", 0.25)]]


def test_render_joins_several_files_to_one_scene(work):
    """The image shows both the capture and the mesh."""
    args = ("--cameras", "@cameras.json", "--frames", "left", "-o", "@a.npz", "--device", "cpu")
    assert work.run("render", "@capture.ply", "@mesh.obj", *args).status == 0
    assert set(np.unique(read_image(work.path("a.npz"))["instance_index"])) >= {0, 1}


def test_render_finds_the_files_of_a_scene_file_in_its_folder(work):
    """Paths in the scene file are relative to the folder of the file."""
    work.path("scene.toml").write_text('[[meshes]]\npath = "mesh.obj"\nposition = [0, 0, 4]\n')
    args = ("--cameras", "@cameras.json", "--frames", "left", "-o", "@a.npz")
    assert work.run("render", "@scene.toml", *args).status == 0
    assert read_image(work.path("a.npz"))["depth"][24, 32] == pytest.approx(8.0, abs=1e-3)


def test_info_prints_tables_of_captures_meshes_and_cameras(work):
    """Captures, meshes and camera files have different tables."""
    outcome = work.run("info", "@capture.ply", "@mesh.obj", "@cameras.json")
    assert outcome.status == 0
    scales = work.capture("capture.ply").scales
    assert f"median {np.median(scales):.4g}   99 %" in outcome.out
    for text in ("capture", "SH degree", "opacity", "60", "mesh", "vertices", "frames", "left, right"):
        assert text in outcome.out


def test_info_continues_after_unreadable_files(work):
    """All other files are printed as tables or JSON, then a line for each unreadable file, with status 2."""
    work.path("short.ply").write_text("ply\n")
    for how in ((), ("--json",)):
        outcome = work.run("info", "@none.ply", "@short.ply", "@capture.ply", *how)
        assert outcome.status == 2 and "antialiased" in outcome.out and "none.ply" not in outcome.out
        first, second = outcome.err.splitlines()
        assert first.startswith("error: ") and "none.ply: no such file" in first
        assert second.startswith("error: ") and "short.ply: " in second


def test_info_prints_unusual_properties_only_if_present(work):
    """The kernel degree is printed only if it is not 2; a mesh shows its material."""
    assert "kernel degree" not in work.run("info", "@capture.ply").out
    work.path("scene.toml").write_text(
        '[[splats]]\npath = "capture.ply"\nkernel_degree = 4\n'
        '[[meshes]]\npath = "mesh.obj"\nmaterial = { roughness = 0.0, transmission = 1.0, ior = 1.33 }\n'
    )
    shown = " ".join(work.run("info", "@scene.toml").out.split())
    assert "kernel degree 4" in shown
    assert "metallic 0 roughness 0 specular 1 ior 1.33 transmission 1" in shown


def test_info_prints_numbers_and_names_of_meshes_and_names_of_cameras(work):
    """Meshes of one entry are numbered and named, and frames are listed by their file names."""
    work.path("two.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl wood\nf 1 2 3\nusemtl brass\nf 3 2 1\n")
    work.path("scene.toml").write_text('[[meshes]]\npath = "two.obj"\nname = "lamp"\n')
    ls.save_cameras(work.path("spaced.json"), [front_camera(name="back left")])
    outcome = work.run("info", "@scene.toml", "@spaced.json")
    assert "mesh 0   lamp / wood" in outcome.out and "mesh 1   lamp / brass" in outcome.out
    assert "back_left" in outcome.out


def test_info_prints_text_without_markup_or_control_characters(work):
    """Neither the text in a file nor its name can change the terminal."""
    gaussians = ls.load(work.path("capture.ply"))
    assert isinstance(gaussians, ls.Gaussians)
    ls.save(work.path("[bold].ply"), replace(gaussians, comments=("[/red] :cat: \x1b[2J",)))
    outcome = work.run("info", "@[bold].ply")
    assert outcome.status == 0
    assert "[bold].ply" in outcome.out.replace("\n", "")
    assert "[/red] :cat: ?[2J" in outcome.out


def test_convert_keeps_the_kernel_degree_and_logs_its_loss_if_the_format_lacks_it(work, caplog):
    """SPZ cannot store the degree, and one line reports it."""
    ls.save(work.path("quartic.ply"), replace(work.capture("capture.ply"), kernel_degree=4))
    assert work.run("convert", "@quartic.ply", "@copy.compressed.ply").status == 0
    assert work.capture("copy.compressed.ply").kernel_degree == 4
    assert not caplog.records
    assert work.run("convert", "@copy.compressed.ply", "@copy.spz").status == 0
    assert ["cannot store the kernel degree, 4" in record.getMessage() for record in caplog.records] == [True]


@pytest.mark.parametrize("target", ["copy.compressed.ply", "copy.spz", "copy.ply"])
def test_convert_writes_the_same_gaussians_in_every_format(work, target):
    """Only the rounding of the format differs."""
    outcome = work.run("convert", "@capture.ply", f"@{target}")
    assert outcome.status == 0
    assert "60 Gaussians" in outcome.out
    before, after = ls.load(work.path("capture.ply")), ls.load(work.path(target))
    assert isinstance(before, ls.Gaussians) and isinstance(after, ls.Gaussians)
    assert np.allclose(np.sort(after.means, axis=0), np.sort(before.means, axis=0), atol=2e-3)


def test_render_with_drop_invalid_accepts_a_capture_with_nan(work):
    """Without ``--drop-invalid``, a capture with NaN is refused."""
    data = bytearray(work.path("capture.ply").read_bytes())
    data[-4:] = np.float32(np.nan).tobytes()
    work.path("nan.ply").write_bytes(data)
    assert work.run("render", "@nan.ply", "-o", "@a.png", "--width", "32").status == 2
    assert work.run("render", "@nan.ply", "-o", "@a.png", "--width", "32", "--drop-invalid").status == 0


def test_bench_prints_times_of_loading_of_frames_and_of_their_stages(work):
    """There is a row for loading, the first frame, steady frames and each stage."""
    outcome = work.run("bench", "@capture.ply", "--width", "64", "--repeats", "2", "--device", "cpu")
    assert outcome.status == 0
    for word in ("load", "first frame", "median of 2", "composite", "peak"):
        assert word in outcome.out


def test_help_lists_commands_and_their_options(capsys):
    """Without arguments the list of commands is printed, and each command's help has its options."""
    assert main([]) == 0
    listed = capsys.readouterr().out
    for command in ("render", "info", "convert", "demo", "bench", "metrics", "relight"):
        assert command in listed
        assert main([command, "--help"]) == 0
        shown = capsys.readouterr().out
        assert "--debug" in shown
        assert ("camera options" in shown and "light options" in shown) == (command == "render")
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"lumisplat {ls.__version__}\n"


def test_help_lines_end_at_the_width_of_the_terminal(capsys, monkeypatch):
    """Line ends of docstrings do not break lines of the help."""
    monkeypatch.setenv("COLUMNS", "80")
    for command in (["render"], ["farm", "animate"], ["train"]):
        assert main([*command, "--help"]) == 0
        rows = [row[1:-1] for row in capsys.readouterr().out.splitlines() if len(row) == 80]  # between lines, or spaces
        column = next(row.index("show this help") for row in rows if "show this help" in row)
        joined = [
            (row, below) for row, below in pairwise(rows) if row[column - 2 : column] == "  " and below[column:].strip()
        ]
        for row, below in joined:
            if below[:column].isspace() and row[column:].strip():
                assert len(row.rstrip()) + 1 + len(below.split()[0]) > len(row) - 1, (command, row, below)


def test_help_imports_neither_warp_nor_numpy():
    """Help also imports no file library, so that help appears at once."""
    program = (
        "import sys, lumisplat.cli; lumisplat.cli.main(['--help']);"
        "print(sorted({'warp', 'numpy', 'zstandard', 'OpenEXR', 'PIL', 'rich.progress'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_lumisplat_process_prints_one_line_on_success(work):
    """Nothing is on standard error, whatever Warp logs."""
    command = [sys.executable, "-m", "lumisplat", "render", "capture.ply", "-o", "a.png", "--width", "32"]
    command += ["--up", "y-down"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=work.folder, check=True)
    assert (done.stdout, done.stderr) == (f"{Path('a.png')} (32 x 18)\n", "")


@pytest.mark.parametrize("debug", [False, True])
def test_warnings_of_python_and_numpy_appear_only_with_debug(debug: bool) -> None:
    """Warnings of Python and NumPy appear with --debug only."""
    program = (
        "import warnings, lumisplat.cli as cli, lumisplat.__main__ as process\n"
        "cli.main = lambda: warnings.warn('overflow', RuntimeWarning) or 0\n"
        "process.main()"
    )
    options = ["--debug"] if debug else []
    done = subprocess.run([sys.executable, "-c", program, *options], capture_output=True, text=True, check=True)
    assert ("RuntimeWarning" in done.stderr) is debug
