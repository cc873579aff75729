"""Radiance of camera rays by path tracing, bounce by bounce (Kajiya 1986; Veach 1997).

A wave is all rays of paths that are still alive after the same number of bounces.
"""

from __future__ import annotations

import warp as wp

from lumisplat.config import RenderConfig
from lumisplat.config.render import PATH_PARTS
from lumisplat.constants import SHADE_BANDS_PER_THREAD
from lumisplat.device.path.contributions import PARTS, PathImages, PathShadowRays
from lumisplat.device.path.opaque_blocks import OpaqueWave
from lumisplat.device.path.steps import PathData, PathSteps
from lumisplat.device.structs.rays import RayData
from lumisplat.renderer.integrators import opaque_path_kernels, path_kernels, path_wave_kernels
from lumisplat.renderer.integrators.opaque_paths import OpaquePaths
from lumisplat.renderer.integrators.sample_integrator import SampleIntegrator
from lumisplat.renderer.light.surfaces import Surfaces
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.shadow.shadow_rays import ShadowRays
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.renderer.trace.ray_tracer import RayTracer
from lumisplat.renderer.trace.ray_wave import CarriedState, LightImages, RayWave
from lumisplat.runtime.buffers import Buffers, DeviceArray, Struct, device_array
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.runtime.primitives import prefix_sum

SPAWNED_FIELDS = frozenset({"is_active", "t_max", "sample_key", "pixel_key", "sample"})
"""Fields of the next ray that `spawn_paths` computes from the previous ray, so that `PathSteps` needs no arrays for
them."""


