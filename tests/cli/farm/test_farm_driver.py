"""Tests the driver of a farm with a simulated Ray: no frame is lost, and none is made twice without need."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

import lumisplat as ls
from lumisplat.cli import main
from lumisplat.cli.farm.cluster import LOCAL
from lumisplat.cli.farm.driver import FAILURES_IN_A_ROW, Driver, FarmOptions
from lumisplat.cli.farm.failed_frames import FramesMissingError
from lumisplat.cli.farm.worker import Answer, Order
from support.fake_ray import Does, FakeRay, answer, died
from support.frame_makers import FakeMaker

FULL = ls.FormatError("out/frame_0001.png", "cannot be written: No space left on device")
Trouble = Callable[[int, int | None], Answer | Exception | str | None]


class Farm:
    """Driver of workers that write files, with the failures that a test injects."""

    def __init__(self, folder: Path, count: int, trouble: Trouble = lambda *_: None, **changes: Any) -> None:
        self.frames = FakeMaker(folder / "out", count=count).open_frames(lambda *_: None).frames
        self.frames = replace(self.frames, **{k: v for k, v in changes.items() if k in ("needs", "in_sequence")})
        self.ray = FakeRay(self._does(trouble), cpus=changes.get("cpus", 2), gpus=changes.get("gpus", 0))
        self.shown: list[tuple[str, float]] = []
        options = FarmOptions(
            workers=changes.get("workers", 2),
            cores=changes.get("cores"),
            frame_timeout=changes.get("frame_timeout"),
            address=changes.get("address", "auto"),
        )
        order = Order(FakeMaker(folder / "out", count=count), os.getcwd())
        self.driver = Driver(
            *(self.ray, order, options, changes.get("device", "cpu"), lambda *progress: self.shown.append(progress)),
            overwrite=False,
            video=None,
            clock=lambda: self.ray.now,
        )

    def run(self) -> str:
        """Makes the frames."""
        return self.driver.run()

    @property
    def tries(self) -> dict[int, int]:
        """Counts how often each frame was given to a worker."""
        return dict(Counter(frame for _, frame in self.ray.given))

    @property
    def finished(self) -> list[int]:
        """Lists the frames whose files exist."""
        return [index for index in self.frames.wanted if self.frames.folder.is_finished(index)]

    def _does(self, trouble: Trouble) -> Does:
        def does(worker: int, frame: int | None) -> Answer | Exception | None:
            found = trouble(worker, frame)
            if isinstance(found, str):
                return None
            if found is not None:
                return found
            if frame is None:
                return answer(frames=self.frames)
            self.frames.folder.path(frame).write_text(f"{frame}")
            return answer(seconds=2.0)

        return does


@pytest.fixture(autouse=True)
def _host(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("socket.gethostname", lambda: "here")


def once(frame: int, what: Answer | Exception | str) -> Trouble:
    """Returns a failure of the first attempt at a frame."""
    left = [what]
    return lambda _, index: left.pop() if index == frame and left else None


def always(frame: int, what: Answer | Exception | str) -> Trouble:
    """Returns a failure of every attempt at a frame."""
    return lambda _, index: what if index == frame else None


def failed(error: BaseException, *, is_mistake: bool = False) -> Answer:
    """Returns the answer about a failed frame."""
    return answer(error=error, is_mistake=is_mistake)


def test_farm_gives_each_frame_to_exactly_one_worker(tmp_path: Path) -> None:
    """A worker has one frame at a time; the summary has the time, and no worker remains."""
    farm = Farm(tmp_path, 9)
    assert farm.run().startswith(f"9 frames in {tmp_path / 'out'}\n9 frames by 2 workers in ")
    assert farm.tries == dict.fromkeys(range(9), 1) and farm.finished == list(range(9))
    assert not farm.ray.living
    assert {worker for worker, _ in farm.ray.given} == {0, 1}


def test_farm_does_not_make_existing_frames_again(tmp_path: Path) -> None:
    """Only missing frames are given to workers; if none is missing, no worker starts."""
    Farm(tmp_path, 5).run()
    for index in (1, 3):
        (tmp_path / "out" / f"frame_{index:04d}.png").unlink()
    farm = Farm(tmp_path, 5)
    assert farm.run().startswith(f"5 frames in {tmp_path / 'out'}, 3 of them already existed\n2 frames by")
    assert sorted(farm.tries) == [1, 3]
    again = Farm(tmp_path, 5)
    assert again.run() == f"5 frames in {tmp_path / 'out'}, 5 of them already existed" and not again.ray.given


def test_farm_replaces_a_lost_worker_and_retries_its_frame(tmp_path: Path, caplog: Any) -> None:
    """All frames exist, and only the frame of the lost worker was started twice."""
    farm = Farm(tmp_path, 9, once(4, died("killed\nby somebody")))
    assert farm.run().endswith("1 worker lost and replaced")
    assert farm.tries == dict.fromkeys(range(9), 1) | {4: 2} and farm.ray.started == 3
    assert "a worker was lost (killed by somebody), at frame 4" in caplog.messages


def test_farm_gives_up_a_frame_that_kills_two_workers(tmp_path: Path) -> None:
    """The error names the frame; all other frames exist, and the exit status tells schedulers to try again."""
    farm = Farm(tmp_path, 6, always(3, died()))
    with pytest.raises(FramesMissingError) as error:
        farm.run()
    assert str(error.value) == (
        f"frame 3: a worker was lost: its process has ended; {tmp_path / 'out'} holds 5 of 6 frames; the same command "
        "continues"
    )
    assert FramesMissingError.status == 3 and farm.tries[3] == 2 and farm.finished == [0, 1, 2, 4, 5]


def test_farm_stops_after_four_failures_in_a_row(tmp_path: Path) -> None:
    """A full disk does not fail a hundred frames; a success between two failures lets the job continue."""
    farm = Farm(tmp_path, 100, lambda _, index: failed(FULL) if index else None, workers=1)
    with pytest.raises(FramesMissingError, match=r"4 failures in a row, the last: .* holds 1 of 100 frames"):
        farm.run()
    assert len(farm.ray.given) <= FAILURES_IN_A_ROW + 1
    other = Farm(tmp_path / "other", 20, lambda _, index: failed(FULL) if index and index % 2 else None)
    with pytest.raises(FramesMissingError, match=r"holds 1[0-9] of 20 frames"):
        other.run()
    assert set(range(0, 20, 2)) <= set(other.finished)


def test_farm_stops_if_a_wrong_setting_makes_the_first_frame_fail(tmp_path: Path) -> None:
    """A wrong setting would be repeated in all frames."""
    farm = Farm(tmp_path, 9, always(0, failed(ls.ConfigError("samples is 0"), is_mistake=True)))
    with pytest.raises(ls.ConfigError, match="samples is 0"):
        farm.run()
    assert len(farm.ray.given) <= 2 and not farm.ray.living


def test_farm_continues_without_workers_that_cannot_start(tmp_path: Path, caplog: Any) -> None:
    """If no worker can start, the last error is that of the job, and the errors before are logged once."""
    lost, full = ls.errors.MissingFileError("lost.ply", "no such file"), ls.DeviceError("no GPU")
    refused: list[BaseException] = [full, lost, full, lost]
    with pytest.raises(ls.errors.MissingFileError, match="no such file"):
        Farm(tmp_path, 9, lambda worker, _: answer(error=refused[worker]), workers=4).run()
    assert caplog.messages == ["a worker could not start: no GPU"]
    farm = Farm(tmp_path, 9, lambda worker, index: answer(error=lost) if worker == 0 and index is None else None)
    farm.run()
    assert len(farm.finished) == 9 and "a worker could not start: lost.ply: no such file" in caplog.messages


def test_farm_stops_after_two_workers_in_a_row_die_while_starting(tmp_path: Path) -> None:
    """Two failed starts in a row end the job."""
    farm = Farm(tmp_path, 9, lambda *_: died("it could not start"), workers=1)
    with pytest.raises(ls.DeviceError, match="a worker ended before it was ready: it could not start"):
        farm.run()
    assert farm.ray.started == 2


def test_farm_workers_continue_if_a_scene_file_is_deleted(tmp_path: Path, caplog: Any) -> None:
    """A replacement worker that cannot load the scene is not used; without workers, all frames left fail."""
    gone = ls.errors.MissingFileError("garden.ply", "no such file")

    def trouble(worker: int, index: int | None) -> Answer | Exception | None:
        if index is None:
            return answer(error=gone) if worker > 1 else None
        return died() if worker == 1 or index == 6 else None

    farm = Farm(tmp_path, 9, trouble)
    with pytest.raises(FramesMissingError, match=r"garden\.ply: no such file"):
        farm.run()
    assert len(farm.finished) >= 5


def test_farm_gives_no_frames_to_a_worker_whose_scene_files_differ_from_the_first(tmp_path: Path, caplog: Any) -> None:
    """The log line names the difference: mixed frames would be worse than fewer workers."""
    farm = Farm(tmp_path, 9)
    other = replace(farm.frames, provenance=farm.frames.provenance | {"needs": "older.ply"})
    farm.ray.does = farm._does(lambda worker, index: answer(frames=other) if index is None and worker == 1 else None)
    farm.run()
    assert {worker for worker, _ in farm.ray.given} == {0}
    assert "a worker differs from the first one in needs" in caplog.text


def test_farm_refuses_several_workers_for_a_realtime_sequence(tmp_path: Path) -> None:
    """A real-time frame depends on the frames before, so one worker makes all frames."""
    with pytest.raises(ls.ConfigError, match="workers cannot share them"):
        Farm(tmp_path, 9, in_sequence=True).run()
    farm = Farm(tmp_path, 9, in_sequence=True, workers=1)
    farm.run()
    assert [index for _, index in farm.ray.given] == list(range(9))


def test_farm_logs_a_line_of_several_workers_once_and_names_the_machine_of_an_error(
    tmp_path: Path, caplog: Any
) -> None:
    """An error of a worker on another machine names the machine."""
    farm = Farm(tmp_path, 2)
    farm.ray.does = farm._does(
        lambda worker, index: answer(frames=farm.frames, lines=["grainy"]) if index is None else None
    )
    farm.run()
    assert caplog.messages == ["grainy"]
    gone = answer(error=ls.errors.MissingFileError("garden.ply", "no such file"), host="node-3")
    with pytest.raises(ls.errors.MissingFileError) as raised:
        Farm(tmp_path, 3, lambda *_: gone, workers=1).run()
    assert raised.value.__notes__ == ["on node-3"]


def test_farm_progress_counts_finished_and_failed_frames(tmp_path: Path) -> None:
    """The label also has the time that a worker needs for a frame."""
    farm = Farm(tmp_path, 4)
    farm.run()
    of_frames = [progress for progress in farm.shown if progress[0].startswith("frames, ")]
    assert [fraction for _, fraction in of_frames] == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert of_frames[0][0] == "frames, 0 of 4" and of_frames[-1][0] == "frames, 4 of 4, 2 s per frame on one worker"


def test_farm_starts_a_frame_after_all_frames_on_which_that_frame_depends(tmp_path: Path) -> None:
    """A frame fails if a frame that it needs has failed."""
    needs = {2: (0, 1), 4: (3,)}
    farm = Farm(tmp_path, 5, needs=needs)
    farm.run()
    order = [index for _, index in farm.ray.given]
    assert order.index(2) > max(order.index(0), order.index(1)) and order.index(4) > order.index(3)
    farm = Farm(tmp_path / "other", 5, always(0, failed(FULL)), needs=needs)
    with pytest.raises(FramesMissingError, match="frame 0 and 1 more frame: "):
        farm.run()
    assert farm.finished == [1, 3, 4] and 2 not in farm.tries


def test_farm_ends_a_hanging_worker_after_the_frame_timeout(tmp_path: Path, caplog: Any) -> None:
    """The worker's frame is tried once more, then reported; loading and waiting have no limit."""

    def first(_: int, index: int | None) -> str | None:
        return "hangs" if index == 1 and farm.tries[1] == 1 else None

    farm = Farm(tmp_path, 4, first, frame_timeout="10s", workers=1)
    farm.run()
    assert farm.tries[1] == 2 and 10.0 < farm.ray.now < 12.0
    assert "a worker was lost (it takes longer than --frame-timeout 10s, and was ended), at frame 1" in caplog.messages
    hung = Farm(tmp_path / "other", 3, always(1, "hangs"), frame_timeout="10s")
    with pytest.raises(FramesMissingError, match=r"^frame 1: it takes longer than --frame-timeout 10s; .* 2 of 3"):
        hung.run()
    assert not hung.ray.living

    def loads(worker: int, index: int | None) -> str | None:
        return "loads" if index is None and slow.ray.now < 60.0 else None

    slow = Farm(tmp_path / "slow", 2, loads, frame_timeout="10s")
    slow.run()
    assert slow.ray.started == 2


