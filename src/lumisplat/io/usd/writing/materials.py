"""Materials as networks of UsdPreviewSurface."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from lumisplat.io.usd.library import pxr
from lumisplat.io.usd.writing.stage import StageWriter
from lumisplat.scene.materials import AlphaMode, Material, MaterialPbr, MaterialSimple, wraps_of
from lumisplat.scene.textures import TextureWrap

_WRAPS = {TextureWrap.REPEAT: "repeat", TextureWrap.MIRROR: "mirror", TextureWrap.CLAMP: "clamp"}
_LOST = {
    "specular": ("the strength of reflections (specular)", 1.0),
    "thin_walled": ("thin walls", False),
    "attenuation_distance": ("media inside of meshes", math.inf),
    "sheen_color": ("sheen", (0.0, 0.0, 0.0)),
    "transmission_texture": ("textures of transmission", None),
    "priority": ("priorities of media", 0),
}
"""Fields of a material that have no place, what a remark calls them, and the value at which nothing is lost."""

_Key = tuple[int, bool]


@dataclass(slots=True)
class MaterialWriter:
    """Writes materials, each once."""

    writer: StageWriter
    _known: dict[_Key, tuple[Material, Any]] = field(default_factory=dict[_Key, "tuple[Material, Any]"])

    def bind(self, prim: Any, material: Material, has_colors: bool = False) -> None:
        """Binds a material to a prim.

        Args:
            prim: A mesh or a particle field.
            material: Its material.
            has_colors: Whether the mesh has colours of vertices (the primvar displayColor), by which to multiply.
        """
        key = id(material), has_colors
        if key not in self._known:
            self._known[key] = material, _Network(self.writer, material, has_colors).material
        px = pxr()
        px.UsdShade.MaterialBindingAPI.Apply(prim).Bind(self._known[key][1])


class _Network:
    """The shaders of one material."""

    def __init__(self, writer: StageWriter, material: Material, has_colors: bool) -> None:
        px = pxr()
        self._writer, self._material = writer, material
        self._name = material.name or "material"
        path = writer.path_of(self._name, writer.materials)
        self.material = px.UsdShade.Material.Define(writer.stage, path)
        writer.name(self.material.GetPrim(), material.name)
        self._path = path
        self._surface = self._node("Surface", "UsdPreviewSurface")
        self.material.CreateSurfaceOutput().ConnectToSource(self._surface.ConnectableAPI(), "surface")
        if isinstance(material, MaterialPbr):
            self._write_pbr(material, has_colors)
        else:
            self._write_simple(material, has_colors)

    def _node(self, name: str, kind: str) -> Any:
        px = pxr()
        shader = px.UsdShade.Shader.Define(self._writer.stage, f"{self._path}/{name}")
        shader.CreateIdAttr(kind)
        return shader

    def _set(self, shader: Any, name: str, kind: str, value: Any) -> Any:
        made = shader.CreateInput(name, getattr(pxr().Sdf.ValueTypeNames, kind))
        made.Set(value)
        return made

    def _connect(self, name: str, kind: str, source: Any, output: str, output_kind: str) -> None:
        """Feeds an input of the surface by an output of another node."""
        types = pxr().Sdf.ValueTypeNames
        made = source.CreateOutput(output, getattr(types, output_kind))
        self._surface.CreateInput(name, getattr(types, kind)).ConnectToSource(made)

    def _write_pbr(self, material: MaterialPbr, has_colors: bool) -> None:
        for name, (remark, nothing) in _LOST.items():
            held = getattr(material, name)
            if held is not nothing and held != nothing:
                self._writer.remarks.add(remark, self._name)
        self._write_color(material, material.base_color, has_colors)
        self._write_plane(
            "metallic_roughness",
            "roughness",
            material.roughness,
            "g",
            (1.0, material.roughness, material.metallic, 1.0),
        )
        self._write_plane(
            "metallic_roughness", "metallic", material.metallic, "b", (1.0, material.roughness, material.metallic, 1.0)
        )
        self._set(self._surface, "ior", "Float", material.ior)
        self._write_plane("clearcoat", "clearcoat", material.clearcoat, "r", (material.clearcoat,) * 3 + (1.0,))
        rough = material.clearcoat_roughness
        self._write_plane("clearcoat_roughness", "clearcoatRoughness", rough, "g", (rough,) * 3 + (1.0,))
        emissive = self._texture("emissive", (*material.emissive, 1.0), color=True)
        if emissive is None:
            self._set(self._surface, "emissiveColor", "Color3f", pxr().Gf.Vec3f(*material.emissive))
        else:
            self._connect("emissiveColor", "Color3f", emissive, "rgb", "Float3")
        scale = material.normal_scale
        normal = self._texture("normal", (2 * scale, 2 * scale, 2.0, 1.0), (-scale, -scale, -1.0, 0.0))
        if normal is not None:
            self._connect("normal", "Normal3f", normal, "rgb", "Float3")
        strength = material.occlusion_strength
        occlusion = self._texture("occlusion", (strength,) * 3 + (1.0,), (1.0 - strength,) * 3 + (0.0,))
        if occlusion is not None:
            self._connect("occlusion", "Float", occlusion, "r", "Float")
        self._write_opacity(material)

    def _write_simple(self, material: MaterialSimple, has_colors: bool) -> None:
        """A `MaterialSimple` as what comes near to it: its diffuse part, and what it emits."""
        self._writer.remarks.add("simple materials, of which a diffuse and an emitting part stay", self._name)
        color = material.base_color
        diffuse = tuple(d * c for d, c in zip(material.diffuse, color, strict=True))
        self._write_color(material, diffuse, has_colors)
        emitted = [(e + a) * c for e, a, c in zip(material.emissive, material.ambient, color, strict=True)]
        texture = self._texture("base_color", (*emitted, 1.0), color=True, name="emissive") if any(emitted) else None
        if texture is None:
            self._set(self._surface, "emissiveColor", "Color3f", pxr().Gf.Vec3f(*emitted))
        else:
            self._connect("emissiveColor", "Color3f", texture, "rgb", "Float3")
        self._set(self._surface, "roughness", "Float", 1.0)
        self._write_opacity(material)

    def _write_color(self, material: Material, color: tuple[float, ...], has_colors: bool) -> None:
        texture = self._texture("base_color", (*color, material.alpha), color=True)
        if texture is not None:
            self._connect("diffuseColor", "Color3f", texture, "rgb", "Float3")
            if has_colors:
                self._writer.remarks.add("colours of vertices beside a texture", self._name)
        elif has_colors:
            reader = self._node("VertexColors", "UsdPrimvarReader_float3")
            self._set(reader, "varname", "String", "displayColor")
            self._connect("diffuseColor", "Color3f", reader, "result", "Float3")
        else:
            self._set(self._surface, "diffuseColor", "Color3f", pxr().Gf.Vec3f(*color))

    def _write_opacity(self, material: Material) -> None:
        """Alpha; or, of what transmits, glass."""
        transmission = material.transmission if isinstance(material, MaterialPbr) else 0.0
        if material.alpha_mode is AlphaMode.OPAQUE:
            if transmission > 0.0:
                self._set(self._surface, "opacity", "Float", 1.0 - transmission)
                self._set(self._surface, "opacityMode", "Token", "transparent")
            return
        if transmission > 0.0:
            self._writer.remarks.add("transmission beside alpha", self._name)
        if material.base_color_texture is not None and material.base_color_texture.shape[2] == 4:
            source = pxr().UsdShade.Shader.Get(self._writer.stage, f"{self._path}/base_color")
            self._connect("opacity", "Float", source, "a", "Float")
        else:
            self._set(self._surface, "opacity", "Float", material.alpha)
        if material.alpha_mode is AlphaMode.MASK:
            self._set(self._surface, "opacityThreshold", "Float", max(material.alpha_cutoff, 1e-6))
        else:
            self._set(self._surface, "opacityMode", "Token", "presence")

    def _write_plane(self, texture: str, name: str, factor: float, channel: str, scale: tuple[float, ...]) -> None:
        """An input that is a number, or a channel of a texture times it."""
        source = self._texture(texture, scale)
        if source is None:
            self._set(self._surface, name, "Float", factor)
        else:
            self._connect(name, "Float", source, channel, "Float")

    def _texture(
        self,
        field_name: str,
        scale: tuple[float, ...],
        bias: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0),
        *,
        color: bool = False,
        name: str | None = None,
    ) -> Any:
        """The node of a texture, ``texel * scale + bias``; None if the material does not have it."""
        px, material = pxr(), self._material
        texels = getattr(material, f"{field_name}_texture", None)
        if texels is None:
            return None
        name = name or field_name
        known = px.UsdShade.Shader.Get(self._writer.stage, f"{self._path}/{name}")
        if known:
            return known
        node = self._node(name, "UsdUVTexture")
        path = self._writer.texture(texels, f"{self._name}_{field_name}")
        self._set(node, "file", "Asset", px.Sdf.AssetPath(path))
        self._set(node, "sourceColorSpace", "Token", "sRGB" if color else "raw")
        self._set(node, "scale", "Float4", px.Gf.Vec4f(*scale))
        if any(bias):
            self._set(node, "bias", "Float4", px.Gf.Vec4f(*bias))
        for key, wrap in zip(("wrapS", "wrapT"), wraps_of(material, f"{field_name}_texture"), strict=True):
            self._set(node, key, "Token", _WRAPS[wrap])
        coordinates = self._coordinates().CreateOutput("result", px.Sdf.ValueTypeNames.Float2)
        node.CreateInput("st", px.Sdf.ValueTypeNames.Float2).ConnectToSource(coordinates)
        return node

    def _coordinates(self) -> Any:
        known = pxr().UsdShade.Shader.Get(self._writer.stage, f"{self._path}/st")
        if known:
            return known
        reader = self._node("st", "UsdPrimvarReader_float2")
        self._set(reader, "varname", "String", "st")
        return reader
