"""What README and guide say is true: their Python runs, their links lead somewhere, their options exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import lumisplat as ls
from lumisplat.cli import main
from scenes import front_camera, random_gaussians

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "docs" / "conventions.md", *sorted((ROOT / "docs" / "guide").glob("*.md"))]
PROGRAMS = [
    pytest.param(block, id=f"{page.stem}-{number}")
    for page in PAGES
    for number, block in enumerate(re.findall(r"<!-- runnable -->\n```python\n(.*?)```", page.read_text(), re.DOTALL))
]
COMMANDS = sorted(
    {
        line
        for page in PAGES
        for line in re.findall(r"lumisplat (?:render|info|convert|bench|demo)[^`\n]*", page.read_text())
    }
)


@pytest.mark.parametrize("program", PROGRAMS)
def test_python_of_the_docs_runs(program, tmp_path, monkeypatch):
    """Every block marked runnable runs, beside a capture, a mesh and a camera file."""
    import trimesh

    monkeypatch.chdir(tmp_path)
    ls.save("garden.ply", random_gaussians(1, count=100))
    ls.save_cameras(Path("transforms.json"), [front_camera(name="0001")])
    Path("statue.obj").write_text("v 0 0 4\nv 1 0 4\nv 0 1 4\nf 1 2 3\n")
    trimesh.creation.box().export("statue.glb")
    exec(compile(program, "docs", "exec"), {})


def test_all_python_of_the_docs_is_marked():
    """A Python block that is not run is a claim that nothing checks."""
    blocks = sum(page.read_text().count("```python") for page in PAGES)
    assert len(PROGRAMS) == blocks > 0


def test_every_public_name_is_in_the_reference():
    """The page on the Python API documents each public name where it is defined."""
    listed = (ROOT / "docs" / "api.md").read_text()
    missing = [name for name, home in ls._HOME.items() if f"lumisplat.{home}.{name}\n" not in listed]
    described = re.search(r"automodule:: lumisplat.errors\n +:members: (.*)", listed)
    assert described and set(missing) == set(described[1].split(", "))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_somewhere(page):
    """Relative links of a page exist."""
    for target in re.findall(r"\]\((?!https?:)([^)#]+)", page.read_text()):
        assert (page.parent / target).exists(), target


@pytest.mark.parametrize("command", COMMANDS)
def test_options_of_the_docs_exist(command, capsys):
    """Every option that the docs use is one that the command's help lists."""
    assert main([command.split()[1], "--help"]) == 0
    listed = capsys.readouterr().out
    for option in re.findall(r"(?<=\s)--?[a-z][a-z-]*", command):
        assert option in listed
