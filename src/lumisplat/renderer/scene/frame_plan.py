"""The plan of a frame: which passes run, computed once from settings and scene."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace

from lumisplat.config import (
    GaussianSurface,
    HitDistance,
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
from lumisplat.scene.camera import Camera, CameraModel
from lumisplat.scene.checks import with_checked
from lumisplat.scene.lights import AreaLight, Light, LightDirectional, LightEnvironment
from lumisplat.scene.materials import Material, MaterialPbr
from lumisplat.scene.scene import Scene

SAMPLES_UNLIMITED = 1_000_000
"""Largest number of samples per pixel of a frame that ends by time limit or target noise; no scene needs so many."""

SAMPLES_OF_RANDOM_LIGHT = 16
"""Default samples per pixel if light directions or alpha are sampled at random; the remaining noise is fine-grained."""

SAMPLES_OF_ENVIRONMENT_ON_SPLATS = 8
"""Default samples per pixel if an environment lights only splat sets. Captures are rough, so 8 samples are as close to
the converged image (41 dB on the biker) as 16 samples are for meshes (42 dB on a duck). Samples of captures cost more,
because each ray crosses Gaussians.
"""

METAL_MIN = 0.5
"""A rough material counts as metal if its ``metallic`` is at least this value. It then gets reflections, without which
it would be black."""

AMBIENT_RAYS_OF_FRAMES = 2
"""Ambient shadow rays per frame and pixel on shadow catchers in real time. Few are enough, because frames are
averaged."""

SPECULAR_BOUNCES = 3
"""Default largest number of reflections and refractions of a ray."""

PATH_BOUNCES = 8
"""Default largest number of bounces of a path."""

SAMPLES_OF_PATHS = 64
"""Default number of paths per pixel."""

CAPTURED_LIGHT_DRAWS = 32
"""Number of directions in which a mesh pixel samples an environment rendered from captures, summed over a frame's
samples. Directions cost little without shadow rays, so one sample per pixel suffices
(docs/adr/0093-meshes-in-captures-are-placed-automatically.md)."""

LISTED_REPEATS_MAX = 4
"""Camera rays find Gaussians through lists of tiles if assets have at most so many instances on average, weighted by
Gaussians. Each instance adds 130 bytes for each of its Gaussians to the lists, and with 50 instances a BVH is faster.
"""

UNLIT_AOVS = frozenset({"hits", "variance", "sample_count"})
"""Images in ``aovs`` that unlit frames support as well as lit frames."""

ENVIRONMENT = "the environment"
SOFT_LIGHTS = "lights with a size"
REFLECTIONS = "reflections in rough surfaces"


@dataclass(frozen=True, slots=True, eq=False)
class CapturedLight(LightEnvironment):
    """Environment light rendered from captures around meshes, for scenes without lights."""


@dataclass(frozen=True, slots=True)
class SplatShadows:
    """Surfaces on which splat sets may cast shadows: reflecting surfaces, shadow catchers, both or none."""

    on_reflecting: bool
    """True if splat sets cast shadows on surfaces that reflect light; all splat sets then do."""
    on_shadow_catchers: bool
    """True if splat sets cast shadows on shadow catchers; splat sets that are shadow catchers themselves do not."""

    @classmethod
    def of(cls, scene: Scene) -> SplatShadows:
        """Returns on which surfaces of a scene its splat sets may cast shadows."""
        casting = [not instance.shadow_catcher for instance in scene.splats]
        return cls(reflects_light(scene) and bool(casting), any(casting) and not all(casting))

    @property
    def exist(self) -> bool:
        """True if splat sets may cast shadows on any surface."""
        return self.on_reflecting or self.on_shadow_catchers


ON_ALL = SplatShadows(on_reflecting=True, on_shadow_catchers=True)
"""Splat shadows on reflecting surfaces and shadow catchers, for rays whose surface is unknown."""


@dataclass(frozen=True, slots=True)
class FramePlan:
    """Passes that a frame runs, computed from settings and scene."""

    is_lit: bool
    """True if the frame is lit, by ``RenderConfig.lighting`` or the scene's default; False: captured colours and base
    colours are shown as they are."""
    visibility: Visibility
    """Whether camera rays' hits (primary hits) are found by rasterisation or by ray tracing."""
    is_unscented: bool
    """True if Gaussians are rasterised by ``Projection.UNSCENTED``: projected by sigma points, for any lens, and
    evaluated on pixel rays. Meshes that pixels show are then found by ray tracing."""
    integrator: Integrator
    """Integrator of the frame. Unlit frames never have a path-tracing integrator."""
    has_unshadowed: bool
    """True if some light reaches a reflecting surface without a shadow test: the light or the whole frame casts no
    shadows, or the light is the headlight."""
    samples_unshadowed: bool
    """True if such light may come from the environment or from soft lights, which are sampled at random."""
    casts_shadows: bool
    """True if shadow rays are traced: some light casts shadows, and some object can block that light."""
    splat_shadows: SplatShadows
    """Surfaces (reflecting surfaces, shadow catchers) on which splat sets may cast shadows."""
    is_sampled: bool
    """True if images are means over samples of an integrator; False if `UnlitRaster` composites an unlit frame
    directly.
    """
    samples: int
    """Largest number of samples per pixel; meaningless if ``is_sampled`` is False."""
    adapts: bool
    """True if noisy pixels get more samples than others."""
    jitters: bool
    """True if samples are jittered within their pixel. By default they are not jittered if the scene has emissive
    captures, so that pixels showing only such a capture stay as captured."""
    jitters_meshes: bool
    """True if samples of meshes, but not of Gaussians, are jittered within their pixel: the default if the scene has
    emissive captures."""
    samples_wanted: int
    """Smallest number of samples per pixel at which the frame's randomly sampled lights show no visible noise."""
    noise_sources: tuple[str, ...]
    """Descriptions of the lights that are sampled in random directions, and are noisy with too few samples."""
    has_lobes: bool
    """True if rough surfaces reflect the scene by one ray, sampled from their specular lobe."""
    max_bounces: int
    """Largest number of bounces. For Whitted rays: reflections, refractions and passes through blended meshes; 0 if
    the scene has no such surfaces. For paths: scattering events at any surface."""
    has_headlight: bool
    """True if a headlight at the camera lights the scene, because the scene has no lights."""
    has_meshes: bool
    """True if the scene has mesh instances."""
    has_only_opaque_meshes: bool
    """True if all surfaces are meshes without mirrors, glass, clearcoat and sheen, so that paths need fewer kernels."""
    has_media: bool
    """True if rays refract into meshes; rays then store which meshes they are inside."""
    absorbs: bool
    """True if some mesh contains a medium that absorbs light."""
    has_coatings: bool
    """True if surfaces may have clearcoat, sheen, or compensation of multiple scattering."""
    has_rough_glass: bool
    """True if paths scatter through rough transmissive surfaces."""
    has_shadow_catchers: bool
    """True if some splat set is a shadow catcher and the frame is lit and not path-traced; shadows then darken the
    set's captured colours."""
    ambient_rays: int
    """Number of ambient shadow rays per sample from each visible shadow catcher, in random directions; 0 without
    ambient light."""
    has_emissive_captures: bool
    """True if some splat set emits its captured colours."""
    relights: bool
    """True if some splat set is relit: it reflects lights and hides its captured colours."""
    mixes_sets: bool
    """True if the scene has both emissive captures and relit sets, whose radiance is accumulated separately."""
    merges_sets: bool
    """True if the rasteriser merges several splat sets by the depths of their surfaces in each pixel."""
    has_mean_surface: bool
    """True if the rasteriser averages depth, roughness and metallic over a pixel's relit Gaussians to get the lit
    surface."""
    has_receivers: bool
    """True if paths estimate the irradiance on shadow catchers, because added objects may block or add light."""
    shows_lights_in_haze: bool
    """True if camera rays or paths may hit lights behind blended Gaussians, such as emissive captures."""
    aovs: frozenset[str]
    """Names of the additional images (AOVs) of the frame."""
    lists_gaussians: bool
    """True if camera rays find their Gaussians through lists by tiles of the image; False: they traverse BVHs, or are
    rasterised."""
    for_camera: bool
    """True for the rays of a camera's pixels, which show a background; False for rays from a caller."""

    @property
    def rasterises(self) -> bool:
        """True if primary hits are rasterised; otherwise they are traced."""
        return self.visibility is Visibility.RASTERISED

    @property
    def traces_paths(self) -> bool:
        """True if light bounces in all directions, as in path tracing, offline or in real time."""
        return self.integrator in (Integrator.PATH, Integrator.REALTIME)

    @property
    def has_history(self) -> bool:
        """True if frames reuse the lighting of earlier frames."""
        return self.integrator is Integrator.REALTIME

    @property
    def follows_rays(self) -> bool:
        """True if camera, secondary or shadow rays traverse the BVHs of Gaussians."""
        traces_camera_rays = not self.rasterises and not self.lists_gaussians
        return (
            traces_camera_rays
            or self.traces_paths
            or self.max_bounces > 0
            or (self.casts_shadows and self.splat_shadows.exist)
        )

    @property
    def spawns_shadow_rays(self) -> bool:
        """True if rays start at surfaces: shadow rays, rays for images of each light, or rays in specular lobes."""
        return self.casts_shadows or self.traces_paths or self.has_lobes or "lights" in self.aovs

    @property
    def draws_alpha(self) -> bool:
        """True if rays hit a translucent mesh at random, with probability alpha: in paths, and with direct light only.

        Frames with direct light only (``Pipeline.RASTER``) trace no rays behind the mesh that a pixel shows. If False,
        Whitted rays add the mesh with weight alpha and continue behind the mesh. Meshes that enclose a medium (glass)
        are always hit, so that a ray that enters them also leaves them.
        """
        return self.traces_paths or self.integrator is Integrator.DIRECT

    @property
    def shades_opaque_paths(self) -> bool:
        """True if one kernel does all shading of paths: the scene is simple, and no layer needs parts of the light."""
        return self.has_only_opaque_meshes and self.aovs <= UNLIT_AOVS and not self.shows_lights_in_haze

    @property
    def has_path_layers(self) -> bool:
        """True if paths record whether their first surface scattered the light diffusely or specularly."""
        return self.traces_paths and bool(self.aovs & set(PATH_PARTS))

    @classmethod
    def of(cls, config: RenderConfig, scene: Scene) -> FramePlan:
        """Returns the plan for a frame of a scene."""
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
            samples_unshadowed=has_unshadowed
            and (config.shadows is Shadows.SOFT or any(isinstance(light, LightEnvironment) for light in scene.lights)),
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
            has_only_opaque_meshes=has_only_opaque_meshes(config, scene),
            has_media=has_media,
            absorbs=has_media and any(map(absorbs, scene.meshes)),
            has_coatings=is_lit and (config.energy_compensation or any(map(has_layers, materials_of(scene)))),
            has_rough_glass=traces_paths and any(map(is_rough_glass, scene.meshes)),
            ambient_rays=ambient_rays_of(config, scene, samples_wanted) * casts_shadows,
            has_emissive_captures=has_captures,
            relights=relights,
            mixes_sets=is_lit and has_captures and relights and blends_first(config),
            merges_sets=rasterises and not is_unscented and merges_sets(config, scene, is_lit=is_lit),
            has_mean_surface=is_lit and rasterises and relights and finds_mean_surface(config.raster),
            has_shadow_catchers=is_lit and not is_path and any(instance.shadow_catcher for instance in scene.splats),
            has_receivers=casts_shadows and traces_paths and not is_realtime and adds_to_captures(scene),
            shows_lights_in_haze=in_haze,
            aovs=aovs,
            lists_gaussians=False,
            for_camera=True,
        )

    def with_lists(self, scene: Scene, camera: Camera | None) -> FramePlan:
        """Returns the plan with lists of Gaussians by tiles for traced camera rays, if tiles can bound the rays.

        They cannot if rays start apart, through an aperture or in parallel, or if some pixels have more rays than
        others. Scenes of many instances have no lists, which contain each instance's Gaussians, as BVHs do not.
        ``camera`` is the frame's; None: one that has lists.
        """
        starts_apart = camera is not None and (camera.aperture > 0.0 or camera.model is CameraModel.ORTHOGRAPHIC)
        assets = {id(instance.gaussians): len(instance.gaussians) for instance in scene.splats}
        listed = sum(len(instance.gaussians) for instance in scene.splats)
        repeats = listed > LISTED_REPEATS_MAX * sum(assets.values())
        return replace(self, lists_gaussians=not (self.rasterises or self.adapts or starts_apart or repeats))

    @classmethod
    def of_rays(cls, config: RenderConfig, scene: Scene) -> FramePlan:
        """Returns the plan for rays from a caller: without camera, headlight, background and additional images."""
        is_path = config.pipeline.traces_paths
        pipeline = Pipeline.PATH if is_path else Pipeline.TRACE
        lighting = config.lighting
        if lighting is None:
            lighting = bool(scene.lights) or (is_path and has_emitters(scene))
        limits = {"time_limit": None, "noise": None, "adaptive": False}  # only the number of samples ends a query
        plan = cls.of(with_checked(config, pipeline=pipeline, aovs=(), lighting=lighting, **limits), scene)
        has_headlight = plan.has_headlight and not (is_path and config.lighting is None)
        return replace(plan, for_camera=False, has_headlight=has_headlight, has_receivers=False)


