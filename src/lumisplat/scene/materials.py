"""Surface materials for meshes and splats, and their textures: metallic-roughness as in glTF 2.0, and a simpler one.

The surface colour of a mesh is ``base_color`` times texture and vertex colour. That of a splat set is the albedo of
its Gaussians if they have one and the material is not emissive, else the captured colour, decoded; ``base_color`` and
textures are not used. Roughness and metallic of the Gaussians, if they have them, replace those of the material.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from enum import Enum
from typing import Annotated

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import Range
from lumisplat.config.setting import Share, frozen, given
from lumisplat.errors import SceneError
from lumisplat.math.arrays import host_array, read_only_array
from lumisplat.scene.checks import COLOR, UNIT_COLOR, take_scene_fields

Texture = npt.NDArray[np.uint8]


class TextureWrap(Enum):
    """What a texture shows beyond its edges."""

    REPEAT = "repeat"
    """The texture again."""
    MIRROR = "mirror"
    """The texture again, every second time mirrored."""
    CLAMP = "clamp"
    """The texels of its edge."""


WrapPair = tuple[TextureWrap, TextureWrap]
"""How a texture wraps along u and along v."""
Wraps = Mapping[str, WrapPair]
"""The same of several textures, by the names of their fields."""
WrapsLike = Mapping[str, TextureWrap | str | Sequence[TextureWrap | str]]
"""What is taken for `Wraps`: also one value for both axes, and values of the enum."""


def to_texture(value: npt.ArrayLike | None, name: str = "texture") -> Texture | None:
    """Converts texels of a material to a read-only array.

    Raises:
        SceneError: They are not (H, W, 3 or 4) uint8.
    """
    if value is None:
        return None
    texture = np.asarray(host_array(value))
    if texture.dtype != np.uint8 or texture.ndim != 3 or texture.shape[2] not in (3, 4) or texture.size == 0:
        raise SceneError(f"{name} is {texture.dtype} {texture.shape}, expected uint8 (H, W, 3 or 4)")
    return read_only_array(texture, np.uint8)


def checked_wraps(given: WrapsLike | None, known: Sequence[str]) -> Wraps | None:
    """The wraps of single textures of a material, as pairs.

    Args:
        given: What the material was given.
        known: Names of its textures.

    Raises:
        SceneError: There is no such texture, or no such way to wrap.
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
            ways = ", ".join(repr(way.value) for way in TextureWrap)
            raise SceneError(f"texture_wraps of {name} is {value!r}, expected one of {ways}, or two of them") from None
        wraps[name] = u, v
    return wraps


Color = tuple[float, float, float]


class AlphaMode(Enum):
    """What the alpha of a mesh's material means: ``alpha`` times that of the base colour texture (glTF 3.9.4)."""

    OPAQUE = "opaque"
    """Nothing."""
    MASK = "mask"
    """There is a surface where it is at least ``alpha_cutoff``, and none elsewhere."""
    BLEND = "blend"
    """It is the share of the surface that is there; what is behind shows through the rest."""


