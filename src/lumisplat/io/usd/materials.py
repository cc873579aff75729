"""Reads UsdPreviewSurface networks as `MaterialPbr`, and writes materials as UsdPreviewSurface networks.

A shader input is a constant, a primvar, or a texture with a UV transform.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.files.source import TextureBytes
from lumisplat.io.images.texture import decode_texture
from lumisplat.io.usd.library import pxr
from lumisplat.io.usd.stage import StageWriter, UsdFile, asset_bytes, asset_name, prim_name, shortest, value
from lumisplat.math.arrays import Doubles, FloatArray, finite_numbers
from lumisplat.math.color import encode_srgb
from lumisplat.scene.materials import (
    AlphaMode,
    Material,
    MaterialPbr,
    MaterialSimple,
    Texture,
    TextureWrap,
    WrapPair,
    wraps_of,
)

_WRAP_MODES = {"repeat": TextureWrap.REPEAT, "mirror": TextureWrap.MIRROR, "clamp": TextureWrap.CLAMP}
"""Supported wrap modes of UsdUVTexture. ``black`` and ``useMetadata`` are read as repeat: image files state no wrap
mode.
"""
_CHANNELS = {"r": 0, "g": 1, "b": 2, "a": 3}


class UvTransform(NamedTuple):
    """Texture coordinates that a texture uses: a primvar of the mesh, scaled, then rotated, then translated.

    The origin (0, 0) is the bottom left of the image.
    """

    primvar: str = "st"
    scale: tuple[float, float] = (1.0, 1.0)
    rotation: float = 0.0
    """Counter-clockwise angle in radians."""
    translation: tuple[float, float] = (0.0, 0.0)

    def apply(self, uvs: FloatArray) -> FloatArray:
        """Returns the texture coordinates of V vertices, scaled, rotated and translated, shape (V, 2); v points up."""
        if self == UvTransform(self.primvar):
            return uvs
        cos, sin = np.cos(self.rotation), np.sin(self.rotation)
        rotation = np.array([[cos, -sin], [sin, cos]])
        return ((uvs * self.scale) @ rotation.T + self.translation).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class _TextureInput:
    """A texture connected to a shader input. The input's value is ``texel * scale + bias``, in four channels."""

    asset: Any
    channel: int | None
    """Texture channel that the shader input takes, 0 to 3 for r, g, b, a; None takes red, green and blue."""
    uv_transform: UvTransform
    wraps: WrapPair
    scale: Doubles
    bias: Doubles
    color_space: str
    label: str


@dataclass(frozen=True, slots=True)
class _ShaderInput:
    """Where the value of a shader input comes from: a constant, a texture, or a mesh primvar, given by name."""

    value: Any = None
    texture: _TextureInput | None = None
    primvar: str = ""


class _PreviewSurface:
    """Inputs of a material's UsdPreviewSurface shader.

    Args:
        file: The open file.
        shader: The shader.
    """

    def __init__(self, file: UsdFile, shader: Any) -> None:
        self._file, self._shader = file, shader

    def read(self, name: str) -> _ShaderInput:
        """Returns a shader input. Its value is None if the file gives neither a value nor a supported connection."""
        return _read_input(self._file, self._shader.GetInput(name))

    def number(self, name: str, default: float, low: float = 0.0, high: float = 1.0) -> float:
        """Returns the constant of an input, clipped to ``low``..``high``; ``default`` if the input has no constant."""
        found = self.read(name).value
        numbers = finite_numbers(found, ())
        return default if numbers is None else float(np.clip(shortest(float(numbers)), low, high))

    def color(self, name: str, default: tuple[float, float, float]) -> tuple[float, float, float]:
        """Returns the constant colour of an input, at least 0; ``default`` if the input has no constant."""
        numbers = finite_numbers(self.read(name).value, (3,))
        if numbers is None:
            return default
        red, green, blue = (max(shortest(float(one)), 0.0) for one in numbers)
        return red, green, blue


