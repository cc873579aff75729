"""Tests mistakes of users: exit status 2, one line that names the mistake, and no file left behind."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
import warp as wp

import lumisplat as ls
from lumisplat.cli.input.arguments import one_line
from support.files.cli_files import Workspace

CAMERAS = ("--cameras", "@cameras.json")

SINGULAR = [[0.0] * 4, [0.0] * 4, [0.0] * 4, [0.0, 0.0, 0.0, 1.0]]


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workspace:
    """Returns a folder with files that are wrong in some way."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    workspace = Workspace(tmp_path, capsys)
    workspace.path("a_file").write_text("in the way of a folder")
    workspace.path("empty.ply").write_bytes(b"")
    workspace.path("short.ply").write_bytes(workspace.path("capture.ply").read_bytes()[:-7])
    workspace.path("capture.xyz").write_text("0 0 0\n")
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    workspace.path("points.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex 1\n{axes}end_header\n0 0 0\n")
    workspace.path("no_frames.json").write_text('{"frames": []}')
    workspace.path("broken.json").write_text('{"frames": [')
    workspace.write_cameras("zero_width.json", w=0)
    workspace.write_cameras("singular.json", transform_matrix=SINGULAR)
    workspace.path("typo.toml").write_text('[[splats]]\npath = "capture.ply"\nscael = 2\n')
    workspace.path("quintic.toml").write_text('[[splats]]\npath = "capture.ply"\nkernel_degree = 9\n')
    workspace.path("settings.toml").write_text('[[meshes]]\npath = "mesh.obj"\n[render]\nsampels = 4\n')
    workspace.path("views.toml").write_text('[[meshes]]\npath = "mesh.obj"\n\n[[cameras]]\ntarget = [0, 0, 0]\n')
    workspace.path("sky.hdr").write_bytes(b"#?RADIANCE\n\n-Y 4 +X 8\n\2\2")
    workspace.path("lost.toml").write_text('[[splats]]\npath = "lost.ply"\n')
    return workspace


