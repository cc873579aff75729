"""README and guide are correct: their Python runs, their links exist, their options exist."""

from __future__ import annotations

import gc
import re
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.cli import main
from lumisplat.io import change_config
from support.files.body_files import body_file, person_bvh, pose_file
from support.files.rig_files import BEND, TubeRig
from support.files.splat_files import streamed
from support.files.training_image_files import ring_cameras, write_nerfstudio_images
from support.scenes.raster_scenes import front_camera, random_gaussians

ROOT = Path(__file__).resolve().parents[2]
PAGES = [
    *(ROOT / name for name in ("README.md", "docs/index.md", "docs/conventions.md")),
    *(page for folder in ("tutorials", "guide") for page in sorted((ROOT / "docs" / folder).glob("*.md"))),
]
PROGRAMS = [
    pytest.param(block, id=f"{page.stem}-{number}")
    for page in PAGES
    for number, block in enumerate(re.findall(r"<!-- runnable -->\n```python\n(.*?)```", page.read_text(), re.DOTALL))
]
OPTIONAL_PROGRAMS = [
    pytest.param(package, block, id=f"{page.stem}-{package}")
    for page in PAGES
    for package, block in re.findall(r"<!-- runnable with (\w+) -->\n```python\n(.*?)```", page.read_text(), re.DOTALL)
]
"""Programs of the docs that need a package which is no dependency of Lumisplat."""
SCENE_FILES = [
    pytest.param(block, id=f"{page.stem}-{number}")
    for page in PAGES
    for number, block in enumerate(re.findall(r"<!-- runnable -->\n```toml\n(.*?)```", page.read_text(), re.DOTALL))
]
NAMES = (
    "view|render|extract-frames|train|orbit|info|convert|bench|demo|metrics|evaluate|shadowmap|relight|animate|bake|fit|delight|"
    "doctor|farm|export|dataset|blocks|study|profile"
)
COMMANDS = sorted({line for page in PAGES for line in re.findall(rf"lumisplat (?:{NAMES})[^`\n]*", page.read_text())})


@pytest.fixture
def beside(tmp_path, monkeypatch):
    """Makes and enters a folder with a capture, meshes, a rig, frames, an environment, images and a camera file."""
    import trimesh

    from lumisplat.io.images.exr import write_exr

    monkeypatch.chdir(tmp_path)
    ls.save("garden.ply", random_gaussians(1, count=100))
    ls.save("thing.ply", random_gaussians(1, count=100))
    ls.save("avatar.ply", random_gaussians(2, count=80, center=(0.0, 0.5, 0.0), extent=(0.3, 0.8, 0.3)))
    ls.save_cameras(Path("transforms.json"), [front_camera(name="0001")])
    Path("statue.obj").write_text("v 0 0 4\nv 1 0 4\nv 0 1 4\nf 1 2 3\n")
    trimesh.creation.box().export("statue.glb")
    TubeRig(clips={"walk": BEND}).write(Path("walker.glb"))
    body_file(Path("SMPLX_NEUTRAL.npz"), "SMPL-X")
    pose_file(Path("walk.npz"), "SMPL-X")
    Path("dance.bvh").write_text(person_bvh(2 * ("0 " * 30 + "\n")))
    Path("frames").mkdir()
    for k in range(3):
        ls.save(Path("frames") / f"{k}.ply", random_gaussians(k, count=10 + k))
    Path("city").mkdir()
    streamed(Path("city"))
    write_nerfstudio_images(Path("fox"), ring_cameras(9))
    write_exr("sky.exr", dict.fromkeys("RGB", np.ones((2, 4), np.float32)))
    return tmp_path


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.usefixtures("beside")
def test_python_blocks_of_the_docs_run(program):
    """Every runnable block runs in a folder with a capture, a mesh and a camera file."""
    exec(compile(program, "docs", "exec"), {})


