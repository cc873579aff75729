"""Captures as OpenUSD particle fields: exact round trips, and files of other programs."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.errors import FormatError
from lumisplat.io.usd import writing
from lumisplat.math.transforms import matrices_from_quaternions
from support.files.splat_files import capture, load_gaussians
from support.files.usd_files import EXTENSIONS, field, usd_core, validation_messages, write_usda
from support.kinds import expect_kind

Z_UP = 'upAxis = "Z"'
SH_1 = "[" + ", ".join(f"({k}, {k + 0.25}, {k + 0.5})" for k in range(8)) + "]"


def relightable(count: int = 60) -> ls.Gaussians:
    """Returns a capture with all optional fields."""
    rng = np.random.default_rng(5)
    return capture(
        count,
        3,
        normals=rng.normal(size=(count, 3)),
        albedo=rng.random((count, 3)),
        roughness=rng.random(count),
        metallic=rng.random(count),
        albedo_error=2.0 * rng.random(count),
        roughness_error=rng.random(count),
        antialiased=True,
        kernel_degree=3,
        comments=("a comment", "another"),
    )


@pytest.mark.parametrize("extension", EXTENSIONS)
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_usd_round_trip_keeps_every_bit_of_a_capture(tmp_path: Path, extension: str, degree: int) -> None:
    """Files are binary, text and packages."""
    usd_core()
    saved, path = capture(50, degree), tmp_path / f"capture{extension}"
    ls.save(path, saved)
    loaded = load_gaussians(path)
    for name, values in saved.arrays().items():
        np.testing.assert_array_equal(getattr(loaded, name), values, err_msg=name)


def test_usd_round_trip_keeps_materials_of_relightable_captures(tmp_path: Path) -> None:
    """Normals, albedo, roughness and metallic are primvars; training settings and comments are restored, too."""
    usd_core()
    saved, path = relightable(), tmp_path / "capture.usdc"
    ls.save(path, saved)
    loaded = load_gaussians(path)
    assert loaded.arrays().keys() == saved.arrays().keys()
    for name, values in saved.arrays().items():
        np.testing.assert_array_equal(getattr(loaded, name), values, err_msg=name)
    assert (loaded.antialiased, loaded.kernel_degree, loaded.comments) == (True, 3, ("a comment", "another"))
    stage = usd_core().Stage.Open(str(path))
    primvar = stage.GetPrimAtPath("/World/gaussians").GetAttribute("primvars:albedo")
    assert primvar.GetTypeName() == "color3f[]" and primvar.GetMetadata("interpolation") == "vertex"


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_captures_written_to_usd_pass_the_validators_of_usd_core(tmp_path: Path, extension: str) -> None:
    """Files are text, binary and packages."""
    usd_core()
    ls.save(tmp_path / f"capture{extension}", relightable())
    assert not validation_messages(tmp_path / f"capture{extension}")


def test_sh_count_and_colour_space_of_captures_are_written_to_usd(tmp_path: Path) -> None:
    """The schema of particle fields leaves both open."""
    usd = usd_core()
    ls.save(tmp_path / "a.usdc", capture(5, 2))
    stage = usd.Stage.Open(str(tmp_path / "a.usdc"))
    (prim,) = (one for one in stage.Traverse() if one.GetTypeName() == "ParticleField3DGaussianSplat")
    attribute = prim.GetAttribute("radiance:sphericalHarmonicsCoefficients")
    authored = attribute.GetMetadata("elementSize"), attribute.GetMetadata("interpolation"), attribute.GetColorSpace()
    assert authored == (9, "vertex", "srgb_rec709_scene")


def test_captures_written_to_usd_are_upright_in_other_programs(tmp_path: Path) -> None:
    """The root rotates a y-down capture: -y becomes +y. Units are metres."""
    usd_core()
    ls.save(tmp_path / "capture.usdc", capture(5))
    stage = usd_core().Stage.Open(str(tmp_path / "capture.usdc"))
    geom = usd_core("UsdGeom")
    transform = geom.XformCache().GetLocalToWorldTransform(stage.GetPrimAtPath("/World/gaussians"))
    assert list(transform.Transform(usd_core("Gf").Vec3d(1, -2, 3))) == [1, 2, -3]
    assert geom.GetStageUpAxis(stage) == "Y" and geom.GetStageMetersPerUnit(stage) == 1.0


def test_usd_quaternions_of_gaussians_are_read_scalar_first(tmp_path: Path) -> None:
    """The text (0.6, 0, 0, 0.8) is w, x, y, z, a rotation about z; y up adds a half turn about x."""
    rotation = "[(0.6, 0, 0, 0.8), (1, 0, 0, 0)]"
    path = write_usda(
        tmp_path / "a.usda", field({"quatf[] orientations": rotation, "float3[] scales": "[(1,2,3),(1,1,1)]"})
    )
    loaded = load_gaussians(path)
    expected = np.diag([1.0, -1.0, -1.0]) @ matrices_from_quaternions(np.array([[0.6, 0.0, 0.0, 0.8]]))[0]
    np.testing.assert_allclose(matrices_from_quaternions(loaded.rotations_wxyz)[0], expected, atol=1e-6)


def test_usd_sh_coefficients_are_stored_particle_by_particle(tmp_path: Path) -> None:
    """Four coefficients of the first particle are followed by four of the second."""
    sh = {
        "uniform int radiance:sphericalHarmonicsDegree": "1",
        "float3[] radiance:sphericalHarmonicsCoefficients": SH_1,
    }
    two = field(sh) + "\n" + field(sh, name="other")
    scene = expect_kind(ls.Scene, ls.load(write_usda(tmp_path / "a.usda", two)))
    stored = np.arange(8.0)[:, None] + np.array([0.0, 0.25, 0.5])
    np.testing.assert_array_equal(scene.splats[0].gaussians.sh, stored.reshape(2, 4, 3))


def test_half_precision_usd_attributes_are_read_only_if_float_ones_are_missing(tmp_path: Path) -> None:
    """An attribute ending in h replaces a missing float attribute."""
    halves = {
        "point3f[] positions": "",
        "point3h[] positionsh": "[(1, 2, 3), (4, 5, 6)]",
        "half3[] scalesh": "[(9, 9, 9), (9, 9, 9)]",
        "float3[] scales": "[(0.5, 1, 2), (1, 1, 1)]",
        "half[] opacitiesh": "[0.25, 0.5]",
        "quath[] orientationsh": "[(1, 0, 0, 0), (1, 0, 0, 0)]",
        "half3[] radiance:sphericalHarmonicsCoefficientsh": "[(1, 2, 3), (0, 0, 0)]",
        "uniform int radiance:sphericalHarmonicsDegree": "0",
    }
    loaded = load_gaussians(write_usda(tmp_path / "a.usda", field(halves)))
    np.testing.assert_array_equal(loaded.means, [(1, -2, -3), (4, -5, -6)])
    np.testing.assert_array_equal(loaded.scales[0], (0.5, 1.0, 2.0))
    np.testing.assert_array_equal(loaded.opacities, (0.25, 0.5))
    np.testing.assert_allclose(loaded.sh[0, 0], (1.0, 2.0, 3.0), atol=1e-6)


def test_missing_or_short_usd_particle_attributes_get_defaults(tmp_path: Path) -> None:
    """Opacity is 1, rotation none, scale 1, SH grey; longer arrays are truncated."""
    odd = {
        "quatf[] orientations": "[(0, 1, 0, 0)]",
        "float3[] scales": "[(5, 5, 5)]",
        "float3[] radiance:sphericalHarmonicsCoefficients": "[(1, 1, 1)]",
    }
    loaded = load_gaussians(write_usda(tmp_path / "a.usda", field(odd)))
    assert loaded.sh.shape == (2, 1, 3) and not loaded.sh.any()
    np.testing.assert_array_equal(loaded.scales, np.ones((2, 3)))
    np.testing.assert_array_equal(loaded.opacities, (1.0, 1.0))
    np.testing.assert_array_equal(np.abs(loaded.rotations_wxyz), [(0, 1, 0, 0)] * 2)  # converted to y down
    long = {"float[] opacities": "[0.25, 0.5, 0.75]"}
    loaded = load_gaussians(write_usda(tmp_path / "b.usda", field(long)))
    np.testing.assert_array_equal(loaded.opacities, (0.25, 0.5))


def test_usd_log_scales_and_logit_opacities_are_detected(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """If only a few scales are negative, they are mirrored scales and not logarithms."""
    logs = {"float3[] scales": "[(-3, -4, 0.1), (-1, -2, -0.5)]", "float[] opacities": "[2, 2]"}
    loaded = load_gaussians(write_usda(tmp_path / "a.usda", field(logs)))
    np.testing.assert_allclose(loaded.scales, np.exp([(-3, -4, 0.1), (-1, -2, -0.5)]), rtol=1e-6)
    np.testing.assert_allclose(loaded.opacities, 0.880797, rtol=1e-6)
    assert "negative scales, read as logarithms" in caplog.text and "read as logits" in caplog.text
    caplog.clear()
    mirrored = {"float3[] scales": "[(-0.5, 1, 2), (1, 1, 1)]"}
    loaded = load_gaussians(write_usda(tmp_path / "b.usda", field(mirrored)))
    np.testing.assert_array_equal(loaded.scales[0], (0.5, 1.0, 2.0))
    assert "logarithms" not in caplog.text


def test_usd_sh_above_degree_three_are_dropped(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The first 16 of 25 coefficients of degree 4 are read."""
    values = "[" + ", ".join(f"({k}, 0, 0)" for k in range(50)) + "]"
    four = {
        "uniform int radiance:sphericalHarmonicsDegree": "4",
        "float3[] radiance:sphericalHarmonicsCoefficients": values,
    }
    scene = expect_kind(ls.Scene, ls.load(write_usda(tmp_path / "a.usda", field(four) + "\n" + field(name="b"))))
    np.testing.assert_array_equal(scene.splats[0].gaussians.sh[1, :, 0], np.arange(25.0, 41.0))
    assert "SH above degree 3 (/splats)" in caplog.text