@pytest.mark.parametrize(
    ("args", "named"),
    [
        (("render",), "no scene"),
        (("render", "@missing.ply"), "missing.ply"),
        (("render", "@capture.xyz"), "capture.xyz"),
        (("render", "@empty.ply"), "empty.ply"),
        (("render", "@short.ply"), "short.ply"),
        (("render", "@points.ply"), "point cloud"),
        (("render", "@typo.toml"), "scael"),
        (("render", "@lost.toml"), "lost.ply"),
        (("render", "@capture.ply", "--cameras", "@missing.json"), "missing.json"),
        (("render", "@capture.ply", "--cameras", "@no_frames.json"), "no_frames.json"),
        (("render", "@capture.ply", "--cameras", "@broken.json"), "broken.json"),
        (("render", "@capture.ply", "--cameras", "@zero_width.json"), "zero_width.json"),
        (("render", "@capture.ply", "--cameras", "@singular.json"), "singular.json"),
        (("render", "@capture.ply", *CAMERAS, "--frames", "middle"), "no camera is named 'middle'"),
        (("render", "@capture.ply", *CAMERAS, "--width", "0"), "error: --width is 0, expected a whole number from 1"),
        (("render", "@capture.ply", "--height", "-3"), "error: --height is -3, expected a whole number from 1"),
        (("orbit", "@capture.ply", "-o", "@round", "--width", "100000"), "error: --width is 100000, expected"),
        (("render", "@capture.ply", "--width", "1e9"), "--width is '1e9', expected a whole number (see"),
        (("render", "@capture.ply", "--samples", "many"), "--samples is 'many', expected a whole number or auto (see"),
        (("render", "@capture.ply", "--fov", "wide"), "--fov is 'wide', expected a number (see"),
        (("orbit", "@capture.ply", "--fps", "fast"), "--fps is 'fast', expected a number (see"),
        (("relight", "@capture.ply", "@capture.ply", "--degree", "x"), "--degree is 'x', expected a whole number (see"),
        (("orbit", "@capture.ply", "--widht", "64"), "perhaps you meant --width"),
        (("render", "@capture.ply", "--device", "cuda:7"), "cuda:7"),
        (("render", "@capture.ply", "--device", "tpu"), "tpu"),
        (("render", "@capture.ply", "--background", "mauve"), "mauve"),
        (("render", "@capture.ply", "--background", "0,0,7"), "background"),
        (("render", "@capture.ply", "--background", "nan,0,0"), "background"),
        (("render", "@capture.ply", "--aov", "depth,dept"), "'dept'"),
        (
            ("render", "@capture.ply", "--set=raster.sh_degree=4", "--set=trace.sh_degree=4"),
            "--set raster.sh_degree=4: sh_degree is 4",
        ),
        (("render", "@capture.ply", "--samples", "0"), "samples is 0"),
        (("render", "@capture.ply", "--set=seed=-1"), "seed is -1"),
        (("render", "@capture.ply", "--set=max_bounces=65"), "--set max_bounces=65: max_bounces is 65"),
        (
            ("render", "@capture.ply", "--set=response.kernel_degree=6"),
            "--set response.kernel_degree=6: kernel_degree is 6",
        ),
        (("render", "@capture.ply", "--set=response.min_response=nan"), "min_response is nan"),
        (
            (
                "render",
                "@capture.ply",
                "--set=raster.transmittance_min=2",
                "--set=trace.transmittance_min=2",
                "--set=shadow_rays.transmittance_min=2",
            ),
            "transmittance_min is 2",
        ),
        (("render", "@quintic.toml"), "line 3, splats[0]: kernel_degree is 9"),
        (("render", "@settings.toml"), "line 4, render: unknown 'sampels', did you mean 'samples'?"),
        (("render", "@settings.toml", "@quintic.toml"), "are both scene files"),
        (("render", "@views.toml"), "line 4, cameras[0]: lacks eye"),
        (("render", "@capture.ply", "--cameras", "@lost.toml"), "lost.toml: has no cameras"),
        (("render", "@capture.ply", "--environment", "@lost.hdr"), "lost.hdr: no such file"),
        (("render", "@capture.ply", "--environment", "@capture.ply"), "is neither Radiance HDR nor OpenEXR"),
        (("render", "@capture.ply", "--environment-rotation", "90"), "--environment-rotation needs --environment"),
        (("render", "@capture.ply", "--exposure", "nan", *CAMERAS), "--exposure is nan"),
        (("render", "@capture.ply", "--set=shadow_rays.offset=-1"), "offset is -1"),
        (("render", "@capture.ply", "--set=shadow_rays.transmittance_threshold=1"), "transmittance_threshold is 1"),
        (("render", "@capture.ply", "--set=shadow_rays.color_strength=6"), "color_strength is 6"),
        (("info",), "no file"),
        (("info", "@missing.ply"), "missing.ply"),
        (("info", "@no_frames.json"), "no_frames.json"),
        (("info", "@sky.hdr"), "sky.hdr: truncated"),
        (("info", "@views.toml"), "views.toml: line 4, cameras[0]: lacks eye"),
        (("convert", "@missing.ply", "@out.spz"), "missing.ply"),
        (("convert", "@capture.ply", "@out.xyz"), "out.xyz"),
        (
            ("convert", "@mesh.obj", "@out.ply"),
            "mesh.obj: is not a capture: convert takes Gaussians only (Python: ls.gau",
        ),
        (("convert", "@capture.ply", "@a_file/out.ply"), "a_file"),
        (("convert", "@capture.ply"), "convert needs a file to read and a file to write: lumisplat convert IN OUT"),
        (("convert", "-o", "@out.ply"), "convert needs a file to read and a file to write"),
        (("convert", "@capture.ply", "@capture.ply", "@out.ply"), "needs -o: lumisplat convert A B -o OUT"),
        (("convert", "@capture.ply", "@mesh.obj", "-o", "@out.ply"), "mesh.obj: is not a capture"),
        (("convert", "@capture.ply", "@out.ply", "--outside"), "--outside needs --box or --sphere"),
        (
            ("convert", "@capture.ply", "@out.ply", "--sphere", "99", "0", "0", "1"),
            "--sphere: no Gaussian of 60 is left; their means lie within (",
        ),
        (("convert", "@capture.ply", "@out.ply", "--sphere", "0", "0", "0", "-1"), "--sphere: the radius"),
        (("convert", "@capture.ply", "@out.ply", "--keep", "opacty=0.1.."), "unknown value 'opacty', expected one of"),
        (("convert", "@capture.ply", "@out.ply", "--keep", "opacity>0.1"), "--keep opacity>0.1: unknown value"),
        (("convert", "@capture.ply", "@out.ply", "--keep", "opacity=0.1"), "expected opacity=MIN..MAX"),
        (("convert", "@capture.ply", "@out.ply", "--keep", "opacity=.."), "expected opacity=MIN..MAX"),
        (("convert", "@capture.ply", "@out.ply", "--keep", "opacity=a..b"), "expected opacity=MIN..MAX"),
        (("convert", "@capture.ply", "@out.ply", "--keep", "roughness=0.."), "--keep: select cannot use roughness"),
        (("convert", "@capture.ply", "@out.ply", "--keep", "x=0..", "--keep", "x=..1"), "--keep names x twice"),
        (("convert", "@capture.ply", "@out.ply", "--floaters", "0"), "--floaters: neighbours is 0"),
        (("convert", "@capture.ply", "@out.ply", "--sh-degree", "5"), "--sh-degree: degree is 5"),
        (("convert", "@capture.ply", "@out.ply", "--decimate", "few"), "--decimate: few, expected the number of"),
        (("convert", "@capture.ply", "@out.ply", "--decimate", "-5%"), "--decimate: -5%, expected the number of"),
        (("convert", "@capture.ply", "@out.ply", "--decimate", "0"), "--decimate: 0, expected the number of"),
        (("convert", "@capture.ply", "@out.ply", "--scale", "0"), "scale is 0.0, expected a number above 0"),
        (("bench", "@missing.ply"), "missing.ply"),
        (("bench", "@capture.ply", "--repeats", "0"), "repeats"),
        (("bench", "--device", "cuda:7"), "cuda:7"),
        (("demo", "--device", "cuda:7"), "cuda:7"),
    ],
)
def test_every_mistake_on_the_command_line_is_reported_in_one_line(work, monkeypatch, args, named):
    """Each mistake ends with status 2, prints one line on standard error that names the mistake, and writes no file."""
    monkeypatch.chdir(work.folder)
    before = work.files()
    outcome = work.run(*args)
    assert (outcome.status, outcome.out) == (2, "")
    assert outcome.err.startswith("error: ")
    assert outcome.err.count("\n") == 1
    assert named in outcome.err
    assert work.files() == before


