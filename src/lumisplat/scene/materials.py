"""Materials of meshes and splat sets, and their textures: metallic-roughness as in glTF 2.0, and a simpler model.

The surface colour of a mesh is ``base_color`` times texture and vertex colour. The surface colour of a splat set is the
albedo of its Gaussians, or the decoded captured colour if the Gaussians have no albedo or the material is emissive;
``base_color`` of a `MaterialPbr` multiplies it, and textures are ignored. Roughness and metallic of the Gaussians, if
stored, are multiplied by the material's (docs/adr/0123-materials-are-factors-on-a-sets-own-values.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from enum import Enum
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import Range
from lumisplat.config.setting import Share, frozen, given
from lumisplat.errors import SceneError
from lumisplat.math.arrays import host_array, read_only_array
from lumisplat.scene.checks import COLOR, UNIT_COLOR, OptionalColor, take_scene_fields

if TYPE_CHECKING:
    from lumisplat.scene.gaussians import Gaussians

Texture = npt.NDArray[np.uint8]


class TextureWrap(Enum):
    """Texture wrap mode: how a texture continues where texture coordinates leave 0..1."""

    REPEAT = "repeat"
    """Repeat the texture."""
    MIRROR = "mirror"
    """Repeat the texture, mirroring every second copy."""
    CLAMP = "clamp"
    """Extend the edge texels."""


WrapPair = tuple[TextureWrap, TextureWrap]
"""Wrap modes of one texture along u and v."""
Wraps = Mapping[str, WrapPair]
"""Wrap modes along u and v by the name of the material's texture field."""
WrapsLike = Mapping[str, TextureWrap | str | Sequence[TextureWrap | str]]
"""Input that `checked_wraps` converts to `Wraps`: a mode may be given by value, and one mode may stand for both axes.
"""


def to_texture(value: npt.ArrayLike | None, name: str = "texture") -> Texture | None:
    """Converts texels to a read-only array; None stays None.

    Raises:
        SceneError: The texels are not of shape (H, W, 3 or 4) and type uint8.
    """
    if value is None:
        return None
    texture = np.asarray(host_array(value))
    if texture.dtype != np.uint8 or texture.ndim != 3 or texture.shape[2] not in (3, 4) or texture.size == 0:
        raise SceneError(f"{name} is {texture.dtype} {texture.shape}, expected uint8 (H, W, 3 or 4)")
    return read_only_array(texture, np.uint8)


def checked_wraps(given: WrapsLike | None, known: Sequence[str]) -> Wraps | None:
    """Converts a user's wrap modes of textures to pairs (along u, along v) by texture name; None stays None.

    Args:
        given: Wrap modes from the user, by texture name.
        known: Names of the material's textures.

    Raises:
        SceneError: The material has no such texture, or there is no such wrap mode.
    """
    if given is None:
        return None
    wraps: dict[str, WrapPair] = {}
    for name, value in given.items():
        if name not in known:
            raise SceneError(f"texture_wraps names {name!r}, expected one of {', '.join(known)}")
        pair = [value] * 2 if isinstance(value, str | TextureWrap) else value
        try:
            u, v = map(TextureWrap, pair)
        except (TypeError, ValueError):
            choices = ", ".join(repr(choice.value) for choice in TextureWrap)
            raise SceneError(
                f"texture_wraps of {name} is {value!r}, expected one of {choices}, or two of them"
            ) from None
        wraps[name] = u, v
    return wraps


Color = tuple[float, float, float]

MESH_COLOR: Color = (0.8, 0.8, 0.8)
"""Base colour of meshes whose `MaterialPbr` gives none."""
METALLIC, ROUGHNESS = 0.0, 0.5
"""Metalness and roughness of surfaces that store none and whose `MaterialPbr` gives none."""


class AlphaMode(Enum):
    """Meaning of a mesh material's alpha: the product of ``alpha`` and the base colour texture's alpha (glTF 3.9.4)."""

    OPAQUE = "opaque"
    """Alpha is ignored."""
    MASK = "mask"
    """The surface exists where alpha is at least ``alpha_cutoff``."""
    BLEND = "blend"
    """Alpha is the coverage of the surface; the background shows through the rest."""


class SurfaceValues(NamedTuple):
    """Holds what a `MaterialPbr` gives a surface: its values, or factors on a splat set's own values."""

    base_color: Color
    metallic: float
    roughness: float


