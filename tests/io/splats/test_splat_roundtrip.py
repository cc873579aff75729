"""Every format preserves captures to within the steps of its quantisation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import SH_C0
from lumisplat.io.splats.compressed_ply import morton_order
from lumisplat.scene.gaussians import Gaussians
from support.files.splat_files import FORMATS, capture, load_gaussians, write_format

FLOAT = 1e-6
"""Rounding error of float32 exp, log and normalisation at the magnitudes used here."""


@dataclass(frozen=True)
class Steps:
    """Half a quantisation step of each property, the largest change by rounding."""

    mean: float = 0.0
    log_scale: float = FLOAT
    rotation: float = FLOAT
    """Half a step of one stored component."""
    opacity: float = FLOAT
    dc: float = 0.0
    rest: float = 0.0


def half_step(values: np.ndarray, levels: int) -> float:
    """Returns half a step of ``levels`` over the values' range, for the widest channel, plus float32 rounding."""
    return float(np.ptp(values, axis=0).max()) / levels / 2 + FLOAT


def steps(name: str, gaussians: Gaussians) -> Steps:
    """Returns the tolerances of a format.

    Compressed PLY has 11, 10 and 11 bits for a position in its chunk, which spans at most the whole capture, 10 bits
    over sqrt(2) for rotations, 8 bits for opacity and colour, and 256 steps over -4..4 for SH. SPZ has 12 fractional
    bits for positions, sixteenths for log scales, a byte of 255 * 0.15 times SH degree 0 for colours, steps of 1/128
    for other SH, and 9 bits over sqrt(1/2) for rotations (8 over 2 before version 3); version 1 has half floats. SOG
    has 16 bits over the range of log(1 + |x|), whose derivative is 1 + |x|, for positions, and bytes elsewhere.
    """
    logs = np.log(gaussians.scales)
    if name.endswith(".compressed.ply"):
        return Steps(
            mean=half_step(gaussians.means, 1023),
            log_scale=half_step(logs, 1023),
            rotation=np.sqrt(2) / 1023 / 2 + FLOAT,
            opacity=1 / 510 + FLOAT,
            dc=half_step(gaussians.sh[:, 0] * SH_C0, 255) / SH_C0,
            rest=1 / 64 + FLOAT,
        )
    if name.endswith(".ply"):
        return Steps()
    if name.endswith(".spz"):
        largest = np.abs(gaussians.means).max()
        return Steps(
            mean=largest * 2**-11 if name == "v1.spz" else 2**-13 + FLOAT,
            log_scale=1 / 32 + FLOAT,
            rotation=(1 / 255 if name in ("v1.spz", "v2.spz") else np.sqrt(0.5) / 511 / 2) + FLOAT,
            opacity=1 / 510 + 2 * FLOAT,
            dc=1 / (2 * 255 * 0.15) + FLOAT,
            rest=1 / 256 + FLOAT,
        )
    largest = 1 + np.abs(gaussians.means).max()
    everything = gaussians.sh[:, 1:].ravel()
    logits = np.log(gaussians.opacities / (1 - gaussians.opacities))
    return Steps(
        mean=largest * half_step(np.sign(gaussians.means) * np.log1p(np.abs(gaussians.means)), 65535) + 2 * FLOAT,
        log_scale=half_step(logs.ravel(), 255),
        rotation=np.sqrt(2) / 255 / 2 + FLOAT,
        # Version 1 stores the logit; the sigmoid's derivative is at most 1/4.
        opacity=half_step(logits, 255) / 4 if name == "linear.sog" else 1 / 510 + FLOAT,
        dc=half_step(gaussians.sh[:, 0].ravel(), 255),
        rest=half_step(everything, 255) if everything.size else 0.0,
    )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("name", FORMATS)
def test_round_trip_of_every_capture_format_is_within_half_a_quantisation_step(
    tmp_path: Path, name: str, degree: int
) -> None:
    """A capture is written and loaded in each format."""
    gaussians = capture(300, degree)
    loaded = load_gaussians(write_format(tmp_path, name, gaussians))
    if name.endswith(".compressed.ply"):
        gaussians = gaussians.subset(morton_order(gaussians.means))
    tolerance = steps(name, gaussians)
    assert loaded.sh_degree == degree
    np.testing.assert_allclose(loaded.means, gaussians.means, rtol=0, atol=tolerance.mean)
    np.testing.assert_allclose(np.log(loaded.scales), np.log(gaussians.scales), rtol=0, atol=tolerance.log_scale)
    np.testing.assert_allclose(loaded.opacities, gaussians.opacities, rtol=0, atol=tolerance.opacity)
    np.testing.assert_allclose(loaded.sh[:, 0], gaussians.sh[:, 0], rtol=0, atol=tolerance.dc)
    np.testing.assert_allclose(loaded.sh[:, 1:], gaussians.sh[:, 1:], rtol=0, atol=tolerance.rest)
    # Three components move by a step each, and the fourth, m >= 1/2, follows by |kept| |step| / m <= sqrt(3) |step|
    # (version 1 and 2 of SPZ leave w out, however small, and round its square instead).
    moved = np.sqrt(3) * tolerance.rotation
    follows = np.sqrt(2 * moved) if name in ("v1.spz", "v2.spz") else np.sqrt(3) * moved
    apart = np.sqrt(moved**2 + follows**2)
    cosines = np.abs(np.einsum("ij,ij->i", loaded.rotations_wxyz, gaussians.rotations_wxyz))
    assert cosines.min() >= 1 - apart**2 / 2 - FLOAT