class PathIntegrator(SampleIntegrator):
    """Computes the radiance of rays by path tracing, one path per ray.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings.
        tracer: Finds the hits of the paths' rays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig, tracer: RayTracer) -> None:
        self._launcher, self._buffers, self._tracer = launcher, buffers, tracer
        self._surfaces = Surfaces(launcher, buffers)
        self._shadows = ShadowRays(launcher, buffers, config)
        self._opaque = OpaquePaths(launcher, buffers)
        self._layers = PathLayers(buffers)

    def modules(self, plan: FramePlan) -> list[KernelModule]:
        """Returns the kernel modules of a frame, without the modules that find primary hits."""
        if self._follows_blocks(plan):
            return self._opaque.modules()
        modules = [path_wave_kernels, *self._tracer.modules(plan, bounced=True)]
        if not plan.shades_opaque_paths:
            modules += [path_kernels, *self._surfaces.modules()]
        else:
            modules += [opaque_path_kernels]
        if plan.casts_shadows:
            modules += self._shadows.modules(plan.splat_shadows, has_meshes=plan.has_meshes, incoherent=True)
        return modules

    def begin_sample(self, scene: DeviceScene, sample: int) -> None:
        """Begins sample ``sample`` of the frame: writes to the device what changes from sample to sample."""
        self._shadows.begin_sample(sample)

    def shade(self, scene: DeviceScene, plan: FramePlan, hits: PrimaryHits) -> RayWave:
        """Returns the camera rays with their radiance over all bounces.

        Args:
            scene: The device scene, synced.
            plan: Plan of the frame.
            hits: The rays and their hits.
        """
        with self._launcher.stage("light"):
            return self._follow(scene, plan, hits)

    def _follow(self, scene: DeviceScene, plan: FramePlan, hits: PrimaryHits) -> RayWave:
        """Traces the paths that begin at the camera rays' hits, bounce by bounce; returns the camera rays' radiance."""
        if self._follows_blocks(plan):
            first = self._surfaces.unshaded(plan, hits, 0, "path.wave0")
            self._opaque.follow(scene, plan, first, self._layers.begin(plan, first, lights=len(scene.lights.names)))
            return first
        paths = self._begin(plan, hits)
        first = wave = self._wave(scene, plan, hits, paths, 0)
        if first.count == 0:
            return first
        images = self._layers.begin(plan, first, lights=len(scene.lights.names))
        steps = self._extend(scene, plan, 0, wave=wave, paths=paths, images=images)
        for number in range(1, plan.max_bounces + 2):
            capacity = self._launcher.capacity_of(device_array(steps.next_ends))
            if capacity == 0:
                break
            rays = self._buffers.struct(f"path.rays{number % 2}", RayData, capacity)
            next_paths = self._paths(plan, number % 2, capacity)
            self._spawn(wave, paths, steps, number, rays=rays, next_paths=next_paths)
            paths = next_paths
            hits = self._tracer.find_hits(scene, rays, f"path{number % 2}", bounced=True)
            wave = self._wave(scene, plan, hits, paths, number)
            if number == 1 and plan.has_receivers:
                self._add_captured(scene, plan, wave, paths, images)
            steps = self._extend(scene, plan, number, wave=wave, paths=paths, images=images)
        return first

    def _follows_blocks(self, plan: FramePlan) -> bool:
        """Returns whether one kernel follows the paths of each block of camera rays over all bounces, without waves."""
        return plan.shades_opaque_paths and not self._launcher.is_parallel

    def light_images(self, scene: DeviceScene, plan: FramePlan, hits: PrimaryHits) -> LightImages:
        """Returns the layers by light, bounce and BSDF lobe that the frame requests, from the last `shade`."""
        return self._layers.images(plan)

    def _begin(self, plan: FramePlan, hits: PrimaryHits) -> PathData:
        """Returns a new path for each camera ray."""
        paths = self._paths(plan, 0, hits.count)
        self._launcher.run_banded(path_wave_kernels.begin_paths, hits.count, self._row("paths0", PathData, paths))
        return paths

    def _wave(self, scene: DeviceScene, plan: FramePlan, hits: PrimaryHits, paths: PathData, number: int) -> RayWave:
        """Evaluates the surfaces that the paths' rays hit; returns the rays' emission, before lights are sampled."""
        # Two sets of buffers suffice: one for the first wave, one for later waves, which end before the next begins.
        table = f"path.wave{_buffer_index(number)}"
        if plan.shades_opaque_paths:
            return self._surfaces.unshaded(plan, hits, min(number, 1), table)
        carried = CarriedState(media=device_array(paths.media) if plan.has_media and number > 0 else None)
        return self._surfaces.shade(
            scene,
            plan,
            hits,
            min(number, 1),
            carried=carried,
            may_branch=False,
            table=table,
        )

    def _add_captured(
        self, scene: DeviceScene, plan: FramePlan, wave: RayWave, paths: PathData, images: PathImages
    ) -> None:
        """Adds the irradiance on shadow catchers that the capture causes without added objects.

        The irradiance is sampled by the rays that leave the catchers.
        """
        count, run, no_shadows = wave.count, self._launcher.run_banded, not plan.casts_shadows
        rows = self._row("paths1", PathData, paths), self._row("images", PathImages, images)
        ends = self._buffers.get("path.receiver_ends", wp.float32, count)
        run(path_kernels.leave_receivers, count, wave.data, rows[0], ends)
        captured = self._tracer.find_captured(scene, wave.row.rays, ends, "path.captured")
        run(path_kernels.add_captured_light, count, no_shadows, scene.shading, wave.data, rows[0], captured, rows[1])
        if plan.ambient_rays == 0:
            return
        ambient = self._buffers.struct("path.ambient_rays", RayData, count)
        skips = self._buffers.get("path.ambient_skips", wp.bool, count)
        run(path_kernels.start_ambient_rays, count, wave.data, *rows, ambient, skips)
        with self._launcher.stage("shadow"):
            visibility = self._shadows.trace(
                scene, ambient, skips, "path.open", splat_shadows=plan.splat_shadows, incoherent=True
            )
        run(path_kernels.add_ambient_visibility, count, ambient, visibility, *rows)

    def _extend(
        self, scene: DeviceScene, plan: FramePlan, number: int, *, wave: RayWave, paths: PathData, images: PathImages
    ) -> PathSteps:
        """Adds the radiance at the rays' hits and from sampled lights to images; returns the next ray of each path."""
        count, run, no_shadows = wave.count, self._launcher.run_banded, not plan.casts_shadows
        bands = SHADE_BANDS_PER_THREAD * self._launcher.threads
        shadows, steps = self._shadow_rays(plan, count), self._steps(plan, count)
        rows = (
            self._row(f"paths{number % 2}", PathData, paths),
            self._row("shadows", PathShadowRays, shadows),
            self._row("images", PathImages, images),
        )
        scene_and_wave = scene.shading, wave.data
        step_row = self._row("steps", PathSteps, steps)
        is_last = number > plan.max_bounces
        with self._launcher.stage("shade"):
            if plan.shades_opaque_paths:
                inputs = number, no_shadows, is_last, opaque_wave(*scene_and_wave, *rows, step_row)
                run(opaque_path_kernels.shade_opaque_paths, count, *inputs, bands=bands)
            else:
                inputs = number, no_shadows, *scene_and_wave, *rows
                run(path_kernels.add_hit_radiance, count, *inputs, bands=bands)
                if is_last:
                    steps.goes_on.zero_()
                else:
                    run(path_kernels.continue_paths, count, *inputs, step_row, bands=bands)
        visibility = shadows.contributions
        if plan.casts_shadows and (not is_last or plan.shows_lights_in_haze):
            with self._launcher.stage("shadow"):
                visibility = self._shadows.trace(
                    scene,
                    shadows.rays,
                    shadows.skips,
                    "path.visibility",
                    opaque=shadows.opaque,
                    media=device_array(shadows.media) if plan.absorbs else None,
                    splat_shadows=plan.splat_shadows,
                    incoherent=True,
                )
        run(
            path_wave_kernels.add_sampled_light, count, number, scene.shading, wave.data, *rows[:2], visibility, rows[2]
        )
        prefix_sum(device_array(steps.goes_on), device_array(steps.next_ends), inclusive=True)
        return steps

    def _spawn(
        self, wave: RayWave, paths: PathData, steps: PathSteps, number: int, *, rays: RayData, next_paths: PathData
    ) -> None:
        """Writes the rays of paths after ``number`` bounces, and the paths that they belong to, without gaps."""
        rays.is_active.zero_()
        rows = (
            self._row(f"paths{(number - 1) % 2}", PathData, paths),
            self._row("steps", PathSteps, steps),
            rays,
            self._row(f"paths{number % 2}", PathData, next_paths),
        )
        self._launcher.run_banded(path_wave_kernels.spawn_paths, wave.count, wave.data, *rows)

    def _row(self, name: str, struct: type[Struct], arrays: Struct) -> DeviceArray:
        """Returns a struct of path arrays as a table with one row. Each thread would copy a struct passed by value.

        Rays after successive bounces alternate between two sets of arrays with fixed names, so that a recorded CUDA
        graph uploads no row.
        """
        return self._buffers.table(f"path.{name}.row", struct, [arrays])

    def _paths(self, plan: FramePlan, number: int, count: int) -> PathData:
        return self._buffers.struct(f"path.paths{number}", PathData, count, unused_fields(plan))

    def _steps(self, plan: FramePlan, count: int) -> PathSteps:
        steps = self._buffers.struct("path.steps", PathSteps, count, {"rays", "paths"})
        steps.rays = self._buffers.struct("path.step_rays", RayData, count, SPAWNED_FIELDS)
        steps.paths = self._buffers.struct("path.step_paths", PathData, count, {"root", *unused_fields(plan)})
        return steps

    def _shadow_rays(self, plan: FramePlan, count: int) -> PathShadowRays:
        """Returns arrays for shadow rays to sampled lights, and to lights that rays hit behind translucent captures."""
        total = 2 * count if plan.shows_lights_in_haze else count
        without = {"rays", *unused_fields(plan)}
        if "lights" not in plan.aovs:
            without |= {"unshadowed", "reaching"}
        if not plan.absorbs:
            without.add("media")
        shadows = self._buffers.struct("path.shadows", PathShadowRays, total, without)
        shadows.rays = self._buffers.struct("path.shadow_rays", RayData, total)
        return shadows


