"""The plan of a frame, decided once: which passes run is read from it, how they work from the settings."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace

from lumisplat.config import (
    GaussianSurface,
    PathPrimary,
    Pipeline,
    Projection,
    RasterConfig,
    RasterStrategy,
    RenderConfig,
    ShadowMethod,
    Shadows,
)
from lumisplat.config.pipelines import Integrator, Visibility
from lumisplat.config.render import PATH_PARTS
from lumisplat.renderer.scene.materials import (
    absorbs,
    catcher_ambient,
    emits_capture_only,
    has_layers,
    is_medium,
    is_relit,
    is_rough_glass,
)
from lumisplat.scene.checks import with_checked
from lumisplat.scene.lights import AreaLight, Light, LightDirectional, LightEnvironment
from lumisplat.scene.materials import Material, MaterialPbr
from lumisplat.scene.scene import Scene

SAMPLES_UNLIMITED = 1_000_000
"""Most samples of a frame that ends by its time or its noise: no scene needs as many."""

SAMPLES_OF_RANDOM_LIGHT = 16
"""Samples of a pixel where light comes from random directions, or alpha is drawn, unless they are given: what noise is
left is fine grain."""

SAMPLES_OF_ENVIRONMENT_ON_SPLATS = 8
"""The same where an environment shines on splat sets alone: captures are rough, and 8 samples of them are as near to
many (41 dB on the biker) as 16 of meshes (42 dB on a duck), but cost more, as each ray crosses Gaussians."""

METAL_MIN = 0.5
"""Factor ``metallic`` from which on a rough material counts as a metal, which is black without what is around it."""

AMBIENT_RAYS_OF_FRAMES = 2
"""Shadow rays a frame in real time from each pixel that shows a shadow catcher: frames are averaged."""

SPECULAR_BOUNCES = 3
"""Reflections and refractions that a ray follows, unless told."""

PATH_BOUNCES = 8
"""Bounces of a path, unless told."""

SAMPLES_OF_PATHS = 64
"""Paths a pixel, unless told."""

CAPTURED_LIGHT_DRAWS = 32
"""Directions in which each pixel of a mesh looks for the light of a capture, over all samples of a frame: without
shadow rays they cost little, and a frame needs one sample only. docs/adr/0093-meshes-put-into-captures.md."""

UNLIT_AOVS = frozenset({"hits", "variance", "sample_count"})
"""Further images that unlit frames have, too."""

ENVIRONMENT = "the environment"
SOFT_LIGHTS = "lights that have a size"
REFLECTIONS = "what is around rough surfaces"


@dataclass(frozen=True, slots=True, eq=False)
class CapturedLight(LightEnvironment):
    """The light of captures around meshes, in place of the lights that a scene does not have."""


@dataclass(frozen=True, slots=True)
class SplatShadows:
    """On what splat sets may cast shadows."""

    on_reflecting: bool
    """On surfaces that reflect light: all sets do."""
    on_shadow_catchers: bool
    """On shadow catchers: sets that are none themselves do."""

    @classmethod
    def of(cls, scene: Scene) -> SplatShadows:
        """Of the splat sets of a scene, on what there is in it."""
        casting = [not instance.shadow_catcher for instance in scene.splats]
        return cls(reflects_light(scene) and bool(casting), any(casting) and not all(casting))

    @property
    def exist(self) -> bool:
        """Whether there are any."""
        return self.on_reflecting or self.on_shadow_catchers


ON_ALL = SplatShadows(on_reflecting=True, on_shadow_catchers=True)
"""Of rays whose receivers are not known."""


@dataclass(frozen=True, slots=True)
class FramePlan:
    """The passes of a frame."""

    is_lit: bool
    """Lights light the surfaces that reflect."""
    visibility: Visibility
    """How primary hits are found."""
    is_unscented: bool
    """They are rasterised along the rays of any lens, by sigma points; those of meshes are traced."""
    integrator: Integrator
    """How light is carried from there; that of an unlit frame is none by paths."""
    has_unshadowed: bool
    """Some surface reflects a light without a shadow: it casts none, the frame has none, or it is the headlight."""
    casts_shadows: bool
    """Shadow rays are followed: some light casts shadows, on some surface that something can shadow."""
    splat_shadows: SplatShadows
    """Which of these rays splat sets may block."""
    is_sampled: bool
    """Images are means of samples, computed from primary hits; otherwise `UnlitRaster` draws them in one go."""
    samples: int
    """Samples a pixel, at most; of no meaning unless the frame is sampled."""
    adapts: bool
    """Noisy pixels have more samples than others."""
    jitters: bool
    """Samples spread over their pixel. Those that nobody asked for do not where captures are kept: what shows only
    such a capture stays as captured."""
    jitters_meshes: bool
    """Those that nobody asked for spread over their pixel for meshes alone, where captures are kept."""
    samples_wanted: int
    """How many its light needs, so that none of it is grainy."""
    noise_sources: tuple[str, ...]
    """Light that comes from random directions, in words: too few samples show it as grain."""
    has_lobes: bool
    """Rough surfaces reflect what is around them, by a ray within their highlights."""
    max_bounces: int
    """How many times a ray is reflected or refracted by meshes, or passes those that blend, at most, 0 in scenes
    without any; or how many times a path is by any surface."""
    has_headlight: bool
    """A light at the camera replaces those that the scene does not have."""
    has_meshes: bool
    """The scene has mesh instances."""
    has_media: bool
    """Rays are refracted into meshes, and know which they are in."""
    absorbs: bool
    """Some medium inside a mesh absorbs light."""
    has_coatings: bool
    """Interactions have clearcoat, sheen, or light that is scattered more than once."""
    has_rough_glass: bool
    """Paths are scattered through rough surfaces."""
    has_shadow_catchers: bool
    """Some splat set is a shadow catcher, and not seen by paths: lights darken it."""
    ambient_rays: int
    """Shadow rays a sample, in random directions, from what shows a shadow catcher on which ambient light is given."""
    has_emissive_captures: bool
    """Some splat sets keep their captured colours."""
    relights: bool
    """Some splat sets are relit."""
    mixes_sets: bool
    """Both are there, and what they show is added up apart."""
    has_mean_surface: bool
    """Surfaces of relit Gaussians that are rasterised are weighted means."""
    has_receivers: bool
    """Paths find what shadow catchers receive, as there is something that takes or adds light."""
    shows_lights_in_haze: bool
    """Rays of paths may show lights behind Gaussians that are blended, such as captures that are kept."""
    aovs: frozenset[str]
    """Further images of the frame."""
    for_camera: bool
    """Rays are those of a camera's pixels, which see a background."""

    @property
    def rasterises(self) -> bool:
        """Primary hits are rasterised; otherwise traced."""
        return self.visibility is Visibility.RASTERISED

    @property
    def traces_paths(self) -> bool:
        """Light bounces in all directions, by paths."""
        return self.integrator in (Integrator.PATH, Integrator.REALTIME)

    @property
    def has_history(self) -> bool:
        """Each frame adds to what those before it have found."""
        return self.integrator is Integrator.REALTIME

    @property
    def follows_rays(self) -> bool:
        """Some rays traverse the hierarchies of Gaussians: from the camera, from mirrors, or to lights."""
        return self.integrator is not Integrator.DIRECT or (self.casts_shadows and self.splat_shadows.exist)

    @property
    def spawns_shadow_rays(self) -> bool:
        """Rays start at interactions: for shadows, for images of each light, or within highlights."""
        return self.casts_shadows or self.traces_paths or self.has_lobes or "lights" in self.aovs

    @property
    def draws_alpha(self) -> bool:
        """Rays meet surfaces of some alpha by chance, as in paths and where meshes are rasterised only.

        Else they go on behind such surfaces by the share that these leave. Media are met either way: who enters one
        leaves it, too.
        """
        return self.traces_paths or self.integrator is Integrator.DIRECT

    @property
    def has_path_layers(self) -> bool:
        """Paths say of their light whether the first surface has scattered it diffusely."""
        return self.traces_paths and bool(self.aovs & set(PATH_PARTS))

    @classmethod
    def of(cls, config: RenderConfig, scene: Scene) -> FramePlan:
        """The plan of a frame of a scene."""
        pipeline = config.pipeline
        bounces, is_path, is_realtime = pipeline.bounces_light, pipeline.traces_paths, pipeline.is_sequence
        is_lit = config.is_lit(by_default=scene.is_lit_by_default)
        traces_paths = bounces and is_lit
        rasterises, only_rasterises = pipeline.rasterises, not pipeline.spawns_rays
        is_unscented = rasterises and config.raster.projection is Projection.UNSCENTED
        has_captures, relights = has_emissive_captures(scene), any(is_relit(instance) for instance in scene.splats)
        reflects, splat_shadows = reflects_light(scene), SplatShadows.of(scene)
        in_haze = is_lit and shows_lights_in_haze(config, scene)
        if in_haze:
            splat_shadows = replace(splat_shadows, on_reflecting=True)
        has_blockers = splat_shadows.exist or bool(scene.meshes)
        casts_shadows = in_haze or (is_lit and has_blockers and lights_cast_shadows(config, scene))
        aovs = frozenset(config.aovs) if is_lit else UNLIT_AOVS & frozenset(config.aovs)
        has_mirrors = any(instance.mesh.material.sends_rays_on for instance in scene.meshes)
        all_cast = casts_shadows and all(light.casts_shadow for light in scene.lights)
        has_unshadowed = is_lit and not is_path and reflects and not all_cast
        noise_sources = random_light(config, scene) if not bounces and (has_unshadowed or casts_shadows) else ()
        follows = pipeline.integrator is Integrator.WHITTED and config.max_bounces != 0
        wants_lobes = has_rough_metal(scene) if config.glossy_reflections is None else config.glossy_reflections
        has_lobes = wants_lobes and follows and is_lit and reflects
        noise_sources += (REFLECTIONS,) * has_lobes
        has_media = not only_rasterises and any(is_medium(i, traces_paths=traces_paths) for i in scene.meshes)
        is_dithered = only_rasterises and any(instance.mesh.material.blends for instance in scene.meshes)
        samples_wanted = 1 if is_realtime else SAMPLES_OF_PATHS if traces_paths else samples_of(noise_sources, scene)
        samples_wanted = max(samples_wanted, SAMPLES_OF_RANDOM_LIGHT if is_dithered else 1)
        is_stochastic = config.raster.strategy is RasterStrategy.STOCHASTIC or is_dithered
        has_stop_criterion = config.time_limit is not None or config.noise is not None
        adapts = may_adapt(config) and (config.noise is not None if config.adaptive is None else config.adaptive)
        spreads = is_realtime or has_stop_criterion or config.samples is not None or not has_captures
        samples = config.samples or (SAMPLES_UNLIMITED if has_stop_criterion else samples_wanted)
        return cls(
            is_lit=is_lit,
            visibility=pipeline.visibility,
            is_unscented=is_unscented,
            integrator=pipeline.integrator if is_lit or not bounces else Integrator.WHITTED,
            has_unshadowed=has_unshadowed,
            casts_shadows=casts_shadows,
            splat_shadows=splat_shadows,
            is_sampled=is_lit or is_stochastic or bool(aovs) or not only_rasterises or is_unscented,
            samples=samples,
            adapts=adapts,
            jitters=may_jitter(config, is_lit=is_lit) and spreads,
            jitters_meshes=may_jitter(config, is_lit=is_lit) and not spreads and not adapts and bool(scene.meshes),
            samples_wanted=samples_wanted,
            noise_sources=noise_sources,
            has_lobes=has_lobes,
            max_bounces=bounces_of(config, is_lit=is_lit, has_mirrors=has_mirrors, has_lobes=has_lobes),
            has_headlight=is_lit
            and not scene.lights
            and not (bounces and config.lighting is None and has_emitters(scene)),
            has_meshes=bool(scene.meshes),
            has_media=has_media,
            absorbs=has_media and any(map(absorbs, scene.meshes)),
            has_coatings=is_lit and (config.energy_compensation or any(map(has_layers, materials_of(scene)))),
            has_rough_glass=traces_paths and any(map(is_rough_glass, scene.meshes)),
            ambient_rays=ambient_rays_of(config, scene, samples_wanted) * casts_shadows,
            has_emissive_captures=has_captures,
            relights=relights,
            mixes_sets=is_lit and has_captures and relights and blends_first(config),
            has_mean_surface=is_lit and rasterises and relights and finds_mean_surface(config.raster),
            has_shadow_catchers=is_lit and not is_path and any(instance.shadow_catcher for instance in scene.splats),
            has_receivers=casts_shadows and traces_paths and not is_realtime and adds_to_captures(scene),
            shows_lights_in_haze=in_haze,
            aovs=aovs,
            for_camera=True,
        )

    @classmethod
    def of_rays(cls, config: RenderConfig, scene: Scene) -> FramePlan:
        """The plan of rays that a caller gives: without a camera, its headlight, a background, and further images."""
        is_path = config.pipeline.traces_paths
        pipeline = Pipeline.PATH if is_path else Pipeline.TRACE
        lighting = config.lighting
        if lighting is None:
            lighting = bool(scene.lights) or (is_path and has_emitters(scene))
        limits = {"time_limit": None, "noise": None, "adaptive": False}  # samples alone end a ray
        plan = cls.of(with_checked(config, pipeline=pipeline, aovs=(), lighting=lighting, **limits), scene)
        has_headlight = plan.has_headlight and not (is_path and config.lighting is None)
        return replace(plan, for_camera=False, has_headlight=has_headlight, has_receivers=False)