@pytest.mark.parametrize("name", ["capture.ply", "capture.compressed.ply", "capture.spz"])
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("comments", [(), ("antialiased 1", "made by hand"), ("SplatRenderMode: default",)])
def test_capture_round_trip_preserves_the_antialiased_flag(
    tmp_path: Path, name: str, antialiased: bool, comments: tuple[str, ...]
) -> None:
    """Old comments that state another value do not matter, also in a second round trip."""
    path = tmp_path / name
    ls.save(path, capture(20, antialiased=antialiased, comments=comments))
    once = load_gaussians(path)
    ls.save(path, once)
    assert once.antialiased is antialiased
    assert load_gaussians(path).antialiased is antialiased


@pytest.mark.parametrize("name", ["capture.ply", "capture.compressed.ply"])
@pytest.mark.parametrize("degree", [0, 2, 4])
@pytest.mark.parametrize(
    "comments", [(), ("made by hand", "lumisplat kernel_degree 5"), ("Lumisplat Kernel_Degree  2",)]
)
def test_ply_round_trip_preserves_the_kernel_degree(
    tmp_path: Path, name: str, degree: int, comments: tuple[str, ...]
) -> None:
    """The degree wins over old comments in PLY and compressed PLY; a comment is written only if the degree is not 2."""
    path = tmp_path / name
    ls.save(path, capture(20, kernel_degree=degree, comments=comments))
    once = load_gaussians(path)
    ls.save(path, once)
    assert once.kernel_degree == degree
    assert load_gaussians(path).kernel_degree == degree
    stated = [comment for comment in load_gaussians(path).comments if "kernel" in comment.lower()]
    assert len(stated) == (degree != 2 or "Lumisplat Kernel_Degree  2" in comments)


@pytest.mark.parametrize("stated", [6, -1, 999_999_999])
def test_invalid_kernel_degree_comments_of_a_ply_are_refused(tmp_path: Path, stated: int) -> None:
    """The error names the file."""
    path = tmp_path / "capture.ply"
    ls.save(path, capture(5))
    path.write_bytes(path.read_bytes().replace(b"format ", b"comment lumisplat kernel_degree %d\nformat " % stated, 1))
    with pytest.raises(ls.FormatError, match=f"capture.ply: kernel_degree is {stated}, expected a whole number"):
        ls.load(path)


def test_spz_logs_a_dropped_kernel_degree_other_than_the_default(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """SPZ cannot store the kernel degree; a degree of 4 is logged, and the default of 2 is not."""
    ls.save(tmp_path / "usual.spz", capture(5))
    assert not caplog.records
    ls.save(tmp_path / "quartic.spz", capture(5, kernel_degree=4))
    assert [record.getMessage().partition(": ")[2] for record in caplog.records] == [
        "SPZ cannot store the kernel degree, 4: left out, save as .ply to keep it"
    ]


@pytest.mark.parametrize("name", ["capture.ply", "capture.compressed.ply"])
def test_ply_round_trip_preserves_the_order_of_comments(tmp_path: Path, name: str) -> None:
    """A second round trip does not double the comments."""
    path = tmp_path / name
    ls.save(path, capture(20, comments=("first", "second  one")))
    ls.save(path, load_gaussians(path))
    assert load_gaussians(path).comments == ("first", "second one")


def test_ply_round_trip_preserves_normals_and_materials(tmp_path: Path) -> None:
    """The materials are albedo, roughness and metallic, and the errors of the first two."""
    rng = np.random.default_rng(3)
    normals = rng.normal(size=(30, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    extra = {"normals": normals, "albedo": rng.random((30, 3)), "roughness": rng.random(30), "metallic": rng.random(30)}
    extra |= {"albedo_error": 2.0 * rng.random(30), "roughness_error": rng.random(30)}
    ls.save(tmp_path / "relit.ply", capture(30, **extra))
    loaded = load_gaussians(tmp_path / "relit.ply")
    for field, values in extra.items():
        np.testing.assert_allclose(getattr(loaded, field), values, atol=FLOAT)


@pytest.mark.parametrize("name", ["lossy.compressed.ply", "lossy.spz"])
def test_capture_formats_log_materials_that_they_cannot_store(
    tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Formats that cannot store materials log which ones they drop."""
    ls.save(tmp_path / name, capture(10, roughness=np.full(10, 0.5)))
    assert "cannot store roughness" in caplog.text


@pytest.mark.parametrize("name", ["capture.ply", "capture.compressed.ply", "capture.spz"])
@pytest.mark.parametrize("count", [1, 255, 256, 257])
def test_captures_of_about_256_gaussians_keep_their_count_in_chunked_formats(
    tmp_path: Path, name: str, count: int
) -> None:
    """No Gaussian is lost or added at the edges of a chunk of 256."""
    ls.save(tmp_path / name, capture(count))
    assert load_gaussians(tmp_path / name).count == count


def test_ply_round_trip_keeps_opacities_0_and_1(tmp_path: Path) -> None:
    """The stored logits would be infinite."""
    base = capture(3)
    extreme = Gaussians(base.means, base.rotations_wxyz, base.scales, [0.0, 1.0, 0.5], base.sh)
    ls.save(tmp_path / "extreme.ply", extreme)
    np.testing.assert_allclose(load_gaussians(tmp_path / "extreme.ply").opacities, [0.0, 1.0, 0.5], atol=1e-8)
