"""PlayCanvas compressed PLY, checked bit by bit."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import SH_C0
from lumisplat.errors import FormatError
from lumisplat.io.splats.columns import pack_smallest_three, unpack_smallest_three
from lumisplat.io.splats.compressed_ply import morton_order
from support.files.splat_files import load_gaussians

RANGES = [f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"]
SCALES = [f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"]
COLORS = [f"{end}_{axis}" for end in ("min", "max") for axis in "rgb"]


def by_hand(path: Path, colors: bool, sh: bytes = b"", vertex_count: int = 1) -> Path:
    """Writes one Gaussian in one chunk, packed by hand.

    Position (2047, 0, 1023) of (2047, 1023, 2047) in -1..1; rotation: component 2 left out, all others at the middle
    512; scale (0, 1023, 2047) of -4..-2; colour (255, 0, 51), opacity 102.
    """
    names = [*RANGES, *SCALES, *(COLORS if colors else [])]
    values = [-1, -1, -1, 1, 1, 1, -4, -4, -4, -2, -2, -2, *([0.25] * 3 + [0.75] * 3 if colors else [])]
    words = [
        2047 << 21 | 0 << 11 | 1023,
        2 << 30 | 512 << 20 | 512 << 10 | 512,
        0 << 21 | 1023 << 11 | 2047,
        255 << 24 | 0 << 16 | 51 << 8 | 102,
    ]
    lines = ["ply", "format binary_little_endian 1.0", "element chunk 1", *(f"property float {n}" for n in names)]
    lines += [f"element vertex {vertex_count}"]
    lines += [f"property uint packed_{n}" for n in ("position", "rotation", "scale", "color")]
    if sh:
        lines += ["element sh 1", *(f"property uchar f_rest_{i}" for i in range(len(sh)))]
    data = np.array(values, "<f4").tobytes() + np.array(words, "<u4").tobytes() * vertex_count + sh
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode() + data)
    return path


def test_compressed_ply_packed_by_hand_is_decoded(tmp_path: Path) -> None:
    """Every bit field is where PlayCanvas's layout has it."""
    one = load_gaussians(by_hand(tmp_path / "one.ply", colors=True))
    np.testing.assert_allclose(one.means, [[1.0, -1.0, -1 + 2 * 1023 / 2047]], rtol=1e-6)
    np.testing.assert_allclose(np.log(one.scales), [[-4.0, -2.0, -2.0]], rtol=1e-6)
    small = (512 / 1023 - 0.5) * np.sqrt(2)
    np.testing.assert_allclose(one.rotations_wxyz, [[small, small, np.sqrt(1 - 3 * small**2), small]], rtol=1e-5)
    np.testing.assert_allclose(one.opacities, [102 / 255], rtol=1e-6)
    np.testing.assert_allclose(one.sh[0, 0] * SH_C0 + 0.5, [0.75, 0.25, 0.25 + 0.5 * 51 / 255], rtol=1e-6)


def test_compressed_ply_without_colour_ranges_is_read(tmp_path: Path) -> None:
    """In older files a byte is the colour itself."""
    one = load_gaussians(by_hand(tmp_path / "old.ply", colors=False))
    np.testing.assert_allclose(one.sh[0, 0] * SH_C0 + 0.5, [1.0, 0.0, 51 / 255], atol=1e-6)


def test_compressed_ply_sh_bytes_are_bin_centres(tmp_path: Path) -> None:
    """Bins cover -4..4; the first and last byte are the ends of the range. SH are ordered by channel."""
    one = load_gaussians(by_hand(tmp_path / "sh.ply", colors=True, sh=bytes([0, 128, 255, 64, 127, 192, 1, 2, 254])))
    expected = np.array([-4.0, 1 / 64, 4.0, -2 + 1 / 64, -1 / 64, 2 + 1 / 64, -4 + 3 / 64, -4 + 5 / 64, 4 - 3 / 64])
    np.testing.assert_allclose(one.sh[0, 1:], expected.reshape(3, 3).T, rtol=1e-6)


def test_compressed_ply_with_a_missing_chunk_is_refused(tmp_path: Path) -> None:
    """The reader does not read past the end of the chunks."""
    with pytest.raises(FormatError, match="has 1 chunks for 257 Gaussians, expected 2"):
        ls.load(by_hand(tmp_path / "few.ply", colors=True, vertex_count=257))


def test_compressed_ply_with_a_wrong_number_of_sh_rows_is_refused(tmp_path: Path) -> None:
    """The file has one row of SH for two Gaussians."""
    with pytest.raises(FormatError, match="has 1 sh rows of 9 values for 2 Gaussians"):
        ls.load(by_hand(tmp_path / "sh.ply", colors=True, sh=bytes(9), vertex_count=2))


def test_morton_order_puts_neighbouring_points_next_to_each_other() -> None:
    """Mean steps along the curve are below a fifth of random order, and every index occurs once."""
    points = np.random.default_rng(2).random((4096, 3)).astype(np.float32)
    order = morton_order(points)

    def step(sequence: np.ndarray) -> float:
        return float(np.linalg.norm(np.diff(sequence, axis=0), axis=1).mean())

    np.testing.assert_array_equal(np.sort(order), np.arange(4096))
    assert step(points[order]) < 0.2 * step(points)


