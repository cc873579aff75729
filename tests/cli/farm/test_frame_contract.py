"""Tests what schedulers rely on: frame ranges, whole frames of one provenance, and exit statuses."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import pytest
import warp as wp

import lumisplat as ls
from lumisplat.cli.commands.render import Render
from lumisplat.cli.farm.failed_frames import FramesMissingError
from lumisplat.cli.farm.job import FrameJob, make_frames
from support.files.cli_files import Workspace
from support.frame_makers import FakeMaker

SIZE = ("--width", "32", "--height", "24", "--device", "cpu")


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workspace:
    """Returns a folder to run commands in; Warp's log level is restored afterwards."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    return Workspace(tmp_path, capsys)


def orbit(work: Workspace, folder: str, *options: str):
    """Renders six frames into a folder."""
    return work.run("orbit", "@capture.ply", "-o", f"@{folder}", "--seconds", "0.3", "--fps", "20", *SIZE, *options)


def images(work: Workspace, folder: str) -> dict[str, bytes]:
    """Returns the frames of a folder."""
    return {path.name: path.read_bytes() for path in sorted(work.path(folder).glob("*.png"))}


def test_orbit_rendered_in_several_frame_ranges_equals_the_whole_orbit(work) -> None:
    """Numbers, ranges and steps may come in any order; the output counts only the requested frames."""
    assert orbit(work, "whole").status == 0
    for part, count in (("1-5x2", 3), ("0,4", 2), ("2", 1)):
        assert f"{count} frame{'s' * (count > 1)} in" in orbit(work, "parts", "--frames", part).out
    assert images(work, "parts") == images(work, "whole")
    refused = orbit(work, "parts", "--frames", "4-6")
    assert refused.status == 2 and "and '4-6' is out of range: there are 6 frames, 0-5" in refused.err


def render(work: Workspace, folder: str, *options: str):
    """Renders an image for each of two cameras."""
    options = (*SIZE, "--cameras", str(work.path("cameras.json")), *options)
    return work.run("render", "@capture.ply", "-o", f"@{folder}", *options)


def test_render_with_resume_keeps_images_with_equal_settings_and_refuses_other_settings(work) -> None:
    """Without --resume, all images are rendered anew."""
    assert render(work, "whole").status == 0
    assert render(work, "out", "--resume", "--frames", "1").status == 0
    assert [*images(work, "out")] == ["right.png"] and work.path("out/render.json").exists()
    before = work.path("out/right.png").stat().st_mtime_ns
    assert "2 frames in" in (out := render(work, "out", "--resume").out) and "1 of them already existed" in out
    assert work.path("out/right.png").stat().st_mtime_ns == before
    assert images(work, "out") == images(work, "whole")
    refused = render(work, "out", "--resume", "--set=raster.sh_degree=0", "--set=trace.sh_degree=0")
    assert refused.status == 2 and "holds frames of other settings or files (raster.sh_degree" in refused.err
    assert ": leave out --resume to remove them, or choose another folder" in refused.err
    assert render(work, "out", "--set=raster.sh_degree=0", "--set=trace.sh_degree=0").status == 0
    assert not work.path("out/render.json").exists()  # the file described images of other settings
    assert "holds frames, but no render.json" in render(work, "out", "--resume").err


def test_layers_of_a_frame_are_written_before_its_image(work, monkeypatch) -> None:
    """The image marks a finished frame, so a run that ends in between leaves no frame without layers."""
    module = sys.modules[ls.Frame.__module__]
    written: list[str] = []
    write = module.write_png

    def watched(path: Path, pixels: object) -> None:
        written.append(Path(path).name)
        write(path, pixels)

    monkeypatch.setattr(module, "write_png", watched)
    assert render(work, "out", "--resume", "--aov", "depth,normal", "--frames", "0").status == 0
    assert sorted(written) == ["left.depth.png", "left.normal.png", "left.png"] and written[-1] == "left.png"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--resume", "--view", "normal"), "--view colours all images by the first of a run"),
        (
            ("--resume", "-o", "out.png", "--frames", "left"),
            "is one image, but there are several frames: give a folder",
        ),
        (("--frames", "2"), "there are 2 cameras, 0-1"),
    ],
)
def test_render_refuses_resume_with_options_or_outputs_that_cannot_be_resumed(
    work, options: tuple[str, ...], message: str
) -> None:
    """Each refusal prints one line with status 2, and writes nothing."""
    before = work.files()
    refused = render(work, "out", *options)
    assert refused.status == 2 and message in refused.err and refused.err.count("\n") == 1
    assert work.files() == before


def test_run_stops_if_another_run_starts_in_its_frame_folder(tmp_path: Path) -> None:
    """The check comes before and after a frame is rendered, so that frames of two runs do not mix."""
    job = FakeMaker(tmp_path / "out").open_frames(lambda *_: None)
    other = replace(job.frames, provenance={"kind": "other"})

    def overtaken_while_rendering(index: int, report: object) -> ls.Frame:
        other.begin(True)
        return job.render(index, lambda *_: None)

    def overtaken_while_writing(frame: ls.Frame, index: int) -> None:
        other.begin(True)
        job.write(frame, index)

    for overtaken_job in (replace(job, render=overtaken_while_rendering), replace(job, write=overtaken_while_writing)):
        overtaken_job.frames.begin(True)
        with pytest.raises(ls.ConfigError, match="this run stops, so that frames do not mix"):
            overtaken_job.make(3, lambda *_: None)
        assert not list((tmp_path / "out").glob("*.png"))