def may_jitter(config: RenderConfig, *, is_lit: bool) -> bool:
    """Whether samples may be anywhere in their pixels; in real time, if frames are averaged."""
    if config.pipeline.is_sequence:
        return config.jitter and is_lit and config.realtime.of_quality.antialiasing
    return config.jitter


def blends_first(config: RenderConfig) -> bool:
    """Whether Gaussians on rays from the camera are blended, not met one at a time."""
    return not config.pipeline.traces_paths or config.path.primary is PathPrimary.ISO


def may_adapt(config: RenderConfig) -> bool:
    """Whether pixels may have different numbers of samples: rays find what they see, and each has its own chance."""
    shadows = config.shadow_rays
    return not config.pipeline.rasterises and not (shadows.method is ShadowMethod.STOCHASTIC and shadows.shared_draws)


def lights_cast_shadows(config: RenderConfig, scene: Scene) -> bool:
    """Whether anything casts shadows: a light, or in paths what shines by itself."""
    if config.shadows is Shadows.OFF:
        return False
    casts = any(light.enabled and light.casts_shadow for light in scene.lights)
    return casts or (config.pipeline.bounces_light and has_emitters(scene))


def shows_lights_in_haze(config: RenderConfig, scene: Scene) -> bool:
    """Whether rays of paths may show lights behind Gaussians that are blended, so that shadow rays say how much."""
    if not config.pipeline.bounces_light or config.shadows is Shadows.OFF:
        return False
    return (has_emissive_captures(scene) or blends_first(config)) and any(map(is_visible, scene.lights))


