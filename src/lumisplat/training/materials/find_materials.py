"""Finds the materials of a capture and the light of its images: ``lumisplat.inverse.find_materials``."""

from __future__ import annotations

import logging
import math
import os
import random
import time
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lumisplat.config import MaterialsConfig, Pipeline, RenderConfig
from lumisplat.config.checks import check_kind
from lumisplat.errors import ConfigError, FormatError, SceneError
from lumisplat.frame.frame import Frame
from lumisplat.io import save
from lumisplat.io.files.atomic import atomic_write, check_can_be_written
from lumisplat.io.images.radiance import write_radiance
from lumisplat.io.training_images.loading import Photographs, is_bent, load_photographs
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.math.color import albedo_in_range, decode_srgb
from lumisplat.math.sh import even_directions
from lumisplat.progress import Progress, say_nothing
from lumisplat.relighting.irradiance import mean_outgoing
from lumisplat.renderer.renderer import Renderer, create_renderer
from lumisplat.renderer.splat_gradients import DifferentiableRenderer
from lumisplat.runtime.interrupts import interrupts_held
from lumisplat.scene.checks import check_argument
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import LightEnvironment
from lumisplat.scene.local_frame import LocalFrame
from lumisplat.scene.scene import Scene
from lumisplat.training.materials.lit_gaussians import IncidentRadiance, Materials, seen_normals, traced_incident
from lumisplat.training.materials.material_checkpoint import FoundSoFar, MaterialFiles
from lumisplat.training.materials.material_fit import MaterialFit, fitted_sky, lit_white, materials_of, sky_image
from lumisplat.training.run_folder import RunFolder
from lumisplat.training.train import CHECKPOINT_EVERY_S
from lumisplat.training.views import Picture, TrainingView

EXPOSURE_VIEWS = 24
"""Photographs whose exposures are compared, at most."""

EXPOSURE_PIXELS = 64
"""Of a photograph, at least, for it to tell."""

EXPOSURE_RANGE = (0.08, 0.92)
"""Display values between which neither black nor white has cut off what was there."""

EXPOSURES_DIFFER = 0.25
"""Standard deviation of exposures, stops, from which on it is said: photographs of one exposure have 0.1,
rendered ones 0.01."""

_log = logging.getLogger("lumisplat")

ENVIRONMENT = ".environment.exr"
"""What the file of the sky ends in."""


@dataclass(frozen=True, slots=True, eq=False)
class FoundMaterials:
    """A capture that can be relit, and the light that it was in."""

    gaussians: Gaussians
    """The same Gaussians in the same order, with ``albedo``, ``roughness`` and ``normals``; colours as they were."""
    environment: LightEnvironment
    """The sky around the capture, 16 x 32, in world space, in units of display white."""
    error: float
    """Mean difference between photographs and what materials and sky show, display-referred, of the last round of
    photographs; of no step, NaN."""
    too_light: float
    """Share of Gaussians, by how much of the photographs they are, whose albedo would have been above 1, and begins
    at 1 in its lightest channel: they are highlights, or the light that reaches them was underestimated."""


def find_materials(
    gaussians: Gaussians,
    photographs: Photographs | str | os.PathLike[str],
    config: MaterialsConfig | None = None,
    *,
    output: str | os.PathLike[str] | None = None,
    device: str = "auto",
    threads: int | None = None,
    progress: Progress | None = None,
) -> FoundMaterials:
    """Finds albedo, roughness and normals of a capture, and the sky around it, from the photographs it was made of.

    The second stage of Relightable 3D Gaussians (Gao et al. 2024), with light that is traced in place of light that is
    learnt: the geometry stays. Where other Gaussians block the sky, what they show in the capture shines on a Gaussian;
    only the sky is unknown. The product of light and albedo alone is seen: the brightness and the tint of the sky are
    conventions (lightest surfaces reflect 0.8).

    Args:
        gaussians: A capture whose Gaussians lie on surfaces, as of `lumisplat.train` with terms on them.
        photographs: Of it, a folder or what `lumisplat.io.load_photographs` has read; those of pinholes.
        config: Settings; None: the defaults.
        output: The capture with materials, .ply, beside which the sky is written as ``NAME.environment.exr``. The
            folder ``NAME.training`` has what is needed to go on: the same call again goes on where it was interrupted,
            to the same bits. None: nothing is written.
        device: As of `lumisplat.create_renderer`.
        threads: As of `lumisplat.create_renderer`.
        progress: Called with what is being done and the fraction done, 0..1.

    Raises:
        ConfigError: The output is no .ply, or a lens bends.
        FormatError: Photographs cannot be read, or a file cannot be written.
        SceneError: ``gaussians`` is something else, or no photograph shows a surface of it.
    """
    config = config or MaterialsConfig()
    check_kind("config", config, MaterialsConfig)
    check_argument("find_materials", gaussians, Gaussians, "Gaussians", " (lumisplat.load reads files)")
    name = ".ply" if output is None else Path(output).name.lower()
    if not name.endswith(".ply") or name.endswith(".compressed.ply"):
        raise ConfigError(f"output is {output}, expected a .ply: other captures have no columns for materials")
    if output is not None:
        for path in (Path(output), environment_path(Path(output))):
            check_can_be_written(path)
    if not isinstance(photographs, Photographs):
        photographs = load_photographs(photographs)
    origin, frame = gaussians.origin, LocalFrame(np.asarray(gaussians.origin))
    gaussians = replace(gaussians, origin=(0.0, 0.0, 0.0))
    views = [TrainingView.of(photograph) for photograph in photographs.training]
    views = [replace(view, camera=frame.camera(view.camera)) for view in views]
    for view in views:
        if is_bent(view.camera):
            raise ConfigError(f"photograph {view.name} is of a lens that bends: load photographs straightened")
    files = None
    if output is not None:
        folder = RunFolder.of(Path(output)).path
        files = MaterialFiles.of(folder, gaussians, photographs.fingerprint, config)
    search = _Search(gaussians, views, config, files, device=device, threads=threads, progress=progress or say_nothing)
    found = search.found()
    found = replace(found, gaussians=replace(found.gaussians, origin=origin))
    if output is not None:
        _write(Path(output), found)
    return found