@pytest.mark.parametrize(
    ("output", "named"),
    [
        (("-o", "@a_file"), "a_file"),
        (("-o", "@a_file/deeper"), "a_file"),
        (("-o", "@out.png"), "2 frames"),
        (("-o", "@out.jpg"), "expected .png, .exr or .npz"),
        (("-o", "@out.png", "--frames", "left", "--format", "exr"), "--format"),
        (("-o", "/proc/lumisplat"), "/proc/lumisplat"),
        (("-o", "/proc/lumisplat.png", "--frames", "left"), "/proc/lumisplat.png"),
    ],
)
def test_render_names_an_output_that_cannot_be_written(work, output, named):
    """Nothing is written."""
    before = work.files()
    outcome = work.run("render", "@capture.ply", *CAMERAS, *output)
    assert (outcome.status, outcome.err.count("\n")) == (2, 1)
    assert named in outcome.err
    assert work.files() == before


@pytest.mark.parametrize(
    ("args", "named"),
    [
        (
            ("render", "--widht", "5"),
            "--widht is no option of lumisplat render; perhaps you meant --width (see lumisplat render --help)",
        ),
        (("paint",), "'paint' is no command (see lumisplat --help)"),
        (("rendr", "x.ply"), "'rendr' is no command; perhaps you meant render (see lumisplat --help)"),
        (("x.ply",), "'x.ply' is no command: lumisplat render x.ply renders it (see lumisplat --help)"),
        (
            ("render", "x.ply", "--format", "gif"),
            "--format is 'gif', expected auto, exr, npz or png (see lumisplat render --help)",
        ),
        (("render", "x.ply", "--width", "wide"), "'wide'"),
        (("render", "x.ply", "--set=trace.strategy=random"), "--set trace.strategy=random: strategy is 'random'"),
        (
            ("render", "x.ply", "--set=trace.hits_per_pass=17"),
            "--set trace.hits_per_pass=17: hits_per_pass is 17, expected 4, 8, 16 or 32",
        ),
        (
            ("render", "x.ply", "--set=response.kernel_degree=two"),
            "--set response.kernel_degree=two: kernel_degree is 'two', expected a whole number",
        ),
        (
            ("bench", "x.ply", "--pipeline", "rays"),
            "--pipeline is 'rays', expected hybrid, path, raster, realtime or trace (see lumisplat bench --help)",
        ),
        (("render", "x.ply", "--shadows", "dark"), "--shadows is 'dark', expected hard, off or soft"),
        (("render", "x.ply", "--shadow", "hard"), "perhaps you meant --shadow"),
        (("render", "x.ply", "--exposure", "bright"), "--exposure is 'bright', expected a number"),
        (("render", "x.ply", "--aov"), "--aov needs a value (see lumisplat render --help)"),
        (("view", "x.ply", "--capture-gain", "1"), "--capture-gain is a setting: --set capture_gain=1"),
        (
            ("view", "x.ply", "--exposure", "1"),
            "--exposure is no option of lumisplat view, but of render, orbit, animate and 7 more (see",
        ),
        (("convert", "x.ply", "y.ply", "--box"), "--box"),
    ],
)
def test_arguments_that_do_not_parse_are_reported_in_one_line(work, args, named):
    """The process ends with status 2."""
    outcome = work.run(*args)
    assert (outcome.status, outcome.out) == (2, "")
    assert outcome.err.startswith("error: ")
    assert outcome.err.count("\n") == 1
    assert named in outcome.err
    assert not set("│─╭╰") & set(outcome.err)


