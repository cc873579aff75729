"""Tests workers as Ray actors: after deaths of workers and driver all frames exist, and nothing else is affected."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import warp as wp

import lumisplat as ls
from lumisplat.cli.farm import cluster
from lumisplat.cli.farm.cluster import connected
from lumisplat.cli.farm.driver import Driver, FarmOptions
from lumisplat.cli.farm.failed_frames import FramesMissingError
from lumisplat.cli.farm.worker import Order
from support.files.cli_files import Workspace
from support.frame_makers import FakeMaker
from support.scenes.raster_scenes import one_gaussian, random_gaussians

needs_ray = pytest.mark.skipif(
    importlib.util.find_spec("ray") is None, reason="Ray is not installed: pip install 'lumisplat[farm]'"
)
pytestmark = [needs_ray, pytest.mark.filterwarnings("ignore")]

SIZE = ("--width", "24", "--height", "16", "--device", "cpu")
TWO = ("--workers", "2", "--cores", "1")
SCENE = """
[[splats]]
path = "capture.ply"

[[lights]]
type = "point"
position = [0.6, 2.0, 0.4]
intensity = 4.0

[[actors]]
path = "ball.ply"

[[actors.keyframes]]
time = 0.0
position = [-0.5, 0.0, 4.0]

[[actors.keyframes]]
time = 0.4
position = [0.5, 0.0, 4.0]

[animation]
fps = 10.0
frames = 5

[animation.lighting.shadow_map]
resolution = 32
bins = 16
"""


@pytest.fixture
def work(tmp_path, capsys, monkeypatch, ray) -> Workspace:
    """Returns a folder to run commands in; Warp's log level is restored afterwards."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    workspace = Workspace(tmp_path, capsys)
    ls.save(workspace.path("ball.ply"), random_gaussians(2, count=20))
    workspace.path("scene.toml").write_text(SCENE)
    return workspace


def wait_for(condition: Callable[[], object]) -> None:
    """Waits until a condition holds."""
    while not condition():
        time.sleep(0.02)


def farm(ray: Any, maker: FakeMaker, workers: int = 2) -> str:
    """Makes frames by workers, and returns the summary lines."""
    options = FarmOptions(workers=workers, cores=1)
    order = Order(maker, os.getcwd())
    return Driver(ray, order, options, "cpu", lambda *_: None, overwrite=False, video=None).run()


def expected(count: int) -> dict[str, str]:
    """Returns the expected frames."""
    return {f"frame_{index:04d}.png": f"{index}" for index in range(count)}


def test_frames_of_killed_ray_workers_are_made_by_other_workers(
    ray: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """One worker is killed during frame 2 and one exits during frame 7.

    All frames exist, and only frames 2 and 7 were started twice.
    """
    maker = FakeMaker(tmp_path / "out", count=12, wrong={2: "kill", 7: "exit"})
    lines = farm(ray, maker)
    assert maker.contents == expected(12) and maker.begun == sorted([*range(12), 2, 7])
    assert lines.endswith("2 workers lost and replaced")
    assert [line for line in caplog.messages if "its process on 127.0.0.1 has ended" in line and "at frame 2" in line]
    assert len({path.name.split("_")[1] for path in (tmp_path / "made").iterdir()}) <= 4


def test_error_of_a_ray_worker_is_raised_by_the_farm_command(ray: Any, tmp_path: Path) -> None:
    """A missing package and a mistake are reported once; unexpected errors have their type, message and line."""
    with pytest.raises(
        ls.errors.MissingExtraError, match=r"OpenUSD needs a package .*: pip install 'lumisplat\[usd\]'"
    ):
        farm(ray, FakeMaker(tmp_path / "a", count=4, wrong={0: "extra", 1: "extra"}), workers=1)
    with pytest.raises(ls.SceneError, match="ends in the middle of Gaussian 5"):
        farm(ray, FakeMaker(tmp_path / "b", count=3, wrong=dict.fromkeys(range(3), "data"), again=True), workers=1)
    ours = r"^frame 1: ValueError: shapes differ, in .*frame_makers\.py, line \d+;"
    with pytest.raises(FramesMissingError, match=ours):
        farm(ray, FakeMaker(tmp_path / "c", count=4, wrong={1: "bug"}, again=True), workers=1)


def files(folder: Path) -> dict[str, bytes]:
    """Returns the files of a job, except times and texts with durations."""
    varying = (".txt", "curve.json", "curve.png", ".toml")
    found = {str(path.relative_to(folder)): path for path in folder.rglob("[!.]*") if path.is_file()}
    return {name: path.read_bytes() for name, path in found.items() if not name.endswith(varying)}


PATH = ("--pipeline", "path", "--lighting", "on", "--samples", "40")


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("animate", ("@scene.toml", "-o", "@OUT", *SIZE)),
        pytest.param("render", ("@capture.ply", "-o", "@OUT/t.png", *SIZE, "--tiles", "2x1"), marks=pytest.mark.deep),
        pytest.param(
            "render", ("@capture.ply", "-o", "@OUT/s.exr", *SIZE, *PATH, "--tiles", "samples"), marks=pytest.mark.deep
        ),
        pytest.param(
            "render",
            ("@capture.ply", "-o", "@OUT/b.exr", *SIZE, *PATH, "--tiles", "2x1,samples"),
            marks=pytest.mark.deep,
        ),
        pytest.param("dataset", ("@mesh.obj", "-o", "@OUT/set", "--views", "6", *SIZE), marks=pytest.mark.deep),
    ],
)
def test_files_made_by_farm_workers_equal_those_of_one_process(
    work: Workspace, name: str, options: tuple[str, ...]
) -> None:
    """Frames, tiles, samples, samples of tiles and data sets are equal bit by bit."""
    alone, farmed = ([option.replace("OUT", folder) for option in options] for folder in ("alone", "farm"))
    resume = ["--resume"] if name == "render" and "--tiles" not in options else []
    assert work.run(name, *alone, *resume).status == 0
    done = work.run("farm", name, *farmed, *TWO)
    assert done.status == 0 and " by 2 workers in " in done.out, done.err
    assert files(work.path("farm")) == files(work.path("alone"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("orbit", "@lost.ply"), "lost.ply: no such file"),
        pytest.param(("orbit", "@capture.ply", "--samples", "0"), "samples is 0, expected", marks=pytest.mark.deep),
        pytest.param(
            ("render", "@capture.ply", "--view", "normal"),
            "--view colours all images by the first",
            marks=pytest.mark.deep,
        ),
    ],
)
def test_mistakes_found_by_farm_workers_are_reported_in_one_line(
    work: Workspace, monkeypatch, options: tuple[str, ...], message: str
) -> None:
    """Each mistake ends with status 2, and no frame is written."""
    monkeypatch.chdir(work.folder)
    done = work.run("farm", *options, "--device", "cpu", "--workers", "1")
    assert (done.status, done.out) == (2, ""), done.err
    assert message in done.err and done.err.strip().count("\n") == 0
    assert not [name for name in work.files() if name.endswith(".png")]


