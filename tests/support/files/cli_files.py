"""Writes small files for tests of the command line."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import pytest

import lumisplat as ls
from lumisplat.cli import main
from support.scenes.raster_scenes import front_camera, random_gaussians


@dataclass(frozen=True)
class Outcome:
    """Exit status and output of a command."""

    status: int
    out: str
    err: str


class Workspace:
    """A folder with a capture, a camera file of two frames and a mesh, in which tests run commands."""

    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.folder = folder
        self._capsys = capsys
        ls.save(folder / "capture.ply", random_gaussians(1, count=60))
        ls.save_cameras(folder / "cameras.json", [front_camera(name="left"), front_camera(name="right")])
        (folder / "mesh.obj").write_text("v -1 -1 4\nv 1 -1 4\nv 0 1 4\nf 1 2 3\n")

    def path(self, name: str) -> Path:
        """Returns the path of a file in the folder."""
        return self.folder / name

    def capture(self, name: str) -> ls.Gaussians:
        """Loads a capture from the folder."""
        loaded = ls.load(self.path(name))
        assert isinstance(loaded, ls.Gaussians)
        return loaded

    def run(self, *args: str) -> Outcome:
        """Runs a command; ``@name`` stands for the path of a file in the folder."""
        self._capsys.readouterr()
        status = main([str(self.path(arg[1:])) if arg.startswith("@") else arg for arg in args])
        captured = self._capsys.readouterr()
        return Outcome(status, captured.out, captured.err)

    def files(self) -> set[str]:
        """Returns the relative names of all files below the folder, including hidden ones."""
        return {str(path.relative_to(self.folder)) for path in self.folder.rglob("*") if path.is_file()}

    def write_cameras(self, name: str, **changes: object) -> None:
        """Writes the camera file with changed entries of its first frame; None removes an entry."""
        content = json.loads(self.path("cameras.json").read_text())
        content["frames"][0] |= changes
        content["frames"][0] = {key: value for key, value in content["frames"][0].items() if value is not None}
        self.path(name).write_text(json.dumps(content))
