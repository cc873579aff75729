"""Scene files written by hand, for the tests of what they may hold."""

from __future__ import annotations

from pathlib import Path

import pytest

import lumisplat as ls


def write_scene(folder: Path, text: str) -> Path:
    """Writes ``scene.toml``; returns its path."""
    (folder / "scene.toml").write_text(text, encoding="utf-8")
    return folder / "scene.toml"


def load_scene(folder: Path, text: str) -> ls.Scene:
    """The scene that ``text`` describes."""
    scene = ls.load(write_scene(folder, text))
    assert isinstance(scene, ls.Scene)
    return scene


def refuses(caught: pytest.ExceptionInfo[ls.FormatError], folder: Path, problem: str) -> None:
    """The error is one line about the scene file that holds ``problem``."""
    said = str(caught.value)
    assert said.startswith(f"{folder / 'scene.toml'}: ")
    assert problem in said
    assert "\n" not in said
