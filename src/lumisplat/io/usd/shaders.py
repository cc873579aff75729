"""Shader networks: the inputs of a UsdPreviewSurface, each a value or a texture with its placement."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from lumisplat.io.usd.library import pxr
from lumisplat.io.usd.stage import UsdFile, shortest
from lumisplat.math.arrays import Doubles, FloatArray, finite_numbers
from lumisplat.scene.textures import TextureWrap, WrapPair

_WRAPS = {"repeat": TextureWrap.REPEAT, "mirror": TextureWrap.MIRROR, "clamp": TextureWrap.CLAMP}
"""Others are black beyond the edges, or left to the image, which says nothing."""
_CHANNELS = {"r": 0, "g": 1, "b": 2, "a": 3}


class Placement(NamedTuple):
    """Where texture coordinates come from: a primvar, scaled, turned, then moved, with (0, 0) at the bottom left."""

    primvar: str = "st"
    scale: tuple[float, float] = (1.0, 1.0)
    rotation: float = 0.0
    """Radians, counter-clockwise."""
    translation: tuple[float, float] = (0.0, 0.0)

    def transform(self, uvs: FloatArray) -> FloatArray:
        """Coordinates, shape (V, 2), as stored."""
        if self == Placement(self.primvar):
            return uvs
        cos, sin = np.cos(self.rotation), np.sin(self.rotation)
        turn = np.array([[cos, -sin], [sin, cos]])
        return ((uvs * self.scale) @ turn.T + self.translation).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class TextureInput:
    """A texture that feeds an input: ``texel * scale + bias``, four channels each."""

    asset: Any
    channel: int | None
    """0..3; None: all three colours."""
    placement: Placement
    wraps: WrapPair
    scale: Doubles
    bias: Doubles
    color_space: str
    label: str


@dataclass(frozen=True, slots=True, eq=False)
class ShaderInput:
    """What feeds an input: a value, a texture, or a primvar of the mesh."""

    value: Any = None
    texture: TextureInput | None = None
    primvar: str = ""


class PreviewSurface:
    """The inputs of a material's UsdPreviewSurface.

    Args:
        file: The open file.
        shader: The shader.
    """

    def __init__(self, file: UsdFile, shader: Any) -> None:
        self._file, self._shader = file, shader

    def read(self, name: str) -> ShaderInput:
        """An input; one that has neither a value nor a connection that is known has value None."""
        return _read_input(self._file, self._shader.GetInput(name))

    def number(self, name: str, default: float, low: float = 0.0, high: float = 1.0) -> float:
        """The value of an input within limits; the default if it is none, or fed by a texture."""
        found = self.read(name).value
        held = finite_numbers(found, ())
        return default if held is None else float(np.clip(shortest(float(held)), low, high))

    def color(self, name: str, default: tuple[float, float, float]) -> tuple[float, float, float]:
        """The same of three values, at least 0."""
        held = finite_numbers(self.read(name).value, (3,))
        if held is None:
            return default
        red, green, blue = (max(shortest(float(one)), 0.0) for one in held)
        return red, green, blue


def surface_of(file: UsdFile, material: Any, remark: bool) -> PreviewSurface | None:
    """The UsdPreviewSurface of a material; None, perhaps with a remark, if it has none."""
    shader = material.ComputeSurfaceSource()[0]
    if not shader or shader.GetIdAttr().Get() != "UsdPreviewSurface":
        if remark:
            file.remarks.add("materials without a UsdPreviewSurface", str(material.GetPath()))
        return None
    return PreviewSurface(file, shader)


def _read_input(file: UsdFile, given: Any) -> ShaderInput:
    px = pxr()
    if not given:
        return ShaderInput()
    sources = given.GetValueProducingAttributes()
    if not sources:
        return ShaderInput(given.Get(file.time))
    source = sources[0]
    if px.UsdShade.Utils.GetType(source.GetName()) != px.UsdShade.AttributeType.Output:
        return ShaderInput(source.Get(file.time))
    shader = px.UsdShade.Shader(source.GetPrim())
    kind, output = str(shader.GetIdAttr().Get()), px.UsdShade.Output(source).GetBaseName()
    if kind == "UsdUVTexture":
        return ShaderInput(texture=_read_texture(file, shader, str(output)))
    if kind.startswith("UsdPrimvarReader"):
        return ShaderInput(primvar=str(_read_input(file, shader.GetInput("varname")).value or ""))
    file.remarks.add(f"shader nodes of kind {kind}", str(shader.GetPath()))
    return ShaderInput()


def _read_texture(file: UsdFile, shader: Any, output: str) -> TextureInput | None:
    asset = _read_input(file, shader.GetInput("file")).value
    name = str(getattr(asset, "path", asset or ""))
    if not name or "<UDIM>" in name:
        file.remarks.add("textures without a file, or of UDIM tiles", str(shader.GetPath()))
        return None

    def four(key: str, default: float) -> Doubles:
        held = finite_numbers(_read_input(file, shader.GetInput(key)).value, (4,))
        return np.full(4, default) if held is None else np.array([shortest(float(one)) for one in held])

    def wrap(key: str) -> TextureWrap:
        return _WRAPS.get(str(_read_input(file, shader.GetInput(key)).value), TextureWrap.REPEAT)

    return TextureInput(
        asset=asset,
        channel=_CHANNELS.get(output),
        placement=_read_placement(file, shader.GetInput("st")),
        wraps=(wrap("wrapS"), wrap("wrapT")),
        scale=four("scale", 1.0),
        bias=four("bias", 0.0),
        color_space=str(_read_input(file, shader.GetInput("sourceColorSpace")).value or "auto"),
        label=str(shader.GetPath()),
    )


def _read_placement(file: UsdFile, st: Any) -> Placement:
    """The coordinates of a texture: through a UsdTransform2d, if there is one."""
    px = pxr()
    sources = st.GetValueProducingAttributes() if st else ()
    if not sources:
        return Placement()
    shader = px.UsdShade.Shader(sources[0].GetPrim())
    if shader.GetIdAttr().Get() != "UsdTransform2d":
        return Placement(_read_input(file, st).primvar or "st")
    primvar = _read_placement(file, shader.GetInput("in")).primvar

    def pair(key: str, default: float) -> tuple[float, float]:
        held = finite_numbers(_read_input(file, shader.GetInput(key)).value, (2,))
        return (default, default) if held is None else (float(held[0]), float(held[1]))

    turn = finite_numbers(_read_input(file, shader.GetInput("rotation")).value, ())
    return Placement(
        primvar, pair("scale", 1.0), 0.0 if turn is None else float(np.radians(turn)), pair("translation", 0.0)
    )
