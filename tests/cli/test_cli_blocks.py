"""Tests commands with captures in blocks: writing, rendering view by view, planning, and mistakes."""

from __future__ import annotations

import json
import weakref
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from support.files.cli_files import Workspace
from support.scenes.raster_scenes import random_gaussians


@pytest.fixture
def work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Workspace:
    """Returns a folder with a larger capture, some of it in blocks, and three cameras, one of which sees few blocks."""
    workspace = Workspace(tmp_path, capsys)
    capture = random_gaussians(5, count=3000, center=(0.0, 0.0, 0.0), extent=(12.0, 3.0, 12.0))
    ls.save(workspace.path("town.ply"), capture)
    up = (0.0, -1.0, 0.0)
    cameras = [
        ls.Camera.look_at((0.3, 0.2, 0.1), (5.0, 0.0, 3.0), up, width=64, height=48, fov_y=0.9, name="inside"),
        ls.Camera.look_at((-20.0, -4.0, 0.0), (0.0, 0.0, 0.0), up, width=64, height=48, fov_y=0.1, name="far"),
        ls.Camera.look_at((0.0, -900.0, 0.0), (0.0, -1000.0, 0.0), (0.0, 0.0, 1.0), width=64, height=48, name="away"),
    ]
    ls.save_cameras(workspace.path("views.json"), cameras)
    return workspace


def made(work: Workspace, *options: str) -> str:
    """Returns the capture in blocks."""
    outcome = work.run("blocks", "@town.ply", "-o", "@town", "--cell", "3", *options)
    assert outcome.status == 0, outcome.err
    return outcome.out


def pixels(path: Path) -> np.ndarray:
    """Returns the pixels of an image."""
    return ls.load_image(path)


def test_blocks_command_writes_blocks_and_info_describes_them(work: Workspace) -> None:
    """A line describes the written folder; info reads the index, and convert all blocks."""
    line = made(work, "--coarser", "1")
    index = ls.io.open_blocks(work.path("town"))
    count = len(index.blocks)
    assert f"town: 3,000 Gaussians in {count} blocks, cubes of 3 and less, 1 coarser level" in line
    outcome = work.run("info", "@town")
    assert "3,000" in outcome.out and f"{count}" in outcome.out and "coarser" in outcome.out
    (facts,) = json.loads(work.run("info", "@town/blocks.json", "--json").out)
    assert facts["kind"] == "blocks" and facts["blocks"] == count > 20
    assert facts["level_gaussians"] == [3000, sum(block.levels[1].count for block in index.blocks)]
    assert work.run("convert", "@town", "@again.ply").status == 0
    assert work.capture("again.ply").count == 3000


def test_blocks_command_joins_several_files_of_any_format(work: Workspace) -> None:
    """Streamed and loaded files become one capture."""
    ls.save(work.path("more.spz"), random_gaussians(6, count=70))
    outcome = work.run("blocks", "@town.ply", "@more.spz", "-o", "@both")
    assert outcome.status == 0, outcome.err
    assert ls.io.open_blocks(work.path("both")).count == 3070