@frozen(kw_only=True)
class MaterialPbr:
    """Metallic-roughness material (glTF 2.0 section 3.9, KHR_materials_{specular,ior,transmission,volume,...}).

    At roughness 0 the surface is smooth, and rays are reflected or refracted: a mirror where it is metallic, glass
    where it transmits. Unlit frames show the base colour of all other surfaces.

    Raises:
        SceneError: A value is outside its range, or a texture is not (H, W, 3 or 4) uint8.
    """

    base_color: Color = given(converter=UNIT_COLOR, default=(0.8, 0.8, 0.8))
    """Linear Rec.709; a factor of the texture, which ``(1, 1, 1)``, glTF's default, shows as it is."""
    metallic: Share = 0.0
    """0 is a dielectric, 1 a metal."""
    roughness: Share = 0.5
    """Perceptual roughness; exactly 0 is smooth. The roughness of splats is at least 0.03."""
    specular: Share = 1.0
    """Strength of the dielectric reflection."""
    ior: Annotated[float, Range(1.0)] = 1.5
    """Index of refraction; with 1, light is neither reflected nor bent."""
    transmission: Share = 0.0
    """Share of the light not reflected that is refracted through the dielectric, tinted by the base colour at
    each crossing. The mesh should be closed and its triangles counter-clockwise from outside, which is how a ray
    decides whether it enters or leaves. Splats scatter that share back, and rough meshes do but in `Pipeline.PATH`."""
    thin_walled: bool = False
    """Whether the mesh is a wall without an inside: light goes straight through it, and what follows means nothing."""
    attenuation_color: Color = given(converter=UNIT_COLOR, default=(1.0, 1.0, 1.0))
    """What white light becomes inside after ``attenuation_distance``, linear."""
    attenuation_distance: Annotated[float, Range(0.0, unit="scene units", above=True, infinite=True)] = math.inf
    """Distance inside after which white light has that colour; inf: nothing is absorbed."""
    priority: Annotated[int, Range(-(2**31), 2**31 - 1)] = 0
    """Where meshes that transmit overlap, the highest one's inside is there; of equal ones, that entered last."""
    clearcoat: Share = 0.0
    """Strength of a clear coat over all of it (KHR_materials_clearcoat)."""
    clearcoat_roughness: Share = 0.0
    """Roughness of the coat; below 0.03 as 0.03."""
    sheen_color: Color = given(converter=UNIT_COLOR, default=(0.0, 0.0, 0.0))
    """Linear colour of the sheen of cloth, below the coat; black: none (KHR_materials_sheen)."""
    sheen_roughness: Share = 0.0
    """Roughness of the sheen: less of it is at grazing angles the higher; below 0.1 as 0.1."""
    emissive: Color = given(converter=COLOR, default=(0.0, 0.0, 0.0))
    """Emitted linear radiance; on a splat set, a factor of the captured colour."""
    double_sided: bool = True
    """Whether meshes emit from the back of their triangles as well, from which these are clockwise. False: the back is
    black but for what it reflects, as with glTF's ``doubleSided``. Light is reflected on both sides either way."""
    base_color_texture: Texture | None = given(converter=to_texture, default=None)
    """sRGB-encoded texels, shape (H, W, 3 or 4), row 0 at v = 0 (top, as in glTF); the fourth is alpha."""
    metallic_roughness_texture: Texture | None = given(converter=to_texture, default=None)
    """Factors of roughness (green) and metallic (blue), linear."""
    normal_texture: Texture | None = given(converter=to_texture, default=None)
    """Tangent-space normals ``2 c - 1``: x along u, y against v, z away from the surface."""
    normal_scale: Annotated[float, Range()] = 1.0
    """Factor of x and y of the normal texture."""
    occlusion_texture: Texture | None = given(converter=to_texture, default=None)
    """Share of the environment's light that reaches the surface (red)."""
    occlusion_strength: Share = 1.0
    """Strength of the occlusion."""
    emissive_texture: Texture | None = given(converter=to_texture, default=None)
    """sRGB-encoded factor of ``emissive``."""
    transmission_texture: Texture | None = given(converter=to_texture, default=None)
    """Factor of ``transmission`` (red), linear."""
    clearcoat_texture: Texture | None = given(converter=to_texture, default=None)
    """Factor of ``clearcoat`` (red), linear."""
    clearcoat_roughness_texture: Texture | None = given(converter=to_texture, default=None)
    """Factor of ``clearcoat_roughness`` (green), linear."""
    sheen_color_texture: Texture | None = given(converter=to_texture, default=None)
    """sRGB-encoded factor of ``sheen_color``."""
    sheen_roughness_texture: Texture | None = given(converter=to_texture, default=None)
    """Factor of ``sheen_roughness`` (alpha), linear."""
    wrap_u: TextureWrap = TextureWrap.REPEAT
    """What textures show beyond their left and right edges; also by its value, ``"clamp"``."""
    wrap_v: TextureWrap = TextureWrap.REPEAT
    """The same beyond their upper and lower edges."""
    texture_wraps: Wraps | None = None
    """What single textures show there instead, along u and v: ``{"normal_texture": ("clamp", "repeat")}``."""
    alpha_mode: AlphaMode = AlphaMode.OPAQUE
    """What alpha means, on meshes; also by its value, ``"mask"``."""
    alpha: Share = 1.0
    """Factor of the base colour texture's alpha."""
    alpha_cutoff: Annotated[float, Range(0.0)] = 0.5
    """With ``AlphaMode.MASK``, the alpha from which on there is a surface; above 1 there is none."""
    name: str = ""

    def __post_init__(self) -> None:
        take_scene_fields(self)
        object.__setattr__(self, "texture_wraps", checked_wraps(self.texture_wraps, texture_names(self)))

    @property
    def is_solid(self) -> bool:
        """Whether light enters the inside of a mesh of it."""
        return self.transmission > 0.0 and not self.thin_walled

    @property
    def is_emissive(self) -> bool:
        """Whether it shines by itself."""
        return any(self.emissive)

    @property
    def is_smooth(self) -> bool:
        """Whether rays are reflected or refracted by it."""
        return self.roughness == 0.0

    @property
    def blends(self) -> bool:
        """Whether a share of a mesh of it shows what is behind, by its alpha."""
        return self.alpha_mode is AlphaMode.BLEND

    @property
    def sends_rays_on(self) -> bool:
        """Whether rays go on from a mesh of it: reflected, refracted, or past the share that alpha leaves."""
        return self.is_smooth or self.blends


