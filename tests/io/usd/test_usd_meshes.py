"""OpenUSD meshes, materials and instances, written as text."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import lumisplat as ls
from lumisplat.errors import FormatError
from support.files.usd_files import usd_core, write_usda
from support.kinds import expect_kind

QUAD = """point3f[] points = [(0,0,0), (1,0,0), (1,1,0), (0,1,0)]
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    uniform token subdivisionScheme = "none"
"""


def load_scene(path: Path, body: str, head: str = 'upAxis = "Y"') -> ls.Scene:
    """Returns the scene of a layer with the given content."""
    return expect_kind(ls.Scene, ls.load(write_usda(path / "a.usda", body, head)))


def mesh(extra: str = "", geometry: str = QUAD, name: str = "quad", applied: str = "") -> str:
    """Returns a mesh as text."""
    return f'def Mesh "{name}" {applied} {{\n{geometry}\n{extra}\n}}\n'


def bound(name: str = "mat") -> tuple[str, str]:
    """Returns, as text, the schema that allows material bindings, and a binding to the material ``name``."""
    return '( prepend apiSchemas = ["MaterialBindingAPI"] )', f"rel material:binding = </{name}>"


def material(inputs: str, nodes: str = "", name: str = "mat") -> str:
    """Returns a UsdPreviewSurface material as text."""
    return f"""def Material "{name}" {{
        token outputs:surface.connect = </{name}/s.outputs:surface>
        def Shader "s" {{
            uniform token info:id = "UsdPreviewSurface"
            token outputs:surface
            {inputs}
        }}
        {nodes}
    }}
    """


def texture(name: str, outputs: str, extra: str = "", file: str = "t.png", owner: str = "mat") -> str:
    """Returns a texture node that reads the primvar st, as text."""
    return f"""def Shader "{name}" {{
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @{file}@
            float2 inputs:st.connect = </{owner}/r.outputs:result>
            {outputs}
            {extra}
        }}
        """


READER = """def Shader "r" {
            uniform token info:id = "UsdPrimvarReader_float2"
            string inputs:varname = "st"
            float2 outputs:result
        }
        """
ST = """texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)] ( interpolation = "vertex" )"""


def quad_material(path: Path, inputs: str, nodes: str = "", extra: str = "") -> ls.MaterialPbr:
    """Writes a quad with a material of these inputs, and returns the loaded material."""
    applied, binding = bound()
    scene = load_scene(path, mesh(f"{extra}\n{binding}", applied=applied) + material(inputs, nodes))
    return expect_kind(ls.MaterialPbr, scene.meshes[0].mesh.material)


def test_usd_polygons_become_triangle_fans(tmp_path: Path) -> None:
    """A quad becomes two counter-clockwise triangles; without a material it is grey, without normals flat."""
    quad = load_scene(tmp_path, mesh()).meshes[0].mesh
    np.testing.assert_array_equal(quad.indices, [(0, 1, 2), (0, 2, 3)])
    assert quad.normals is None
    assert quad.material.base_color == (0.18, 0.18, 0.18)


def test_faces_of_left_handed_usd_meshes_are_reversed(tmp_path: Path) -> None:
    """A clockwise face gets the opposite normal."""
    quad = load_scene(tmp_path, mesh('uniform token orientation = "leftHanded"')).meshes[0].mesh
    corners = quad.positions[quad.indices[0]]
    assert np.cross(corners[1] - corners[0], corners[2] - corners[0])[2] < 0.0


def test_face_varying_usd_primvars_split_vertices(tmp_path: Path) -> None:
    """Two triangles with different coordinates at shared vertices have six vertices; equal corners stay merged."""
    two = """point3f[] points = [(0,0,0), (1,0,0), (1,1,0), (0,1,0)]
    int[] faceVertexCounts = [3, 3]
    int[] faceVertexIndices = [0, 1, 2, 0, 2, 3]
    uniform token subdivisionScheme = "none"
    texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0.5, 0), (1, 1), (0, 0.25)] ( interpolation = "faceVarying" )
    normal3f[] normals = [(0, 0, 1), (0, 1, 0)] ( interpolation = "uniform" )
    """
    applied, binding = bound()
    body = mesh(binding, two, applied=applied) + material("color3f inputs:diffuseColor = (1, 0, 0)")
    split = load_scene(tmp_path, body).meshes[0].mesh
    assert split.vertex_count == 6 and split.uvs is not None and split.normals is not None
    corners = split.indices.reshape(-1)
    np.testing.assert_array_equal(split.uvs[corners], [(0, 1), (1, 1), (1, 0), (0.5, 1), (1, 0), (0, 0.75)])
    np.testing.assert_array_equal(split.normals[corners], [(0, 0, 1)] * 3 + [(0, 1, 0)] * 3)
    np.testing.assert_array_equal(
        split.positions[corners], [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 0, 0), (1, 1, 0), (0, 1, 0)]
    )


def test_indexed_usd_primvars_are_resolved(tmp_path: Path) -> None:
    """Vertex colours are the base colour of a mesh without a material."""
    colors = """color3f[] primvars:displayColor = [(1, 0, 0), (0, 1, 0)] ( interpolation = "vertex" )
    int[] primvars:displayColor:indices = [0, 1, 1, 0]"""
    quad = load_scene(tmp_path, mesh(colors)).meshes[0].mesh
    np.testing.assert_array_equal(quad.colors, [(1, 0, 0), (0, 1, 0), (0, 1, 0), (1, 0, 0)])
    assert quad.material.base_color == (1.0, 1.0, 1.0)


def test_usd_subdivision_surfaces_get_smooth_normals(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Subdivision is the default; the control mesh is used, with a remark."""
    quad = load_scene(tmp_path, mesh(geometry=QUAD.replace('"none"', '"catmullClark"'))).meshes[0].mesh
    assert quad.normals is not None
    np.testing.assert_allclose(quad.normals, [(0, 0, 1)] * 4, atol=1e-6)
    assert "subdivision surfaces, read as their control meshes (/quad)" in caplog.text


