"""Workers as processes: they are killed, they leave, their driver is killed, and all frames are there."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import lumisplat as ls
from lumisplat.cli.farm.failed_frames import FramesMissingError
from lumisplat.cli.farm.places import FarmRoom, local_places
from lumisplat.cli.farm.run import FarmRun
from lumisplat.cli.farm.worker import Order
from support.frame_makers import FakeMaker
from support.processes import PROGRAM, driver_of, is_running, wait_for
from support.scenes.raster_scenes import one_gaussian

TWO = FarmRoom(workers=2, cores=1, device="cpu")


def farm(maker: FakeMaker, room: FarmRoom = TWO, **options: bool) -> str:
    """Makes the frames by two processes; the lines that say so."""
    order = Order(maker, os.getcwd())
    overwrite = options.get("overwrite", False)
    return FarmRun(order, "local", room, lambda *_: None, overwrite=overwrite, video=None).run()


def expected(count: int) -> dict[str, str]:
    """The frames that are to be there."""
    return {f"frame_{index:04d}.png": f"{index}" for index in range(count)}


def test_frames_of_workers_that_die(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """One is killed, one exits, each in mid-frame: all frames are there, and only what was at hand was begun twice."""
    maker = FakeMaker(tmp_path / "out", count=12, wrong={2: "kill", 7: "exit"})
    lines = farm(maker)
    assert maker.contents == expected(12)
    assert maker.begun == sorted([*range(12), 2, 7])
    assert lines.startswith(f"12 frames in {tmp_path / 'out'}\n12 frames by 2 workers in ")
    assert lines.endswith("2 workers lost and replaced")
    assert any("killed by SIGKILL" in line and "at frame 2" in line for line in caplog.messages)
    assert any("ended with status 7" in line and "at frame 7" in line for line in caplog.messages)
    again = farm(maker)
    assert again == f"12 frames in {tmp_path / 'out'}, 12 of them were there"
    assert len(maker.begun) == 14


def test_how_far_it_is_is_shown(tmp_path: Path) -> None:
    """How many of how many, and what one takes of a worker; the bar adds the time that is left."""
    maker, shown = FakeMaker(tmp_path / "out", count=4, seconds=0.1), list[tuple[str, float]]()
    order = Order(maker, os.getcwd())
    FarmRun(order, "local", TWO, lambda *told: shown.append(told), overwrite=False, video=None).run()
    of_frames = [told for told in shown if told[0].startswith("frames, ")]
    assert of_frames[0] == ("frames, 0 of 4", 0.0) and [fraction for _, fraction in of_frames] == [
        0,
        0.25,
        0.5,
        0.75,
        1,
    ]
    assert all("s of a worker each" in label for label, _ in of_frames[1:])


def test_a_missing_package_is_said_once(tmp_path: Path) -> None:
    """The error of a worker crosses to the driver whole, and ends the job: it would come again in all frames."""
    with pytest.raises(ls.MissingExtraError, match=r"OpenUSD needs a package .*: pip install 'lumisplat\[usd\]'"):
        farm(FakeMaker(tmp_path / "out", count=4, wrong={0: "extra", 1: "extra"}))


def test_a_frame_that_kills_its_worker_twice_is_reported_and_left(tmp_path: Path) -> None:
    """The others are there; the status tells schedulers that a second try may help."""
    maker = FakeMaker(tmp_path / "out", count=6, wrong={3: "exit"}, again=True)
    with pytest.raises(FramesMissingError) as error:
        farm(maker)
    assert str(error.value) == (
        f"frame 3: a worker was lost: it ended with status 7; {tmp_path / 'out'} holds 5 of 6 frames; the same command "
        "continues"
    )
    assert FramesMissingError.status == 3
    assert maker.begun == [0, 1, 2, 3, 3, 4, 5]


def test_a_full_disk(tmp_path: Path) -> None:
    """It ends the job after a few frames, with a line; once there is room, the same command continues."""
    full = dict.fromkeys(range(3, 40), "full")
    maker = FakeMaker(tmp_path / "out", count=40, wrong=full, again=True)
    with pytest.raises(FramesMissingError) as error:
        farm(maker, FarmRoom(workers=1, cores=1, device="cpu"))
    assert str(error.value).count("failures in a row, the last: ") == 1  # of all that were given up
    assert str(error.value).count("No space left on device") <= 3 and "holds 3 of 40 frames" in str(error.value)
    assert len(maker.begun) < 12
    farm(FakeMaker(tmp_path / "out", count=40))
    assert maker.contents == expected(40)


@pytest.mark.parametrize(("kind", "error"), [("setting", ls.ConfigError), ("data", ls.SceneError)])
def test_a_mistake_is_said_once(tmp_path: Path, kind: str, error: type[Exception]) -> None:
    """As it is without workers: one line, status 2."""
    maker = FakeMaker(tmp_path / "out", count=6, wrong=dict.fromkeys(range(6), kind), again=True)
    with pytest.raises(error) as raised:
        farm(maker)
    assert not isinstance(raised.value, FramesMissingError)


@pytest.mark.deep
def test_a_file_that_vanishes(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A worker that is started anew cannot load the scene any more: the other one does its frames."""
    scene = tmp_path / "scene.ply"
    scene.write_text("scene")
    maker = FakeMaker(tmp_path / "out", count=50, seconds=0.1, wrong={8: "kill"}, needs=scene)

    def watched(*_: object) -> None:
        if scene.exists() and (tmp_path / "made").exists():
            if len({path.name.split("_")[1] for path in (tmp_path / "made").iterdir()}) == 2:
                scene.unlink()

    order = Order(maker, os.getcwd())
    FarmRun(order, "local", TWO, watched, overwrite=False, video=None).run()
    assert maker.contents == expected(50)
    assert any("one worker fewer: " in line and "no such file" in line for line in caplog.messages)
    with pytest.raises(ls.MissingFileError, match="no such file"):
        farm(maker)


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    """It is said before any frame."""
    (tmp_path / "out").write_text("a file")
    with pytest.raises(ls.FormatError, match="is a file, expected a folder"):
        farm(FakeMaker(tmp_path / "out"))