def adds_to_captures(scene: Scene) -> bool:
    """Whether there are shadow catchers, and something else that may take light from them or add some."""
    captured = [instance.shadow_catcher for instance in scene.splats]
    return any(captured) and (bool(scene.meshes) or not all(captured))


def ambient_rays_of(config: RenderConfig, scene: Scene, samples_wanted: int) -> int:
    """Shadow rays a sample that find how much of the ambient light around shadow catchers is open.

    Frames of one sample that nobody asked for have as many as their ambient light needs.
    """
    catchers = [instance for instance in scene.splats if instance.shadow_catcher]
    if not (adds_to_captures(scene) and any(any(catcher_ambient(one, scene)) for one in catchers)):
        return 0
    if config.pipeline.is_sequence:
        return AMBIENT_RAYS_OF_FRAMES
    return SAMPLES_OF_RANDOM_LIGHT if config.samples is None and samples_wanted == 1 else 1


def is_visible(light: Light) -> bool:
    """Whether paths show a light as a body."""
    return isinstance(light, AreaLight) and light.enabled and light.visible


def bounces_of(config: RenderConfig, *, is_lit: bool, has_mirrors: bool, has_lobes: bool) -> int:
    """How often light bounces at most; in real time, by smooth surfaces."""
    if config.pipeline.traces_paths and is_lit:
        return PATH_BOUNCES if config.max_bounces is None else config.max_bounces
    if not has_mirrors or not config.pipeline.spawns_rays:
        return int(has_lobes)
    return SPECULAR_BOUNCES if config.max_bounces is None else config.max_bounces


