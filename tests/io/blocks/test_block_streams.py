"""PLYs streamed in chunks equal those that `load` reads; unsupported files are refused in one line."""

from __future__ import annotations

import logging
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.io.blocks import storage, stream
from support.files.splat_files import FLAT_NAMES, ply_header
from support.scenes.raster_scenes import random_gaussians


def written(path: Path, count: int = 500, degree: int = 1) -> ls.Gaussians:
    """Writes a capture. Returns it and its file."""
    capture = random_gaussians(3, count=count, degree=degree)
    ls.save(path, capture)
    return capture


@pytest.mark.parametrize("degree", [0, 2])
@pytest.mark.parametrize("piece", [64, 10**6])
def test_ply_chunks_streamed_from_a_file_equal_the_loaded_capture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, degree: int, piece: int
) -> None:
    """Streamed chunks equal `load` bit for bit, in file order; reported progress rises to 1."""
    monkeypatch.setattr(stream, "BLOCK_PIECE", piece)
    written(tmp_path / "a.ply", degree=degree)
    reported: list[float] = []
    opened = ls.io.stream_ply(tmp_path / "a.ply", progress=reported.append)
    pieces = list(opened)
    assert len(pieces) == max(1, -(-500 // piece)) and reported[-1] == 1.0 and reported == sorted(reported)
    assert (opened.count, opened.sh_count) == (500, (degree + 1) ** 2)
    whole = ls.load(tmp_path / "a.ply")
    assert isinstance(whole, ls.Gaussians)
    for name in ("means", "rotations_wxyz", "scales", "opacities", "sh"):
        joined = np.concatenate([getattr(one, name) for one in pieces])
        np.testing.assert_array_equal(joined, getattr(whole, name), name)


def test_streaming_a_ply_gives_2d_gaussians_the_tiny_third_scale_of_load(tmp_path: Path) -> None:
    """A PLY of 2D Gaussians, which have two scales, streams with the same scales as `load` returns."""
    rows = np.random.default_rng(1).normal(size=(20, len(FLAT_NAMES))).astype("<f4")
    (tmp_path / "flat.ply").write_bytes(ply_header(len(rows), FLAT_NAMES) + rows.tobytes())
    (piece,) = ls.io.stream_ply(tmp_path / "flat.ply")
    loaded = ls.load(tmp_path / "flat.ply")
    assert isinstance(loaded, ls.Gaussians)
    np.testing.assert_array_equal(piece.scales, loaded.scales)


def test_streaming_a_ply_refuses_invalid_gaussians_unless_told_to_drop_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The error names the first and last row of a chunk with invalid Gaussians; one log line counts dropped ones."""
    monkeypatch.setattr(stream, "BLOCK_PIECE", 100)
    written(tmp_path / "a.ply", 500, 0)
    data = bytearray((tmp_path / "a.ply").read_bytes())
    width = (len(data) - data.index(b"end_header\n") - 11) // 500
    start = len(data) - 500 * width
    for row in [7, *range(200, 300)]:
        data[start + row * width : start + row * width + 4] = np.float32(np.nan).tobytes()
    (tmp_path / "a.ply").write_bytes(data)
    with pytest.raises(ls.FormatError, match=r"1 NaN or infinite values in x, among Gaussians 0 to 99; --drop-invalid"):
        list(ls.io.stream_ply(tmp_path / "a.ply"))
    with caplog.at_level(logging.WARNING):
        pieces = list(ls.io.stream_ply(tmp_path / "a.ply", drop_invalid=True))
    assert [one.count for one in pieces] == [99, 100, 100, 100]
    assert [record.getMessage().partition(": ")[2] for record in caplog.records] == [
        "dropped 101 of 500 Gaussians: 1 NaN or infinite values in x"
    ]


def test_streaming_a_ply_into_blocks_refuses_unsupported_plys_and_drops_materials(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Each refusal is one line, and so is the log line about dropped materials."""
    capture = written(tmp_path / "a.ply", 50, 0)
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "cut.ply").write_bytes(data[:-1])
    (tmp_path / "text.ply").write_bytes(data.replace(b"binary_little_endian", b"ascii"))
    ls.save(tmp_path / "small.compressed.ply", capture)
    (tmp_path / "points.ply").write_bytes(
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nend_header\n\0\0\0\0"
    )
    for name, message in (
        ("cut.ply", "truncated: the header promises 50 Gaussians"),
        ("text.ply", "is a text PLY, which cannot be streamed"),
        ("small.compressed.ply", "is a compressed PLY"),
        ("points.ply", "a point cloud, not a Gaussian capture"),
        ("none.ply", "no such file"),
    ):
        assert not ls.io.can_stream(tmp_path / name)
        with pytest.raises(ls.FormatError, match=message):
            ls.io.stream_ply(tmp_path / name)
    shiny = replace(capture, roughness=np.full(50, 0.5, np.float32))
    ls.save(tmp_path / "shiny.ply", shiny)
    ls.io.stream_ply(tmp_path / "shiny.ply")
    assert "roughness left out: blocks cannot store them" in caplog.text


def test_proposed_block_cell_size_suits_captures_with_far_outliers(tmp_path: Path) -> None:
    """The proposed edge length makes few cubes, yet most cubes have few enough Gaussians for a single block."""
    for far in (1.0, 1000.0):
        rng = np.random.default_rng(5)
        means = rng.uniform(-4.0, 4.0, (20_000, 3))
        means[:400] *= far
        one = random_gaussians(1, count=20_000, degree=0)
        ls.save(tmp_path / "a.ply", replace(one, means=means.astype(np.float32)))
        opened = ls.io.stream_ply(tmp_path / "a.ply")
        cell = opened.cell(block_max=1000)
        cubes = len(np.unique(np.floor(means / cell), axis=0))
        assert cubes <= 8 + 4 * 20
        assert (cell <= 4.0) == (far == 1.0)


def test_write_blocks_refuses_a_cell_size_that_makes_too_many_cubes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A too small edge length would create one file per Gaussian; files written before the refusal are removed."""
    monkeypatch.setattr(storage, "BLOCK_CELLS_MAX", 50)
    with pytest.raises(
        ls.ConfigError, match=r"cell is 0\.01, so the capture would fill more than 50 cubes: give a larger"
    ):
        ls.io.write_blocks(tmp_path / "a", [random_gaussians(1, count=100)], 0.01)
    assert not (tmp_path / "a").exists()


def test_write_blocks_refuses_folders_with_other_files_and_keeps_the_files(tmp_path: Path) -> None:
    """A folder with other files stays unchanged; a capture with kernel degree 4 is refused, too."""
    capture = random_gaussians(1, count=100)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ls.FormatError, match=r"holds other files \(notes.txt\): give a new folder"):
        ls.io.write_blocks(tmp_path, [capture], 1.0)
    assert [file.name for file in tmp_path.iterdir()] == ["notes.txt"]
    with pytest.raises(ls.SceneError, match="kernel degree 4: blocks support only degree 2"):
        ls.io.write_blocks(tmp_path / "a", [replace(capture, kernel_degree=4)], 1.0)
    with pytest.raises(ls.FormatError, match="is a file, expected a folder"):
        ls.io.write_blocks(tmp_path / "notes.txt", [capture], 1.0)


@pytest.mark.skipif(sys.platform == "win32", reason="without locks of files")
def test_second_process_writing_blocks_to_one_folder_is_refused(tmp_path: Path) -> None:
    """The second writer is refused while the first one writes, and removes none of the first writer's files."""
    pieces = [random_gaussians(seed, count=200) for seed in (1, 2)]

    def stream() -> Iterator[ls.Gaussians]:
        yield pieces[0]
        with pytest.raises(ls.FormatError, match="another process is writing blocks there: give a new folder"):
            ls.io.write_blocks(tmp_path / "a", pieces, 1.0)
        yield pieces[1]

    index = ls.io.write_blocks(tmp_path / "a", stream(), 1.0)
    loaded = ls.io.load_blocks(index, [ls.io.BlockPart(number, 0) for number in range(len(index.blocks))])
    assert loaded.count == 400 and index.count == 400


def test_load_reads_a_folder_of_blocks_at_a_given_level_or_gaussian_budget(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """`load` takes the folder or its index; thinning a capture takes Gaussians from every block."""
    capture = random_gaussians(2, count=2000, degree=0, extent=(8.0, 2.0, 8.0))
    index = ls.io.write_blocks(tmp_path / "a", [capture], 4.0, levels=2, block_max=400)
    whole = ls.load(tmp_path / "a")
    assert isinstance(whole, ls.Gaussians) and whole.count == 2000
    coarse = ls.load(tmp_path / "a" / "blocks.json", lod=1)
    assert isinstance(coarse, ls.Gaussians) and coarse.count == sum(block.levels[1].count for block in index.blocks)
    fitting = ls.load(tmp_path / "a", budget=coarse.count)
    assert isinstance(fitting, ls.Gaussians) and fitting.count == coarse.count
    assert f"a: level 1 (of 0 to 2) is loaded, with {coarse.count:,} Gaussians" in caplog.text
    least = ls.load(tmp_path / "a", budget=1)
    assert isinstance(least, ls.Gaussians) and least.count > 1 and "no level has as few as 1" in caplog.text
    with pytest.raises(ls.FormatError, match="has no level 3: its levels are 0"):
        ls.load(tmp_path / "a", lod=3)
    some = ls.io.thin_blocks(index, 100)
    assert some.count == 100
    np.testing.assert_array_equal(some.means, whole.means[::20])


_MEMORY = """
import sys, resource, lumisplat as ls
from lumisplat.io.blocks import stream, storage
stream.BLOCK_PIECE = storage.BLOCK_PIECE = 2**14
opened = ls.io.stream_ply(sys.argv[1])
next(iter(opened))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
ls.io.write_blocks(sys.argv[2], opened, 16.0)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="memory in kB as Linux says it")
def test_writing_blocks_from_a_ply_stream_holds_only_a_few_chunks_in_memory(tmp_path: Path) -> None:
    """A million Gaussians (60 MB) are divided into blocks with memory for a few chunks of 16,384 Gaussians."""
    one = random_gaussians(1, count=2**16, degree=0, extent=(50.0, 5.0, 50.0))
    ls.save(tmp_path / "one.ply", one)
    data = (tmp_path / "one.ply").read_bytes()
    end = data.index(b"end_header\n") + 11
    with (tmp_path / "a.ply").open("wb") as file:
        file.write(data[:end].replace(b"vertex 65536", b"vertex 1048576"))
        for _ in range(16):
            file.write(data[end:])
    command = [sys.executable, "-c", _MEMORY, str(tmp_path / "a.ply"), str(tmp_path / "out")]
    grown = int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    assert grown < 20e6
    assert ls.io.open_blocks(tmp_path / "out").count == 2**20