def test_run_that_another_run_replaced_does_not_overwrite_frames_of_the_other(tmp_path: Path) -> None:
    """A frame that the other run has written is not overwritten."""
    job = FakeMaker(tmp_path / "out").open_frames(lambda *_: None)
    theirs = replace(job.frames, provenance={"kind": "other"})

    def overtaken(index: int, report: object) -> ls.Frame:
        theirs.begin(True)
        theirs.folder.path(index).write_text("theirs")
        return job.render(index, lambda *_: None)

    job.frames.begin(True)
    with pytest.raises(ls.ConfigError, match="this run stops, so that frames do not mix"):
        replace(job, render=overtaken).make(3, lambda *_: None)
    assert theirs.folder.path(3).read_text() == "theirs"


def test_overwriting_run_removes_the_settings_file_before_the_frames_that_it_describes(
    tmp_path: Path, monkeypatch
) -> None:
    """The file of settings is removed first, so that old frames are not taken for new ones."""
    maker = FakeMaker(tmp_path / "out")
    make_frames(maker.open_frames(lambda *_: None), lambda *_: None, overwrite=False, video=None, fewer="")
    frames = replace(maker.open_frames(lambda *_: None).frames, provenance={"kind": "other"})
    unlink = Path.unlink

    def cut_off(path: Path, missing_ok: bool = False) -> None:
        if path.name == "frame_0002.png":
            raise KeyboardInterrupt
        unlink(path, missing_ok)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "unlink", cut_off)
        with pytest.raises(KeyboardInterrupt):
            frames.begin(True)
    with pytest.raises(ls.ConfigError, match=r"holds frames, but no fake\.json"):
        frames.begin(False)


def alone(job: FrameJob) -> str:
    """Makes the frames of a job in this process."""
    return make_frames(job, lambda *_: None, overwrite=False, video=None, fewer="--frames")


@pytest.mark.parametrize(
    ("wrong", "kind"),
    [
        ({0: "setting"}, ls.ConfigError),
        ({5: "setting"}, ls.ConfigError),
        ({0: "data"}, ls.SceneError),
        ({5: "data"}, FramesMissingError),
        ({0: "full"}, FramesMissingError),
        ({5: "full"}, FramesMissingError),
    ],
)
def test_exit_status_is_3_if_some_frames_failed_and_2_for_mistakes_of_the_user(
    tmp_path: Path, wrong: dict[int, str], kind: type[Exception]
) -> None:
    """Errors of all frames are mistakes with exit status 2; errors of one frame or of the disk have status 3."""
    with pytest.raises(ls.LumisplatError) as raised:
        alone(FakeMaker(tmp_path / "out", wrong=wrong).open_frames(lambda *_: None))
    assert isinstance(raised.value, kind)
    assert isinstance(raised.value, FramesMissingError) == (kind is FramesMissingError)
    if kind is FramesMissingError:
        (index,) = wrong
        assert str(raised.value).startswith(f"frame {index}: ")
        assert f"holds {index} of 8 frames; the same command continues" in str(raised.value)


def test_orbit_on_a_full_disk_ends_with_status_3(work) -> None:
    """A process limit of 8,000 bytes a file stands for the disk; no partial file is left."""
    program = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (8000, 8000)); "
        "from lumisplat.cli import main; sys.exit(main())"
    )
    command = [sys.executable, "-c", program, "orbit", "capture.ply", "-o", "out", "--seconds", "0.3", "--fps", "20"]
    command += ["--width", "512", "--height", "384", "--device", "cpu", "--up", "y-down"]
    done = subprocess.run(command, cwd=work.folder, capture_output=True, text=True, check=False, env=os.environ)
    assert done.returncode == 3, done.stderr
    assert done.stderr.startswith("error: frame 0: out/frame_0000.png: cannot be written: ")
    assert "out holds 0 of 6 frames; the same command continues" in done.stderr
    assert not list(work.path("out").glob("*.png")) and not list(work.path("out").glob(".*"))


def test_stored_settings_have_every_option_that_images_depend_on(work) -> None:
    """The test fails for a new option that is in neither list."""
    assert render(work, "out", "--resume", "--format", "exr").status == 0
    stamp = json.loads(work.path("out/render.json").read_text())
    options = {field.name for field in fields(Render) if not is_dataclass(field.default_factory)}
    missing = options - stamp.keys() - {"viewpoint", "light"}
    assert missing == {"output", "resume", "frames", "tiles", "debug", "stats", "changes"}
    assert {"trace.hits_per_pass", "seed", "crease_angle"} <= stamp.keys()  # settings that have no option of their own