@pytest.mark.deep
def test_two_farms_in_one_folder(tmp_path: Path) -> None:
    """Of one origin, they share the work; of another, the second is refused."""
    maker = FakeMaker(tmp_path / "out", count=20, seconds=0.1)
    other = driver_of(tmp_path / "out", 20, 0.1)
    farm(maker)
    assert other.wait() == 0
    assert maker.contents == expected(20)
    needs = tmp_path / "x.ply"
    needs.write_text("scene")
    with pytest.raises(ls.ConfigError, match=r"holds frames of other settings or files \(needs\)"):
        farm(FakeMaker(tmp_path / "out", count=20, needs=needs))
    assert maker.contents == expected(20)


def test_a_driver_that_is_killed(tmp_path: Path) -> None:
    """Its workers end with it, half-made frames leave nothing, and the next driver makes what is missing."""
    maker = FakeMaker(tmp_path / "out", count=12, seconds=0.3)
    driver = driver_of(tmp_path / "out", 12, 0.3)
    wait_for(lambda: len(maker.contents) >= 3)
    workers = {int(path.name.split("_")[1]) for path in (tmp_path / "made").iterdir()}
    driver.kill()
    driver.wait()
    wait_for(lambda: not any(is_running(process) for process in workers))
    there = maker.contents
    assert 3 <= len(there) < 12 and not list((tmp_path / "out").glob(".*"))
    begun = len(maker.begun)
    lines = farm(maker)
    assert maker.contents == expected(12) and f"{len(there)} of them were there" in lines
    assert len(maker.begun) - begun == 12 - len(there)
    assert len(maker.begun) <= 12 + 2  # at most what both were at is begun twice


@pytest.mark.deep
def test_an_interrupt_says_how_far_it_is(tmp_path: Path) -> None:
    """Ctrl C, which reaches the workers, too, ends the driver; they end by its end."""
    maker = FakeMaker(tmp_path / "out", count=12, seconds=0.3)
    program = PROGRAM.replace(
        "except ls.LumisplatError",
        "except KeyboardInterrupt as stop:\n        print(*stop.args)\n    except ls.LumisplatError",
    )
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    driver = driver_of(tmp_path / "out", 12, 0.3, program, **pipes)
    wait_for(lambda: len(maker.contents) >= 2)
    os.killpg(driver.pid, signal.SIGINT)
    out, err = driver.communicate()
    assert f"{tmp_path / 'out'} holds " in out and "of 12 frames; the same command continues" in out
    assert "Traceback" not in err


def test_workers_do_not_hear_an_interrupt(tmp_path: Path) -> None:
    """It is for the driver: a worker that alone is told to stop goes on."""
    maker = FakeMaker(tmp_path / "out", count=6, seconds=0.3)
    driver = driver_of(tmp_path / "out", 6, 0.3)
    wait_for(lambda: len(maker.contents) >= 2)
    for pid in {int(path.name.split("_")[1]) for path in (tmp_path / "made").iterdir()}:
        os.kill(pid, signal.SIGINT)
    assert driver.wait() == 0
    assert maker.contents == expected(6) and maker.begun == list(range(6))


def test_places() -> None:
    """As many as asked for, each with its share of the cores; one a GPU where there are any."""
    places = local_places(FarmRoom(workers=3, cores=2, device="cpu"))
    assert [place.environment for place in places] == [{"LUMISPLAT_THREADS": "2"}] * 3
    with pytest.raises(ls.ConfigError, match="--workers is 0, expected 1 or more"):
        FarmRoom(workers=0, cores=None, device="cpu")


def test_workers_share_the_gpus(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that this process may use; a device that is named is used by all."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2,5")
    seen = [
        place.environment["CUDA_VISIBLE_DEVICES"]
        for place in local_places(FarmRoom(workers=None, cores=None, device="auto"))
    ]
    assert seen == ["2", "5"]
    (place,) = local_places(FarmRoom(workers=1, cores=1, device="cuda:1"))
    assert "CUDA_VISIBLE_DEVICES" not in place.environment
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "-1")
    assert "CUDA_VISIBLE_DEVICES" not in local_places(FarmRoom(workers=1, cores=1, device="auto"))[0].environment


def test_workers_run_no_modules_of_the_working_folder(tmp_path: Path) -> None:
    """Python would look for its own modules there first: the folder of a stranger's capture is no place for that."""
    (tmp_path / "multiprocessing.py").write_text("open('hostile', 'w').close()")
    ls.save(tmp_path / "one.ply", one_gaussian())
    command = [str(Path(sys.executable).with_name("lumisplat")), "farm", "render", "one.ply", "--width", "16"]
    command += ["--workers", "1", "--device", "cpu", "-o", "frames"]
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONSAFEPATH"}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "hostile").exists()