def _surface_of(file: UsdFile, material: Any, remark: bool) -> _PreviewSurface | None:
    """Returns the UsdPreviewSurface shader of a material; None if the material has another surface shader, or none.

    Args:
        file: The open file.
        material: The material prim.
        remark: Whether to log a material without a UsdPreviewSurface.
    """
    shader = material.ComputeSurfaceSource()[0]
    if not shader or shader.GetIdAttr().Get() != "UsdPreviewSurface":
        if remark:
            file.remarks.add("materials without a UsdPreviewSurface", str(material.GetPath()))
        return None
    return _PreviewSurface(file, shader)


def _read_input(file: UsdFile, given: Any) -> _ShaderInput:
    """Returns the source of a shader input: its constant, or the UsdUVTexture or primvar reader connected to it."""
    px = pxr()
    if not given:
        return _ShaderInput()
    sources = given.GetValueProducingAttributes()
    if not sources:
        return _ShaderInput(given.Get(file.time))
    source = sources[0]
    if px.UsdShade.Utils.GetType(source.GetName()) != px.UsdShade.AttributeType.Output:
        return _ShaderInput(source.Get(file.time))
    shader = px.UsdShade.Shader(source.GetPrim())
    kind, output = str(shader.GetIdAttr().Get()), px.UsdShade.Output(source).GetBaseName()
    if kind == "UsdUVTexture":
        return _ShaderInput(texture=_read_texture(file, shader, str(output)))
    if kind.startswith("UsdPrimvarReader"):
        return _ShaderInput(primvar=str(_read_input(file, shader.GetInput("varname")).value or ""))
    file.remarks.add(f"shader nodes of type {kind}", str(shader.GetPath()))
    return _ShaderInput()


def _read_texture(file: UsdFile, shader: Any, output: str) -> _TextureInput | None:
    """Reads a UsdUVTexture node. Logs and returns None for a node without a file or with UDIM tiles."""
    asset = _read_input(file, shader.GetInput("file")).value
    name = str(getattr(asset, "path", asset or ""))
    if not name or "<UDIM>" in name:
        file.remarks.add("textures without a file, or with UDIM tiles", str(shader.GetPath()))
        return None

    def four(key: str, default: float) -> Doubles:
        numbers = finite_numbers(_read_input(file, shader.GetInput(key)).value, (4,))
        return np.full(4, default) if numbers is None else np.array([shortest(float(one)) for one in numbers])

    def wrap(key: str) -> TextureWrap:
        return _WRAP_MODES.get(str(_read_input(file, shader.GetInput(key)).value), TextureWrap.REPEAT)

    return _TextureInput(
        asset=asset,
        channel=_CHANNELS.get(output),
        uv_transform=_read_uv_transform(file, shader.GetInput("st")),
        wraps=(wrap("wrapS"), wrap("wrapT")),
        scale=four("scale", 1.0),
        bias=four("bias", 0.0),
        color_space=str(_read_input(file, shader.GetInput("sourceColorSpace")).value or "auto"),
        label=str(shader.GetPath()),
    )


def _read_uv_transform(file: UsdFile, st: Any) -> UvTransform:
    """Reads the primvar of a texture's ``st`` input, and its UsdTransform2d if there is one."""
    px = pxr()
    sources = st.GetValueProducingAttributes() if st else ()
    if not sources:
        return UvTransform()
    shader = px.UsdShade.Shader(sources[0].GetPrim())
    if shader.GetIdAttr().Get() != "UsdTransform2d":
        return UvTransform(_read_input(file, st).primvar or "st")
    primvar = _read_uv_transform(file, shader.GetInput("in")).primvar

    def pair(key: str, default: float) -> tuple[float, float]:
        numbers = finite_numbers(_read_input(file, shader.GetInput(key)).value, (2,))
        return (default, default) if numbers is None else (float(numbers[0]), float(numbers[1]))

    rotation = finite_numbers(_read_input(file, shader.GetInput("rotation")).value, ())
    return UvTransform(
        primvar, pair("scale", 1.0), 0.0 if rotation is None else float(np.radians(rotation)), pair("translation", 0.0)
    )


