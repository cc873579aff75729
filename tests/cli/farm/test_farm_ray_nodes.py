"""Nodes of a cluster of Ray that join and die in the middle of a job, and each kind of work by its actors."""

from __future__ import annotations

import importlib.util
import os
import secrets
import subprocess
import sys
from pathlib import Path

import pytest

from support.files.cli_files import Workplace
from support.scenes.training_scenes import folder_of

pytestmark = [
    pytest.mark.skipif(
        importlib.util.find_spec("ray") is None, reason="Ray is not installed: pip install 'lumisplat[farm]'"
    ),
    pytest.mark.filterwarnings("ignore"),
]

NODES = """
import os, signal, sys, threading, time
from pathlib import Path
from ray.cluster_utils import Cluster
import lumisplat as ls
from lumisplat.cli.farm.places import FarmRoom
from lumisplat.cli.farm.run import FarmRun
from lumisplat.cli.farm.worker import Order
from support.frame_makers import FakeMaker

quick = {"health_check_initial_delay_ms": 500, "health_check_period_ms": 500, "health_check_failure_threshold": 3}
cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "_system_config": quick})
maker = FakeMaker(Path("out").absolute(), count=60, seconds=0.2)
joined = []

def processes():
    return {path.name.split("_")[1] for path in Path("made").iterdir()} if Path("made").exists() else set()

def watch(*_):
    # Two workers are wanted, and there is room for one: the other waits for the second node.
    if not joined and len(maker.contents) >= 5:
        assert len(processes()) == 1
        joined.append(cluster.add_node(num_cpus=1))
    if len(joined) == 1 and len(processes()) == 2 and len(maker.contents) >= 30:
        cluster.remove_node(joined[0], allow_graceful=False)
        joined.append(cluster.add_node(num_cpus=1))

room = FarmRoom(workers=2, cores=1, device="cpu")
print(FarmRun(Order(maker, os.getcwd()), cluster.address, room, watch, overwrite=False, video=None).run())
assert len(joined) == 2, "nothing has happened"
print(len(processes()), "processes")
"""
WORK = """
import subprocess, sys
from ray.cluster_utils import Cluster
from lumisplat.cli import main

cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 2})
two = ["--workers", "2", "--cores", "1", "--address", cluster.address]
size = ["--width", "48", "--height", "32", "--device", "cpu"]
path = ["--pipeline", "path", "--lighting", "on", "--samples", "40", *size]
train = ["--iterations", "20", "--cap", "100", "--sh-degree", "0", "--prune-below", "0", "--device", "cpu"]
jobs = {
    "render": ["capture.ply", "-o", "OUT/tiled.png", *size, "--tiles", "3x2"],
    "render samples": ["capture.ply", "-o", "OUT/shared.exr", *path, "--tiles", "samples"],
    "render both": ["capture.ply", "-o", "OUT/both.exr", *path, "--tiles", "2x1,samples"],
    "dataset": ["mesh.obj", "-o", "OUT/set", "--views", "6", *size],
    "train": ["one", "two", "-o", "OUT/captures", *train],
}
for name, options in jobs.items():
    command = ["farm", name.split()[0]]
    for folder, how in (("local", ["--workers", "2"]), ("ray", two)):
        done = main([*command, *(option.replace("OUT", folder) for option in options), *how])
        assert done == 0, (name, folder, done)
cluster.shutdown()
"""


def run(program: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Runs a program in a process of its own, whose cluster listens on 127.0.0.1 alone."""
    environment = os.environ | {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0", "RAY_USAGE_STATS_ENABLED": "0"}
    environment |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    command = [sys.executable, "-c", program]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, env=environment)


def test_nodes_join_and_die(tmp_path: Path) -> None:
    """Two workers at a time, on three nodes: all frames are there, and at most what was at hand came twice."""
    done = run(NODES, tmp_path)
    assert done.returncode == 0, done.stderr
    assert "60 frames by 2 workers in " in done.stdout and "1 worker lost and replaced" in done.stdout
    assert "3 processes" in done.stdout
    frames = {path.name: path.read_text() for path in (tmp_path / "out").glob("frame_*.png")}
    assert frames == {f"frame_{number:04d}.png": f"{number}" for number in range(60)}
    begun = [int(path.name.split("_")[0]) for path in (tmp_path / "made").iterdir()]
    assert len(begun) <= 61


@pytest.mark.deep
def test_all_work_by_two_actors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Tiles, samples, samples of tiles, a data set and trainings: the files are those of workers of this machine."""
    Workplace(tmp_path, capsys)
    for name in ("one", "two"):
        folder_of(tmp_path / name)
    done = run(WORK, tmp_path)
    assert done.returncode == 0, done.stderr
    local, ray = (files(tmp_path / name) for name in ("local", "ray"))
    assert local.keys() == ray.keys() and {"tiled.png", "shared.exr", "both.exr", "captures/two.ply"} <= local.keys()
    assert [name for name, content in local.items() if ray[name] != content] == []


def files(folder: Path) -> dict[str, bytes]:
    """What a job has left, but times and texts that say how long it took."""
    told = (".txt", "curve.json", "curve.png", ".toml")
    found = {str(path.relative_to(folder)): path for path in folder.rglob("*") if path.is_file()}
    return {name: path.read_bytes() for name, path in found.items() if not name.endswith(told)}
