"""Tests levels of detail of streamed SOGs: options, keys of scene files, and fingerprints."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import lumisplat as ls
from lumisplat.cli.input.loading import file_fingerprints
from support.files.cli_files import Workspace
from support.files.splat_files import streamed
from support.kinds import expect_kind


@pytest.fixture
def work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Workspace:
    """Returns a folder with a streamed SOG of 50, 23 and 8 Gaussians."""
    streamed(tmp_path / "city")
    return Workspace(tmp_path, capsys)


@pytest.mark.parametrize(
    ("options", "count"), [([], 50), (["--lod", "1"], 23), (["--lod", "budget=30"], 23), (["--lod", "budget=8"], 8)]
)
def test_lod_option_of_convert_and_info_selects_a_level_of_a_streamed_sog(
    work: Workspace, options: list[str], count: int
) -> None:
    """The SOG may be given by its folder or its file."""
    assert work.run("convert", "@city", "@out.ply", *options).status == 0
    assert work.capture("out.ply").count == count
    shown = json.loads(work.run("info", "@city/lod-meta.json", "--json", *options).out)
    assert shown[0]["gaussians"] == count


def test_lod_option_of_render_selects_a_level_of_a_streamed_sog(work: Workspace) -> None:
    """The option applies to a file, and to entries of a scene file without a level."""
    for scene in ("@city", "@scene.toml"):
        work.path("scene.toml").write_text('[[splats]]\npath = "city"\n')
        images: list[bytes] = []
        for options in ([], ["--lod", "2"]):
            outcome = work.run("render", scene, "-o", "@out.png", "--width", "16", "--height", "16", *options)
            assert (outcome.status, outcome.err) == (0, "")
            images.append(work.path("out.png").read_bytes())
        assert images[0] != images[1]


@pytest.mark.parametrize(("keys", "count"), [("lod = 2", 8), ("lod_budget = 30", 23), ("", 23)])
def test_scene_file_entries_select_levels_of_a_streamed_sog(work: Workspace, keys: str, count: int) -> None:
    """An entry overrides the option; a file is loaded once for each level."""
    work.path("scene.toml").write_text(f'[[splats]]\npath = "city"\n{keys}\n[[splats]]\npath = "city"\nlod = 0\n')
    scene = expect_kind(ls.Scene, ls.load(work.path("scene.toml"), lod=1))
    assert [splat.gaussians.count for splat in scene.splats] == [count, 50]
    document = ls.io.SceneDocument.open(work.path("scene.toml"))
    assert document.scene().splats[1].gaussians.count == 50 and not document.problems


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["info", "@capture.ply", "--lod", "1"],
            "--lod needs a streamed SOG (a folder with a lod-meta.json) or blocks, got ",
        ),
        (["convert", "@capture.ply", "@b.ply", "--lod", "budget=9"], "--lod needs a streamed SOG"),
        (["render", "@capture.ply", "--lod", "1"], "--lod needs a streamed SOG"),
        (["render", "@city", "--lod", "-1"], "--lod is -1, expected a whole number of at least 0, or budget=COUNT"),
        (["view", "@city", "--lod", "budget=0"], "--lod is budget=0, expected a whole number of at least 1"),
        (["info", "@city", "--lod", "pixels=2"], "--lod is pixels=2, expected a level such as 1, or budget=N"),
        (["render", "@city", "--lod", "size=2"], "expected a level such as 1, or budget=N or pixels=N"),
        (["view", "@city", "--lod", "budget=much"], "--lod is budget=much, expected a whole number of at least 1"),
        (["convert", "@city", "@b.ply", "--lod", ""], "--lod is empty, expected a level such as 1, or budget=N"),
        (["info", "@city", "--lod", "3"], "has no level 3: its levels are 0 (finest) to 2"),
    ],
)
def test_mistakes_of_the_lod_option_are_reported_in_one_line(
    work: Workspace, arguments: list[str], message: str
) -> None:
    """Each mistake ends with status 2."""
    outcome = work.run(*arguments)
    assert outcome.status == 2 and message in outcome.err and outcome.err.count("\n") == 1


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ('path = "capture.ply"\nlod = 1', r"line 3.*lod applies to a streamed SOG, but path is 'capture.ply'"),
        ('path = "city"\nlod = -1', r"line 3.*lod.*expected 0 or more"),
        ('path = "city"\nlod_budget = 0', r"line 3.*lod_budget.*expected 1 or more"),
        ('path = "city"\nlod = 1\nlod_budget = 30', r"line 4.*lod and lod_budget are both given"),
        ('path = "city"\nlod = 7', r"has no level 7"),
    ],
)
def test_error_for_a_wrong_lod_key_of_a_scene_file_names_file_and_line(
    work: Workspace, entry: str, message: str
) -> None:
    """The file is a streamed SOG or another capture."""
    work.path("scene.toml").write_text(f"[[splats]]\n{entry}\n")
    with pytest.raises(ls.FormatError, match=message):
        ls.load(work.path("scene.toml"))


def test_fingerprints_include_the_captures_of_all_sog_levels(work: Workspace) -> None:
    """Files that a USD text layer names count as well."""
    work.path("stage.usda").write_text("#usda 1.0\n(\n    subLayers = [@./city/notes.usda@]\n)\n")
    work.path("city/notes.usda").write_text("#usda 1.0\n")
    work.path("scene.toml").write_text('[[splats]]\npath = "city"\n[[meshes]]\npath = "stage.usda"\n')
    marks = file_fingerprints([work.path("scene.toml")], work.path("frames"))
    assert {"city/lod-meta.json", "city/0_0/meta.json", "city/0_0/means_l.webp", "city/notes.usda"} <= marks.keys()
