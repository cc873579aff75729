"""Captures saved in the columns of Relightable 3D Gaussians (R3DG)."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.io.splats.columns import R3DG
from lumisplat.math.sh import sh_basis
from support.files.splat_files import capture, load_gaussians, parse_ply
from support.kinds import present

ORDER = [
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(45))),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    *("base_color_0", "base_color_1", "base_color_2", "roughness"),
    *("incidents_dc_0", "incidents_dc_1", "incidents_dc_2", *(f"incidents_rest_{i}" for i in range(45))),
    *("visibility_dc_0", *(f"visibility_rest_{i}" for i in range(15))),
]


def relightable(count: int = 200, **changes: Any) -> ls.Gaussians:
    """Returns a capture whose materials span the range of R3DG's columns."""
    rng = np.random.default_rng(5)
    normals = rng.normal(size=(count, 3))
    albedo = rng.uniform(0.03, 0.8, (count, 3)).astype(np.float32)
    roughness = rng.uniform(0.09, 0.99, count).astype(np.float32)
    albedo[0], albedo[1], roughness[:2] = 0.03, 0.8, (0.09, 0.99)
    made = replace(capture(count), normals=normals, albedo=albedo, roughness=roughness)
    return replace(made, **changes)


def test_r3dg_ply_has_the_130_columns_of_relightable_3d_gaussians(tmp_path: Path) -> None:
    """Columns are in order, values are stored before activation, and SH are ordered by channel."""
    light = np.random.default_rng(1).normal(size=(200, 16, 3)).astype(np.float32)
    first = relightable(incident=light)
    ls.save(tmp_path / "theirs.ply", first, columns="r3dg")
    names, rows = parse_ply((tmp_path / "theirs.ply").read_bytes())
    assert (len(ORDER), names) == (130, ORDER)
    columns = dict(zip(names, rows.T, strict=True))
    albedo = present(first.albedo).astype(np.float64)
    inner = slice(2, None)  # limits are logits of 20
    fraction = (albedo[inner, 1] - 0.03) / 0.77
    np.testing.assert_allclose(
        columns["base_color_1"][inner], np.log(fraction / (1.0 - fraction)), rtol=1e-4, atol=1e-6
    )
    np.testing.assert_array_equal(columns["base_color_1"][:2], [-20.0, 20.0])
    np.testing.assert_array_equal(columns["incidents_rest_17"], light[:, 3, 1])
    np.testing.assert_array_equal(columns["ny"], present(first.normals)[:, 1])
    assert not any(columns[name].any() for name in names if name.startswith("visibility"))


def test_r3dg_ply_round_trip_preserves_materials(tmp_path: Path) -> None:
    """Materials are right to the last digit, later round trips exact; no Lumisplat comment marks them as linear."""
    first = relightable(comments=("lumisplat materials linear", "of a walk"))
    ls.save(tmp_path / "once.ply", first, columns="r3dg")
    once = load_gaussians(tmp_path / "once.ply")
    ls.save(tmp_path / "ours.ply", once)
    ls.save(tmp_path / "twice.ply", load_gaussians(tmp_path / "ours.ply"), columns="r3dg")
    twice = load_gaussians(tmp_path / "twice.ply")
    for name in ("means", "normals", "albedo", "roughness", "sh"):
        np.testing.assert_array_equal(getattr(twice, name), getattr(once, name), name)
    for name in ("scales", "opacities", "rotations_wxyz"):
        np.testing.assert_array_max_ulp(getattr(twice, name), getattr(once, name), 2)
    for name in ("albedo", "roughness"):
        np.testing.assert_array_max_ulp(getattr(once, name), getattr(first, name), 2)
    np.testing.assert_array_equal(once.sh[:, : first.sh.shape[1]], first.sh)
    assert once.sh_degree == 3 and not once.sh[:, first.sh.shape[1] :].any()
    assert once.comments == ("of a walk",)


def test_materials_decoded_from_float32_logits_are_encoded_exactly() -> None:
    """Logits cover -18 to 18; encoding and decoding gives the same albedo and roughness again."""
    logits = np.concatenate([np.linspace(-18.0, 18.0, 100_001), np.random.default_rng(0).normal(size=100_000)])
    for name in ("albedo", "roughness"):
        values = R3DG.activated(name, logits.astype(np.float32))
        np.testing.assert_array_equal(R3DG.activated(name, R3DG.stored(name, values)), values)