GREY = 0.18
"""Base colour of meshes without a material: the default diffuseColor of UsdPreviewSurface."""

_Texels = npt.NDArray[np.uint8]

_WRAP_NAMES = {wrap: name for name, wrap in _WRAP_MODES.items()}
_UNSUPPORTED_FIELDS = {
    "specular": ("specular strength", 1.0),
    "thin_walled": ("thin-walled transmission", False),
    "attenuation_distance": ("absorption inside meshes", math.inf),
    "sheen_color": ("sheen", (0.0, 0.0, 0.0)),
    "transmission_texture": ("transmission textures", None),
    "priority": ("priorities of overlapping media", 0),
}
"""Material fields that UsdPreviewSurface lacks, each with words for the log and the value at which it has no effect.

A field with another value is logged."""

_SPLAT_FACTORS = {"base_color": "diffuseColor", "metallic": "metallic", "roughness": "roughness"}
"""Material fields that are factors on the values of a capture, and their inputs of a UsdPreviewSurface."""

_Key = tuple[int, bool, bool]


class ReadMaterial(NamedTuple):
    """A material, and the names of the mesh primvars from which it takes texture coordinates and colour."""

    material: MaterialPbr
    uv_transform: UvTransform = UvTransform()
    """Primvar and transform of the texture coordinates that all textures of the material share."""
    color_primvar: str = ""
    """Name of the mesh primvar that provides the base colour; empty if no primvar does."""
    on_splats: MaterialPbr | None = None
    """The material as captures have it: of base colour, metallic and roughness, those that the file does not give are
    None, so that they leave the capture's own values unchanged."""


class UsdMaterials:
    """Reads the materials of a USD file; each is decoded once.

    Args:
        file: The open file.
    """

    def __init__(self, file: UsdFile) -> None:
        self._file = file
        self._cache: dict[str, ReadMaterial | None] = {}
        self._one_sided: dict[int, MaterialPbr] = {}
        self._images: dict[str, _Texels] = {}
        self._total = TextureBytes(file.path)

    def bound_to(self, prim: Any, *, remark: bool = True) -> ReadMaterial | None:
        """Returns the material bound to a prim; None if no supported material is bound.

        Args:
            prim: A mesh or a particle field.
            remark: Whether to log an unsupported material.

        Raises:
            FormatError: A value is out of range, or a texture is missing or corrupt.
        """
        material = pxr().UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
        if not material:
            return None
        # A material of a prototype has a different path in each instance.
        material_prim = material.GetPrim()
        key = str((material_prim.GetPrimInPrototype() if material_prim.IsInstanceProxy() else material_prim).GetPath())
        if key not in self._cache:
            surface = _surface_of(self._file, material, remark)
            try:
                self._cache[key] = surface and _Decoder(self, surface).decode(prim_name(material_prim))
            except FormatError:
                raise
            except SceneError as error:
                raise FormatError(self._file.path, f"{material.GetPath()}: {error}") from None
        return self._cache[key]

    def sided(self, material: MaterialPbr, prim: Any) -> MaterialPbr:
        """Returns a material for a mesh: if emissive, it emits only from front faces unless the mesh is doubleSided."""
        if not material.is_emissive or value(self._file, prim, "doubleSided", False):
            return material
        if id(material) not in self._one_sided:
            self._one_sided[id(material)] = replace(material, double_sided=False)
        return self._one_sided[id(material)]

    def texels(self, texture: _TextureInput) -> _Texels:
        """Returns the texels of a texture as stored, shape (H, W, 3) or (H, W, 4)."""
        name = str(getattr(texture.asset, "resolvedPath", "")) or asset_name(texture.asset)
        if name not in self._images:
            data = asset_bytes(self._file, texture.asset, texture.label)
            self._images[name] = decode_texture(data, self._file.path, asset_name(texture.asset), self._total)
        return self._images[name]

    def remark(self, text: str, label: str) -> None:
        """Records for the log that a feature, ``text``, of the material or texture ``label`` is left out."""
        self._file.remarks.add(text, label)