def test_usd_geometry_subsets_become_separate_meshes(tmp_path: Path) -> None:
    """Faces outside subsets have the mesh's material; each mesh has only the vertices that it uses."""
    two = """point3f[] points = [(0,0,0), (1,0,0), (1,1,0), (0,1,0)]
    int[] faceVertexCounts = [3, 3]
    int[] faceVertexIndices = [0, 1, 2, 0, 2, 3]
    uniform token subdivisionScheme = "none"
    """
    subset = """uniform token subsetFamily:materialBind:familyType = "nonOverlapping"
    def GeomSubset "part" ( prepend apiSchemas = ["MaterialBindingAPI"] ) {
        uniform token elementType = "face"
        uniform token familyName = "materialBind"
        int[] indices = [1]
        rel material:binding = </red>
    }"""
    applied, binding = bound()
    body = mesh(f"{binding}\n{subset}", two, applied=applied) + material("color3f inputs:diffuseColor = (0, 1, 0)")
    scene = load_scene(tmp_path, body + material("color3f inputs:diffuseColor = (1, 0, 0)", name="red"))
    colors = {m.mesh.material.base_color: m.mesh for m in scene.meshes}
    assert set(colors) == {(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)}
    np.testing.assert_array_equal(colors[1.0, 0.0, 0.0].positions, [(0, 0, 0), (1, 1, 0), (0, 1, 0)])
    np.testing.assert_array_equal(colors[0.0, 1.0, 0.0].positions, [(0, 0, 0), (1, 0, 0), (1, 1, 0)])


def test_constants_of_usd_preview_surfaces_are_read(tmp_path: Path) -> None:
    """Inputs without textures become material fields."""
    found = quad_material(
        tmp_path,
        """color3f inputs:diffuseColor = (0.1, 0.2, 0.3)
        color3f inputs:emissiveColor = (4, 5, 6)
        float inputs:metallic = 0.25
        float inputs:roughness = 0.75
        float inputs:clearcoat = 0.5
        float inputs:clearcoatRoughness = 0.125
        float inputs:ior = 1.25""",
    )
    assert (found.base_color, found.emissive) == ((0.1, 0.2, 0.3), (4.0, 5.0, 6.0))
    assert (found.metallic, found.roughness, found.ior) == (0.25, 0.75, 1.25)
    assert (found.clearcoat, found.clearcoat_roughness) == (0.5, 0.125)