def may_jitter(config: RenderConfig, *, is_lit: bool) -> bool:
    """Returns whether sub-pixel jitter is allowed; in real time, only in lit frames that antialiasing averages."""
    if config.pipeline.is_sequence:
        return config.jitter and is_lit and config.realtime.of_quality.antialiasing
    return config.jitter


def blends_first(config: RenderConfig) -> bool:
    """Returns whether the Gaussians on a camera ray are blended; otherwise the ray hits one of them at random."""
    return not config.pipeline.traces_paths or config.path.primary is PathPrimary.ISO


def may_adapt(config: RenderConfig) -> bool:
    """Returns whether pixels may have different numbers of samples.

    They may if camera rays are traced and the pixels have independent random numbers.
    """
    shadows = config.shadow_rays
    return not config.pipeline.rasterises and not (shadows.method is ShadowMethod.STOCHASTIC and shadows.shared_draws)


def lights_cast_shadows(config: RenderConfig, scene: Scene) -> bool:
    """Returns whether some light, or in path tracing some emissive surface, casts shadows."""
    if config.shadows is Shadows.OFF:
        return False
    casts = any(light.enabled and light.casts_shadow for light in scene.lights)
    return casts or (config.pipeline.bounces_light and has_emitters(scene))


def shows_lights_in_haze(config: RenderConfig, scene: Scene) -> bool:
    """Returns whether paths may hit visible lights behind translucent Gaussians; such lights need shadow rays."""
    if not config.pipeline.bounces_light or config.shadows is Shadows.OFF:
        return False
    return (has_emissive_captures(scene) or blends_first(config)) and any(map(is_visible, scene.lights))