class _Decoder:
    """Decodes one UsdPreviewSurface material to the fields of a `MaterialPbr`."""

    def __init__(self, materials: UsdMaterials, surface: _PreviewSurface) -> None:
        self._materials, self._surface = materials, surface
        self._values: dict[str, Any] = {}
        self._uv_transform: UvTransform | None = None
        self._wraps: dict[str, WrapPair] = {}

    def decode(self, name: str) -> ReadMaterial:
        surface = self._surface
        primvar = surface.read("diffuseColor").primvar
        self._values |= {
            "base_color": _unit(surface.color("diffuseColor", (GREY, GREY, GREY))) if not primvar else (1.0, 1.0, 1.0),
            "metallic": surface.number("metallic", 0.0),
            "roughness": surface.number("roughness", 0.5),
            "ior": surface.number("ior", 1.5, 1.0, np.inf),
            "emissive": surface.color("emissiveColor", (0.0, 0.0, 0.0)),
            "clearcoat": surface.number("clearcoat", 0.0),
            "clearcoat_roughness": surface.number("clearcoatRoughness", 0.01),
        }
        if self._values["clearcoat"] == 0.0:
            self._values["clearcoat_roughness"] = 0.0
        if surface.number("useSpecularWorkflow", 0.0) > 0.0:
            self._materials.remark("specular colours (useSpecularWorkflow)", name)
            self._values["metallic"] = 0.0
        if surface.read("displacement").texture:
            self._materials.remark("displacement", name)
        self._base_color()
        self._emission()
        self._metallic_roughness()
        self._normals_and_occlusion()
        self._coat()
        self._opacity()
        material = MaterialPbr(**self._values, **self._wrap_values(), name=name)
        absent = [name for name, key in _SPLAT_FACTORS.items() if surface.read(key) == _ShaderInput()]
        on_splats = replace(material, **dict.fromkeys(absent))
        return ReadMaterial(material, self._uv_transform or UvTransform(), primvar, on_splats)

    def _texture_input(self, name: str) -> _TextureInput | None:
        """Returns the texture of a shader input; None if no texture is connected.

        All textures of a material share the texture coordinates of the first. A texture with other coordinates is left
        out: None is returned, and the log reports it.
        """
        texture = self._surface.read(name).texture
        if texture is None:
            return None
        if self._uv_transform is None:
            self._uv_transform = texture.uv_transform
        if texture.uv_transform != self._uv_transform:
            self._materials.remark(
                "textures whose coordinates differ from those of the material's first texture", texture.label
            )
            return None
        return texture

    def _set(self, name: str, texture: _TextureInput, texels: Texture) -> None:
        self._values[name], self._wraps[name] = texels, texture.wraps

    def _base_color(self) -> None:
        texture = self._texture_input("diffuseColor")
        if texture is not None:
            self._values["base_color"] = _unit(texture.scale[:3])
            self._set("base_color_texture", texture, self._colors(texture))

    def _emission(self) -> None:
        texture = self._texture_input("emissiveColor")
        if texture is not None:
            self._values["emissive"] = tuple(np.maximum(texture.scale[:3], 0.0).tolist())
            self._set("emissive_texture", texture, self._colors(texture))

    def _colors(self, texture: _TextureInput) -> Texture:
        """Returns red, green and blue of a colour texture in sRGB; linear values (``raw``) are encoded as sRGB."""
        texels = self._materials.texels(texture)
        texels = texels[:, :, :3] if texture.channel is None else np.repeat(_channel(texels, texture)[:, :, None], 3, 2)
        if texture.bias[:3].any():
            self._materials.remark("biases of colour textures", texture.label)
        if texture.color_space != "raw":
            return texels
        table = np.round(255.0 * encode_srgb(np.arange(256) / 255.0)).astype(np.uint8)
        return table[texels]

    def _metallic_roughness(self) -> None:
        """Stores roughness and metallic textures as one texture, roughness in green and metallic in blue, as in glTF.

        The plane of an input without a texture becomes 255.
        """
        planes: dict[int, _Texels] = {}
        for name, plane in (("roughness", 1), ("metallic", 2)):
            texture = self._texture_input(name)
            if texture is None:
                continue
            texels = self._plane(texture, plane)
            if planes and texels.shape[:2] != next(iter(planes.values())).shape[:2]:
                self._materials.remark("roughness and metallic textures of different sizes", texture.label)
                continue
            self._values[name] = float(np.clip(texture.scale[texture.channel or 0], 0.0, 1.0))
            planes[plane] = texels
            self._wraps["metallic_roughness_texture"] = texture.wraps
        if planes:
            textures = list(planes.values())
            both = textures[0] if len(textures) == 1 or textures[0] is textures[1] else np.full_like(textures[0], 255)
            for plane, texels in planes.items():
                if both is not texels:
                    both[:, :, plane] = texels[:, :, plane]
            if len(planes) == 1:  # the other input is a constant
                both = both.copy()
                both[:, :, 2 if 1 in planes else 1] = 255
            self._values["metallic_roughness_texture"] = both

    def _plane(self, texture: _TextureInput, channel_index: int) -> _Texels:
        """Returns a texture of three channels, whose channel ``channel_index`` has the values for the shader input."""
        texels, channel = self._materials.texels(texture), texture.channel or 0
        if channel == channel_index:
            return texels[:, :, :3] if texels.shape[2] > 3 else texels
        return np.repeat(_channel(texels, texture)[:, :, None], 3, axis=2)

    def _normals_and_occlusion(self) -> None:
        texture = self._texture_input("normal")
        if texture is not None:
            # 8-bit normal maps need scale 2 and bias -1; some files omit both and mean the same.
            scale = float(texture.scale[0]) / 2.0 if texture.bias[:3].any() else 1.0
            self._values["normal_scale"] = scale
            self._set("normal_texture", texture, self._materials.texels(texture)[:, :, :3])
        texture = self._texture_input("occlusion")
        if texture is not None:
            self._values["occlusion_strength"] = float(np.clip(texture.scale[texture.channel or 0], 0.0, 1.0))
            self._set("occlusion_texture", texture, self._plane(texture, 0))

    def _coat(self) -> None:
        for usd_name, name, plane in (("clearcoat", "clearcoat", 0), ("clearcoatRoughness", "clearcoat_roughness", 1)):
            texture = self._texture_input(usd_name)
            if texture is not None:
                self._values[name] = float(np.clip(texture.scale[texture.channel or 0], 0.0, 1.0))
                self._set(f"{name}_texture", texture, self._plane(texture, plane))

    def _opacity(self) -> None:
        """Reads opacity as transmission or as alpha.

        Opacity below 1 becomes transmission if it is constant and has no threshold, its mode is not ``presence``, and
        either the mode is ``transparent`` or the roughness is 0. Otherwise opacity becomes alpha: masked if it has a
        threshold, else blended.
        """
        surface, cutoff = self._surface, self._surface.number("opacityThreshold", 0.0)
        texture, opacity = self._texture_input("opacity"), surface.number("opacity", 1.0)
        mode = str(surface.read("opacityMode").value or "")
        if texture is None and cutoff == 0.0 and opacity < 1.0 and mode != "presence":
            if mode == "transparent" or self._values["roughness"] == 0.0:
                self._values["transmission"] = 1.0 - opacity
                return
        if texture is None and opacity == 1.0:
            return
        self._values["alpha_mode"] = AlphaMode.MASK if cutoff > 0.0 else AlphaMode.BLEND
        if cutoff > 0.0:
            self._values["alpha_cutoff"] = cutoff
        self._values["alpha"] = opacity
        if texture is not None:
            self._values["alpha"] = float(np.clip(texture.scale[texture.channel or 0], 0.0, 1.0))
            self._add_alpha(texture)

    def _add_alpha(self, texture: _TextureInput) -> None:
        """Stores the opacity texture as the fourth channel of the base colour texture."""
        plane = _channel(self._materials.texels(texture), texture)
        colors = self._values.get("base_color_texture")
        if colors is None:
            colors = np.full((*plane.shape, 3), 255, np.uint8)
            self._wraps["base_color_texture"] = texture.wraps
        if colors.shape[:2] != plane.shape:
            self._materials.remark("opacity textures whose size differs from that of the colour texture", texture.label)
            return
        self._values["base_color_texture"] = np.concatenate([colors[:, :, :3], plane[:, :, None]], axis=2)

    def _wrap_values(self) -> dict[str, Any]:
        """Returns wrap fields of a material: ``wrap_u`` and ``wrap_v`` of the first texture, and ``texture_wraps``.

        ``texture_wraps`` has the modes of textures that differ from the first.
        """
        if not self._wraps:
            return {}
        first = next(iter(self._wraps.values()))
        others = {name: wrap for name, wrap in self._wraps.items() if wrap != first}
        return {"wrap_u": first[0], "wrap_v": first[1], "texture_wraps": others or None}