@pytest.mark.parametrize(("stored", "expected"), [("", False), ("uniform bool doubleSided = 1", True)])
def test_usd_material_is_double_sided_only_if_its_mesh_is(tmp_path: Path, stored: str, expected: bool) -> None:
    """The default of doubleSided is one side."""
    applied, binding = bound()
    body = mesh(f"{binding}\n{stored}", applied=applied) + material("color3f inputs:emissiveColor = (4, 5, 6)")
    found = expect_kind(ls.MaterialPbr, load_scene(tmp_path, body).meshes[0].mesh.material)
    assert found.double_sided is expected


@pytest.mark.parametrize(
    ("inputs", "mode", "alpha", "transmission"),
    [
        ("float inputs:opacity = 0.25\nfloat inputs:roughness = 0", ls.AlphaMode.OPAQUE, 1.0, 0.75),
        ("float inputs:opacity = 0.25\nfloat inputs:roughness = 0.5", ls.AlphaMode.BLEND, 0.25, 0.0),
        ('float inputs:opacity = 0.25\ntoken inputs:opacityMode = "transparent"', ls.AlphaMode.OPAQUE, 1.0, 0.75),
        ('float inputs:opacity = 0.25\ntoken inputs:opacityMode = "presence"', ls.AlphaMode.BLEND, 0.25, 0.0),
        ("float inputs:opacity = 0.25\nfloat inputs:opacityThreshold = 0.5", ls.AlphaMode.MASK, 0.25, 0.0),
    ],
)
def test_usd_opacity_becomes_transmission_alpha_or_mask(
    tmp_path: Path, inputs: str, mode: ls.AlphaMode, alpha: float, transmission: float
) -> None:
    """Smooth or explicitly transparent surfaces transmit; other opacity is alpha, or a mask with a threshold."""
    found = quad_material(tmp_path, inputs)
    assert (found.alpha_mode, found.alpha, found.transmission) == (mode, alpha, transmission)


def test_textures_of_usd_preview_surfaces_are_read(tmp_path: Path) -> None:
    """Scales become factors, channels are rearranged, v is flipped, and alpha stays."""
    usd_core()
    texels = np.random.default_rng(1).integers(0, 256, (4, 4, 4), dtype=np.uint8)
    Image.fromarray(texels).save(tmp_path / "t.png")
    nodes = READER + texture("c", "float3 outputs:rgb\nfloat outputs:a", "float4 inputs:scale = (0.5, 0.25, 1, 0.5)")
    nodes += texture(
        "m", "float outputs:r\nfloat outputs:b", 'token inputs:wrapS = "mirror"\ntoken inputs:wrapT = "clamp"'
    )
    nodes += texture(
        "n", "float3 outputs:rgb", "float4 inputs:scale = (2, 2, 2, 1)\nfloat4 inputs:bias = (-1, -1, -1, 0)"
    )
    found = quad_material(
        tmp_path,
        """color3f inputs:diffuseColor.connect = </mat/c.outputs:rgb>
        float inputs:opacity.connect = </mat/c.outputs:a>
        float inputs:opacityThreshold = 0.5
        float inputs:roughness.connect = </mat/m.outputs:r>
        float inputs:metallic.connect = </mat/m.outputs:b>
        normal3f inputs:normal.connect = </mat/n.outputs:rgb>""",
        nodes,
        ST,
    )
    assert found.base_color == (0.5, 0.25, 1.0) and found.alpha == 0.5
    np.testing.assert_array_equal(found.base_color_texture, texels)
    both = found.metallic_roughness_texture
    assert both is not None and (found.roughness, found.metallic) == (1.0, 1.0)
    np.testing.assert_array_equal(both[:, :, 1], texels[:, :, 0])
    np.testing.assert_array_equal(both[:, :, 2], texels[:, :, 2])
    np.testing.assert_array_equal(found.normal_texture, texels[:, :, :3])
    assert found.normal_scale == 1.0 and found.wrap_u is ls.TextureWrap.REPEAT
    wraps = found.texture_wraps or {}
    assert wraps["metallic_roughness_texture"] == (ls.TextureWrap.MIRROR, ls.TextureWrap.CLAMP)


