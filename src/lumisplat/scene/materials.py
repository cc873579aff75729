"""Surface materials for meshes and splats: metallic-roughness as in glTF 2.0, and a simpler one.

The surface colour of a mesh is ``base_color`` times texture and vertex colour. That of a splat set is the albedo of
its Gaussians if they have one and the material is not emissive, else the captured colour, decoded; ``base_color`` and
textures are not used. Roughness and metallic of the Gaussians, if they have them, replace those of the material.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import Enum
from typing import TYPE_CHECKING, TypeGuard

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import enum_member, is_flag, is_number, is_whole
from lumisplat.errors import SceneError
from lumisplat.math.arrays import FLOAT32_MAX, host_array
from lumisplat.scene.textures import Texture, TextureWrap, WrapPair, Wraps, checked_texture, checked_wraps

Color = tuple[float, float, float]


_LAYERS = ("clearcoat", "clearcoat_roughness", "sheen_roughness")


class AlphaMode(Enum):
    """What the alpha of a mesh's material means: ``alpha`` times that of the base colour texture (glTF 3.9.4)."""

    OPAQUE = "opaque"
    """Nothing."""
    MASK = "mask"
    """There is a surface where it is at least ``alpha_cutoff``, and none elsewhere."""
    BLEND = "blend"
    """It is the share of the surface that is there; what is behind shows through the rest."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MaterialPbr:
    """Metallic-roughness material (glTF 2.0 section 3.9, KHR_materials_{specular,ior,transmission,volume,...}).

    At roughness 0 the surface is smooth, and rays are reflected or refracted: a mirror where it is metallic, glass
    where it transmits. Unlit frames show the base colour of all other surfaces.

    Raises:
        SceneError: A value is outside its range, or a texture is not (H, W, 3 or 4) uint8.
    """

    base_color: Color = (0.8, 0.8, 0.8)
    """Linear Rec.709, 0..1; a factor of the texture, which ``(1, 1, 1)``, glTF's default, shows as it is."""
    metallic: float = 0.0
    """0..1: 0 is a dielectric, 1 a metal."""
    roughness: float = 0.5
    """Perceptual roughness, 0..1; exactly 0 is smooth. The roughness of splats is at least 0.03."""
    specular: float = 1.0
    """Strength of the dielectric reflection, 0..1."""
    ior: float = 1.5
    """Index of refraction, >= 1; with 1, light is neither reflected nor bent."""
    transmission: float = 0.0
    """Share of the light not reflected that is refracted through the dielectric, 0..1, tinted by the base colour at
    each crossing. The mesh should be closed and its triangles counter-clockwise from outside, which is how a ray
    decides whether it enters or leaves. Splats scatter that share back, and rough meshes do but in `Pipeline.PATH`."""
    thin_walled: bool = False
    """Whether the mesh is a wall without an inside: light goes straight through it, and what follows means nothing."""
    attenuation_color: Color = (1.0, 1.0, 1.0)
    """What white light becomes inside after ``attenuation_distance``, linear, 0..1."""
    attenuation_distance: float = math.inf
    """Scene units, above 0; inf: nothing is absorbed."""
    priority: int = 0
    """Where meshes that transmit overlap, the highest one's inside is there; of equal ones, that entered last."""
    clearcoat: float = 0.0
    """Strength of a clear coat over all of it, 0..1 (KHR_materials_clearcoat)."""
    clearcoat_roughness: float = 0.0
    """Of the coat, 0..1; below 0.03 as 0.03."""
    sheen_color: Color = (0.0, 0.0, 0.0)
    """Linear colour of the sheen of cloth, below the coat, 0..1; black: none (KHR_materials_sheen)."""
    sheen_roughness: float = 0.0
    """Of the sheen, 0..1: less of it is at grazing angles the higher; below 0.1 as 0.1."""
    emissive: Color = (0.0, 0.0, 0.0)
    """Emitted linear radiance, at least 0; on a splat set, a factor of the captured colour."""
    double_sided: bool = True
    """Whether meshes emit from the back of their triangles as well, from which these are clockwise. False: the back is
    black but for what it reflects, as with glTF's ``doubleSided``. Light is reflected on both sides either way."""
    base_color_texture: Texture | None = None
    """sRGB-encoded texels, shape (H, W, 3 or 4), row 0 at v = 0 (top, as in glTF); the fourth is alpha."""
    metallic_roughness_texture: Texture | None = None
    """Factors of roughness (green) and metallic (blue), linear."""
    normal_texture: Texture | None = None
    """Tangent-space normals ``2 c - 1``: x along u, y against v, z away from the surface."""
    normal_scale: float = 1.0
    """Factor of x and y of the normal texture."""
    occlusion_texture: Texture | None = None
    """Share of the environment's light that reaches the surface (red)."""
    occlusion_strength: float = 1.0
    """Strength of the occlusion, 0..1."""
    emissive_texture: Texture | None = None
    """sRGB-encoded factor of ``emissive``."""
    transmission_texture: Texture | None = None
    """Factor of ``transmission`` (red), linear."""
    clearcoat_texture: Texture | None = None
    """Factor of ``clearcoat`` (red), linear."""
    clearcoat_roughness_texture: Texture | None = None
    """Factor of ``clearcoat_roughness`` (green), linear."""
    sheen_color_texture: Texture | None = None
    """sRGB-encoded factor of ``sheen_color``."""
    sheen_roughness_texture: Texture | None = None
    """Factor of ``sheen_roughness`` (alpha), linear."""
    wrap_u: TextureWrap = TextureWrap.REPEAT
    """What textures show beyond their left and right edges; also by its value, ``"clamp"``."""
    wrap_v: TextureWrap = TextureWrap.REPEAT
    """The same beyond their upper and lower edges."""
    texture_wraps: Wraps | None = None
    """What single textures show there instead, along u and v: ``{"normal_texture": ("clamp", "repeat")}``."""
    alpha_mode: AlphaMode = AlphaMode.OPAQUE
    """What alpha means, on meshes; also by its value, ``"mask"``."""
    alpha: float = 1.0
    """Factor of the base colour texture's alpha, 0..1."""
    alpha_cutoff: float = 0.5
    """With ``AlphaMode.MASK``, the alpha from which on there is a surface, at least 0; above 1 there is none."""
    name: str = ""

    if TYPE_CHECKING:  # what is accepted; the fields above are what it becomes

        def __init__(
            self,
            *,
            base_color: npt.ArrayLike = (0.8, 0.8, 0.8),
            metallic: float = 0.0,
            roughness: float = 0.5,
            specular: float = 1.0,
            ior: float = 1.5,
            transmission: float = 0.0,
            thin_walled: bool = False,
            attenuation_color: npt.ArrayLike = (1.0, 1.0, 1.0),
            attenuation_distance: float = math.inf,
            priority: int = 0,
            clearcoat: float = 0.0,
            clearcoat_roughness: float = 0.0,
            sheen_color: npt.ArrayLike = (0.0, 0.0, 0.0),
            sheen_roughness: float = 0.0,
            emissive: npt.ArrayLike = (0.0, 0.0, 0.0),
            double_sided: bool = True,
            base_color_texture: Texture | None = None,
            metallic_roughness_texture: Texture | None = None,
            normal_texture: Texture | None = None,
            normal_scale: float = 1.0,
            occlusion_texture: Texture | None = None,
            occlusion_strength: float = 1.0,
            emissive_texture: Texture | None = None,
            transmission_texture: Texture | None = None,
            clearcoat_texture: Texture | None = None,
            clearcoat_roughness_texture: Texture | None = None,
            sheen_color_texture: Texture | None = None,
            sheen_roughness_texture: Texture | None = None,
            wrap_u: TextureWrap = TextureWrap.REPEAT,
            wrap_v: TextureWrap = TextureWrap.REPEAT,
            texture_wraps: Wraps | None = None,
            alpha_mode: AlphaMode = AlphaMode.OPAQUE,
            alpha: float = 1.0,
            alpha_cutoff: float = 0.5,
            name: str = "",
        ) -> None: ...

    def __post_init__(self) -> None:
        object.__setattr__(self, "base_color", _color("base_color", self.base_color, 1.0))
        object.__setattr__(self, "emissive", _color("emissive", self.emissive, math.inf))
        object.__setattr__(self, "sheen_color", _color("sheen_color", self.sheen_color, 1.0))
        for name in ("metallic", "roughness", "specular", "transmission", "occlusion_strength", *_LAYERS):
            _check_unit(name, getattr(self, name))
        self._check_inside()
        if not is_number(self.ior) or not 1.0 <= self.ior < np.inf:
            raise SceneError(f"ior is {self.ior}, expected at least 1")
        if not is_number(self.normal_scale) or not math.isfinite(self.normal_scale):
            raise SceneError(f"normal_scale is {self.normal_scale}, expected a finite number")
        for name in texture_names(self):
            object.__setattr__(self, name, checked_texture(name, getattr(self, name)))
        _check_alpha_and_wrap(self)
        object.__setattr__(self, "texture_wraps", checked_wraps(self.texture_wraps, texture_names(self)))

    def _check_inside(self) -> None:
        object.__setattr__(self, "attenuation_color", _color("attenuation_color", self.attenuation_color, 1.0))
        if not is_number(self.attenuation_distance) or not self.attenuation_distance > 0.0:
            raise SceneError(f"attenuation_distance is {self.attenuation_distance}, expected a length above 0, or inf")
        for name in ("thin_walled", "double_sided"):
            if not is_flag(getattr(self, name)):
                raise SceneError(f"{name} is {getattr(self, name)}, expected True or False")
        if not is_whole(self.priority) or not -(2**31) <= self.priority < 2**31:
            raise SceneError(f"priority is {self.priority}, expected a whole number of 32 bits")

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


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MaterialSimple:
    """Emission, diffuse reflection and a Phong highlight, each with its factor (docs/method/materials.md#simple).

    With the defaults a splat set shines as captured and reflects nothing, as it does without a material. If the diffuse
    and specular factors add up to more than 1, both are scaled down, so that no more light leaves than arrives.

    Raises:
        SceneError: A value is outside its range, or the texture is not (H, W, 3 or 4) uint8.
    """

    emissive: Color = (1.0, 1.0, 1.0)
    """Factor of the surface colour that shows without any light, at least 0."""
    ambient: Color = (0.0, 0.0, 0.0)
    """Factor of the surface colour that shows in lit frames, wherever the lights are, at least 0."""
    diffuse: Color = (0.0, 0.0, 0.0)
    """Factor of the surface colour that is reflected diffusely, 0..1."""
    specular: Color = (0.0, 0.0, 0.0)
    """Reflectance of the highlight around the mirror direction, 0..1."""
    shininess: float = 32.0
    """Exponent of the highlight, 0..10,000: higher is sharper."""
    base_color: Color = (1.0, 1.0, 1.0)
    """Linear Rec.709, 0..1."""
    base_color_texture: Texture | None = None
    """sRGB-encoded texels, as in `MaterialPbr`."""
    wrap_u: TextureWrap = TextureWrap.REPEAT
    """As in `MaterialPbr`, like what follows."""
    wrap_v: TextureWrap = TextureWrap.REPEAT
    alpha_mode: AlphaMode = AlphaMode.OPAQUE
    alpha: float = 1.0
    alpha_cutoff: float = 0.5
    name: str = ""

    if TYPE_CHECKING:  # what is accepted; the fields above are what it becomes

        def __init__(
            self,
            *,
            emissive: npt.ArrayLike = (1.0, 1.0, 1.0),
            ambient: npt.ArrayLike = (0.0, 0.0, 0.0),
            diffuse: npt.ArrayLike = (0.0, 0.0, 0.0),
            specular: npt.ArrayLike = (0.0, 0.0, 0.0),
            shininess: float = 32.0,
            base_color: npt.ArrayLike = (1.0, 1.0, 1.0),
            base_color_texture: Texture | None = None,
            wrap_u: TextureWrap = TextureWrap.REPEAT,
            wrap_v: TextureWrap = TextureWrap.REPEAT,
            alpha_mode: AlphaMode = AlphaMode.OPAQUE,
            alpha: float = 1.0,
            alpha_cutoff: float = 0.5,
            name: str = "",
        ) -> None: ...

    def __post_init__(self) -> None:
        for name, high in (
            ("emissive", math.inf),
            ("ambient", math.inf),
            ("diffuse", 1.0),
            ("specular", 1.0),
            ("base_color", 1.0),
        ):
            object.__setattr__(self, name, _color(name, getattr(self, name), high))
        if not is_number(self.shininess) or not 0.0 <= self.shininess <= 1e4:
            raise SceneError(f"shininess is {self.shininess}, expected 0 to 10,000")
        object.__setattr__(self, "base_color_texture", checked_texture("base_color_texture", self.base_color_texture))
        _check_alpha_and_wrap(self)

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


