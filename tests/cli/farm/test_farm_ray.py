"""Workers as actors of Ray: they die, and all frames are there; its ports are open to this machine alone."""

from __future__ import annotations

import importlib
import importlib.util
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

import lumisplat as ls
from lumisplat.cli.farm import ray_actors
from lumisplat.cli.farm.ray_actors import connect
from support.files.cli_files import Workplace

needs_ray = pytest.mark.skipif(
    importlib.util.find_spec("ray") is None, reason="Ray is not installed: pip install 'lumisplat[farm]'"
)
pytestmark = [needs_ray, pytest.mark.filterwarnings("ignore")]

PROGRAM = """
import os, sys
from pathlib import Path
import lumisplat as ls
from lumisplat.cli.farm.places import FarmRoom
from lumisplat.cli.farm.run import FarmRun
from lumisplat.cli.farm.worker import Order
from support.frame_makers import FakeMaker

maker = FakeMaker(Path("out").absolute(), count=60, wrong={7: "exit", 23: "kill"})
room = FarmRoom(workers=2, cores=1, device="cpu")
print(FarmRun(Order(maker, os.getcwd()), "ray", room, lambda *_: None, overwrite=False, video=None).run())
"""
PORTS = """
import subprocess
from lumisplat.cli.farm.ray_actors import connect, load_ray
print(connect("ray"))
ray = load_ray()
ray.get(ray.remote(lambda: 1).remote())
print(subprocess.run(["ss", "-ltnpH"], capture_output=True, text=True).stdout)
ray.shutdown()
"""


def run(program: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Runs a program in a process of its own, as Ray stays in one for good."""
    command = [sys.executable, "-c", program]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, env=os.environ)


def test_sixty_frames_of_actors_that_die(tmp_path: Path) -> None:
    """One exits in mid-frame, one is killed: all frames are there, and only what was at hand was begun twice."""
    done = run(PROGRAM, tmp_path)
    assert done.returncode == 0, done.stderr
    assert "60 frames by 2 workers in " in done.stdout and "2 workers lost and replaced" in done.stdout
    assert len(list((tmp_path / "out").glob("frame_*.png"))) == 60
    begun = sorted(int(path.name.split("_")[0]) for path in (tmp_path / "made").iterdir())
    assert begun == sorted([*range(60), 7, 23])
    assert "its ports are open on 127.0.0.1 alone" in done.stderr


def test_ports_of_a_local_cluster(tmp_path: Path) -> None:
    """What the line says of them is what ``ss`` shows of all of Ray's processes."""
    done = run(PORTS, tmp_path)
    assert done.returncode == 0, done.stderr
    assert "its ports are open on 127.0.0.1 alone" in done.stdout
    of_ray = ("raylet", "gcs_server", "ray::")
    addresses = [line.split()[3] for line in done.stdout.splitlines() if any(name in line for name in of_ray)]
    assert addresses
    assert all(address.startswith(("127.0.0.1:", "[::ffff:127.0.0.1]:", "[::1]:")) for address in addresses)


@pytest.mark.deep
def test_frames_are_those_of_one_process(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """To the bit, by the command."""
    work = Workplace(tmp_path, capsys)
    options = ("--seconds", "0.3", "--fps", "20", "--width", "24", "--height", "16", "--device", "cpu")
    assert work.run("orbit", "@capture.ply", "-o", "@whole", *options).status == 0
    command = [
        sys.executable,
        "-m",
        "lumisplat",
        "farm",
        "orbit",
        str(work.path("capture.ply")),
        "-o",
        "farm",
        *options,
    ]
    command += ["--workers", "2", "--address", "ray"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for path in sorted(work.path("whole").glob("*")):
        assert path.read_bytes() == (work.path("farm") / path.name).read_bytes()


@pytest.mark.deep
def test_a_cluster_that_is_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By Ray's client and as a part of it: the same frames, and the cluster stays; its token is shown."""
    work = Workplace(tmp_path, capsys)
    gcs, client = 6399, 9991  # outside of the range of Ray's own ports
    start = [str(Path(sys.executable).with_name("ray")), "start", "--head", "--block", f"--port={gcs}"]
    start += [f"--ray-client-server-port={client}", "--include-dashboard=false", "--num-cpus=2"]
    loopback = os.environ | {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0", "RAY_USAGE_STATS_ENABLED": "0"}
    head = subprocess.Popen(start, env=loopback, start_new_session=True, stdout=subprocess.DEVNULL)
    try:
        wait_for_port(client)
        options = ("--seconds", "0.3", "--fps", "20", "--width", "24", "--height", "16", "--device", "cpu")
        assert work.run("orbit", "@capture.ply", "-o", "@whole", *options).status == 0
        for folder, address in (("client", f"ray://127.0.0.1:{client}"), ("part", f"127.0.0.1:{gcs}")):
            command = [sys.executable, "-m", "lumisplat", "farm", "orbit", "capture.ply", "-o", folder, *options]
            command += ["--workers", "2", "--address", address]
            done = subprocess.run(command, cwd=tmp_path, env=loopback, capture_output=True, text=True, check=False)
            assert done.returncode == 0, done.stderr
            for path in sorted(work.path("whole").glob("*.png")):
                assert path.read_bytes() == (work.path(folder) / path.name).read_bytes()
    finally:
        os.killpg(head.pid, signal.SIGTERM)
        head.wait()


def wait_for_port(port: int) -> None:
    """Waits until somebody listens."""
    for _ in range(300):
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.2)
    raise AssertionError("nobody listens")


@pytest.mark.parametrize(
    ("address", "why"),
    [
        ("127.0.0.1:1", "nobody listens there: "),
        ("ray://127.0.0.1:1", "nobody listens there: "),
    ],
)
def test_no_cluster_is_said_in_a_line(address: str, why: str) -> None:
    """Within seconds, where Ray would try for minutes."""
    with pytest.raises(ls.ConfigError) as raised:
        connect(address)
    assert str(raised.value).startswith(f"--address {address}: {why}") and "\n" not in str(raised.value)


def test_a_cluster_that_has_died_is_not_waited_for(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Ray remembers it, and would try for minutes."""
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    (tmp_path / "current").write_text("127.0.0.1:1")
    monkeypatch.setattr(ray_actors, "_CURRENT", tmp_path / "current")
    with pytest.raises(ls.ConfigError, match=r"--address auto: nobody listens at 127\.0\.0\.1:1: "):
        connect("auto")


@pytest.mark.parametrize("where", ["", " on Ray Client", " on node 127.0.0.1"])
def test_another_ray_on_the_other_side_is_said(monkeypatch: pytest.MonkeyPatch, where: str) -> None:
    """An older one refuses us: a line that has both versions. The words are those of Ray 2.60 about a head of 2.40."""
    ray = importlib.import_module("ray")

    def refused(**_: object) -> None:
        raise RuntimeError(
            "Version mismatch: The cluster was started with:\n    Ray: 2.40.0\n    Python: 3.10.1\n"
            f"This process{where} was started with:\n    Ray: 2.60.0\n    Python: 3.11.7\n"
        )

    monkeypatch.setattr(ray, "init", refused)
    monkeypatch.setattr(ray_actors, "_check_reachable", lambda address: None)
    with pytest.raises(ls.ConfigError) as raised:
        connect("ray://farm:10001")
    assert str(raised.value) == (
        "--address ray://farm:10001: the cluster is of Ray 2.40.0 with Python 3.10.1, this process of Ray 2.60.0 with "
        "Python 3.11.7: install the same on both sides"
    )