def _channel(texels: _Texels, texture: _TextureInput) -> _Texels:
    """Returns the channel of a texture that a shader input takes, shape (H, W); 255 if the image lacks that channel."""
    channel = texture.channel or 0
    return texels[:, :, channel] if channel < texels.shape[2] else np.full(texels.shape[:2], 255, np.uint8)


def _unit(color: Any) -> tuple[float, ...]:
    """Returns a colour clipped to 0..1."""
    return tuple(np.clip(np.asarray(color, np.float64), 0.0, 1.0).tolist())


@dataclass(slots=True)
class MaterialWriter:
    """Writes materials as UsdPreviewSurface networks; a material that several prims use is written once."""

    writer: StageWriter
    _cache: dict[_Key, tuple[Material, Any]] = field(default_factory=dict[_Key, "tuple[Material, Any]"])

    def bind(self, prim: Any, material: Material, has_colors: bool = False, on_splats: bool = False) -> None:
        """Binds a material to a prim, and writes the material on first use.

        Args:
            prim: A mesh or a particle field.
            material: Its material.
            has_colors: Whether the mesh has vertex colours (primvar displayColor), which multiply the base colour.
            on_splats: Whether the prim is a particle field: fields that are factors on its values are left out if None.
        """
        key = id(material), has_colors, on_splats
        if key not in self._cache:
            self._cache[key] = material, _Network(self.writer, material, has_colors, on_splats).material
        px = pxr()
        px.UsdShade.MaterialBindingAPI.Apply(prim).Bind(self._cache[key][1])