def opaque_wave(*rows: DeviceArray) -> OpaqueWave:
    """Returns tables as one kernel argument, in the order of the fields."""
    wave = OpaqueWave()
    wave.scene, wave.wave, wave.paths, wave.shadows, wave.images, wave.steps = rows
    return wave


def _buffer_index(number: int) -> int:
    """Returns which set of arrays rays after ``number`` bounces use: 0 for camera rays, then 1 and 2 in turn."""
    return 0 if number == 0 else 1 + number % 2


def unused_fields(plan: FramePlan) -> list[str]:
    """Returns the names of PathData fields for which a frame needs no arrays."""
    return ["diffuse"] * (not plan.has_path_layers) + ["media"] * (not plan.has_media)


class PathLayers:
    """Images that the paths of a sample add to, such as radiance by light and by bounce.

    Args:
        buffers: Holds the arrays.
    """

    def __init__(self, buffers: Buffers) -> None:
        self._buffers = buffers
        self._images = PathImages()

    def begin(self, plan: FramePlan, first: RayWave, lights: int) -> PathImages:
        """Returns the images that paths add to, such as radiance by light and by bounce, set to 0.

        The images of all light and of the light on shadow catchers are not new: they are the camera rays' radiance
        arrays.

        Args:
            plan: Plan of the frame, with its layers.
            first: The camera rays.
            lights: Number of lights of the frame.
        """
        count = first.count
        self._images = images = PathImages()
        images.light = first.row.radiance.light
        if plan.has_path_layers:
            images.parts = self._rows("parts", PARTS, count)
        if "bounces" in plan.aovs:
            images.bounces = self._rows("bounces", plan.max_bounces + 2, count)
        if "lights" in plan.aovs:
            images.lights_unshadowed = self._rows("lights_unshadowed", lights, count)
            images.lights_shadowed = self._rows("lights_shadowed", lights, count)
            images.lights_total = self._rows("lights_total", lights + 1, count)
        if plan.has_receivers:
            for name in (
                "received",
                "unshadowed",
                "shadowed",
                "emitted_unshadowed",
                "emitted_shadowed",
                "ambient",
                "open",
            ):
                setattr(images, name, getattr(first.row.radiance, name))
        return images

    def images(self, plan: FramePlan) -> LightImages:
        """Returns the layers that the frame requests, one array per image."""
        images, layers = self._images, dict[str, DeviceArray]()
        if plan.has_path_layers:
            parts = dict(zip(PATH_PARTS, self._images_of(images.parts), strict=True))
            layers |= {name: image for name, image in parts.items() if name in plan.aovs}
        if "bounces" in plan.aovs:
            layers |= {f"bounce{number}": image for number, image in enumerate(self._images_of(images.bounces))}
        if "lights" not in plan.aovs:
            return LightImages(layers=layers)
        layers |= {f"total{number}": image for number, image in enumerate(self._images_of(images.lights_total))}
        return LightImages(self._images_of(images.lights_unshadowed), self._images_of(images.lights_shadowed), layers)

    def _rows(self, name: str, rows: int, count: int) -> DeviceArray:
        """Returns an array of ``rows * count`` zeros, for ``rows`` images end to end."""
        array = self._buffers.get(f"path.{name}", wp.vec3, rows * count)
        array.zero_()
        return array

    def _images_of(self, rows: wp.array[wp.vec3]) -> list[DeviceArray]:
        """Splits an array of images end to end into one array per image."""
        count = len(self._images.light)
        return [device_array(rows)[first : first + count] for first in range(0, len(rows), count)]