def has_emitters(scene: Scene) -> bool:
    """Whether something in a scene shines by itself, so that paths find light without any lamp."""
    return has_emissive_captures(scene) or any(material.is_emissive for material in materials_of(scene))


def materials_of(scene: Scene) -> list[Material]:
    """The materials of a scene that are given."""
    materials: list[Material] = [instance.mesh.material for instance in scene.meshes]
    return materials + [instance.material for instance in scene.splats if instance.material is not None]


def reflects_light(scene: Scene) -> bool:
    """Whether lights brighten anything: a mesh, or a splat set with a material that reflects."""
    return bool(scene.meshes) or not all(i.shadow_catcher or emits_capture_only(i) for i in scene.splats)


def finds_mean_surface(raster: RasterConfig) -> bool:
    """Whether the rasteriser finds weighted-mean surfaces: a sample of its stochastic strategy has one Gaussian."""
    return raster.surface is GaussianSurface.MEAN and raster.strategy is RasterStrategy.SORTED


def has_emissive_captures(scene: Scene) -> bool:
    """Whether some splat set keeps its captured colours in lit frames."""
    return not all(is_relit(instance) for instance in scene.splats)


def random_light(config: RenderConfig, scene: Scene) -> tuple[str, ...]:
    """The lights whose direction differs from sample to sample, in words."""
    lights = [light for light in scene.lights if light.enabled]
    environment = any(isinstance(light, LightEnvironment) for light in lights)
    environment = environment and not draws_captured_light(config.aovs, scene)
    soft = config.shadows is Shadows.SOFT and any(has_size(light) for light in lights)
    return (ENVIRONMENT,) * environment + (SOFT_LIGHTS,) * soft