@pytest.mark.parametrize(
    ("changes", "needs", "count"),
    [
        ({"cpus": 16, "workers": None}, {"num_cpus": 4}, 4),
        ({"cpus": 16, "workers": None, "cores": 2}, {"num_cpus": 2}, 8),
        ({"cpus": 16, "gpus": 3, "workers": None, "device": "auto"}, {"num_gpus": 1, "num_cpus": 1}, 3),
        ({"cpus": 16, "gpus": 3, "workers": None, "device": "cpu"}, {"num_cpus": 4}, 4),
        ({"cpus": 16, "gpus": 1, "workers": 2, "device": "cuda"}, {"num_gpus": 1, "num_cpus": 1}, 2),
        (
            {"cpus": 16, "gpus": 1, "workers": 2, "device": "cuda", "address": LOCAL},
            {"num_gpus": 0.5, "num_cpus": 1},
            2,
        ),
        ({"cpus": 16, "workers": 2, "address": LOCAL}, {"num_cpus": 8}, 2),
    ],
)
def test_farm_workers_request_gpus_if_the_cluster_has_any_and_else_cpu_cores(
    tmp_path: Path, changes: dict[str, Any], needs: dict[str, float], count: int
) -> None:
    """Each worker has a GPU if the cluster has any, shared if it has fewer GPUs than workers.

    Otherwise it has CPU cores.
    """
    farm = Farm(tmp_path, 9, **changes)
    farm.run()
    assert farm.ray.needs == {"max_restarts": 0, "max_task_retries": 0} | needs and farm.ray.started == count


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60, deadline=None)
@given(
    seed=st.randoms(use_true_random=False),
    count=st.integers(1, 20),
    workers=st.integers(1, 4),
    trouble=st.floats(0.0, 0.3),
)
def test_farm_loses_no_frame_in_random_failures(tmp_path_factory: Any, seed, count: int, workers: int, trouble) -> None:
    """Each frame exists or is reported; no frame is given to a worker once it exists, or more than twice."""

    def happens(worker: int, index: int | None) -> Answer | Exception | None:
        if index is None or seed.random() >= trouble:
            return None
        return seed.choice([died(), failed(FULL)])

    farm = Farm(tmp_path_factory.mktemp("farm"), count, happens, workers=workers)
    try:
        farm.run()
    except FramesMissingError:
        assert len(farm.finished) < count
    else:
        assert farm.finished == list(range(count))
    assert max(farm.tries.values()) <= 2 and not farm.ray.living


@pytest.mark.parametrize("text", ["soon", "0s", "-3"])
def test_farm_refuses_a_frame_timeout_that_is_no_duration(
    tmp_path: Path, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line is printed before any worker starts."""
    command = ["farm", "orbit", str(tmp_path / "garden.ply"), "-o", str(tmp_path / "out"), f"--frame-timeout={text}"]
    assert main(command) == 2
    assert f"--frame-timeout is '{text}', expected a time such as 90s, 10m or 1.5h" in capsys.readouterr().err