def test_usd_texture_transform_scales_rotates_then_translates(tmp_path: Path) -> None:
    """(1, 0) doubled and rotated by 90 degrees is (0, 2), translated (0.5, 2)."""
    usd_core()
    Image.new("RGB", (4, 4)).save(tmp_path / "t.png")
    nodes = """def Shader "r" {
            uniform token info:id = "UsdTransform2d"
            float2 inputs:in.connect = </mat/p.outputs:result>
            float2 inputs:scale = (2, 2)
            float inputs:rotation = 90
            float2 inputs:translation = (0.5, 0)
            float2 outputs:result
        }
        """ + READER.replace('"r"', '"p"')
    applied, binding = bound()
    inputs = "color3f inputs:diffuseColor.connect = </mat/c.outputs:rgb>"
    body = mesh(f"{ST}\n{binding}", applied=applied) + material(inputs, nodes + texture("c", "float3 outputs:rgb"))
    found = load_scene(tmp_path, body).meshes[0].mesh
    assert found.uvs is not None
    np.testing.assert_allclose(found.uvs[1], (0.5, 1.0 - 2.0), atol=1e-6)


def test_usd_vertex_colours_are_used_only_if_a_shader_reads_them(tmp_path: Path) -> None:
    """Only a shader that reads displayColor uses the mesh's colours."""
    colors = """color3f[] primvars:displayColor = [(1, 0, 0)] ( interpolation = "constant" )"""
    reader = """def Shader "v" {
            uniform token info:id = "UsdPrimvarReader_float3"
            string inputs:varname = "displayColor"
            float3 outputs:result
        }"""
    applied, binding = bound()
    connected = material("color3f inputs:diffuseColor.connect = </mat/v.outputs:result>", reader)
    read = load_scene(tmp_path, mesh(f"{colors}\n{binding}", applied=applied) + connected).meshes[0].mesh
    np.testing.assert_array_equal(read.colors, [(1, 0, 0)] * 4)
    assert read.material.base_color == (1.0, 1.0, 1.0)
    plain = material("color3f inputs:diffuseColor = (0, 0, 1)")
    unread = load_scene(tmp_path, mesh(f"{colors}\n{binding}", applied=applied) + plain).meshes[0].mesh
    assert unread.colors is None


def test_usd_instances_of_one_prototype_share_one_mesh(tmp_path: Path) -> None:
    """Two instances refer to one prim, one instance below the other: one mesh has two transforms and names."""
    body = (
        'class "P" {\n def Xform "tree" {\n' + mesh() + "}\n}\n"
        """def Xform "one" ( instanceable = true\n references = </P/tree> ) {
            double3 xformOp:translate = (1, 2, 3)
            uniform token[] xformOpOrder = ["xformOp:translate"]
        }
        def Xform "two" ( instanceable = true\n references = </P/tree> ) {\n}"""
    )
    scene = load_scene(tmp_path, body)
    one, two = scene.meshes
    assert (one.name, two.name) == ("one", "two") and one.mesh is two.mesh
    np.testing.assert_array_equal(one.transform[:3, 3], (1, 2, 3))