@pytest.mark.parametrize(("package", "program"), OPTIONAL_PROGRAMS)
@pytest.mark.usefixtures("beside")
@pytest.mark.filterwarnings("ignore::ResourceWarning")  # others may leave files open
def test_python_blocks_of_the_docs_run_with_optional_packages(package, program):
    """Blocks that need a package run if it is installed, and are only parsed otherwise."""
    compiled = compile(program, "docs", "exec")
    pytest.importorskip(package)
    if package == "av":
        ls.save_animation("walk.mp4", np.random.default_rng(0).uniform(size=(9, 32, 32, 3)), fps=20)
    exec(compiled, {})
    gc.collect()


@pytest.mark.parametrize("text", SCENE_FILES)
def test_scene_files_of_the_docs_load(text, beside):
    """Every TOML block marked runnable loads completely as a scene file."""
    (beside / "scene.toml").write_text(text)
    ls.load_config("scene.toml")
    ls.load_cameras("scene.toml")
    if "[[" in text:
        assert isinstance(ls.load("scene.toml"), ls.Scene)


@pytest.mark.parametrize("name", ["settings.md", "options.md", "scene_file.md"])
def test_generated_reference_pages_equal_the_declarations(name):
    """Running the generator would not change the pages."""
    from tools.make_reference import PAGES

    assert (ROOT / "docs" / name).read_text(encoding="utf-8") == PAGES[name](), "run tools/make_reference.py"


def test_every_row_of_the_reference_pages_has_a_help_text():
    """The pages list keys of scene files, options and settings."""
    for name, column in (("settings.md", 4), ("options.md", 2), ("scene_file.md", -2)):
        rows = re.findall(r"^\| `.*", (ROOT / "docs" / name).read_text(encoding="utf-8"), re.MULTILINE)
        cells = [re.split(r"(?<!\\)\|", row) for row in rows]
        assert len(rows) > 100
        assert not [row for row, texts in zip(rows, cells, strict=True) if not texts[column].strip()]


def test_every_python_block_of_the_docs_is_checked():
    """Each block is marked as runnable or as one that needs a package."""
    blocks = sum(page.read_text().count("```python") for page in PAGES)
    assert len(PROGRAMS) + len(OPTIONAL_PROGRAMS) == blocks > 0
    assert len(SCENE_FILES) > 0


def test_every_public_name_is_on_the_api_page():
    """The page lists each public name by its import path, and each submodule."""
    listed = (ROOT / "docs" / "api.md").read_text()
    described = re.search(r"automodule:: lumisplat.errors\n +:members: (.*)", listed)
    assert described
    modules = [name for name in ls.__all__ if isinstance(getattr(ls, name), ModuleType)]
    public = {f"{module}.{name}" for module in modules for name in getattr(ls, module).__all__}
    public |= {name for name in ls.__all__ if name not in modules}
    listed_names = {
        path.rpartition(".")[2] for path in re.findall(r":: lumisplat\.([\w.]+)\n", listed) if path in public
    }
    assert {path.rpartition(".")[2] for path in public} - listed_names == set(described[1].split(", "))
    assert not [module for module in modules if f"`ls.{module}`" not in listed]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_relative_links_of_the_docs_lead_to_files(page):
    """The files are in the repository."""
    for target in re.findall(r"\]\((?!https?:)([^)#]+)", page.read_text()):
        assert (page.parent / target).exists(), target


@pytest.mark.parametrize("command", COMMANDS)
def test_options_used_in_the_docs_are_in_the_help_of_their_command(command, capsys):
    """Settings of ``--set`` exist, too."""
    words = command.split()
    assert main([*words[1 : 3 if words[1] == "farm" else 2], "--help"]) == 0
    listed = capsys.readouterr().out
    for option in re.findall(r"(?<=\s)--?[a-z][a-z-]*", command):
        assert option in listed
    for name, value in re.findall(r"--set ([a-z][\w.]*)=(\S+)", command):
        if name.startswith("animation.lighting."):
            change_config(ls.config.AvatarLightingConfig(), name.removeprefix("animation.lighting."), value)
        elif not name.startswith("meshes."):
            change_config(ls.RenderConfig(), name, value)