class _Search:
    """One call of ``find_materials``."""

    def __init__(
        self,
        gaussians: Gaussians,
        views: list[TrainingView],
        config: MaterialsConfig,
        files: MaterialFiles | None,
        *,
        device: str,
        threads: int | None,
        progress: Progress,
    ) -> None:
        self._gaussians, self._views, self._config, self._files = gaussians, views, config, files
        self._device, self._threads, self._progress = device, threads, progress

    def found(self) -> FoundMaterials:
        """All of it."""
        so_far = None if self._files is None else self._files.read()
        incident = None
        if so_far is None:
            so_far, incident = self._begun()
        materials, errors = self._refined(so_far, incident)
        relightable = replace(
            self._gaussians,
            normals=materials.normals.astype(np.float32),
            albedo=materials.albedo.astype(np.float32),
            roughness=materials.roughness.astype(np.float32),
        )
        environment = LightEnvironment(sky_image(even_directions(self._config.directions), materials.sky))
        error = float(np.mean(errors)) if errors else float("nan")
        return FoundMaterials(relightable, environment, error, so_far.too_light)

    def _begun(self) -> tuple[FoundSoFar, IncidentRadiance]:
        """Where steps begin, and what was traced for them."""
        config, gaussians = self._config, self._gaussians
        settings = RenderConfig(pipeline=Pipeline.RASTER, lighting=False)
        renderer = DifferentiableRenderer(settings, self._device, threads=self._threads, progress=self._progress)
        normals, weights = self._normals(renderer)
        self._tell_exposures(renderer)
        directions = even_directions(config.directions)
        incident = self._incident(normals)
        white, outgoing = incident.irradiance(normals), mean_outgoing(gaussians, normals)
        rng = np.random.default_rng([config.seed, 8])
        sky = fitted_sky(outgoing, white, weights, directions, steps=config.sky_steps, rng=rng, report=self._progress)
        albedo = outgoing / lit_white(white, sky)
        too_light = float(np.average(albedo.max(axis=1) > 1.0, weights=weights))
        roughness = np.full(gaussians.count, config.roughness)
        so_far = FoundSoFar(Materials(albedo_in_range(albedo), roughness, normals, sky), too_light)
        if self._files is not None:
            if config.iterations:
                self._files.write_light(incident)
            self._files.write(so_far)
        return so_far, incident

    def _normals(self, renderer: DifferentiableRenderer) -> tuple[Doubles, Doubles]:
        """Of Gaussians, and how much of the photographs these are."""
        cameras = [view.camera for view in self._views]
        normals, weights = seen_normals(self._gaussians, cameras, renderer, self._progress)
        if not weights.any():
            raise SceneError("no photograph shows anything of the capture: they are of something else, or elsewhere")
        return normals, weights

    def _tell_exposures(self, renderer: DifferentiableRenderer) -> None:
        """Says so if photographs are brighter or darker than what the capture shows."""
        spread = exposure_spread(self._gaussians, self._views, renderer, self._progress)
        if spread > EXPOSURES_DIFFER:
            _log.warning(
                "photographs are brighter or darker than the capture, by %.2g stops (standard deviation): their "
                "exposure changes, and is taken for material and light, or the capture was trained by too few steps",
                spread,
            )

    def _incident(self, normals: Doubles) -> IncidentRadiance:
        directions = even_directions(self._config.directions)
        settings = RenderConfig(pipeline=Pipeline.TRACE, lighting=False)
        renderer = create_renderer(settings, self._device, threads=self._threads, progress=self._progress)
        return traced_incident(
            self._gaussians, normals, directions, renderer, seed=self._config.seed, report=self._progress
        )

    def _refined(self, so_far: FoundSoFar, incident: IncidentRadiance | None) -> tuple[Materials, tuple[float, ...]]:
        """Materials and sky after all steps, and their last errors; Ctrl C ends after a step.

        Args:
            so_far: From where they go on.
            incident: What was traced; None: it is read, or traced again.
        """
        total, start = self._config.iterations, so_far.start
        if total == 0:
            return start, ()
        if so_far.iteration == total:
            return materials_of(so_far.fit, start.normals), so_far.errors
        if incident is None:
            incident = (None if self._files is None else self._files.read_light()) or self._incident(start.normals)
        fit = MaterialFit(
            self._gaussians,
            self._views,
            incident,
            start,
            self._config,
            device=self._device,
            threads=self._threads,
            progress=self._progress,
        )
        if so_far.fit:
            fit.restore(so_far.fit, so_far.iteration)
        errors, saved = deque(so_far.errors, len(self._views)), time.monotonic()
        with interrupts_held() as is_interrupted:
            while fit.iteration < total and not is_interrupted():
                self._progress("finding materials", fit.iteration / total)
                errors.append(fit.step().l1)
                if time.monotonic() - saved >= CHECKPOINT_EVERY_S:
                    self._save(so_far, fit, errors)
                    saved = time.monotonic()
            self._save(so_far, fit, errors)
        if is_interrupted():
            raise KeyboardInterrupt
        if self._files is not None:
            self._files.forget_light()
        self._progress("finding materials", 1.0)
        return fit.materials, tuple(errors)

    def _save(self, so_far: FoundSoFar, fit: MaterialFit, errors: Iterable[float]) -> None:
        """Keeps what was found until now."""
        if self._files is not None:
            self._files.write(replace(so_far, iteration=fit.iteration, fit=fit.state, errors=tuple(errors)))