DRIVER = """
import os, sys
from pathlib import Path
from lumisplat.cli.farm.cluster import connected
from lumisplat.cli.farm.driver import Driver, FarmOptions
from lumisplat.cli.farm.worker import Order
from support.frame_makers import FakeMaker

maker = FakeMaker(Path(sys.argv[1]), count=200, seconds=0.1)
try:
    with connected("local", 2) as ray:
        options = FarmOptions(workers=2, cores=1)
        order = Order(maker, os.getcwd())
        Driver(ray, order, options, "cpu", lambda *_: None, overwrite=False, video=None).run()
except KeyboardInterrupt as stop:
    print(*stop.args)
"""


@pytest.mark.parametrize("sent", [signal.SIGINT, pytest.param(signal.SIGKILL, marks=pytest.mark.deep)])
def test_interrupted_farm_ends_its_workers_and_can_continue(ray: Any, tmp_path: Path, sent: signal.Signals) -> None:
    """Ctrl-C prints the number of finished frames.

    After a driver was interrupted or killed, the next run keeps the finished frames and makes the others. Modules in
    the working folder are not run.
    """
    environment = dict(os.environ, PYTHONPATH=os.pathsep.join(sys.path))
    write_hostile_modules(tmp_path)
    command = [sys.executable, "-P", "-c", DRIVER, str(tmp_path / "out")]
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    maker = FakeMaker(tmp_path / "out", count=200)
    driver = subprocess.Popen(command, env=environment, cwd=tmp_path, start_new_session=True, **pipes)
    wait_for(lambda: len(maker.contents) >= 3 or driver.poll() is not None)
    os.killpg(driver.pid, sent) if sent == signal.SIGINT else driver.kill()
    out, err = driver.communicate()
    workers = {int(path.name.split("_")[1]) for path in (tmp_path / "made").iterdir()}
    wait_for(lambda: not any(is_running(process) for process in workers))
    assert 3 <= len(maker.contents) < 200, err
    if sent == signal.SIGINT:
        assert f"{tmp_path / 'out'} holds " in out and "of 200 frames; the same command continues" in out, err
        assert "Traceback" not in err and "its ports are open on 127.0.0.1 only" in err
    assert not (tmp_path / "hostile").exists()
    begun = len(maker.begun)
    finished = len(maker.contents)
    assert f"{finished} of them already existed" in farm(ray, maker)
    assert maker.contents == expected(200) and len(maker.begun) - begun == 200 - finished


def is_running(process: int) -> bool:
    """Returns whether a process has not ended."""
    with contextlib.suppress(OSError):
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


