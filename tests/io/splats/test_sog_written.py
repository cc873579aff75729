"""Writing of SOG: round trips, reproducible bytes, and another reader."""

from __future__ import annotations

import io
import json
import os
import shutil
import subprocess
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import lumisplat as ls
from lumisplat.errors import FormatError
from lumisplat.io.splats.sog import encode, fit_codebook, palette_size
from lumisplat.scene.ops.neighbours import morton_order
from support.files.splat_files import capture, load_gaussians

FIELDS = ("means", "rotations_wxyz", "scales", "opacities", "sh")


def written(folder: Path, gaussians: ls.Gaussians) -> tuple[ls.Gaussians, ls.Gaussians]:
    """Writes a capture as SOG, and returns it in the order of the file and as read back."""
    ls.save(folder / "a.sog", gaussians)
    return gaussians.subset(morton_order(gaussians.means)), load_gaussians(folder / "a.sog")


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_sog_round_trip_is_within_half_a_quantisation_step(tmp_path: Path, degree: int) -> None:
    """A palette of 256 entries for 300 Gaussians preserves most of the SH."""
    before, after = written(tmp_path, capture(300, degree, antialiased=True))
    assert after.antialiased
    assert after.sh_degree == degree
    logs, read = (np.sign(g.means) * np.log1p(np.abs(g.means)) for g in (before, after))
    np.testing.assert_allclose(read, logs, rtol=0, atol=0.5001 * np.ptp(logs, axis=0).max() / 65535 + 1e-6)
    cosines = np.abs(np.einsum("ij,ij->i", before.rotations_wxyz, after.rotations_wxyz))
    assert cosines.min() > 1 - 3 * (np.sqrt(2) / 255) ** 2  # three components, each half a step of sqrt(2) / 255
    np.testing.assert_allclose(after.opacities, before.opacities, rtol=0, atol=0.5001 / 255)
    # A codebook is nowhere coarser than twice the largest gap between 256 values that are spread evenly.
    for a, b in ((np.log(after.scales), np.log(before.scales)), (after.sh[:, 0], before.sh[:, 0])):
        np.testing.assert_allclose(a, b, rtol=0, atol=float(np.ptp(b)) / 255)
    if degree:
        error = np.sqrt(np.mean((after.sh[:, 1:] - before.sh[:, 1:]) ** 2))
        # At the worst, 44 pairs of the 300 unrelated sets share one of 256 entries, each half their distance away.
        assert error < np.sqrt(88 / 300 / 2) * before.sh[:, 1:].std()


def test_sog_bundle_and_folder_contain_the_same_files(tmp_path: Path) -> None:
    """The bundle is an uncompressed zip; images are lossless WebP with sides that are multiples of 4."""
    ls.save(tmp_path / "a.sog", capture(70, 2))
    ls.save(tmp_path / "folder" / "meta.json", capture(70, 2))
    with zipfile.ZipFile(tmp_path / "a.sog") as bundle:
        assert {info.compress_type for info in bundle.infolist()} == {zipfile.ZIP_STORED}
        names = bundle.namelist()
        assert names[0] == "meta.json"
        assert sorted(names) == sorted(os.listdir(tmp_path / "folder"))
        for name in names:
            data = bundle.read(name)
            assert data == (tmp_path / "folder" / name).read_bytes()
            if name.endswith(".webp"):
                image = Image.open(io.BytesIO(data))
                assert b"VP8L" in data[:100]
                assert image.width % 4 == image.height % 4 == 0
    meta = json.loads((tmp_path / "folder" / "meta.json").read_text())
    assert meta["version"] == 2 and meta["count"] == 70 and meta["shN"]["bands"] == 2
    assert [len(meta[field]["codebook"]) for field in ("scales", "sh0", "shN")] == [256] * 3
    for field in FIELDS:
        ours, bundled = (load_gaussians(tmp_path / name) for name in ("folder", "a.sog"))
        np.testing.assert_array_equal(getattr(ours, field), getattr(bundled, field))


