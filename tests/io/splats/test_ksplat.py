"""Files of GaussianSplats3D: levels, sections, buckets, SH, damaged files, and files of the reference writer."""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.errors import FormatError, SceneError
from support.files.ksplat_files import ksplat, order_of
from support.files.splat_files import capture, load_gaussians

NODE = shutil.which("node")
FOLDER = Path(os.environ.get("LUMISPLAT_NODE") or Path.home() / ".cache" / "lumisplat" / "node")

WRITE = """
import fs from "fs";
globalThis.window = globalThis;
const splats = await import("@mkkellogg/gaussian-splats-3d");
const [ply, level, degree, out] = process.argv.slice(2);
const data = fs.readFileSync(ply);
const bytes = data.buffer.slice(data.byteOffset, data.byteOffset + data.byteLength);
const array = splats.PlyParser.parseToUncompressedSplatArray(bytes, Number(degree));
const generator = splats.SplatBufferGenerator.getStandardGenerator(0, Number(level), 0);
fs.writeFileSync(out, Buffer.from(generator.generateFromUncompressedSplatArray(array).bufferData));
"""


def check_same(
    read: ls.Gaussians, given: ls.Gaussians, order: list[int], level: int, *, block: float = 0.5, steps: float = 0.5001
) -> None:
    """Checks that a capture equals another within the level's half step, or a full step for writers that truncate."""
    half = 0.0 if level == 0 else steps * 2.0**-10
    np.testing.assert_allclose(read.means, given.means[order], rtol=1e-6, atol=0.0 if level == 0 else block / 65535)
    np.testing.assert_allclose(read.scales, given.scales[order], rtol=half, atol=2.0**-23 * steps)
    cosines = np.abs(np.einsum("ij,ij->i", read.rotations_wxyz, given.rotations_wxyz[order]))
    assert cosines.min() > 1.0 - 8e-6 * steps
    np.testing.assert_allclose(read.opacities, given.opacities[order], atol=steps / 255)
    np.testing.assert_allclose(read.sh[:, 0], given.sh[order, 0], atol=steps / 255 / 0.28209)


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_all_ksplat_levels_and_sh_degrees_are_decoded(tmp_path: Path, level: int, degree: int) -> None:
    """Levels store float32, float16 with buckets, and bytes between two limits; SH are ordered by channel."""
    given = capture(60, degree)
    least, largest = float(given.sh[:, 1:].min(initial=0.0)) - 0.1, float(given.sh[:, 1:].max(initial=0.0)) + 0.1
    (tmp_path / "a.ksplat").write_bytes(ksplat([given], level, limits=(least, largest)))
    read, order = load_gaussians(tmp_path / "a.ksplat"), order_of(given, level)
    check_same(read, given, order, level)
    assert read.sh.shape == given.sh.shape
    step = (largest - least) / 255.0  # bytes are rounded down
    np.testing.assert_allclose(read.sh[:, 1:], given.sh[order, 1:], rtol=2.0**-11, atol=step if level == 2 else 2e-8)


def test_sh_limits_and_bucket_steps_missing_in_a_ksplat_header_have_defaults(tmp_path: Path) -> None:
    """SH limits default to 1.5, and a bucket has 32,767 steps from its centre to its side."""
    given = capture(30, 1)
    data = bytearray(ksplat([given], 2))
    struct.pack_into("<2f", data, 36, 0.0, 0.0)
    struct.pack_into("<I", data, 4096 + 24, 0)
    (tmp_path / "a.ksplat").write_bytes(data)
    check_same(read := load_gaussians(tmp_path / "a.ksplat"), given, order := order_of(given, 2), 2)
    np.testing.assert_allclose(read.sh[:, 1:], np.clip(given.sh[order, 1:], -1.5, 1.5), atol=3.0 / 255.0 + 1e-6)


@pytest.mark.parametrize("level", [0, 1])
def test_ksplat_sections_of_lower_sh_degree_are_padded_with_zeros(tmp_path: Path, level: int) -> None:
    """The buckets of the larger section are not all full."""
    first, second = capture(21, 2, seed=1), capture(10, 0, seed=2)
    (tmp_path / "a.ksplat").write_bytes(ksplat([first, second], level, bucket=7, block=4.0))
    read = load_gaussians(tmp_path / "a.ksplat")
    orders = [order_of(one, level, bucket=7, block=4.0) for one in (first, second)]
    check_same(ls.merge([read.subset(np.arange(21))]), first, orders[0], level, block=4.0)
    check_same(read.subset(np.arange(21, 31)), second, orders[1], level, block=4.0)
    assert read.sh_degree == 2 and not read.sh[21:, 1:].any()


