"""Captures in blocks: written Gaussians are read back, and a view loads exactly the blocks that it needs."""

from __future__ import annotations

import json
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.io.blocks.storage import packed
from support.scenes.raster_scenes import random_gaussians


def street(count: int = 3000, degree: int = 1) -> ls.Gaussians:
    """Returns Gaussians around the origin, some of them large."""
    small = random_gaussians(5, count=count, degree=degree, center=(0.0, 0.0, 0.0), extent=(12.0, 3.0, 12.0))
    large = random_gaussians(6, 40, degree, center=(0.0, 0.0, 0.0), extent=(12.0, 3.0, 12.0), scale_range=(0.3, 2.0))
    return ls.merge([small, large])


def test_index_of_blocks_with_malicious_json_is_refused_with_a_one_line_error(tmp_path: Path) -> None:
    """Deeply nested JSON, huge integers and NUL in file names give an error that names the index."""
    folder = tmp_path / "city"
    index = ls.io.write_blocks(folder, chunks(street(200)), 40.0)
    good = json.loads((folder / "blocks.json").read_text())
    file, count, largest, mean = good["blocks"][0]["levels"][0]
    bad = [
        "[" * 200_000,
        json.dumps(good).replace(f"{mean}", "1" + "0" * 4000, 1),
        json.dumps(good | {"blocks": [good["blocks"][0] | {"low": [10**400, 0, 0]}]}),
        *(
            json.dumps(good | {"blocks": [good["blocks"][0] | {"levels": [[name, count, largest, mean]]}]})
            for name in ("a\0b", "\ud800", "../city", "/dev/zero", "", 3)
        ),
        json.dumps(good | {"blocks": [good["blocks"][0] | {"levels": [[file, count, -1.0, mean]]}]}),
        json.dumps(good | {"sh_count": [1]}),
        "3",
    ]
    for text in bad:
        (folder / "blocks.json").write_text(text)
        with pytest.raises(ls.FormatError, match=r"blocks\.json: damaged, or not an index of blocks"):
            ls.load(folder)
    assert index.count == 240


