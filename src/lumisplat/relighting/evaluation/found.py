"""What a capture has found: its layers as a camera sees them, and its looks in other light."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lumisplat.config import Pipeline, RenderConfig, Shadows
from lumisplat.constants import SH_C0
from lumisplat.frame.frame_data import unpremultiplied
from lumisplat.math.arrays import FloatArray
from lumisplat.math.color import decode_srgb
from lumisplat.renderer.renderer import Renderer, create_renderer
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import Light
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.scene import Scene, SplatInstance


def with_albedo(gaussians: Gaussians) -> Gaussians:
    """The Gaussians with an albedo: theirs, else their captured colours without view dependence, decoded."""
    if gaussians.albedo is not None:
        return gaussians
    captured = np.clip(0.5 + SH_C0 * gaussians.sh[:, 0], 0.0, 1.0)
    return replace(gaussians, albedo=decode_srgb(captured))


@dataclass(frozen=True, slots=True)
class LayerRenderer:
    """Draws albedo, normals and roughness as relit frames have them."""

    renderer: Renderer
    unlit: Renderer
    lit_scene: Scene
    roughness_scene: Scene | None

    @classmethod
    def of(cls, gaussians: Gaussians, device: str) -> LayerRenderer:
        """Of Gaussians with an albedo."""
        lit = RenderConfig(
            background=None, lighting=True, shadows=Shadows.OFF, samples=1, aovs=("albedo",), pipeline=Pipeline.RASTER
        )
        painted = None
        if gaussians.roughness is not None:
            # Roughness as a colour that is blended as it is.
            values = np.repeat((gaussians.roughness[:, None, None] - 0.5) / SH_C0, 3, axis=2)
            painted = Scene(splats=(SplatInstance(replace(gaussians, sh=values)),))
        return cls(
            create_renderer(lit, device),
            create_renderer(RenderConfig(background=None, lighting=False), device),
            Scene(splats=(SplatInstance(gaussians, material=MaterialPbr()),)),
            painted,
        )

    def draw(self, camera: Camera) -> dict[str, FloatArray]:
        """Linear albedo (H, W, 3), unit normals (H, W, 3), zero where nothing is, and roughness (H, W, 1) if known."""
        frame = self.renderer.render(self.lit_scene, camera)
        assert frame.albedo is not None
        layers = {"albedo": unpremultiplied(frame.albedo, frame.alpha), "normal": frame.normal}
        if self.roughness_scene is not None:
            layers["roughness"] = self.unlit.render(self.roughness_scene, camera).straight()[..., :1]
        return layers


def relit_scene(gaussians: Gaussians, lights: tuple[Light, ...], scale: tuple[float, ...], specular: float) -> Scene:
    """The capture in other light, its albedo scaled and clipped.

    Args:
        gaussians: With an albedo.
        lights: All that there are.
        scale: Of the albedo, a factor a channel.
        specular: Strength of the highlights.
    """
    assert gaussians.albedo is not None
    scaled = replace(gaussians, albedo=np.clip(gaussians.albedo * np.array(scale), 0.0, 1.0))
    return Scene(splats=(SplatInstance(scaled, material=MaterialPbr(specular=specular)),), lights=lights)


def over_black(renderer: Renderer, scene: Scene, camera: Camera) -> FloatArray:
    """A frame without background as display colours over black, shape (H, W, 3), blended as photographs are."""
    pixels = renderer.render(scene, camera).pixels_srgb()
    return pixels[..., :3] * pixels[..., 3:]