@pytest.mark.parametrize(
    ("layout", "offset", "value", "message"),
    [
        ("<2B", 0, (0, 0), "is .ksplat version 0.0, or not a .ksplat: expected version 0.1"),
        ("<2B", 0, (112, 108), "is .ksplat version 112.108, or not a .ksplat"),
        ("<H", 20, (3,), "has compression level 3, expected 0, 1 or 2"),
        ("<I", 4, (0,), "its header states 40 Gaussians, but its sections hold another number"),
        ("<I", 4, (4_000_000_000,), "truncated: its 4,000,000,000 sections begin at"),
        ("<I", 12, (41,), "its header states 41 Gaussians"),
        ("<I", 4096 + 4, (41,), "truncated: a section ends at byte"),
        ("<I", 4096 + 4, (4_000_000_000,), "truncated: a section ends at byte"),
        ("<I", 4096 + 4, (39,), "damaged: its buckets hold 40 Gaussians, expected 39"),
        ("<I", 4096 + 8, (4_000_000_000,), "damaged: its buckets hold "),
        ("<I", 4096 + 32, (4_000_000_000,), "damaged: its buckets hold "),
        ("<H", 4096 + 40, (3,), "has SH degree 3, expected 0, 1 or 2"),
    ],
)
def test_damaged_ksplat_headers_are_refused_with_a_one_line_error(
    tmp_path: Path, layout: str, offset: int, value: tuple[int, ...], message: str
) -> None:
    """The error names the wrong header field."""
    data = bytearray(ksplat([capture(40, 1)], 1, block=8.0))
    struct.pack_into(layout, data, offset, *value)
    (tmp_path / "a.ksplat").write_bytes(data)
    with pytest.raises(FormatError) as error:
        ls.load(tmp_path / "a.ksplat")
    assert message in str(error.value) and "\n" not in str(error.value)


def test_ksplat_without_any_gaussian_is_refused(tmp_path: Path) -> None:
    """The header states a count of zero."""
    data = bytearray(ksplat([capture(1, 0)], 0)[:4096])
    struct.pack_into("<4I", data, 4, 0, 0, 0, 0)
    (tmp_path / "a.ksplat").write_bytes(data)
    with pytest.raises(FormatError, match="holds zero Gaussians"):
        ls.load(tmp_path / "a.ksplat")


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("count", [60, pytest.param(2000, marks=pytest.mark.deep)])
def test_mutated_ksplat_files_either_load_or_are_refused_with_a_one_line_error(
    tmp_path: Path, level: int, count: int
) -> None:
    """Bytes are changed, mostly in headers, or the end is lost."""
    path, rng = tmp_path / "a.ksplat", np.random.default_rng(level)
    original = ksplat([capture(20, 2, seed=3), capture(9, 1, seed=4)], level)
    fields = np.concatenate([np.arange(44), 4096 + np.arange(44), 5120 + np.arange(44)])
    for _ in range(count):
        data = bytearray(original)
        for position in (*rng.choice(fields, 2), rng.integers(0, len(data))):
            data[position] = rng.integers(0, 256)
        path.write_bytes(data if rng.random() < 0.8 else data[: rng.integers(1, len(data))])
        try:
            ls.load(path, drop_invalid=True)
        except SceneError as error:
            assert "\n" not in str(error) and str(path) in str(error)


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("degree", [0, 2])
def test_ksplat_files_of_gaussiansplats3d_are_read(tmp_path: Path, level: int, degree: int) -> None:
    """GaussianSplats3D converts a PLY of Lumisplat to an equal capture; Gaussians are matched by position."""
    if NODE is None or not (FOLDER / "node_modules" / "@mkkellogg").is_dir():
        pytest.skip(f"no @mkkellogg/gaussian-splats-3d in {FOLDER} (set LUMISPLAT_NODE, or npm install it there)")
    given = capture(400, degree)
    ls.save(tmp_path / "a.ply", given)
    script = FOLDER / f"write_ksplat_{os.getpid()}.mjs"
    script.write_text(WRITE)
    try:
        command = [NODE, script, tmp_path / "a.ply", f"{level}", f"{degree}", tmp_path / "a.ksplat"]
        subprocess.run(command, check=True, capture_output=True, timeout=120)
    finally:
        script.unlink()
    read = load_gaussians(tmp_path / "a.ksplat")
    distances = np.linalg.norm(read.means[:, None] - given.means[None], axis=2)
    order = distances.argmin(axis=1).tolist()
    assert sorted(order) == list(range(400))
    check_same(read, given, order, level, block=5.0, steps=1.0001)
    span = float(np.ptp(given.sh[:, 1:])) if degree else 0.0
    np.testing.assert_allclose(
        read.sh[:, 1:], given.sh[order, 1:], rtol=2.0**-10, atol=span / 255.0 + 1e-6 if level == 2 else 1e-6
    )