def draws_captured_light(aovs: Collection[str], scene: Scene) -> bool:
    """Whether each sample looks for the light of captures in many directions, so that one sample is smooth.

    Images of single lights are added up by passes that look in one.
    """
    return "lights" not in aovs and any(isinstance(light, CapturedLight) for light in scene.lights)


def environment_draws(plan: FramePlan, scene: Scene) -> int:
    """Directions in which each interaction and sample looks for an environment that casts no shadow."""
    return math.ceil(CAPTURED_LIGHT_DRAWS / plan.samples) if draws_captured_light(plan.aovs, scene) else 1


def samples_of(noise_sources: tuple[str, ...], scene: Scene) -> int:
    """Samples a pixel that random light needs; one if there is none."""
    if not noise_sources:
        return 1
    return SAMPLES_OF_RANDOM_LIGHT if scene.meshes or SOFT_LIGHTS in noise_sources else SAMPLES_OF_ENVIRONMENT_ON_SPLATS


def has_rough_metal(scene: Scene) -> bool:
    """Whether a scene has a rough metal, which shows nothing but what it reflects, and something to be reflected."""
    rough = (
        isinstance(one, MaterialPbr) and one.metallic >= METAL_MIN and not one.is_smooth for one in materials_of(scene)
    )
    return len(scene.meshes) + len(scene.splats) > 1 and any(rough)


def has_size(light: Light) -> bool:
    """Whether soft shadows sample a light over its extent; an environment has none."""
    if isinstance(light, LightEnvironment):
        return False
    return isinstance(light, AreaLight) or (light.angle if isinstance(light, LightDirectional) else light.radius) > 0.0
