"""Writes scene files for tests."""

from __future__ import annotations

from pathlib import Path

import pytest

import lumisplat as ls


def write_scene(folder: Path, text: str) -> Path:
    """Writes ``scene.toml``. Returns its path."""
    (folder / "scene.toml").write_text(text, encoding="utf-8")
    return folder / "scene.toml"


def load_scene(folder: Path, text: str) -> ls.Scene:
    """Loads the scene that ``text`` describes."""
    scene = ls.load(write_scene(folder, text))
    assert isinstance(scene, ls.Scene)
    return scene


def refuses(caught: pytest.ExceptionInfo[ls.FormatError], folder: Path, problem: str) -> None:
    """Checks that an error is one line that begins with the path of ``scene.toml`` and contains ``problem``."""
    message = str(caught.value)
    assert message.startswith(f"{folder / 'scene.toml'}: ")
    assert problem in message
    assert "\n" not in message