def test_error_for_an_unsupported_usd_particle_kernel_names_the_kernel(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Discs of constant opacity are refused; Gaussian surflets become flat Gaussians."""
    kernel = '"ParticleFieldPositionAttributeAPI", "ParticleFieldScaleAttributeAPI", "ParticleFieldKernel{}API"'
    constant = field(kind="ParticleField", schemas=kernel.format("ConstantSurflet"))
    with pytest.raises(FormatError, match="kernel ConstantSurflet, expected GaussianEllipsoid"):
        ls.load(write_usda(tmp_path / "a.usda", constant))
    scales = {"float3[] scales": "[(1, 0.5, 7), (1, 1, 7)]"}
    flat = field(scales, kind="ParticleField", schemas=kernel.format("GaussianSurflet"))
    loaded = load_gaussians(write_usda(tmp_path / "b.usda", flat))
    np.testing.assert_allclose(loaded.scales, [(1, 0.5, 0.0005), (1, 1, 0.001)], rtol=1e-6)
    assert "surflets, read as flat Gaussians (/splats)" in caplog.text


@pytest.mark.parametrize("where", ["field", "attribute"])
def test_sh_coefficients_of_usd_captures_in_linear_colour_are_encoded_as_srgb(tmp_path: Path, where: str) -> None:
    """The prim or the attribute may state the linear colour space: 0.5 becomes 0.735."""
    dc = (0.5 - 0.5) / 0.28209479177387814
    grey = f"[({dc}, {dc}, {dc}), ({dc}, {dc}, {dc})]"
    space = ' ( colorSpace = "lin_rec709_scene" )' if where == "attribute" else ""
    values = {
        "uniform int radiance:sphericalHarmonicsDegree": "0",
        "float3[] radiance:sphericalHarmonicsCoefficients": grey + space,
    }
    own = 'uniform token colorSpace:name = "{}"'
    linear = own.format("lin_rec709_scene") if where == "field" else own.format("srgb_rec709_display")
    found = load_gaussians(write_usda(tmp_path / "a.usda", field(values, schemas='"ColorSpaceAPI"', properties=linear)))
    np.testing.assert_allclose(0.5 + 0.28209479177387814 * found.sh[:, 0], 0.7353569, atol=1e-6)
    values["float3[] radiance:sphericalHarmonicsCoefficients"] = grey
    shown = own.format("srgb_rec709_display")
    unchanged = load_gaussians(
        write_usda(tmp_path / "b.usda", field(values, schemas='"ColorSpaceAPI"', properties=shown))
    )
    np.testing.assert_array_equal(unchanged.sh, 0.0)


def test_foreign_usd_materials_of_captures_are_ignored_silently(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Omniverse binds a material that is no UsdPreviewSurface; the colours are used as captured."""
    material = """def Material "m" {
        token outputs:mdl:surface.connect = </m/s.outputs:out>
        def Shader "s" {
            uniform token info:implementationSource = "sourceAsset"
            uniform asset info:mdl:sourceAsset = @ParticleFieldEmissive.mdl@
            token outputs:out
        }
    }
    """
    own = field(schemas='"MaterialBindingAPI"', properties="rel material:binding = </m>")
    assert load_gaussians(write_usda(tmp_path / "a.usda", material + own)).count == 2
    assert not caplog.text


def test_nukes_usd_type_name_particlefield_3dgaussiansplat_is_recognised(tmp_path: Path) -> None:
    """Nuke 17.0 writes ParticleField_3DGaussianSplat."""
    path = write_usda(tmp_path / "a.usda", field(kind="ParticleField_3DGaussianSplat"))
    assert load_gaussians(path).count == 2


def test_usd_up_axis_and_metres_per_unit_are_applied_and_logged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """(1, 2, 3) cm with z up is (0.01, 0.03, -0.02) m with y up."""
    one = field({"point3f[] positions": "[(1, 2, 3)]"}, count=1)
    path = write_usda(tmp_path / "a.usda", one + "\n" + field(name="b"), f"{Z_UP}\nmetersPerUnit = 0.01")
    scene = expect_kind(ls.Scene, ls.load(path))
    np.testing.assert_allclose(scene.splats[0].world_means, [(0.01, 0.03, -0.02)], atol=1e-9)
    assert scene.up_direction == (0.0, 1.0, 0.0)
    assert "upAxis Z: rotated to y up; metersPerUnit 0.01: scaled to metres" in caplog.text
    alone = load_gaussians(write_usda(tmp_path / "b.usda", one, Z_UP))
    np.testing.assert_allclose(alone.means, [(1.0, -3.0, 2.0)], atol=1e-6)


def test_nested_usd_transforms_rotate_and_stretch_gaussians(tmp_path: Path) -> None:
    """Below a rotated and stretched prim with matrix M, covariances are M Sigma M^T, and SH rotate along."""
    sh = {
        "uniform int radiance:sphericalHarmonicsDegree": "1",
        "float3[] radiance:sphericalHarmonicsCoefficients": SH_1,
    }
    inner = field({**sh, "float3[] scales": "[(1, 2, 3), (1, 1, 1)]"})
    body = f"""def Xform "turned" {{
        double xformOp:rotateZ = 90
        uniform token[] xformOpOrder = ["xformOp:rotateZ"]
        def Xform "stretched" {{
            double3 xformOp:scale = (2, 1, 1)
            uniform token[] xformOpOrder = ["xformOp:scale"]
            {inner}
        }}
    }}
    {field(name="plain")}"""
    scene = expect_kind(ls.Scene, ls.load(write_usda(tmp_path / "a.usda", body)))
    splat = scene.splats[0]
    np.testing.assert_allclose(splat.world_means, [(0, 0, 0), (0, 2, 0)], atol=1e-6)
    gaussians, placed = splat.gaussians, splat.transform[:3, :3]
    axes = (
        placed @ matrices_from_quaternions(gaussians.rotations_wxyz.astype(np.float64)) * gaussians.scales[:, None, :]
    )
    matrix = np.array([(0.0, -1.0, 0.0), (2.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
    np.testing.assert_allclose(
        (axes @ axes.transpose(0, 2, 1))[0], matrix @ np.diag([1.0, 4.0, 9.0]) @ matrix.T, atol=1e-5
    )
    # Basis functions of degree 1 are -y, z, -x; the rotation maps x to y and y to -x.
    coefficients = expect_kind(ls.Scene, ls.load(tmp_path / "a.usda")).splats[0].gaussians.sh[0, :, 0]
    np.testing.assert_allclose(coefficients, (0.0, 3.0, 2.0, -1.0), atol=1e-6)


def test_usd_captures_with_invalid_particles_are_refused_unless_told_to_drop_them(tmp_path: Path) -> None:
    """The error names the option that drops invalid particles."""
    path = write_usda(tmp_path / "a.usda", field({"float3[] scales": "[(1, nan, 1), (1, 1, 1)]"}))
    with pytest.raises(FormatError, match=r"in 1 of 2 Gaussians; --drop-invalid"):
        ls.load(path)
    assert load_gaussians(path, drop_invalid=True).count == 1


def test_hidden_guide_proxy_and_zero_scale_usd_prims_are_skipped(tmp_path: Path) -> None:
    """One particle field of four is visible, of purpose default and of nonzero scale."""
    hidden = field(name="a", properties='token visibility = "invisible"')
    guide = field(name="b", properties='uniform token purpose = "guide"')
    nothing = 'double3 xformOp:scale = (0, 0, 0)\nuniform token[] xformOpOrder = ["xformOp:scale"]'
    path = write_usda(
        tmp_path / "a.usda", "\n".join([hidden, guide, field(name="c", properties=nothing), field(count=3, name="d")])
    )
    assert load_gaussians(path).count == 3


@pytest.mark.parametrize("left", [0, 4000])
def test_usd_package_write_on_a_full_disk_keeps_the_old_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, left: int
) -> None:
    """The library reports success for a package that a full disk truncated."""
    usd_core()
    path = tmp_path / "a.usdz"
    ls.save(path, capture(3))
    before, true = path.read_bytes(), writing.pxr()

    class FullDisk:
        def __init__(self, text: str) -> None:
            self.text, self.writer = text, true.Sdf.ZipFileWriter.CreateNew(text)

        def __getattr__(self, name: str) -> Any:
            return getattr(self.writer, name)

        def Save(self) -> bool:
            saved = self.writer.Save()
            os.truncate(self.text, left)
            return saved

    full = SimpleNamespace(Sdf=SimpleNamespace(ZipFileWriter=SimpleNamespace(CreateNew=FullDisk)))
    monkeypatch.setattr(writing, "pxr", lambda: full)
    with pytest.raises(FormatError, match=r"a\.usdz: cannot be written: is the disk full\?"):
        ls.save(path, capture(40))
    assert path.read_bytes() == before


@pytest.mark.data
@pytest.mark.parametrize("extension", [".usdc", ".usdz"])
def test_usd_round_trip_of_the_downloaded_biker_is_exact_and_logs_nothing(
    tmp_path: Path, data_dir: Path, extension: str, caplog: pytest.LogCaptureFixture
) -> None:
    """The biker's Gaussians and its rendered frames are identical."""
    usd_core()
    saved, path = load_gaussians(data_dir / "splats" / "biker.spz"), tmp_path / f"biker{extension}"
    caplog.set_level(logging.WARNING)
    ls.save(path, saved)
    loaded = load_gaussians(path)
    for name, values in saved.arrays().items():
        np.testing.assert_array_equal(getattr(loaded, name), values, err_msg=name)
    assert not caplog.text