def test_materials_outside_the_range_of_r3dg_are_clamped_and_logged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Dropped metallic values are logged, too."""
    albedo = np.full((4, 3), 0.5)
    albedo[1] = (0.0, 0.5, 0.95)
    metallic, roughness = np.array([0.0, 0.0, 1.0, 0.0]), np.array([0.5, 1.0, 0.5, 0.5])
    made = relightable(4, albedo=albedo, roughness=roughness, metallic=metallic)
    with caplog.at_level(logging.WARNING, logger="lumisplat"):
        ls.save(tmp_path / "a.ply", made, columns="r3dg")
    color, rough, metal = (record.getMessage() for record in caplog.records)
    assert "albedo from 0.03 to 0.80: 2 of 12 values are outside, by up to 0.15, and are clamped" in color
    assert "roughness from 0.09 to 0.99: 1 of 4 values are outside, by up to 0.01" in rough
    assert "cannot store metallic" in metal
    again = load_gaussians(tmp_path / "a.ply")
    np.testing.assert_allclose(present(again.albedo)[1], (0.03, 0.5, 0.8), atol=1e-6)
    np.testing.assert_allclose(present(again.roughness)[1], 0.99, atol=1e-6)
    assert again.metallic is None
    caplog.clear()
    ls.save(tmp_path / "b.ply", relightable(), columns="r3dg")
    assert not caplog.records


def test_incident_light_of_r3dg_plys_is_not_read_unless_the_caller_asks_for_it(tmp_path: Path) -> None:
    """Files of R3DG and of Lumisplat are read; missing coefficients are zeros."""
    light = np.random.default_rng(1).normal(size=(200, 4, 3)).astype(np.float32)
    made = relightable(incident=light)
    for columns, coefficients in (("lumisplat", 4), ("r3dg", 16)):
        ls.save(tmp_path / "a.ply", made, columns=cast(Any, columns))
        assert load_gaussians(tmp_path / "a.ply").incident is None
        with_incident = ls.load(tmp_path / "a.ply", incident=True)
        assert isinstance(with_incident, ls.Gaussians)
        found = present(with_incident.incident)
        assert found.shape == (200, coefficients, 3) and not found[:, 4:].any()
        np.testing.assert_array_equal(found[:, :4], light)
        np.testing.assert_allclose(present(with_incident.albedo), present(made.albedo), rtol=1e-6)
    plain = replace(made, incident=None)
    ls.save(tmp_path / "b.ply", plain, columns="r3dg")
    with_incident = ls.load(tmp_path / "b.ply", incident=True)
    assert isinstance(with_incident, ls.Gaussians) and not present(with_incident.incident).any()


def test_incident_light_rotates_with_the_capture() -> None:
    """Merging pads incident light of lower degree with zeros."""
    light = np.random.default_rng(1).normal(size=(5, 16, 3))
    made = relightable(5, incident=light)
    quarter = ls.transform(made, rotation_degrees=(0.0, 0.0, 90.0), scale=2.0)
    directions = np.random.default_rng(2).normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    rotated = np.stack([-directions[:, 1], directions[:, 0], directions[:, 2]], axis=1)
    before = np.einsum("dk,nkc->ndc", sh_basis(directions, 3), light)
    after = np.einsum("dk,nkc->ndc", sh_basis(rotated, 3), present(quarter.incident))
    np.testing.assert_allclose(after, before, atol=1e-5)
    both = ls.merge([made, replace(made, incident=light[:, :4])])
    assert present(both.incident).shape == (10, 16, 3) and not present(both.incident)[5:, 4:].any()


def test_captures_that_r3dg_columns_cannot_store_are_refused(tmp_path: Path) -> None:
    """Materials are missing, or the format is no PLY; nothing is written."""
    output = tmp_path / "a.ply"
    with pytest.raises(ls.FormatError, match=r"a.ply: R3DG's columns hold .* no roughness and no normals: lumisplat"):
        ls.save(output, relightable(normals=None, roughness=None), columns="r3dg")
    with pytest.raises(ls.ConfigError, match="columns is 'gsir', expected 'lumisplat' or 'r3dg'"):
        ls.save(output, relightable(), columns=cast(Any, "gsir"))
    for name in ("a.compressed.ply", "a.spz"):
        with pytest.raises(ls.ConfigError, match=f"columns 'r3dg' need a .ply, got .*{name}"):
            ls.save(tmp_path / name, relightable(), columns="r3dg")
    with pytest.raises(ls.SceneError, match="incident has 5 coefficients, expected 1, 4, 9 or 16"):
        relightable(incident=np.zeros((200, 5, 3)))
    assert not list(tmp_path.iterdir())