def environment_path(output: Path) -> Path:
    """The file of the sky beside a capture."""
    return output.with_name(output.stem + ENVIRONMENT)


def _write(output: Path, found: FoundMaterials) -> None:
    """Both or neither: the sky gets its name once the capture is on the disk, and then the capture does."""
    image: FloatArray | None = found.environment.image
    assert image is not None
    with atomic_write(output) as temporary:
        try:
            save(temporary, found.gaussians)
        except FormatError as error:  # of the temporary file, which nobody has named
            raise FormatError(output, error.problem) from None
        write_radiance(environment_path(output), image)


_INSIDE = 0.99
"""Alpha, or weight, from which on a pixel shows nothing else, or counts."""


def exposure_spread(gaussians: Gaussians, views: Sequence[TrainingView], renderer: Renderer, report: Progress) -> float:
    """Standard deviation of how bright photographs are relative to what the capture shows, stops.

    Args:
        gaussians: The capture.
        views: The photographs.
        renderer: Rasterises without light.
        report: Progress.

    Returns:
        0 where fewer than three photographs tell.
    """
    scene, stops = Scene([gaussians]), list[float]()
    # In no order: bracketed exposures come again every few photographs.
    chosen = random.Random(0).sample(views, min(len(views), EXPOSURE_VIEWS))
    for number, view in enumerate(chosen):
        report("comparing exposures", number / len(chosen))
        stops += _stops_beyond(view.read(), renderer.render(scene, view.camera))
    return float(np.std(stops)) if len(stops) >= 3 else 0.0


def _stops_beyond(picture: Picture, frame: Frame) -> list[float]:
    """By how many stops a photograph is brighter: the ratio of medians over pixels that neither end has cut off.

    Returns:
        Nothing where these are few.
    """
    photograph, shown = picture.color.mean(axis=2), frame.color.mean(axis=2)
    inside = frame.alpha > _INSIDE
    for brightness in (photograph, shown):
        inside = inside & (brightness > EXPOSURE_RANGE[0]) & (brightness < EXPOSURE_RANGE[1])
    for share in (picture.weight, picture.alpha):
        if share is not None:
            inside = inside & (share > _INSIDE)
    if inside.sum() < EXPOSURE_PIXELS:
        return []
    medians = [float(np.median(decode_srgb(one[inside]))) for one in (photograph, shown)]
    return [math.log2(medians[0] / medians[1])]