def test_usd_point_instances_are_scaled_rotated_then_translated(tmp_path: Path) -> None:
    """Hidden instances are skipped. The location of prototypes in the file does not matter."""
    body = f"""def PointInstancer "many" {{
        int[] protoIndices = [0, 0, 1, 0]
        point3f[] positions = [(10, 0, 0), (0, 10, 0), (0, 0, 10), (5, 5, 5)]
        quath[] orientations = [(1, 0, 0, 0), (0.70710678, 0, 0, 0.70710678), (1, 0, 0, 0), (1, 0, 0, 0)]
        float3[] scales = [(1, 1, 1), (2, 2, 2), (1, 1, 1), (1, 1, 1)]
        int64[] invisibleIds = [3]
        rel prototypes = [</many/p/a>, </many/p/b>]
        def Xform "p" {{
            double3 xformOp:translate = (100, 0, 0)
            uniform token[] xformOpOrder = ["xformOp:translate"]
            def Xform "a" {{
                double3 xformOp:translate = (1, 0, 0)
                uniform token[] xformOpOrder = ["xformOp:translate"]
                {mesh()}
            }}
            {mesh(name="b")}
        }}
    }}"""
    scene = load_scene(tmp_path, body)
    assert len(scene.meshes) == 3
    moved = [m.transform @ (0, 0, 0, 1) for m in scene.meshes]
    np.testing.assert_allclose([one[:3] for one in moved], [(11, 0, 0), (0, 12, 0), (0, 0, 10)], atol=2e-3)
    np.testing.assert_allclose(
        scene.meshes[1].transform[:3, :3] @ (1, 0, 0), (0, 2, 0), atol=2e-3
    )  # orientations are half floats


def test_usd_cubes_spheres_and_planes_have_the_stated_sizes(tmp_path: Path) -> None:
    """A plane also has its axis, and a cone is skipped."""
    body = """def Cube "c" {\n double size = 3\n }
    def Sphere "s" {\n double radius = 2\n }
    def Plane "p" {\n double width = 4\n double length = 6\n uniform token axis = "X"\n }
    def Cone "no" {\n }"""
    scene = load_scene(tmp_path, body)
    extents = {m.name: np.subtract(*m.bounds()[::-1]) for m in scene.meshes}
    np.testing.assert_allclose(extents["c"], (3, 3, 3), atol=1e-5)
    np.testing.assert_allclose(extents["s"], (4, 4, 4), atol=0.1)
    np.testing.assert_allclose(extents["p"], (0, 6, 4), atol=1e-5)
    plane = next(m.mesh for m in scene.meshes if m.name == "p")
    assert plane.normals is not None
    np.testing.assert_allclose(plane.normals, [(1, 0, 0)] * 4, atol=1e-6)
    corners = plane.positions[plane.indices[0]]
    assert np.cross(corners[1] - corners[0], corners[2] - corners[0])[0] > 0.0


@pytest.mark.parametrize(
    ("geometry", "message"),
    [
        (QUAD.replace("[4]", "[5]"), "has 4 faceVertexIndices, expected 5"),
        (QUAD.replace("0, 1, 2, 3", "0, 1, 2, 9"), None),
        (QUAD.replace("0, 1, 2, 3", "0, 0, 0, 0"), "no usable triangles: 2 without area"),
        (f'{QUAD}\nnormal3f[] normals = [(0, 0, 1)] ( interpolation = "vertex" )', "1 values, expected 4"),
        (
            QUAD.replace("int[] faceVertexCounts = [4]", "int[] faceVertexCounts = [-4]"),
            "has 4 faceVertexIndices, expected -4",
        ),
    ],
)
def test_invalid_usd_meshes_are_refused_and_triangles_with_missing_vertices_dropped(
    tmp_path: Path, geometry: str, message: str | None
) -> None:
    """Errors are one line; a triangle with a missing vertex is dropped and counted."""
    path = write_usda(tmp_path / "a.usda", mesh(geometry=geometry))
    if message is None:
        assert expect_kind(ls.Scene, ls.load(path)).face_count == 1
        return
    with pytest.raises(FormatError, match=message):
        ls.load(path)


def test_missing_usd_texture_and_its_stage_are_named_by_the_error(tmp_path: Path) -> None:
    """The message names the texture file and the stage that needs it."""
    nodes = READER + texture("c", "float3 outputs:rgb", file="gone.png")
    with pytest.raises(FormatError, match=r"gone\.png: no such file \(needed by .*a\.usda\)"):
        quad_material(tmp_path, "color3f inputs:diffuseColor.connect = </mat/c.outputs:rgb>", nodes, ST)