def test_writing_a_capture_twice_gives_identical_sog_files(tmp_path: Path) -> None:
    """Files contain no time stamps or random data."""
    for name in ("a.sog", "b.sog"):
        ls.save(tmp_path / name, capture(200, 3))
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()


def test_sog_preserves_the_colours_of_fully_transparent_gaussians(tmp_path: Path) -> None:
    """SH degree 0 is stored in the colour of pixels whose alpha is the opacity, 0 here."""
    base = capture(64)
    invisible = ls.Gaussians(base.means, base.rotations_wxyz, base.scales, np.zeros(64), base.sh[:, :1])
    before, after = written(tmp_path, invisible)
    np.testing.assert_allclose(after.sh, before.sh, atol=float(np.ptp(before.sh)) / 255)


@pytest.mark.parametrize("count", [1, 2, 17, 1023, 1025])
def test_sog_stores_any_number_of_gaussians(tmp_path: Path, count: int) -> None:
    """The images are padded; all Gaussians may share a coordinate."""
    base = capture(count, 1)
    flat = ls.Gaussians(base.means * (1, 1, 0), base.rotations_wxyz, base.scales, base.opacities, base.sh)
    before, after = written(tmp_path, flat)
    assert after.count == count
    np.testing.assert_array_equal(after.means[:, 2], 0.0)
    np.testing.assert_allclose(after.means, before.means, atol=1e-3)