@frozen(kw_only=True)
class MaterialPbr:
    """Metallic-roughness material (glTF 2.0 section 3.9, KHR_materials_{specular,ior,transmission,volume,...}).

    At roughness 0 the surface is smooth, and reflects or refracts rays in one direction: a metal is a mirror, a
    transmissive dielectric is glass. In `Pipeline.RASTER`, which traces no such rays, they show only the environment or
    the background. Unlit frames show smooth surfaces as such, and all other surfaces in their base colour.

    Raises:
        SceneError: A value is outside its range, or a texture is not (H, W, 3 or 4) uint8.
    """

    base_color: Color | None = given(converter=OptionalColor(), default=None)
    """Linear Rec.709 base colour of a mesh, multiplied by the texture; by default ``(0.8, 0.8, 0.8)``. ``(1, 1, 1)``,
    glTF's default, shows the texture unchanged. For splats, a factor on their own colour, which by default stays
    unchanged."""
    metallic: Share | None = None
    """Metalness: 0, the default, is a dielectric, 1 a metal. For splats with metalness of their own, a factor on it, by
    default 1."""
    roughness: Share | None = None
    """Perceptual roughness, by default 0.5; exactly 0 is smooth. The roughness of splats is at least 0.03. For splats
    with roughness of their own, a factor on it, by default 1."""
    specular: Share = 1.0
    """Strength of the dielectric's specular reflection (KHR_materials_specular): 1 is full Fresnel reflection, 0 none.
    """
    ior: Annotated[float, Range(1.0)] = 1.5
    """Index of refraction; with 1, light is neither reflected nor bent."""
    transmission: Share = 0.0
    """Fraction of the unreflected light that the dielectric refracts, tinted by the base colour at each crossing. The
    mesh should be closed, with triangles counter-clockwise from outside, so that rays can tell entering from leaving.
    Splats scatter this fraction back instead of refracting it, and so do rough meshes outside `Pipeline.PATH`.
    """
    thin_walled: bool = False
    """Treat the mesh as a thin wall without an inside: refracted light passes straight through. The settings of the
    volume inside, attenuation and ``priority``, have no effect."""
    attenuation_color: Color = given(converter=UNIT_COLOR, default=(1.0, 1.0, 1.0))
    """Linear colour of white light after ``attenuation_distance`` inside the volume."""
    attenuation_distance: Annotated[float, Range(0.0, unit="scene units", above=True, infinite=True)] = math.inf
    """Distance inside the volume after which white light has ``attenuation_color``; inf: no absorption."""
    priority: Annotated[int, Range(-(2**31), 2**31 - 1)] = 0
    """Priority where transmissive meshes overlap: the overlap has the volume of the mesh with the highest priority.
    Among equal priorities, it has the volume of the mesh that the ray entered last."""
    clearcoat: Share = 0.0
    """Strength of a clear coat over the whole surface (KHR_materials_clearcoat)."""
    clearcoat_roughness: Share = 0.0
    """Roughness of the clear coat; values below 0.03 count as 0.03."""
    sheen_color: Color = given(converter=UNIT_COLOR, default=(0.0, 0.0, 0.0))
    """Linear colour of the sheen of cloth, below the clear coat; black: none (KHR_materials_sheen)."""
    sheen_roughness: Share = 0.0
    """Roughness of the sheen: at low roughness the sheen shows only at grazing angles. Values below 0.1 count as 0.1.
    """
    emissive: Color = given(converter=COLOR, default=(0.0, 0.0, 0.0))
    """Emitted linear radiance of a mesh; for a splat set, factor on the captured colours that the set emits."""
    double_sided: bool = True
    """Let meshes emit from the back of their triangles, too. False: the back emits nothing, as with glTF's
    ``doubleSided``. Both sides reflect light either way."""
    base_color_texture: Texture | None = given(converter=to_texture, default=None)
    """sRGB-encoded texels, shape (H, W, 3 or 4), row 0 at v = 0 (top, as in glTF); the fourth channel is alpha."""
    metallic_roughness_texture: Texture | None = given(converter=to_texture, default=None)
    """Linear texture whose green channel multiplies ``roughness`` and whose blue channel multiplies ``metallic``."""
    normal_texture: Texture | None = given(converter=to_texture, default=None)
    """Tangent-space normals ``2 c - 1``: x along u, y against v, z away from the surface."""
    normal_scale: Annotated[float, Range()] = 1.0
    """Factor on x and y of the normal texture's normals: 0 flattens them, 1 leaves them unchanged."""
    occlusion_texture: Texture | None = given(converter=to_texture, default=None)
    """Red channel: fraction of the environment's light that reaches the surface (glTF's ambient occlusion), linear."""
    occlusion_strength: Share = 1.0
    """Blend between no occlusion (0) and the occlusion texture's values (1)."""
    emissive_texture: Texture | None = given(converter=to_texture, default=None)
    """sRGB-encoded texture that multiplies ``emissive``."""
    transmission_texture: Texture | None = given(converter=to_texture, default=None)
    """Linear texture whose red channel multiplies ``transmission``."""
    clearcoat_texture: Texture | None = given(converter=to_texture, default=None)
    """Linear texture whose red channel multiplies ``clearcoat``."""
    clearcoat_roughness_texture: Texture | None = given(converter=to_texture, default=None)
    """Linear texture whose green channel multiplies ``clearcoat_roughness``."""
    sheen_color_texture: Texture | None = given(converter=to_texture, default=None)
    """sRGB-encoded texture that multiplies ``sheen_color``."""
    sheen_roughness_texture: Texture | None = given(converter=to_texture, default=None)
    """Linear texture whose alpha channel multiplies ``sheen_roughness``."""
    wrap_u: TextureWrap = TextureWrap.REPEAT
    """Wrap mode along u of all textures that ``texture_wraps`` does not name: a `TextureWrap` or its value, such as
    ``"clamp"``."""
    wrap_v: TextureWrap = TextureWrap.REPEAT
    """Wrap mode along v of all textures that ``texture_wraps`` does not name."""
    texture_wraps: Wraps | None = None
    """Wrap modes along u and v by texture name, such as ``{"normal_texture": ("clamp", "repeat")}``; other textures
    have ``wrap_u`` and ``wrap_v``."""
    alpha_mode: AlphaMode = AlphaMode.OPAQUE
    """How meshes use alpha: ``"opaque"`` ignores it, ``"mask"`` cuts out, ``"blend"`` lets the background show
    through."""
    alpha: Share = 1.0
    """Opacity factor: multiplies the alpha of the base colour texture; `alpha_mode` says how meshes use the product."""
    alpha_cutoff: Annotated[float, Range(0.0)] = 0.5
    """Smallest alpha at which the surface exists with ``AlphaMode.MASK``; above 1, it exists nowhere."""
    name: str = ""
    """Name of the material; in Cryptomatte output, also the name of its matte."""

    def __post_init__(self) -> None:
        take_scene_fields(self)
        object.__setattr__(self, "texture_wraps", checked_wraps(self.texture_wraps, texture_names(self)))

    @property
    def mesh_color(self) -> Color:
        """Base colour of a mesh: ``base_color``, or `MESH_COLOR` for None."""
        return MESH_COLOR if self.base_color is None else self.base_color

    @property
    def mesh_metallic(self) -> float:
        """Metalness of a mesh, or of splats that store none: ``metallic``, or `METALLIC` for None."""
        return METALLIC if self.metallic is None else self.metallic

    @property
    def mesh_roughness(self) -> float:
        """Roughness of a mesh, or of splats that store none: ``roughness``, or `ROUGHNESS` for None."""
        return ROUGHNESS if self.roughness is None else self.roughness

    def values_on(self, gaussians: Gaussians | None = None) -> SurfaceValues:
        """Returns the values of the material on a splat set, or with None on a mesh.

        A field that is None has its default, or leaves the splat set's own values unchanged, as 1 does.
        """
        color, metallic, roughness = self.mesh_color, self.mesh_metallic, self.mesh_roughness
        if gaussians is not None:
            color = (1.0, 1.0, 1.0) if self.base_color is None else color
            metallic = 1.0 if self.metallic is None and gaussians.metallic is not None else metallic
            roughness = 1.0 if self.roughness is None and gaussians.roughness is not None else roughness
        return SurfaceValues(color, metallic, roughness)

    @property
    def is_solid(self) -> bool:
        """True if refracted light travels inside a mesh with this material: transmissive, and not ``thin_walled``."""
        return self.transmission > 0.0 and not self.thin_walled

    @property
    def is_emissive(self) -> bool:
        """True if the surface emits light."""
        return any(self.emissive)

    @property
    def is_smooth(self) -> bool:
        """True if the material reflects and refracts in single directions, as roughness 0 does, without scattering."""
        return self.roughness == 0.0

    @property
    def blends(self) -> bool:
        """True if ``alpha_mode`` is BLEND: the background shows through a mesh where alpha is below 1."""
        return self.alpha_mode is AlphaMode.BLEND

    @property
    def sends_rays_on(self) -> bool:
        """True if rays continue from a mesh with this material: reflected, refracted, or through transparent alpha."""
        return self.is_smooth or self.blends