@pytest.mark.deep
def test_farm_finishes_its_frames_while_nodes_join_and_die(tmp_path: Path) -> None:
    """Two workers at a time use three nodes; all frames exist, and only unfinished frames were started twice."""
    environment = os.environ | {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0", "RAY_USAGE_STATS_ENABLED": "0"}
    environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    command = [sys.executable, "-c", NODES]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    assert "60 frames by 2 workers in " in done.stdout and "1 worker lost and replaced" in done.stdout
    assert FakeMaker(tmp_path / "out").contents == expected(60)
    assert len(FakeMaker(tmp_path / "out").begun) <= 61


NODES = """
import os
from pathlib import Path
from ray.cluster_utils import Cluster
from lumisplat.cli.farm.cluster import connected
from lumisplat.cli.farm.driver import Driver, FarmOptions
from lumisplat.cli.farm.worker import Order
from support.frame_makers import FakeMaker

quick = {"health_check_initial_delay_ms": 500, "health_check_period_ms": 500, "health_check_failure_threshold": 3}
cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "_system_config": quick})
maker = FakeMaker(Path("out").absolute(), count=60, seconds=0.2)
joined = []

def processes():
    return {path.name.split("_")[1] for path in Path("made").iterdir()} if Path("made").exists() else set()

def watch(*_):
    # Two workers are requested but one node has cores for one: the other waits for the second node.
    if not joined and len(maker.contents) >= 5:
        assert len(processes()) == 1
        joined.append(cluster.add_node(num_cpus=1))
    if len(joined) == 1 and len(processes()) == 2 and len(maker.contents) >= 30:
        cluster.remove_node(joined[0], allow_graceful=False)
        joined.append(cluster.add_node(num_cpus=1))

options = FarmOptions(workers=2, cores=1, address=cluster.address)
with connected(cluster.address, 2) as ray:
    print(Driver(ray, Order(maker, os.getcwd()), options, "cpu", watch, overwrite=False, video=None).run())
assert len(joined) == 2, "nothing has happened"
"""


def write_hostile_modules(folder: Path) -> None:
    """Writes modules that create a file ``hostile`` when imported, in a folder that Python could search first."""
    for name in ("multiprocessing.py", "numpy.py", "sitecustomize.py"):
        (folder / name).write_text("open('hostile', 'w').close()")


@pytest.mark.deep
def test_farm_workers_do_not_import_modules_of_the_working_folder(work: Workspace) -> None:
    """The installed command ``lumisplat`` does not import such modules either, and opens ports to this machine only."""
    write_hostile_modules(work.folder)
    ls.save(work.path("one.ply"), one_gaussian())
    command = [str(Path(sys.executable).with_name("lumisplat")), "farm", "render", "one.ply", "--width", "16"]
    command += ["--workers", "1", "--device", "cpu", "-o", "frames"]
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONSAFEPATH"}
    done = subprocess.run(command, cwd=work.folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "its ports are open on 127.0.0.1 only" in done.stderr, done.stderr
    assert not work.path("hostile").exists()


@pytest.mark.parametrize("address", ["127.0.0.1:1", "ray://127.0.0.1:1", "auto"])
def test_farm_reports_a_missing_ray_cluster_in_one_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, address: str
) -> None:
    """The error comes within seconds, even for a remembered cluster that has died; Ray would try for minutes."""
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    (tmp_path / "current").write_text("127.0.0.1:1")
    monkeypatch.setattr(cluster, "_CURRENT", tmp_path / "current")
    monkeypatch.setattr(importlib.import_module("ray"), "is_initialized", lambda: False)
    with pytest.raises(ls.ConfigError) as raised, connected(address, 1):
        pass
    where = "at 127.0.0.1:1" if address == "auto" else "there"
    assert str(raised.value).startswith(f"--address {address}: nothing listens {where}: ")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("where", ["", " on Ray Client", " on node 127.0.0.1"])
def test_farm_reports_a_ray_version_mismatch_in_one_line(monkeypatch: pytest.MonkeyPatch, where: str) -> None:
    """The line has both versions; the test raises the message of Ray 2.60 about a head of 2.40."""
    module = importlib.import_module("ray")

    def refused(**_: object) -> None:
        raise RuntimeError(
            "Version mismatch: The cluster was started with:\n    Ray: 2.40.0\n    Python: 3.10.1\n"
            f"This process{where} was started with:\n    Ray: 2.60.0\n    Python: 3.11.7\n"
        )

    monkeypatch.setattr(module, "init", refused)
    monkeypatch.setattr(module, "is_initialized", lambda: False)
    monkeypatch.setattr(cluster, "_check_reachable", lambda address: None)
    with pytest.raises(ls.ConfigError) as raised, connected("ray://farm:10001", 1):
        pass
    assert str(raised.value) == (
        "--address ray://farm:10001: the cluster runs Ray 2.40.0 with Python 3.10.1, but this process runs Ray 2.60.0 "
        "with Python 3.11.7: install the same versions on both"
    )