@pytest.mark.parametrize(
    "panel",
    [
        "╭─ Title ─────╮\n│ It is wrong │\n│ here.       │\n│ ─────────── │\n│ More.       │\n╰─────────────╯\n",
        "\x1b[31m╭─ \x1b[1mTitle\x1b[0m ─╮\n│\x1b[0m It is wrong here. \x1b[31m│\n│ │\n│ More. │\n╰──────────╯\n",
        " Title     \n ---------- \n  It is wrong here. \n  --------- \n  More. \n",
        "It is wrong here.",
    ],
    ids=["framed", "coloured", "ascii", "no panel"],
)
def test_error_panels_of_the_argument_parser_become_one_line(panel):
    """The first paragraph remains, whatever frame a terminal gives the panel."""
    assert one_line(panel, "lumisplat render") == "It is wrong here. (see lumisplat render --help)"


@pytest.mark.parametrize("name", ["a.ply", "a.obj", "a.stl", "a.glb", "a.gltf", "a.spz", "a.sog", "a.toml", "a.json"])
@pytest.mark.parametrize(
    "data", [b"\xff\xfe\x80garbage", b"[" * 100_000, b"3", b'{"frames": [1], "asset": 2}', b"x = " + b"[" * 5000]
)
def test_errors_of_broken_files_show_no_python_exception(work, name, data):
    """The message names the file and no Python object."""
    work.path(name).write_bytes(data)
    outcome = work.run("info", f"@{name}")
    assert (outcome.status, outcome.err.count("\n")) == (2, 1)
    message = outcome.err.partition(f"{name}: ")[2]
    assert message
    for internal in ("Error", "codec", "object at", "has no attribute", "BytesIO", "not subscriptable", "argument"):
        assert internal not in message