def adds_to_captures(scene: Scene) -> bool:
    """Returns whether the scene has shadow catchers and other objects, which may block or add light on the catchers."""
    captured = [instance.shadow_catcher for instance in scene.splats]
    return any(captured) and (bool(scene.meshes) or not all(captured))


def ambient_rays_of(config: RenderConfig, scene: Scene, samples_wanted: int) -> int:
    """Returns the number of ambient shadow rays per sample from shadow catchers; 0 without ambient light.

    Real-time frames: 2. Frames that have one sample by default: 16, because one random ray would be noisy. Others: 1.
    """
    catchers = [instance for instance in scene.splats if instance.shadow_catcher]
    is_sequence = config.pipeline.is_sequence
    ambient = [catcher_ambient(one, scene, is_sequence=is_sequence) for one in catchers]
    if not (adds_to_captures(scene) and any(map(any, ambient))):
        return 0
    if is_sequence:
        return AMBIENT_RAYS_OF_FRAMES
    return SAMPLES_OF_RANDOM_LIGHT if config.samples is None and samples_wanted == 1 else 1


def is_visible(light: Light) -> bool:
    """Returns whether paths can hit a light as an object: an enabled, visible area light."""
    return isinstance(light, AreaLight) and light.enabled and light.visible


def bounces_of(config: RenderConfig, *, is_lit: bool, has_mirrors: bool, has_lobes: bool) -> int:
    """Returns the largest number of bounces: of paths in lit path-traced frames, else of rays off smooth surfaces.

    If a frame has neither paths nor smooth surfaces, the number is 1 if rough surfaces send a ray into their specular
    lobe (``has_lobes``), else 0.
    """
    if config.pipeline.traces_paths and is_lit:
        return PATH_BOUNCES if config.max_bounces is None else config.max_bounces
    if not has_mirrors or not config.pipeline.spawns_rays:
        return int(has_lobes)
    return SPECULAR_BOUNCES if config.max_bounces is None else config.max_bounces