@pytest.mark.parametrize("name", ["a.sog", "levels/lod-meta.json"])
def test_sog_preserves_positions_in_map_coordinates(
    tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Lumisplat decodes exact positions; other programs round to float32, as a log line warns."""
    base = capture(400, 0)
    far = replace(base, means=base.means + np.array((5e5, 5.4e6, 0.0)), scales=np.full((400, 3), 0.05))
    ls.save(tmp_path / name, far)
    read = load_gaussians(tmp_path / name)
    gaps = np.abs(read.means[:, None].astype(np.float64) - far.means[None]).max(axis=2).min(axis=1)
    assert read.count == 400 and gaps.max() < 1e-3
    assert (
        "the positions of 400 Gaussians are rounded to steps larger than their size, up to 5.1, because" in caplog.text
    )


def test_saving_sog_logs_how_many_gaussians_are_smaller_than_the_position_step(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Only the outlier is coarse, not the Gaussians near the origin; without an outlier nothing is logged."""
    base = capture(100, 0)
    means = base.means.copy()
    means[7] = (40_000.0, 0.0, 0.0)
    ls.save(tmp_path / "a.sog", replace(base, means=means, scales=np.full((100, 3), 0.05)))
    assert "the positions of 1 Gaussian are rounded to steps larger than their size, up to 7.5" in caplog.text
    read = load_gaussians(tmp_path / "a.sog")
    near = read.means[read.means[:, 0] < 1e3]
    gaps = np.abs(near[:, None] - means[None]).max(axis=2).min(axis=1)
    assert len(near) == 99 and gaps.max() < 2e-3
    caplog.clear()
    ls.save(tmp_path / "b.sog", replace(base, scales=np.full((100, 3), 0.05)))
    assert not caplog.records


def test_saving_a_loaded_sog_again_does_not_change_its_sh_coefficients(tmp_path: Path) -> None:
    """The palette of the loaded file is found again."""
    _, once = written(tmp_path, capture(2000, 2))
    before, twice = written(tmp_path, once)
    np.testing.assert_allclose(twice.sh[:, 1:], before.sh[:, 1:], atol=1e-6)


@pytest.mark.parametrize(("count", "size"), [(1, 1), (40, 32), (1024, 1024), (152_746, 65_536), (10**6, 65_536)])
def test_sog_palette_size_is_a_power_of_two_of_at_most_65536(count: int, size: int) -> None:
    """The palette has at most as many entries as the capture has Gaussians."""
    assert palette_size(count) == size


def test_materials_and_kernel_degree_that_sog_drops_are_logged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """One log line names the roughness, another the kernel degree."""
    ls.save(tmp_path / "a.sog", capture(5, 0, kernel_degree=4, roughness=np.full(5, 0.5)))
    messages = " ".join(record.getMessage() for record in caplog.records)
    assert "SOG cannot store roughness" in messages
    assert "SOG cannot store the kernel degree, 4" in messages


def test_interrupted_write_of_a_sog_folder_leaves_no_meta_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An old meta.json beside new images would be inconsistent."""
    meta = tmp_path / "folder" / "meta.json"
    ls.save(meta, capture(20))
    (tmp_path / "folder" / "scales.webp").unlink()
    (tmp_path / "folder" / "scales.webp").mkdir()
    with pytest.raises(FormatError, match=r"scales\.webp.*is a folder"):
        ls.save(meta, capture(20, seed=1))
    with pytest.raises(FormatError, match=r"without a meta\.json"):
        ls.load(tmp_path / "folder")


def test_sog_codebook_is_exact_for_up_to_256_distinct_values() -> None:
    """Each of 200 values, repeated up to 200 times, is decoded to itself."""
    values = np.random.default_rng(0).normal(size=200).astype(np.float32)
    many = np.repeat(values, np.arange(1, 201))
    codebook = fit_codebook(many)
    assert (np.diff(codebook) >= 0).all() and codebook.shape == (256,)
    np.testing.assert_allclose(codebook[encode(many, codebook)], many, rtol=1e-6)


def test_sog_codebook_represents_few_outliers_among_many_values_exactly() -> None:
    """Four values far from ten thousand others get their own entries."""
    rng = np.random.default_rng(0)
    values = np.concatenate([rng.normal(size=10_000), [30.0, 31.0, -25.0, 60.0]])
    codebook = fit_codebook(values)
    np.testing.assert_allclose(codebook[encode(values[-4:], codebook)], values[-4:], rtol=1e-6)


def test_sog_codebook_of_uniform_numbers_has_at_most_1_percent_above_the_least_error() -> None:
    """For uniform numbers the optimum is the error of 256 equal steps."""
    values = (np.arange(51_200) + 0.5) / 51_200
    codebook = fit_codebook(values)
    error = np.mean((codebook[encode(values, codebook)] - values) ** 2)
    assert error < 1.01 / 256**2 / 12


@pytest.mark.data
def test_frames_of_a_capture_before_and_after_saving_as_sog_match_with_over_60_db_psnr(
    tmp_path: Path, data_dir: Path
) -> None:
    """The downloaded biker capture is rendered at 320 x 180 pixels."""
    biker = load_gaussians(data_dir / "splats" / "biker.compressed.ply")
    ls.save(tmp_path / "biker.sog", biker)
    camera = ls.frame_camera(ls.Scene(splats=[biker]), width=320, height=180)
    renderer = ls.create_renderer(device="cpu")
    a, b = (
        renderer.render(ls.Scene(splats=[g]), camera).color for g in (biker, load_gaussians(tmp_path / "biker.sog"))
    )
    assert ls.metrics.psnr(np.clip(a, 0, 1), np.clip(b, 0, 1)) > 60.0
    assert (tmp_path / "biker.sog").stat().st_size < 2_000_000


def splat_transform() -> list[str]:
    """Returns the command of PlayCanvas's splat-transform, or skips the test with the reason."""
    command = os.environ.get("SPLAT_TRANSFORM") or shutil.which("splat-transform")
    if not command:
        pytest.skip("needs PlayCanvas's splat-transform: npm install -g @playcanvas/splat-transform@2.7.1")
    return command.split()


@pytest.mark.parametrize("degree", [0, 3])
def test_splat_transform_and_lumisplat_read_equal_gaussians_from_written_sog(tmp_path: Path, degree: int) -> None:
    """The PLY that splat-transform makes of the SOG equals the loaded capture."""
    command = splat_transform()
    _, ours = written(tmp_path, capture(500, degree))
    done = subprocess.run(
        [*command, tmp_path / "a.sog", tmp_path / "b.ply"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    theirs = load_gaussians(tmp_path / "b.ply")
    for field in FIELDS:
        np.testing.assert_allclose(getattr(theirs, field), getattr(ours, field), rtol=2e-5, atol=2e-5)