def _color(name: str, value: object, high: float) -> Color:
    """Three numbers in 0..high; one number stands for all three channels.

    Raises:
        SceneError: The value is neither.
    """
    values: object = (value,) * 3 if is_number(value) else host_array(value)
    color = [float(one) for one in values if is_number(one)] if _is_vector(values) and len(values) == 3 else []
    if len(color) != 3 or not all(0.0 <= one <= min(high, FLOAT32_MAX) for one in color):
        bound = f"in 0..{high:g}" if math.isfinite(high) else "of at least 0"
        raise SceneError(f"{name} is {value}, expected three numbers {bound}")
    return color[0], color[1], color[2]


def _is_vector(values: object) -> TypeGuard[Sequence[object]]:
    return isinstance(values, Sequence) or (isinstance(values, np.ndarray) and values.ndim == 1)


def _check_unit(name: str, value: object) -> None:
    if not is_number(value) or not 0.0 <= value <= 1.0:
        raise SceneError(f"{name} is {value}, expected 0..1")


def _check_alpha_and_wrap(material: MaterialPbr | MaterialSimple) -> None:
    """Takes enums that are given by their values, and checks alpha."""
    for name, kind in (("wrap_u", TextureWrap), ("wrap_v", TextureWrap), ("alpha_mode", AlphaMode)):
        object.__setattr__(material, name, enum_member(name, getattr(material, name), kind, SceneError))
    _check_unit("alpha", material.alpha)
    if not is_number(material.alpha_cutoff) or not 0.0 <= material.alpha_cutoff <= FLOAT32_MAX:
        raise SceneError(f"alpha_cutoff is {material.alpha_cutoff}, expected at least 0")