def has_emitters(scene: Scene) -> bool:
    """Returns whether captures or meshes of a scene emit light, so that the scene is lit even without lights."""
    return has_emissive_captures(scene) or any(material.is_emissive for material in materials_of(scene))


def materials_of(scene: Scene) -> list[Material]:
    """Returns the materials of all meshes, and of all splat sets that have one."""
    materials: list[Material] = [instance.mesh.material for instance in scene.meshes]
    return materials + [instance.material for instance in scene.splats if instance.material is not None]


def has_only_opaque_meshes(config: RenderConfig, scene: Scene) -> bool:
    """Returns whether a scene has no Gaussians, and only materials whose BSDF has no mirror, glass and layers."""
    if scene.splats or not scene.meshes or config.energy_compensation:
        return False
    materials = materials_of(scene)
    transmits = any(isinstance(one, MaterialPbr) and one.transmission > 0.0 for one in materials)
    return not transmits and not any(one.is_smooth or has_layers(one) for one in materials)


def reflects_light(scene: Scene) -> bool:
    """Returns whether some surface reflects light: a mesh, or a splat set whose material reflects."""
    return bool(scene.meshes) or not all(i.shadow_catcher or emits_capture_only(i) for i in scene.splats)


def merges_sets(config: RenderConfig, scene: Scene, *, is_lit: bool) -> bool:
    """Returns whether sorted splats of several sets are merged by peaks: if rays would sort some set by peaks."""
    sorts_by_peaks = is_lit and any(is_relit(instance) for instance in scene.splats)
    if config.trace.hit_distance is not None:
        sorts_by_peaks = config.trace.hit_distance is not HitDistance.MEAN
    return sorts_by_peaks and len(scene.splats) > 1 and config.raster.strategy is RasterStrategy.SORTED