def test_render_of_blocks_equals_render_of_the_whole_capture(work: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    """Images of camera files, tiles and the default view are equal bit by bit.

    Each view loads only the blocks that it sees.
    """
    made(work)
    loaded: list[int] = []
    load = ls.io.load_blocks

    def counting(index: ls.io.BlockIndex, parts: list[ls.io.BlockPart]) -> ls.Gaussians:
        loaded.append(len(parts))
        return load(index, parts)

    monkeypatch.setattr(ls.io, "load_blocks", counting)
    for source, out in (("@town.ply", "whole"), ("@town", "seen")):
        outcome = work.run("render", source, "--cameras", "@views.json", "-o", f"@{out}", "--device", "cpu")
        assert outcome.status == 0, outcome.err
        assert outcome.err == ""
    for name in ("inside", "far", "away"):
        np.testing.assert_array_equal(pixels(work.path(f"seen/{name}.png")), pixels(work.path(f"whole/{name}.png")))
    assert (
        len(loaded) == 2 and 0 < min(loaded) and max(loaded) < len(ls.io.open_blocks(work.path("town")).blocks)
    )  # the camera "away" sees no block and loads none
    for source, out in (("@town.ply", "front"), ("@town", "front_seen")):
        assert work.run("render", source, "--width", "48", "-o", f"@{out}.png", "--device", "cpu").status == 0
    np.testing.assert_array_equal(pixels(work.path("front_seen.png")), pixels(work.path("front.png")))
    outcome = work.run(
        "render", "@town", "--cameras", "@views.json", "-o", "@tiles", "--tiles", "2x1", "--device", "cpu"
    )
    assert outcome.status == 0, outcome.err
    np.testing.assert_array_equal(pixels(work.path("tiles/inside.png")), pixels(work.path("whole/inside.png")))


def test_render_holds_only_the_blocks_of_one_view_in_memory(work: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks of the last view are released, also by the renderer, before those of the next view are read."""
    made(work)
    references: list[Callable[[], object]] = []
    load = ls.io.load_blocks

    def watching(index: ls.io.BlockIndex, parts: list[ls.io.BlockPart]) -> ls.Gaussians:
        assert not any(one() is not None for one in references)
        loaded = load(index, parts)
        references.extend((weakref.ref(loaded.means), weakref.ref(loaded.sh)))
        return loaded

    monkeypatch.setattr(ls.io, "load_blocks", watching)
    outcome = work.run("render", "@town", "--cameras", "@views.json", "-o", "@seen", "--device", "cpu")
    assert outcome.status == 0, outcome.err
    assert len(references) == 4


def test_lod_pixels_option_of_render_loads_far_blocks_at_coarser_levels(work: Workspace) -> None:
    """An orbit with the same option shows the same capture."""
    made(work, "--coarser", "2")
    for tolerance, out in (("0", "fine"), ("12", "coarse")):
        outcome = work.run(
            "render", "@town", "--cameras", "@views.json", "--frames", "inside", "-o", f"@{out}.png",
            "--lod", f"pixels={tolerance}", "--device", "cpu",
        )  # fmt: skip
        assert outcome.status == 0, outcome.err
    fine, coarse = pixels(work.path("fine.png")), pixels(work.path("coarse.png"))
    assert 1e-4 < np.abs(fine - coarse).mean() < 0.1
    for source, out in (("@town.ply", "a"), ("@town", "b")):
        outcome = work.run(
            "orbit", source, "--width", "32", "--seconds", "1", "--fps", "2", "-o", f"@{out}", "--device", "cpu"
        )
        assert outcome.status == 0, outcome.err
    np.testing.assert_array_equal(pixels(work.path("a/frame_0001.png")), pixels(work.path("b/frame_0001.png")))


def test_lit_frames_of_blocks_load_the_whole_capture(work: Workspace, caplog: pytest.LogCaptureFixture) -> None:
    """Other pipelines than raster, and scenes of several files, also load all blocks; a log line reports the reason."""
    made(work)
    outcome = work.run(
        "render", "@town", "--pipeline", "trace", "--cameras", "@views.json", "--frames", "far", "-o", "@a.png",
        "--width", "16", "--device", "cpu",
    )  # fmt: skip
    assert outcome.status == 0
    assert "town: the whole capture is loaded for --pipeline trace: only unlit, rasterised images" in caplog.text
    outcome = work.run("render", "@town", "@mesh.obj", "-o", "@b.png", "--width", "16", "--device", "cpu")
    assert "the whole capture is loaded for other files of the scene" in caplog.text


def test_blocks_plan_prints_memory_and_loaded_bytes_of_each_worker(work: Workspace) -> None:
    """The table has a row for each worker and their sum, equal to the library's plan."""
    made(work)
    outcome = work.run("blocks", "@town", "--plan", "--cameras", "@views.json", "--workers", "2", "--memory", "0.00006")
    assert outcome.status == 0, outcome.err
    index, cameras = ls.io.open_blocks(work.path("town")), ls.load_cameras(work.path("views.json"))
    plans = ls.io.plan_views(index, cameras, 2, 60_000)
    lines = outcome.out.splitlines()
    assert lines[0].endswith(
        f"town: 3,000 Gaussians, {len(index.blocks)} blocks, {index.row_bytes * 3:.1f} kB (finest)"
    )
    rows = [line.split() for line in lines[2:]]
    assert rows[0][:3] == ["0", "0-0", str(plans[0].tiles)] and rows[1][:3] == ["1", "1-2", str(plans[1].tiles)]
    assert rows[0][3] == f"{plans[0].held_bytes / 1e3:.1f}"
    assert rows[2][:2] == ["all", "3"] and rows[2][5] == f"{sum(plan.moved_bytes for plan in plans) / 1e3:.1f}"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["blocks"], "no file given: lumisplat blocks IN.ply -o FOLDER"),
        (["blocks", "@town.ply"], "-o is missing"),
        (["blocks", "@town.ply", "-o", "@a", "--cell", "0"], "--cell is 0, expected the edge length of a cube"),
        (["blocks", "@town.ply", "-o", "@a", "--coarser", "-1"], "--coarser is -1, expected 0 to 16"),
        (["blocks", "@mesh.obj", "-o", "@a"], "is not one capture"),
        (["blocks", "@none.ply", "-o", "@a"], "no such file"),
        (["blocks", "@town.ply", "@flat.ply", "-o", "@a"], "differ in SH degree or antialiasing"),
        (["blocks", "@town.ply", "-o", "@town.ply"], "is a file, expected a folder"),
        (["blocks", "@town.ply", "-o", "@."], "holds other files ("),
        (["blocks", "@town.ply", "--plan"], "--plan needs one folder"),
        (["blocks", "@town", "--plan"], "--plan needs --cameras FILE"),
        (["blocks", "@town", "--plan", "--cameras", "@views.json", "--workers", "0"], "workers is 0"),
        (["blocks", "@town", "--plan", "--cameras", "@views.json", "--memory", "0"], "--memory is 0"),
        (["blocks", "@town.ply", "-o", "@town"], "holds a complete capture in blocks: give another folder"),
        (["render", "@town.ply", "--lod", "pixels=1", "-o", "@a.png"], "--lod pixels= needs a capture in blocks"),
        (["render", "@town", "--lod", "pixels=-1", "-o", "@a.png"], "--lod is pixels=-1, expected pixels=N of 0"),
        (["render", "@town", "--lod", "pixels=1", "--aov", "deep", "-o", "@a.exr"], "--lod pixels= and --aov deep"),
    ],
)  # fmt: skip
def test_blocks_command_reports_mistakes_of_the_user_in_one_line(
    work: Workspace, arguments: list[str], message: str
) -> None:
    """Each mistake ends with status 2, and leaves no file."""
    made(work)
    ls.save(work.path("flat.ply"), random_gaussians(1, count=20, degree=2))
    before = work.files()
    outcome = work.run(*arguments)
    assert (outcome.status, outcome.err.count("\n")) == (2, 1), outcome.err
    assert message in outcome.err
    assert work.files() == before


def test_blocks_command_refuses_a_full_disk_before_writing(work: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    """The line names needed and free bytes."""
    from collections import namedtuple

    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr("shutil.disk_usage", lambda _: usage(10, 9, 1))
    outcome = work.run("blocks", "@town.ply", "-o", "@a")
    assert outcome.status == 2 and "but the disk has 1 B free" in outcome.err
    assert not work.path("a").exists()
