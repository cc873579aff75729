"""Tests the scripts that submit frames to schedulers by running them here: every frame is made once."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import lumisplat as ls
from lumisplat.cli.input.numbers import frame_numbers
from support.scenes.raster_scenes import random_gaussians

EXAMPLES = Path(__file__).resolve().parents[3] / "examples" / "farm"
COUNT = 7

RECORDER = """#!{python}
import json, sys
with open({log!r}, "a") as log:
    log.write(json.dumps(sys.argv[1:]) + "\\n")
"""
DEADLINE = """#!{python}
# deadlinecommand, which runs the tasks of a command-line job at once, as workers do.
import shlex, subprocess, sys
assert sys.argv[1] == "-SubmitCommandLineJob"
given = dict(zip(sys.argv[2::2], sys.argv[3::2]))
first, last = map(int, given["-frames"].split("-"))
chunk = int(given["-chunksize"])
for start in range(first, last + 1, chunk):
    text = given["-arguments"].replace("<STARTFRAME>", str(start)).replace("<QUOTE>", '"')
    text = text.replace("<ENDFRAME>", str(min(start + chunk - 1, last)))
    subprocess.run([given["-executable"], *shlex.split(text)], check=True, cwd=given["-startupdirectory"])
"""
OUTLINE = """
class Outline:
    def __init__(self, name, shot, show):
        self.layers = []

    def add_layer(self, layer):
        self.layers.append(layer)
"""
SHELL = """
class Shell:
    def __init__(self, name, command, range, chunk):
        self.command, self.range, self.chunk = command, range, chunk
"""
CUERUN = """
# Runs the tasks at once, as RQD does, with Cuebot's tokens replaced.
import os, subprocess

def launch(job, use_pycuerun):
    for layer in job.layers:
        first, last = map(int, layer.range.split("-"))
        for start in range(first, last + 1, layer.chunk):
            numbers = list(range(start, min(start + layer.chunk, last + 1)))
            spec = f"{numbers[0]}-{numbers[-1]}" if len(numbers) > 2 else ",".join(map(str, numbers))
            tokens = {"#FRAMESPEC#": spec, "#IFRAME#": str(start), "#FRAME_END#": str(start + layer.chunk - 1)}
            command = [tokens.get(word, word) for word in layer.command]
            environment = os.environ | {"CUE_IFRAME": str(start), "CUE_CHUNK": str(layer.chunk)}
            subprocess.run(command, check=True, env=environment)
"""


class FakeSchedulers:
    """Folder with programs that stand in for ``lumisplat`` and schedulers."""

    def __init__(self, folder: Path, is_real: bool) -> None:
        self.folder = folder
        self.bin = folder / "bin"
        self.log = folder / "log"
        self.bin.mkdir()
        self.log.touch()
        real = f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m lumisplat "$@"\n'
        self.program("lumisplat", real if is_real else RECORDER.format(python=sys.executable, log=str(self.log)))
        self.program("deadlinecommand", DEADLINE.replace("{python}", sys.executable))
        (self.bin / "outline" / "modules").mkdir(parents=True)
        (self.bin / "outline/__init__.py").write_text(OUTLINE)
        (self.bin / "outline/modules/__init__.py").touch()
        (self.bin / "outline/modules/shell.py").write_text(SHELL)
        (self.bin / "outline/cuerun.py").write_text(CUERUN)

    def program(self, name: str, text: str) -> None:
        """Writes a program."""
        (self.bin / name).write_text(text)
        (self.bin / name).chmod(0o755)

    def run(self, *command: str, **variables: str) -> None:
        """Runs a command in the folder, which has to succeed."""
        paths = {"PATH": f"{self.bin}{os.pathsep}{os.environ['PATH']}"}
        paths["PYTHONPATH"] = f"{self.bin}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
        subprocess.run(command, check=True, cwd=self.folder, env=os.environ | paths | variables)

    def submit(self, scheduler: str, *arguments: str) -> None:
        """Submits a job of `COUNT` frames, three a task or to three tasks."""
        if scheduler == "slurm":
            for task in range(10, 16, 2):  # --array=10-14:2
                array = {"COUNT": "3", "MIN": "10", "MAX": "14", "STEP": "2", "ID": str(task)}
                variables = {f"SLURM_ARRAY_TASK_{name}": value for name, value in array.items()}
                self.run(str(EXAMPLES / "slurm_array.sh"), str(COUNT), *arguments, **variables)
        elif scheduler == "deadline":
            self.run(str(EXAMPLES / "deadline_submit.sh"), str(COUNT), "3", *arguments)
        else:
            self.run(sys.executable, str(EXAMPLES / "opencue_submit.py"), str(COUNT), "3", *arguments)


@pytest.mark.parametrize("scheduler", ["slurm", "deadline", "opencue"])
def test_scheduler_scripts_render_each_frame_once(tmp_path: Path, scheduler: str) -> None:
    """Each task gets a valid range of frames, and the arguments unchanged, including spaces."""
    schedulers = FakeSchedulers(tmp_path, is_real=False)
    schedulers.submit(scheduler, "animate", "my scene.toml", "-o", "frames")
    commands = [re.findall(r'"([^"]*)"', line) for line in schedulers.log.read_text().splitlines()]
    assert len(commands) == 3
    made: list[int] = []
    for command in commands:
        assert command[:5] == ["animate", "my scene.toml", "-o", "frames", "--frames"]
        made += frame_numbers("--frames", command[5], COUNT)
    assert sorted(made) == list(range(COUNT))


def test_scheduler_tasks_beyond_the_last_frame_do_nothing(tmp_path: Path) -> None:
    """The job array is larger than the animation."""
    schedulers = FakeSchedulers(tmp_path, is_real=False)
    variables = {"COUNT": "9", "MIN": "0", "MAX": "8", "STEP": "1", "ID": "8"}
    array = {f"SLURM_ARRAY_TASK_{name}": value for name, value in variables.items()}
    schedulers.run(str(EXAMPLES / "slurm_array.sh"), str(COUNT), "animate", "scene.toml", **array)
    assert not schedulers.log.read_text()


@pytest.mark.deep
def test_frames_rendered_by_scheduler_scripts_equal_those_of_one_process(tmp_path: Path) -> None:
    """Frames and stored settings are equal bit by bit."""
    schedulers = FakeSchedulers(tmp_path, is_real=True)
    ls.save(tmp_path / "capture.ply", random_gaussians(1, count=60))
    orbit = "orbit", "capture.ply", "--seconds", "0.35", "--fps", "20", "--width", "16", "--height", "12", "-o"
    schedulers.run("lumisplat", *orbit, "whole")
    for scheduler in ("slurm", "deadline", "opencue"):
        schedulers.submit(scheduler, *orbit, scheduler)
        for path in sorted((tmp_path / "whole").glob("*.png")):
            assert path.read_bytes() == (tmp_path / scheduler / path.name).read_bytes()
        assert (tmp_path / "whole/orbit.json").read_text() == (tmp_path / scheduler / "orbit.json").read_text()