def test_render_checks_the_output_before_loading_files(work):
    """A folder that cannot be written is reported before a missing input."""
    outcome = work.run("render", "@missing.ply", "-o", "/proc/lumisplat")
    assert outcome.err.startswith("error: /proc/lumisplat: cannot be written")


def test_demo_checks_its_width_before_building_the_scene(work, monkeypatch):
    """No folder is left behind."""
    monkeypatch.setattr(ls, "demo_scene", lambda report: pytest.fail("the scene was built"))
    outcome = work.run("demo", "-o", "@demo", "--width", "0")
    assert (outcome.status, outcome.err.count("\n")) == (2, 1)
    assert "width is 0" in outcome.err
    assert not work.path("demo").exists()


def test_unwritable_kernel_cache_is_reported_in_one_line(work):
    """The line explains the cache and how to move it."""
    environment = {name: value for name, value in os.environ.items() if name != "WARP_CACHE_PATH"}
    command = [sys.executable, "-m", "lumisplat", "render", "mesh.obj", "-o", "a.png", "--device", "cpu"]
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        cwd=work.folder,
        env=environment | {"HOME": "/proc/nohome", "XDG_CACHE_HOME": "/proc/nohome"},
        check=False,
    )
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "compiled kernels cannot be stored here" in done.stderr and "WARP_CACHE_PATH" in done.stderr


def test_too_long_file_name_is_reported_in_one_line(work):
    """The line names the failed action, reading or writing."""
    outcome = work.run("render", "@mesh.obj", *CAMERAS, "--frames", "left", "-o", "@" + "x" * 300 + ".png")
    assert (outcome.status, outcome.err.count("\n")) == (2, 1)
    assert "cannot be written: File name too long" in outcome.err
    message = work.run("info", "@" + "x" * 300 + ".ply").err
    assert (
        "cannot be read: File name too long" in message or "no such file" in message
    )  # the latter from Python 3.14 on


def test_debug_option_shows_the_traceback_of_an_error(work):
    """The status stays 2."""
    outcome = work.run("render", "@missing.ply", "--debug")
    assert outcome.status == 2
    assert "Traceback" in outcome.err


def test_interrupted_command_ends_with_status_130(work, monkeypatch):
    """Ctrl-C prints one word without a traceback."""

    def interrupt(*_args, **_options):
        raise KeyboardInterrupt

    monkeypatch.setattr("lumisplat.load", interrupt)
    outcome = work.run("info", "@capture.ply")
    assert (outcome.status, outcome.err) == (130, "interrupted\n")


def test_commands_end_silently_if_their_output_pipe_closes(work):
    """Printing into ``| head -1`` closes the pipe."""
    for arguments in ("--help", "info capture.ply", "convert capture.ply copy.ply"):
        command = [sys.executable, "-m", "lumisplat", *arguments.split()]
        environment = os.environ | {
            "PYTHONUNBUFFERED": "1"
        }  # the command finds the pipe closed, not the interpreter at exit
        pipe = subprocess.PIPE
        with subprocess.Popen(command, stdout=pipe, stderr=pipe, cwd=work.folder, env=environment) as process:
            assert process.stdout and process.stderr
            process.stdout.close()
            assert process.stderr.read() == b""
            assert process.wait() != 0


def test_interrupt_while_importing_ends_without_a_traceback():
    """The status is 130."""
    program = (
        "import sys\n"
        "class Interrupted:\n"
        "    def find_spec(self, name, *_):\n"
        "        if name == 'tyro': raise KeyboardInterrupt\n"
        "sys.meta_path.insert(0, Interrupted())\n"
        "from lumisplat.__main__ import main\n"
        "sys.exit(main())\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (130, "")


def test_lumisplat_process_prints_one_error_line_with_status_2(work):
    """Native libraries add no line."""
    command = [sys.executable, "-m", "lumisplat", "render", "short.ply", "-o", "out"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=work.folder, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("error: short.ply: ")
    assert done.stderr.count("\n") == 1