class _Network:
    """Writes one material as a network of shader prims around a UsdPreviewSurface."""

    def __init__(self, writer: StageWriter, material: Material, has_colors: bool, on_splats: bool) -> None:
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
            for name, key in _SPLAT_FACTORS.items() if on_splats else ():
                if getattr(material, name) is None and (given := self._surface.GetInput(key)):
                    self._surface.GetPrim().RemoveProperty(given.GetFullName())
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
        """Connects an input of the UsdPreviewSurface to an output of a texture or primvar node.

        Args:
            name: Name of the input.
            kind: Sdf value type of the input, such as ``Float``.
            source: The node.
            output: Name of the output, such as ``rgb``.
            output_kind: Sdf value type of the output.
        """
        types = pxr().Sdf.ValueTypeNames
        made = source.CreateOutput(output, getattr(types, output_kind))
        self._surface.CreateInput(name, getattr(types, kind)).ConnectToSource(made)

    def _write_pbr(self, material: MaterialPbr, has_colors: bool) -> None:
        for name, (remark, neutral) in _UNSUPPORTED_FIELDS.items():
            field_value = getattr(material, name)
            if field_value is not neutral and field_value != neutral:
                self._writer.remarks.add(remark, self._name)
        self._write_color(material, material.mesh_color, has_colors)
        roughness, metallic = material.mesh_roughness, material.mesh_metallic
        self._write_plane("metallic_roughness", "roughness", roughness, "g", (1.0, roughness, metallic, 1.0))
        self._write_plane("metallic_roughness", "metallic", metallic, "b", (1.0, roughness, metallic, 1.0))
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
        """Writes the diffuse and emissive parts of a `MaterialSimple`, which UsdPreviewSurface can only approximate."""
        self._writer.remarks.add("simple materials, reduced to diffuse reflection and emission", self._name)
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
                self._writer.remarks.add("vertex colours of textured meshes", self._name)
        elif has_colors:
            reader = self._node("VertexColors", "UsdPrimvarReader_float3")
            self._set(reader, "varname", "String", "displayColor")
            self._connect("diffuseColor", "Color3f", reader, "result", "Float3")
        else:
            self._set(self._surface, "diffuseColor", "Color3f", pxr().Gf.Vec3f(*color))

    def _write_opacity(self, material: Material) -> None:
        """Writes a material's alpha as opacity, or its transmission as opacity with mode ``transparent``."""
        transmission = material.transmission if isinstance(material, MaterialPbr) else 0.0
        if material.alpha_mode is AlphaMode.OPAQUE:
            if transmission > 0.0:
                self._set(self._surface, "opacity", "Float", 1.0 - transmission)
                self._set(self._surface, "opacityMode", "Token", "transparent")
            return
        if transmission > 0.0:
            self._writer.remarks.add("transmission of materials with alpha", self._name)
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
        """Writes a scalar input of the UsdPreviewSurface, such as roughness.

        Args:
            texture: Material field whose texture gives the value.
            name: Name of the input.
            factor: Constant value if the material has no such texture.
            channel: Texture channel, such as ``g``.
            scale: Factors of the four channels.
        """
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
        """Returns a texture node that outputs ``texel * scale + bias``; None if the material field has no texture."""
        px, material = pxr(), self._material
        texels = getattr(material, f"{field_name}_texture", None)
        if texels is None:
            return None
        name = name or field_name
        existing = px.UsdShade.Shader.Get(self._writer.stage, f"{self._path}/{name}")
        if existing:
            return existing
        node = self._node(name, "UsdUVTexture")
        path = self._writer.texture(texels, f"{self._name}_{field_name}")
        self._set(node, "file", "Asset", px.Sdf.AssetPath(path))
        self._set(node, "sourceColorSpace", "Token", "sRGB" if color else "raw")
        self._set(node, "scale", "Float4", px.Gf.Vec4f(*scale))
        if any(bias):
            self._set(node, "bias", "Float4", px.Gf.Vec4f(*bias))
        for key, wrap in zip(("wrapS", "wrapT"), wraps_of(material, f"{field_name}_texture"), strict=True):
            self._set(node, key, "Token", _WRAP_NAMES[wrap])
        coordinates = self._coordinates().CreateOutput("result", px.Sdf.ValueTypeNames.Float2)
        node.CreateInput("st", px.Sdf.ValueTypeNames.Float2).ConnectToSource(coordinates)
        return node

    def _coordinates(self) -> Any:
        existing = pxr().UsdShade.Shader.Get(self._writer.stage, f"{self._path}/st")
        if existing:
            return existing
        reader = self._node("st", "UsdPrimvarReader_float2")
        self._set(reader, "varname", "String", "st")
        return reader
