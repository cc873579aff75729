"""The script of a folder for Blender, which runs in Blender alone."""

SCRIPT = "import_into_blender.py"
SCENE = "scene.glb"

_TEXT = '''"""README: run this in Blender 4.2 or newer, by `blender --python {script}` or in its text editor.

It makes a new scene of {scene} (meshes, lights, cameras), if there is one, and of the captures, which stand where they
belong; other scenes stay as they are. Captures are points with all their values as attributes, which add-ons for
Gaussian splats take, shown as balls of their colours. Written by Lumisplat.
"""

from math import acos, cos
from pathlib import Path

import bpy
import numpy as np

NAME = {name!r}
SCENE = {glb!r}
CAPTURES = {captures!r}
SH_0 = 0.28209479177387814  # the constant harmonic


def main():
    scene = bpy.data.scenes.new(NAME)  # nothing of the start file is in it, nor its grey sky
    bpy.context.window.scene = scene
    scene.render.engine = "CYCLES"
    scene.view_settings.view_transform = "Standard"  # the sRGB curve and nothing else, as here
    if SCENE is not None:
        # Unitless: a lamp of so many candela is as bright as here.
        bpy.ops.import_scene.gltf(filepath=str(folder() / SCENE), export_import_convert_lighting_mode="COMPAT")
    for lamp in (item for item in scene.objects if item.type == "LIGHT"):
        set_lamp(lamp.data)
    for camera in [item for item in scene.objects if item.type == "CAMERA"][:1]:
        scene.camera = camera
        set_picture(scene, camera.data)
    if CAPTURES:
        scene.cycles.transparent_max_bounces = 64  # a ray behind more balls than that would end in black
        nodes = balls(glow())
    for path in CAPTURES:
        bpy.ops.wm.ply_import(filepath=str(folder() / path), forward_axis="Y", up_axis="Z")
        capture = bpy.context.object
        add_looks(capture.data)
        capture.modifiers.new(nodes.name, "NODES").node_group = nodes


def folder():
    script = Path(__file__)
    if not script.is_file():  # a text of the editor, which knows its file
        script = Path(bpy.path.abspath(bpy.data.texts[script.name].filepath))
    return script.parent


def own(data):
    """What Lumisplat says of a lamp or a camera that glTF has no place for."""
    return data.get("lumisplat") or {{}}


def set_lamp(lamp):
    """Its size, for soft shadows, whether it casts any, and the edge of its cone."""
    if lamp.type == "SUN":
        lamp.angle = 2.0 * own(lamp).get("angle", 0.0)  # across, not from the middle
    else:
        lamp.shadow_soft_size = own(lamp).get("radius", 0.0)
        lamp.use_soft_falloff = False  # a ball, not a disc that turns to what it lights
    if lamp.type == "SPOT":
        # Cones fade by the square of how far the cosine is between its bounds, there smoothly on both sides: what goes
        # there from a third of the way on has as much light. Blender's reader takes angles where Cycles has cosines.
        outer, inner = cos(lamp.spot_size / 2.0), cos((1.0 - lamp.spot_blend) * lamp.spot_size / 2.0)
        edge = outer + (inner - outer) / 3.0
        lamp.spot_size, lamp.spot_blend = 2.0 * acos(edge), (inner - edge) / (1.0 - edge)
    lamp.use_shadow = own(lamp).get("casts_shadow", True)


def set_picture(scene, camera):
    """The size and the exposure of a camera's pictures, and its depth of field."""
    scene.render.resolution_x = own(camera).get("width", scene.render.resolution_x)
    scene.render.resolution_y = own(camera).get("height", scene.render.resolution_y)
    scene.render.resolution_percentage = 100
    scene.view_settings.exposure = own(camera).get("exposure", 0.0)
    if (aperture := own(camera).get("aperture", 0.0)) > 0.0:
        camera.dof.use_dof = True
        camera.dof.focus_distance = own(camera).get("focus_distance", 1.0)
        camera.dof.aperture_fstop = camera.lens / 1000.0 / (2.0 * aperture)


def add_looks(mesh):
    """Adds to points their mean colours, linear, with opacities, and radii of balls that cover as much as they do."""

    def column(name):
        values = np.empty(len(mesh.vertices), np.float32)
        mesh.attributes[name].data.foreach_get("value", values)
        return values.astype(np.float64)

    shown = np.clip(0.5 + SH_0 * np.stack([column(f"f_dc_{{i}}") for i in range(3)], axis=1), 0.0, None)
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    opacity = 1.0 / (1.0 + np.exp(-column("opacity")))
    # A splat of sigmas a, b covers as much as a disc of its opacity of radius sqrt(2 a b); a, b: its longest axes.
    sizes = np.sort(np.stack([column(f"scale_{{i}}") for i in range(3)], axis=1), axis=1)
    radius = np.sqrt(2.0 * np.exp(sizes[:, 1] + sizes[:, 2]))
    colors = np.concatenate([linear, opacity[:, None]], axis=1).astype(np.float32)
    mesh.attributes.new("Color", "FLOAT_COLOR", "POINT").data.foreach_set("color", colors.ravel())
    mesh.attributes.new("radius", "FLOAT", "POINT").data.foreach_set("value", radius.astype(np.float32))
    mesh.color_attributes.active_color_name = "Color"


def glow():
    """A material that shines in the colours of the points, as clear as they are: captures, which no lamp lights."""
    material = bpy.data.materials.new("Capture")
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    color, clear, light, mix, output = map(
        tree.nodes.new,
        (
            "ShaderNodeAttribute",
            "ShaderNodeBsdfTransparent",
            "ShaderNodeEmission",
            "ShaderNodeMixShader",
            "ShaderNodeOutputMaterial",
        ),
    )
    color.attribute_name = "Color"
    tree.links.new(color.outputs["Color"], light.inputs["Color"])
    tree.links.new(color.outputs["Alpha"], mix.inputs[0])
    tree.links.new(clear.outputs[0], mix.inputs[1])
    tree.links.new(light.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], output.inputs["Surface"])
    return material


def balls(material):
    """Geometry nodes that show the vertices of a mesh as balls; without them they cannot be rendered."""
    group = bpy.data.node_groups.new("Balls", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        group.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    given, radius, points, painted, shown = map(
        group.nodes.new,
        (
            "NodeGroupInput",
            "GeometryNodeInputNamedAttribute",
            "GeometryNodeMeshToPoints",
            "GeometryNodeSetMaterial",
            "NodeGroupOutput",
        ),
    )
    radius.data_type = "FLOAT"
    radius.inputs["Name"].default_value = "radius"
    painted.inputs["Material"].default_value = material
    group.links.new(given.outputs["Geometry"], points.inputs["Mesh"])
    group.links.new(radius.outputs["Attribute"], points.inputs["Radius"])
    group.links.new(points.outputs["Points"], painted.inputs["Geometry"])
    group.links.new(painted.outputs["Geometry"], shown.inputs["Geometry"])
    return group


if __name__ == "__main__":
    main()
'''


def script_text(name: str, glb: str | None, captures: list[str]) -> str:
    """The script.

    Args:
        name: Of the scene that it makes in Blender.
        glb: The file of meshes, lights and cameras, in the folder of the script; None: there is none.
        captures: The files of captures, there, too.
    """
    return _TEXT.format(script=SCRIPT, scene=SCENE, name=name, glb=glb, captures=captures)