def finds_mean_surface(raster: RasterConfig) -> bool:
    """Returns whether the rasteriser averages the surface over a pixel's Gaussians, which needs sorted blending."""
    return raster.surface is GaussianSurface.MEAN and raster.strategy is RasterStrategy.SORTED


def has_emissive_captures(scene: Scene) -> bool:
    """Returns whether some splat set emits its captured colours in lit frames."""
    return not all(is_relit(instance) for instance in scene.splats)


def random_light(config: RenderConfig, scene: Scene) -> tuple[str, ...]:
    """Returns descriptions of the lights that are sampled in another direction for each sample."""
    lights = [light for light in scene.lights if light.enabled]
    environment = any(isinstance(light, LightEnvironment) for light in lights)
    environment = environment and not draws_captured_light(config.aovs, scene)
    soft = config.shadows is Shadows.SOFT and any(has_size(light) for light in lights)
    return (ENVIRONMENT,) * environment + (SOFT_LIGHTS,) * soft


def draws_captured_light(aovs: Collection[str], scene: Scene) -> bool:
    """Returns whether each sample covers many directions of an environment rendered from captures, without noise.

    False with the layers of single lights (``lights`` in ``aovs``), because their passes sample one direction at a
    time.
    """
    return "lights" not in aovs and any(isinstance(light, CapturedLight) for light in scene.lights)


def environment_draws(plan: FramePlan, scene: Scene) -> int:
    """Returns the number of directions, per surface point and sample, in which an unshadowed environment is sampled.

    For an environment rendered from captures, the number is `CAPTURED_LIGHT_DRAWS` divided by the number of samples.
    For other environments it is 1.
    """
    return math.ceil(CAPTURED_LIGHT_DRAWS / plan.samples) if draws_captured_light(plan.aovs, scene) else 1


def samples_of(noise_sources: tuple[str, ...], scene: Scene) -> int:
    """Returns the samples per pixel at which randomly sampled lights look smooth; 1 without such lights.

    ``noise_sources`` describes the lights.
    """
    if not noise_sources:
        return 1
    return SAMPLES_OF_RANDOM_LIGHT if scene.meshes or SOFT_LIGHTS in noise_sources else SAMPLES_OF_ENVIRONMENT_ON_SPLATS


def has_rough_metal(scene: Scene) -> bool:
    """Returns whether a scene has a rough metal, which shows only reflections, and an object that it can reflect."""
    rough = (
        isinstance(one, MaterialPbr) and one.mesh_metallic >= METAL_MIN and not one.is_smooth
        for one in materials_of(scene)
    )
    return len(scene.meshes) + len(scene.splats) > 1 and any(rough)


def has_size(light: Light) -> bool:
    """Returns whether soft shadows sample a light over its area, radius or angle; False for environments."""
    if isinstance(light, LightEnvironment):
        return False
    return isinstance(light, AreaLight) or (light.angle if isinstance(light, LightDirectional) else light.radius) > 0.0