def test_saving_compressed_ply_logs_how_many_positions_an_outlier_makes_coarse(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """One distant outlier makes the positions of its chunk of 256 Gaussians coarse, and a warning counts the 256."""
    rng = np.random.default_rng(0)
    means = rng.random((1000, 3)).astype(np.float32)

    def saved_with(means: np.ndarray) -> str:
        caplog.clear()
        count = len(means)
        rotations, sh = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)), np.zeros((count, 1, 3))
        gaussians = ls.Gaussians(means, rotations, np.full((count, 3), 0.01), np.full(count, 0.5), sh)
        ls.save(tmp_path / "a.compressed.ply", gaussians)
        return caplog.text

    assert saved_with(means) == ""
    stray = np.concatenate([means, [[1e4, 0.0, 0.0]]])
    assert "the positions of 256 Gaussians" in saved_with(stray)  # one chunk, where the curve runs last along x
    farther = np.concatenate([means, [[1e8, 0.0, 0.0]]])
    assert "the positions of 256 Gaussians" in saved_with(farther)  # only the chunk of the outlier, however far it is


def test_morton_order_keeps_the_order_of_coincident_points() -> None:
    """A bounding box without extent causes no division by zero."""
    np.testing.assert_array_equal(morton_order(np.ones((3, 3), dtype=np.float32)), [0, 1, 2])


def test_packing_rotations_as_smallest_three_components_is_invertible() -> None:
    """Packing and unpacking give the same rotation, whichever component is largest."""
    quaternions = np.random.default_rng(0).normal(size=(200, 4)).astype(np.float32)
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    largest, smallest = pack_smallest_three(quaternions)
    assert set(largest) == {0, 1, 2, 3}
    assert np.abs(smallest).max() <= np.sqrt(0.5) + 1e-6
    cosines = np.einsum("ij,ij->i", unpack_smallest_three(largest, smallest), quaternions)
    np.testing.assert_allclose(np.abs(cosines), 1.0, atol=1e-6)


@pytest.mark.data
def test_downloaded_biker_compressed_ply_is_decoded_to_the_values_of_gsply(data_dir: Path) -> None:
    """Rows at chunk borders equal those that gsply 0.4.6 decoded (numbers recorded once)."""
    biker = load_gaussians(data_dir / "splats" / "biker.compressed.ply")
    assert (biker.count, biker.sh_degree, biker.comments) == (152_746, 0, ("Generated by SuperSplat 2.7.1",))
    for row, mean, log_scale, wxyz, opacity, dc in GSPLY_ROWS:
        np.testing.assert_allclose(biker.means[row], mean, atol=1e-6)
        np.testing.assert_allclose(np.log(biker.scales[row]), log_scale, atol=1e-5)
        np.testing.assert_allclose(biker.rotations_wxyz[row], wxyz, atol=1e-6)
        np.testing.assert_allclose(biker.opacities[row], opacity, atol=1e-6)
        np.testing.assert_allclose(biker.sh[row, 0], dc, atol=1e-5)


@pytest.mark.data
def test_loading_a_compressed_ply_does_not_import_warp_or_pillow(data_dir: Path) -> None:
    """In a fresh process the imports would cost seconds."""
    code = (
        "import sys, lumisplat; lumisplat.load(sys.argv[1]);"
        "print(sorted({'warp', 'zstandard', 'PIL'} & set(sys.modules)))"
    )
    path = str(data_dir / "splats" / "biker.compressed.ply")
    output = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, check=True).stdout
    assert output.strip() == "[]"


# (row, mean, log scale, wxyz, opacity, DC): gsply.reader.read_compressed, its logits taken back by the sigmoid.
GSPLY_ROWS = [
    (
        0,
        (-0.10453680, -2.38789821, -0.36081100),
        (-6.06891680, -4.20654297, -7.05074787),
        (0.46103638, -0.06290001, 0.88485521, 0.02280990),
        1 / (1 + np.exp(2.577688455581665)),
        (0.54786843, 0.52228427, 0.56815183),
    ),
    (
        255,
        (-0.12901378, -2.06011534, -0.44404089),
        (-5.36553240, -5.10452747, -6.08820486),
        (0.50250894, -0.28546929, 0.09469563, 0.81057066),
        1 / (1 + np.exp(0.3728889524936676)),
        (-1.37748659, -1.36017811, -1.33881748),
    ),
    (
        256,
        (-0.13092470, -2.04713583, -0.44644001),
        (-4.60482073, -5.44883585, -8.72695827),
        (0.90584749, -0.05322309, 0.38085616, 0.17764071),
        1 / (1 + np.exp(2.1756255626678467)),
        (-1.66011047, -1.65126634, -1.62688911),
    ),
    (
        152_745,
        (0.16716531, -0.60306394, 0.32881942),
        (-5.77518606, -4.84216404, -7.63839293),
        (0.99819165, 0.04078133, -0.04216375, 0.01313297),
        1 / (1 + np.exp(2.8457396030426025)),
        (1.11975539, 1.09743500, 1.05975068),
    ),
]