@frozen(kw_only=True)
class MaterialSimple:
    """Emission, diffuse reflection and a Phong highlight, each with its factor (docs/method/materials.md#simple).

    With the defaults a splat set shines as captured and reflects nothing, as it does without a material. If the diffuse
    and specular factors add up to more than 1, both are scaled down, so that no more light leaves than arrives.

    Raises:
        SceneError: A value is outside its range, or the texture is not (H, W, 3 or 4) uint8.
    """

    emissive: Color = given(converter=COLOR, default=(1.0, 1.0, 1.0))
    """Factor of the surface colour that shows without any light."""
    ambient: Color = given(converter=COLOR, default=(0.0, 0.0, 0.0))
    """Factor of the surface colour that shows in lit frames, wherever the lights are."""
    diffuse: Color = given(converter=UNIT_COLOR, default=(0.0, 0.0, 0.0))
    """Factor of the surface colour that is reflected diffusely."""
    specular: Color = given(converter=UNIT_COLOR, default=(0.0, 0.0, 0.0))
    """Reflectance of the highlight around the mirror direction."""
    shininess: Annotated[float, Range(0.0, 1e4)] = 32.0
    """Exponent of the highlight: higher is sharper."""
    base_color: Color = given(converter=UNIT_COLOR, default=(1.0, 1.0, 1.0))
    """Linear Rec.709."""
    base_color_texture: Texture | None = given(converter=to_texture, default=None)
    """sRGB-encoded texels, as in `MaterialPbr`."""
    wrap_u: TextureWrap = TextureWrap.REPEAT
    """As in `MaterialPbr`, like what follows."""
    wrap_v: TextureWrap = TextureWrap.REPEAT
    alpha_mode: AlphaMode = AlphaMode.OPAQUE
    alpha: Share = 1.0
    alpha_cutoff: Annotated[float, Range(0.0)] = 0.5
    name: str = ""

    __post_init__ = take_scene_fields

    @property
    def is_emissive(self) -> bool:
        """Whether it shines by itself, or by ambient light."""
        return any(self.emissive) or any(self.ambient)

    @property
    def is_smooth(self) -> bool:
        """Whether rays are reflected or refracted by it: never."""
        return False

    @property
    def blends(self) -> bool:
        """Whether a share of a mesh of it shows what is behind, by its alpha."""
        return self.alpha_mode is AlphaMode.BLEND

    @property
    def sends_rays_on(self) -> bool:
        """Whether rays go on from a mesh of it: past the share that alpha leaves."""
        return self.blends


Material = MaterialPbr | MaterialSimple
"""Any material."""


def texture_names(material: Material) -> list[str]:
    """The fields that hold textures, whether there are any or not."""
    return [field.name for field in fields(material) if field.name.endswith("_texture")]


def wraps_of(material: Material, name: str) -> WrapPair:
    """How the texture in field ``name`` wraps along u and v."""
    own = material.texture_wraps if isinstance(material, MaterialPbr) else None
    return (own or {}).get(name, (material.wrap_u, material.wrap_v))
