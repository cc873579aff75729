"""Surface materials: metallic-roughness, as glTF 2.0 defines it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError
from lumisplat.scene.arrays import is_number, kept


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MaterialPbr:
    """Metallic-roughness material (glTF 2.0 section 3.9, KHR_materials_{specular,ior,transmission,volume}).

    Where roughness is 0 the surface is smooth, and the ray tracer follows what it reflects and lets through: a mirror
    where metallic, glass where transmission. The rasteriser, and the ray tracer where roughness is above 0, show the
    base colour alone.

    Raises:
        SceneError: A value is outside its range, or the texture is not (H, W, 3 or 4) uint8.
    """

    base_color: tuple[float, float, float] = (0.8, 0.8, 0.8)
    """Linear Rec.709, 0..1; multiplied with the texture and the vertex colour."""
    metallic: float = 0.0
    """0 dielectric, 1 metal."""
    roughness: float = 0.5
    """Perceptual roughness, 0..1; exactly 0 is smooth."""
    specular: float = 1.0
    """Strength of the dielectric reflection, 0..1."""
    ior: float = 1.5
    """Index of refraction, >= 1; 1 neither reflects nor bends light."""
    transmission: float = 0.0
    """Share of the light that is not reflected that goes on through the dielectric, refracted, and tinted by the base
    colour at each crossing, 0..1. The mesh should be closed, its triangles counter-clockwise from outside: that is how
    a ray knows whether it enters or leaves."""
    base_color_texture: npt.NDArray[np.uint8] | None = None
    """sRGB-encoded texels, shape (H, W, 3 or 4), row 0 at v = 0 (top, as in glTF); alpha is ignored."""
    name: str = ""

    def __post_init__(self) -> None:
        try:
            color = tuple(float(c) for c in self.base_color)
        except (TypeError, ValueError):
            color = ()
        if len(color) != 3 or not all(0.0 <= c <= 1.0 for c in color):
            raise SceneError(f"base_color is {self.base_color}, expected three numbers in 0..1")
        object.__setattr__(self, "base_color", color)
        for name in ("metallic", "roughness", "specular", "transmission"):
            value = getattr(self, name)
            if not is_number(value) or not 0.0 <= value <= 1.0:
                raise SceneError(f"{name} is {value}, expected 0..1")
        if not is_number(self.ior) or not 1.0 <= self.ior < np.inf:
            raise SceneError(f"ior is {self.ior}, expected at least 1")
        if self.base_color_texture is not None:
            texture = np.asarray(self.base_color_texture)
            if texture.dtype != np.uint8 or texture.ndim != 3 or texture.shape[2] not in (3, 4) or texture.size == 0:
                raise SceneError(
                    f"base_color_texture is {texture.dtype} {texture.shape}, expected uint8 (H, W, 3 or 4)"
                )
            object.__setattr__(self, "base_color_texture", kept(texture, np.uint8))