@frozen(kw_only=True)
class MaterialSimple:
    """Simple material: emission, ambient light, diffuse reflection and a Phong highlight.

    With the defaults a splat set emits its captured colour and reflects nothing, as a splat set without a material
    does. If the diffuse and specular factors add up to more than 1, both are scaled down, so that energy is conserved.
    The equations are in docs/method/materials.md#simple.

    Raises:
        SceneError: A value is outside its range, or the texture is not (H, W, 3 or 4) uint8.
    """

    emissive: Color = given(converter=COLOR, default=(1.0, 1.0, 1.0))
    """Factor on the surface colour that is emitted, with or without lights; may exceed 1."""
    ambient: Color = given(converter=COLOR, default=(0.0, 0.0, 0.0))
    """Factor on the surface colour that lit frames show everywhere, also in shadow; may exceed 1."""
    diffuse: Color = given(converter=UNIT_COLOR, default=(0.0, 0.0, 0.0))
    """Fraction of the surface colour that is reflected diffusely."""
    specular: Color = given(converter=UNIT_COLOR, default=(0.0, 0.0, 0.0))
    """Reflectance of the highlight around the mirror direction."""
    shininess: Annotated[float, Range(0.0, 1e4)] = 32.0
    """Exponent of the Phong highlight: the higher, the smaller and sharper the highlight."""
    base_color: Color = given(converter=UNIT_COLOR, default=(1.0, 1.0, 1.0))
    """Linear Rec.709 base colour of a mesh, multiplied by texture and vertex colour. Splat sets ignore it: ``diffuse``
    is a factor on their own colour."""
    base_color_texture: Texture | None = given(converter=to_texture, default=None)
    """sRGB-encoded texels of the base colour, shape (H, W, 3 or 4), row 0 at v = 0 (top); the fourth channel is alpha.
    """
    wrap_u: TextureWrap = TextureWrap.REPEAT
    """Wrap mode of the base colour texture along u: a `TextureWrap` or its value, such as ``"clamp"``."""
    wrap_v: TextureWrap = TextureWrap.REPEAT
    """Wrap mode of the base colour texture along v: a `TextureWrap` or its value, such as ``"clamp"``."""
    alpha_mode: AlphaMode = AlphaMode.OPAQUE
    """How meshes use alpha: ignore it (OPAQUE), cut out (MASK) or blend with the background (BLEND)."""
    alpha: Share = 1.0
    """Opacity factor: multiplies the alpha of the base colour texture; `alpha_mode` says how meshes use the product."""
    alpha_cutoff: Annotated[float, Range(0.0)] = 0.5
    """Smallest alpha at which the surface exists with ``AlphaMode.MASK``."""
    name: str = ""
    """Name of the material; in Cryptomatte output, also the name of its matte."""

    __post_init__ = take_scene_fields

    @property
    def mesh_color(self) -> Color:
        """Base colour of a mesh: ``base_color``."""
        return self.base_color

    @property
    def is_emissive(self) -> bool:
        """True if the surface shows its colour without lights, by emission or ambient light."""
        return any(self.emissive) or any(self.ambient)

    @property
    def is_smooth(self) -> bool:
        """Always False: this material has no perfect mirror reflection or refraction."""
        return False

    @property
    def blends(self) -> bool:
        """True if ``alpha_mode`` is BLEND: the background shows through a mesh where alpha is below 1."""
        return self.alpha_mode is AlphaMode.BLEND

    @property
    def sends_rays_on(self) -> bool:
        """True if ``alpha_mode`` is BLEND: rays continue through a mesh where alpha is below 1."""
        return self.blends


Material = MaterialPbr | MaterialSimple
"""Any material class."""


def texture_names(material: Material) -> list[str]:
    """Returns the names of all texture fields that the material's class has, including those that are None."""
    return [field.name for field in fields(material) if field.name.endswith("_texture")]


def wraps_of(material: Material, name: str) -> WrapPair:
    """Returns the wrap modes of texture field ``name`` along u and v."""
    own = material.texture_wraps if isinstance(material, MaterialPbr) else None
    return (own or {}).get(name, (material.wrap_u, material.wrap_v))