def test_error_for_invalid_gaussians_names_their_block_file(tmp_path: Path) -> None:
    """The block file holds the invalid Gaussian, and the index does not."""
    folder = tmp_path / "city"
    index = ls.io.write_blocks(folder, chunks(street(2000)), 8.0)
    assert len(index.blocks) > 1
    path = folder / index.blocks[1].levels[0].file
    rows = np.fromfile(path, "<f4").reshape(-1, index.row_bytes // 4)
    rows[0, 7] = -1.0
    rows.tofile(path)
    with pytest.raises(ls.FormatError, match=path.name):
        ls.load(folder)


def chunks(gaussians: ls.Gaussians, size: int = 700) -> list[ls.Gaussians]:
    """Splits a capture into a stream of chunks."""
    return [
        gaussians.subset(np.arange(first, min(first + size, gaussians.count)))
        for first in range(0, gaussians.count, size)
    ]


def sorted_rows(gaussians: ls.Gaussians) -> np.ndarray:
    """Returns the values of all Gaussians, sorted by row."""
    rows = packed(gaussians)
    return rows[np.lexsort(rows.T)]


def all_of(index: ls.io.BlockIndex) -> ls.Gaussians:
    """Loads the whole capture, in the order of its blocks."""
    return ls.io.load_blocks(index, [ls.io.BlockPart(number, 0) for number in range(len(index.blocks))])


VIEWS = {
    "from inside": ls.Camera.look_at(
        (0.3, 0.2, 0.1), (5.0, 0.0, 3.0), (0.0, -1.0, 0.0), width=96, height=64, fov_y=0.9
    ),
    "wide": ls.Camera.look_at((2.0, -1.0, 2.0), (6.0, 1.0, 6.0), (0.0, -1.0, 0.0), width=80, height=64, fov_y=2.2),
    "narrow": ls.Camera.look_at((-20.0, -4.0, 0.0), (0.0, 0.0, 0.0), (0.0, -1.0, 0.0), width=64, height=48, fov_y=0.1),
    "off-centre": replace(
        ls.Camera.look_at((0.0, -1.0, -9.0), (3.0, 0.0, 0.0), (0.0, -1.0, 0.0), width=90, height=50, fov_y=0.6), cx=10.0
    ),
}


def test_every_gaussian_is_written_to_exactly_one_block(tmp_path: Path) -> None:
    """For any chunk size, no block exceeds its maximum count, and the bounds of a block contain its Gaussians."""
    capture = street()
    written = ls.io.write_blocks(tmp_path / "a", chunks(capture), 4.0, block_max=150)
    index = ls.io.open_blocks(tmp_path / "a")
    assert index.blocks == written.blocks and index.count == capture.count and len(index.blocks) > 20
    np.testing.assert_array_equal(sorted_rows(all_of(index)), sorted_rows(capture))
    for number, block in enumerate(index.blocks):
        part = ls.io.load_blocks(index, [ls.io.BlockPart(number, 0)])
        assert part.count == block.levels[0].count <= 150
        np.testing.assert_array_equal(part.means.min(axis=0), block.low)
        np.testing.assert_array_equal(part.means.max(axis=0), block.high)
        assert block.levels[0].scale_max == pytest.approx(part.scales.max())
    ls.io.write_blocks(tmp_path / "b", chunks(capture, 5000), 4.0, block_max=150)
    for path in (tmp_path / "a").glob("*"):
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()
    assert not list((tmp_path / "a").glob("*.part"))


def test_loading_blocks_does_not_copy_the_whole_capture(tmp_path: Path) -> None:
    """Peak memory stays below 1.5 times the size of the loaded capture."""
    index = ls.io.write_blocks(tmp_path, [random_gaussians(1, 20_000, 3, extent=(9.0, 9.0, 9.0))], 3.0, block_max=1000)
    tracemalloc.start()
    try:
        loaded = ls.io.load_blocks(index, ls.io.all_blocks(index))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 1.5 * index.row_bytes * loaded.count


def test_coincident_gaussians_stay_in_one_block(tmp_path: Path) -> None:
    """Gaussians at one position cannot be divided, so their block may exceed the maximum count."""
    one = random_gaussians(1, count=1)
    index = ls.io.write_blocks(tmp_path, [ls.merge([one] * 40)], 8.0, block_max=10)
    assert [block.levels[0].count for block in index.blocks] == [40]


@pytest.mark.parametrize("name", VIEWS)
@pytest.mark.parametrize("antialiased", [False, True])
def test_frame_rendered_from_the_visible_blocks_equals_that_of_the_whole_capture(
    name: str, antialiased: bool, tmp_path: Path
) -> None:
    """Frames are equal bit for bit, also in windows of a frame, which need fewer blocks, and with jittered samples."""
    capture = replace(street(), antialiased=antialiased)
    index = ls.io.write_blocks(tmp_path, chunks(capture), 3.0, block_max=200)
    camera = VIEWS[name]
    config = ls.RenderConfig(aovs=("sample_count",), samples=3)
    renderer = ls.create_renderer(config, "cpu")
    whole = renderer.render(ls.Scene([all_of(index)]), camera)
    visible = ls.io.visible_blocks(index, camera)
    assert 0 < len(visible) < 0.8 * len(index.blocks)
    frame = renderer.render(ls.Scene([ls.io.load_blocks(index, visible)]), camera)
    for image in ("color", "alpha", "depth", "normal"):
        np.testing.assert_array_equal(getattr(frame, image), getattr(whole, image), image)
    window = camera.windows(2, 2)[3]
    fewer = ls.io.visible_blocks(index, window)
    assert set(fewer) <= set(visible)
    if fewer:
        part = renderer.render(ls.Scene([ls.io.load_blocks(index, fewer)]), window)
        left, top = window.image_corner
        np.testing.assert_array_equal(part.color, whole.color[top:, left:])


def test_distant_blocks_are_loaded_at_coarser_levels_of_detail(tmp_path: Path) -> None:
    """Each level has a quarter of the Gaussians of the finer one.

    Near blocks use the finest level, and so do all blocks without a tolerance in pixels.
    """
    index = ls.io.write_blocks(tmp_path, chunks(street(degree=0)), 6.0, levels=2, block_max=800)
    for block in index.blocks:
        counts = [level.count for level in block.levels]
        assert counts[1] == max(1, counts[0] // 4) and counts[2] == max(1, counts[1] // 4)
        assert block.levels[0].scale_mean < block.levels[2].scale_mean
    camera = ls.Camera.look_at((-15.0, -2.0, 0.0), (0, 0, 0), (0.0, -1.0, 0.0), width=320, height=200)
    assert {part.level for part in ls.io.visible_blocks(index, camera)} == {0}
    parts = ls.io.visible_blocks(index, camera, pixels=12.0)
    assert {part.level for part in parts} >= {0, 1}
    depth = {part.level: [] for part in parts}
    for part in parts:
        block = index.blocks[part.block]
        depth[part.level].append(0.5 * (block.low[0] + block.high[0]))
    assert np.mean(depth[0]) < np.mean(depth[max(depth)])
    assert ls.io.load_blocks(index, parts).count < index.count


def test_plan_of_views_loads_a_block_again_only_if_blocks_exceed_the_memory(tmp_path: Path) -> None:
    """Blocks that exceed the memory are loaded again for later views.

    A view that does not fit is split into windows.
    """
    capture = random_gaussians(
        5, count=3000, center=(0.0, 0.0, 0.0), extent=(12.0, 3.0, 12.0), scale_range=(0.01, 0.05)
    )
    index = ls.io.write_blocks(tmp_path, chunks(capture), 3.0, block_max=100)
    cameras = [VIEWS["from inside"], VIEWS["wide"], VIEWS["from inside"], VIEWS["narrow"]]
    size = index.row_bytes * index.count
    (one,) = ls.io.plan_views(index, cameras, 1, size)
    visible = {part for camera in cameras for part in ls.io.visible_blocks(index, camera)}
    assert one.tiles == 4 and one.too_large == 0
    assert (
        one.held_bytes
        == one.moved_bytes
        == index.row_bytes * sum(index.blocks[part.block].levels[0].count for part in visible)
    )
    two = ls.io.plan_views(index, cameras, 2, size)
    assert [plan.views for plan in two] == [range(2), range(2, 4)]
    assert sum(plan.moved_bytes for plan in two) > one.moved_bytes
    above = ls.Camera.look_at((0.0, -30.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), width=96, height=96, fov_y=0.8)
    needed = index.row_bytes * ls.io.load_blocks(index, ls.io.visible_blocks(index, above)).count
    (enough,) = ls.io.plan_views(index, [above, above], 1, needed)
    assert (enough.tiles, enough.held_bytes, enough.moved_bytes) == (2, needed, needed)
    (small,) = ls.io.plan_views(index, [above, above], 1, int(0.7 * needed))
    assert small.tiles == 8 and small.too_large == 0
    assert small.held_bytes <= 0.7 * needed and small.moved_bytes > needed
    (tiny,) = ls.io.plan_views(index, cameras, 1, 100)
    assert tiny.too_large > 0
    with pytest.raises(ls.ConfigError, match="workers is 0"):
        ls.io.plan_views(index, cameras, 0, size)


def test_block_functions_refuse_invalid_arguments_with_a_one_line_error(tmp_path: Path) -> None:
    """Bad cell sizes, empty or mixed captures, bad parts and unsupported cameras are refused."""
    capture = street(50)
    with pytest.raises(ls.ConfigError, match="cell is 0"):
        ls.io.write_blocks(tmp_path / "a", [capture], 0)
    with pytest.raises(ls.SceneError, match="zero Gaussians"):
        ls.io.write_blocks(tmp_path / "a", [], 1.0)
    with pytest.raises(ls.SceneError, match="differ in SH degree"):
        ls.io.write_blocks(tmp_path / "a", [capture, street(50, degree=0)], 1.0)
    assert not (tmp_path / "a").exists()  # a failed write leaves nothing behind
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "cell0_0_0.part").write_bytes(b"left by a run that was killed")
    index = ls.io.write_blocks(tmp_path / "a", [capture], 1.0)
    np.testing.assert_array_equal(sorted_rows(all_of(index)), sorted_rows(capture))
    with pytest.raises(ls.FormatError, match="holds a complete capture in blocks"):
        ls.io.write_blocks(tmp_path / "a", [capture], 1.0)
    away = ls.Camera.look_at((0, -900, 0), (0, -1000, 0), (0, 0, 1))
    assert ls.io.visible_blocks(index, away) == []
    with pytest.raises(ls.SceneError, match="no block is visible"):
        ls.io.load_blocks(index, [])
    with pytest.raises(ls.SceneError, match="selected only for pinholes"):
        ls.io.visible_blocks(index, replace(away, model=ls.CameraModel.FISHEYE))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 2}, "has version 2, expected 1"),
        ({"sh_count": 3}, "not an index of blocks"),
        (
            {"blocks": [{"low": [0, 0, 0], "high": [1, 1, 1], "levels": [["../x", 3, 1.0, 1.0]]}]},
            "not the name of a file",
        ),
        ({"blocks": [{"low": [0, 0], "high": [1, 1, 1], "levels": [["x", 3, 1.0, 1.0]]}]}, "not an index of blocks"),
        ({"blocks": [{"low": [0, 0, 0], "high": [1, 1, 1], "levels": [["x", 3, 1.0, 1.0]]}]}, "cannot be read"),
        ({"blocks": 3}, "not an index of blocks"),
    ],
)
def test_error_for_a_damaged_index_of_blocks_states_the_fault(
    tmp_path: Path, change: dict[str, object], message: str
) -> None:
    """The one-line error states the fault; files outside the folder are not opened."""
    ls.io.write_blocks(tmp_path, [street(50)], 1.0)
    path = tmp_path / "blocks.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(ls.FormatError, match=message):
        ls.io.open_blocks(tmp_path)


def test_truncated_block_files_and_missing_indices_are_refused(tmp_path: Path) -> None:
    """A block file may be shorter than the index states, or the folder may have no index."""
    index = ls.io.write_blocks(tmp_path, [street(50)], 100.0)
    path = tmp_path / index.blocks[0].levels[0].file
    path.write_bytes(path.read_bytes()[:-4])
    with pytest.raises(ls.FormatError, match="the capture is incomplete"):
        ls.io.open_blocks(tmp_path)
    with pytest.raises(ls.FormatError, match="fewer rows than the index states"):
        all_of(index)
    (tmp_path / "blocks.json").unlink()
    with pytest.raises(ls.errors.MissingFileError):
        ls.io.open_blocks(tmp_path)
