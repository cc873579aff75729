"""Implements ``lumisplat.inverse.find_materials``: finds the materials of a capture and the light of its images."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import random
import time
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from lumisplat.config import MaterialsConfig, Pipeline, RenderConfig
from lumisplat.config.checks import check_kind
from lumisplat.constants import RADIANCE_LEAST
from lumisplat.errors import ConfigError, FormatError, MissingFileError, SceneError
from lumisplat.frame.frame import Frame
from lumisplat.io import save
from lumisplat.io.files.arrays import checked_array, read_arrays
from lumisplat.io.files.atomic import atomic_write, check_can_be_written
from lumisplat.io.images.radiance import write_radiance
from lumisplat.io.training_images.loading import TrainingImages, is_curvilinear, load_training_images
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.math.color import albedo_in_range, decode_srgb
from lumisplat.math.sh import even_directions
from lumisplat.progress import Progress, no_progress
from lumisplat.relighting.incident import neighbours_of
from lumisplat.relighting.irradiance import constant_radiance, mean_outgoing
from lumisplat.relighting.material_errors import AlbedoErrors, roughness_error
from lumisplat.relighting.seen_normals import rendered_normals
from lumisplat.renderer.gradients.differentiable_renderer import DifferentiableRenderer
from lumisplat.renderer.renderer import Renderer, create_renderer
from lumisplat.runtime.interrupts import deferred_interrupt
from lumisplat.scene.checks import check_argument
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import LightEnvironment
from lumisplat.scene.local_frame import LocalFrame
from lumisplat.scene.scene import Scene
from lumisplat.training.color_fit import CapturedColors, chosen_views, fit_colors
from lumisplat.training.lit_gaussians import IncidentRadiance, Materials, traced_incident
from lumisplat.training.material_fit import (
    MaterialFit,
    environment_image,
    fit_environment,
    white_radiance,
)
from lumisplat.training.material_parameters import materials_of
from lumisplat.training.run_folder import RunFolder, write_state
from lumisplat.training.train import CHECKPOINT_EVERY_S
from lumisplat.training.views import TargetPixels, TrainingView

EXPOSURE_VIEWS = 24
"""Largest number of images whose brightness is compared with renders of the capture, to find varying exposures."""

EXPOSURE_PIXELS = 64
"""Smallest number of unclipped pixels from which the exposure of an image is estimated."""

EXPOSURE_RANGE = (0.08, 0.92)
"""Display values between which a pixel counts as clipped neither at black nor at white."""

EXPOSURE_SPREAD_MAX = 0.25
"""Standard deviation of exposures, stops, above which a warning is logged.

Photographs taken with one exposure measure 0.1, rendered images 0.01."""

ALBEDO_ERRORS = AlbedoErrors(least=0.53, apart=2.5, dim=1.19)
"""Sources of error of albedos that `find_materials` finds, fitted to one trained capture of a glossy cow (decision
0143)."""

ROUGHNESS_ERRORS = 0.2, 0.27
"""``least`` and ``slope`` of `roughness_error`, fitted to the same capture as `ALBEDO_ERRORS`."""

METAL_ALBEDO = 0.6
"""Albedo of metals before the fits."""

_log = logging.getLogger("lumisplat")

ENVIRONMENT = ".environment.exr"
"""Suffix of the file beside a capture that holds its environment image, in place of the capture's ``.ply``."""


@dataclass(frozen=True, slots=True, eq=False)
class FoundMaterials:
    """Relightable capture and the environment that lit its images."""

    gaussians: Gaussians
    """Input Gaussians in their order with ``albedo``, ``roughness``, ``normals``, ``albedo_error`` and
    ``roughness_error``, and for metals ``metallic`` 1; the captured colours are unchanged."""
    environment: LightEnvironment
    """Environment around the capture, 16 x 32 pixels in world space, in units of display white."""
    error: float
    """Mean absolute difference between images and relit views over the last epoch, display-referred, 0..1; NaN if no
    iteration was run."""
    too_light: float
    """Fraction of Gaussians, weighted by visibility in the images, whose initial albedo was above 1 and was clamped.

    Such Gaussians are highlights, or their irradiance was underestimated."""


def find_materials(
    gaussians: Gaussians,
    images: TrainingImages | str | os.PathLike[str],
    config: MaterialsConfig | None = None,
    *,
    output: str | os.PathLike[str] | None = None,
    device: str = "auto",
    threads: int | None = None,
    progress: Progress | None = None,
) -> FoundMaterials:
    """Finds albedo, roughness and normals of a capture, and its environment, from the images that it was trained on.

    This is the second stage of Relightable 3D Gaussians (Gao et al. 2024), except that visibility and indirect radiance
    are ray traced instead of optimised. The geometry is fixed. Directions blocked by other Gaussians contribute the
    captured radiance of those Gaussians, so the environment is the only unknown light. The images determine only the
    product of light and albedo. The brightness and tint of the environment are therefore conventions: the lightest
    surfaces have albedo 0.8.

    Args:
        gaussians: Capture whose Gaussians lie on surfaces, such as one of `lumisplat.train` with surface terms.
        images: Images of the capture by pinhole cameras: a folder, or the result of
            `lumisplat.io.load_training_images`.
        config: Settings; None for the defaults.
        output: Capture to write with its materials, .ply. The environment is written as ``NAME.environment.exr`` beside
            it, and the state of the search into the folder ``NAME.training``. Repeating the same call resumes an
            interrupted search and returns the same bits. None writes nothing.
        device: As in `lumisplat.create_renderer`.
        threads: As in `lumisplat.create_renderer`.
        progress: Called with a description of the current work and the fraction done, 0..1.

    Returns:
        The relightable capture and its environment.

    Raises:
        ConfigError: ``output`` is not a .ply file, or a lens is distorted.
        FormatError: An image cannot be read, or a file cannot be written.
        SceneError: ``gaussians`` is not a `Gaussians`, or no image shows a surface of it.
    """
    config = config or MaterialsConfig()
    check_kind("config", config, MaterialsConfig)
    check_argument("find_materials", gaussians, Gaussians, "Gaussians", " (lumisplat.load reads files)")
    name = ".ply" if output is None else Path(output).name.lower()
    if not name.endswith(".ply") or name.endswith(".compressed.ply"):
        raise ConfigError(f"output is {output}, expected .ply: other capture formats cannot store materials")
    if output is not None:
        for path in (Path(output), environment_path(Path(output))):
            check_can_be_written(path)
    if not isinstance(images, TrainingImages):
        images = load_training_images(images)
    origin, frame = gaussians.origin, LocalFrame(np.asarray(gaussians.origin))
    gaussians = replace(gaussians, origin=(0.0, 0.0, 0.0))
    views = [TrainingView.of(image) for image in images.training]
    views = [replace(view, camera=frame.camera(view.camera)) for view in views]
    for view in views:
        if is_curvilinear(view.camera):
            raise ConfigError(
                f"image {view.name} has lens distortion, expected a pinhole: load the images with straighten=True"
            )
    files = None
    if output is not None:
        folder = RunFolder.of(Path(output)).path
        files = MaterialFiles.of(folder, gaussians, images.fingerprint, config)
    search = _Search(gaussians, views, config, files, device=device, threads=threads, progress=progress or no_progress)
    found = search.run()
    found = replace(found, gaussians=replace(found.gaussians, origin=origin))
    if output is not None:
        _write(Path(output), found)
    return found


class _Search:
    """One call of `find_materials`: traces incident radiance, fits the environment, then refines the materials."""

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

    def run(self) -> FoundMaterials:
        """Runs the material search, or continues it from its state files, and returns the result."""
        state = None if self._files is None else self._files.read()
        incident = None
        if state is None:
            state, incident = self._initial_state()
        materials, errors = self._refined(state, incident)
        relightable = replace(
            self._gaussians,
            normals=materials.normals.astype(np.float32),
            albedo=materials.albedo.astype(np.float32),
            roughness=materials.roughness.astype(np.float32),
            metallic=np.ones(self._gaussians.count, np.float32) if self._config.metal else None,
            albedo_error=self._albedo_error(materials),
            roughness_error=roughness_error(materials.roughness, *ROUGHNESS_ERRORS),
        )
        environment = LightEnvironment(
            environment_image(even_directions(self._config.directions), materials.environment)
        )
        error = float(np.mean(errors)) if errors else float("nan")
        return FoundMaterials(relightable, environment, error, state.too_light)

    def _albedo_error(self, materials: Materials) -> FloatArray:
        """Returns the half width of the 90 % interval of log albedo of N Gaussians, shape (N,).

        Their light is the captured radiance divided by the albedo, as in the images.
        """
        outgoing = mean_outgoing(self._gaussians, materials.normals)
        light = (outgoing / np.maximum(materials.albedo, RADIANCE_LEAST)).mean(axis=1)
        near = neighbours_of(self._gaussians)
        return ALBEDO_ERRORS.of(materials.albedo, light, materials.normals, near)

    def _initial_state(self) -> tuple[SearchState, IncidentRadiance]:
        """Returns the initial materials and environment, and the traced incident radiance."""
        config, gaussians = self._config, self._gaussians
        settings = RenderConfig(pipeline=Pipeline.RASTER, lighting=False)
        renderer = DifferentiableRenderer(settings, self._device, threads=self._threads, progress=self._progress)
        normals, weights, colors = self._surfaces(renderer)
        self._warn_of_exposures(renderer)
        directions = even_directions(config.directions)
        incident = self._incident(normals)
        white, outgoing = incident.irradiance(normals), mean_outgoing(gaussians, normals)
        roughness = np.full(gaussians.count, config.roughness)
        if config.metal:
            constant = np.full((len(directions), 3), constant_radiance(outgoing, white, weights))
            start = Materials(np.full((gaussians.count, 3), METAL_ALBEDO), roughness, normals, constant)
            start = self._metals(start, incident, colors)
        else:
            rng = np.random.default_rng([config.seed, 8])
            environment = fit_environment(
                outgoing, white, weights, directions, steps=config.environment_steps, rng=rng, report=self._progress
            )
            start = Materials(outgoing / white_radiance(white, environment), roughness, normals, environment)
        too_light = float(np.average(start.albedo.max(axis=1) > 1.0, weights=weights))
        state = SearchState(replace(start, albedo=albedo_in_range(start.albedo)), too_light)
        if self._files is not None:
            if config.iterations:
                self._files.write_incident(incident)
            self._files.write(state)
        return state, incident

    def _metals(self, start: Materials, incident: IncidentRadiance, colors: CapturedColors) -> Materials:
        """Returns the metals and the environment that explain the captured colours, found from a constant one."""
        return fit_colors(
            self._gaussians,
            incident,
            start,
            colors,
            seed=self._config.seed,
            device=self._device,
            threads=self._threads,
            report=self._progress,
        )

    def _surfaces(self, renderer: DifferentiableRenderer) -> tuple[Doubles, Doubles, CapturedColors]:
        """Returns each Gaussian's normal, its blending weight in all images, and, of metals, views of its colours."""
        cameras = [view.camera for view in self._views]
        kept: Sequence[int] = chosen_views(len(cameras)) if self._config.metal else ()
        normals, weights, by_view = rendered_normals(self._gaussians, cameras, renderer, self._progress, kept=kept)
        if not (by_view if kept else weights).any():
            raise SceneError(
                "no image shows the capture: expected images of the same scene with poses in the same coordinates"
            )
        return normals, weights, CapturedColors([cameras[index].eye for index in kept], by_view)

    def _warn_of_exposures(self, renderer: DifferentiableRenderer) -> None:
        """Logs a warning if the brightness of the images varies by more than `EXPOSURE_SPREAD_MAX`."""
        spread = exposure_spread(self._gaussians, self._views, renderer, self._progress)
        if spread > EXPOSURE_SPREAD_MAX:
            _log.warning(
                "image brightness varies by %.2g stops (standard deviation) relative to the capture: varying exposure "
                "distorts materials and light, or the capture was trained for too few iterations",
                spread,
            )

    def _incident(self, normals: Doubles) -> IncidentRadiance:
        directions = even_directions(self._config.directions)
        settings = RenderConfig(pipeline=Pipeline.TRACE, lighting=False)
        renderer = create_renderer(settings, self._device, threads=self._threads, progress=self._progress)
        return traced_incident(
            self._gaussians, normals, directions, renderer, seed=self._config.seed, report=self._progress
        )

    def _refined(self, state: SearchState, incident: IncidentRadiance | None) -> tuple[Materials, tuple[float, ...]]:
        """Runs the remaining iterations of the search; returns the materials with the environment, and L1 errors.

        The errors are those of the last epoch, one per image. Ctrl C ends the search after the current iteration.

        Args:
            state: State from which the search continues.
            incident: Traced incident radiance; None to read it from disk or trace it again.
        """
        total, start = self._config.iterations, state.start
        if total == 0:
            return start, ()
        if state.iteration == total:
            return materials_of(state.fit, start.normals), state.errors
        if incident is None:
            incident = (None if self._files is None else self._files.read_incident()) or self._incident(start.normals)
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
        if state.fit:
            fit.restore(state.fit, state.iteration)
        errors, saved = deque(state.errors, len(self._views)), time.monotonic()
        with deferred_interrupt() as is_interrupted:
            while fit.iteration < total and not is_interrupted():
                self._progress("finding materials", fit.iteration / total)
                errors.append(fit.step().l1)
                if time.monotonic() - saved >= CHECKPOINT_EVERY_S:
                    self._save(state, fit, errors)
                    saved = time.monotonic()
            self._save(state, fit, errors)
        if is_interrupted():
            raise KeyboardInterrupt
        if self._files is not None:
            self._files.remove_incident()
        self._progress("finding materials", 1.0)
        return fit.materials, tuple(errors)

    def _save(self, state: SearchState, fit: MaterialFit, errors: Iterable[float]) -> None:
        """Writes the state of the material search after the iterations that ``fit`` has completed."""
        if self._files is not None:
            self._files.write(replace(state, iteration=fit.iteration, fit=fit.state, errors=tuple(errors)))


def environment_path(output: Path) -> Path:
    """Returns the path of a capture's environment image: ``fox.environment.exr`` for ``fox.ply``."""
    return output.with_name(output.stem + ENVIRONMENT)


def _write(output: Path, found: FoundMaterials) -> None:
    """Writes capture and environment, both or neither.

    The environment is written after the capture's temporary file and before that file gets its final name.
    """
    image: FloatArray | None = found.environment.image
    assert image is not None
    with atomic_write(output) as temporary:
        try:
            save(temporary, found.gaussians)
        except FormatError as error:  # names the temporary file; report the output instead
            raise FormatError(output, error.problem) from None
        write_radiance(environment_path(output), image)


_COVERED_MIN = 0.99
"""Smallest alpha, and smallest loss weight, of the pixels from which the exposure of an image is estimated."""


def exposure_spread(gaussians: Gaussians, views: Sequence[TrainingView], renderer: Renderer, report: Progress) -> float:
    """Returns the standard deviation, over the images, of their brightness relative to the capture, stops.

    Args:
        gaussians: The capture.
        views: Its training views.
        renderer: Renderer of unlit raster frames.
        report: Progress callback.

    Returns:
        0 if fewer than three images have enough unclipped pixels.
    """
    scene, stops = Scene([gaussians]), list[float]()
    # A random sample, because bracketed exposures repeat every few images.
    chosen = random.Random(0).sample(views, min(len(views), EXPOSURE_VIEWS))
    for number, view in enumerate(chosen):
        report("comparing exposures", number / len(chosen))
        stops += _stops_brighter(view.read(), renderer.render(scene, view.camera))
    return float(np.std(stops)) if len(stops) >= 3 else 0.0


def _stops_brighter(target: TargetPixels, frame: Frame) -> list[float]:
    """Returns how many stops an image is brighter than a frame, by the ratio of their medians over unclipped pixels.

    Returns:
        A list of that one number; an empty list if too few pixels are unclipped.
    """
    image, shown = target.color.mean(axis=2), frame.color.mean(axis=2)
    inside = frame.alpha > _COVERED_MIN
    for brightness in (image, shown):
        inside = inside & (brightness > EXPOSURE_RANGE[0]) & (brightness < EXPOSURE_RANGE[1])
    for share in (target.weight, target.alpha):
        if share is not None:
            inside = inside & (share > _COVERED_MIN)
    if inside.sum() < EXPOSURE_PIXELS:
        return []
    medians = [float(np.median(decode_srgb(one[inside]))) for one in (image, shown)]
    return [math.log2(medians[0] / medians[1])]


VERSION = 1
_OF_START, _OF_FIT = "start.", "fit."
_SETTING_KEYS = {"environment_steps": "sky_steps"}
"""Key under which a setting enters the fingerprint of a search, where it differs from the field of `MaterialsConfig`.
"""

_MATERIAL_KEYS = {"albedo": "albedo", "roughness": "roughness", "normals": "normals", "environment": "sky"}
"""Key in the state file of each array of `Materials`, by its field."""


@dataclass(frozen=True, slots=True, eq=False)
class SearchState:
    """State from which a material search resumes, without its settings, images, capture and incident radiance."""

    start: Materials
    """Materials and environment before the first iteration."""
    too_light: float
    """Fraction of Gaussians whose initial albedo was clamped, as in `FoundMaterials.too_light`."""
    iteration: int = 0
    """Number of iterations completed."""
    fit: dict[str, Doubles] = field(default_factory=dict[str, Doubles])
    """Optimised materials and environment with their Adam moments, by name, as `MaterialFit.state`; empty before the
    first iteration."""
    errors: tuple[float, ...] = ()
    """Mean absolute errors (L1) of the latest iterations of the material search, at most one per image."""


@dataclass(frozen=True, slots=True)
class MaterialFiles:
    """Files that hold the state of one material search, in the folder beside its capture.

    A file that is damaged or belongs to another search is ignored: a warning is logged and the search starts again.
    """

    folder: Path
    fingerprint: str
    """Hash of the capture, images and settings of the material search; other files belong to another search."""
    count: int
    """Number of Gaussians of the capture."""
    directions: int
    """Number of directions in which incident radiance is traced."""

    @classmethod
    def of(cls, folder: Path, gaussians: Gaussians, images: str, config: MaterialsConfig) -> MaterialFiles:
        """Returns the state files of a material search.

        Args:
            folder: Folder of the files.
            gaussians: The capture.
            images: Fingerprint of the images.
            config: Settings.
        """
        settings = {_SETTING_KEYS.get(name, name): value for name, value in asdict(config).items()}
        if not config.metal:
            del settings["metal"]  # as before there were metals
        stored = hashlib.sha256(json.dumps([VERSION, images, settings, gaussians.antialiased]).encode())
        for name in ("means", "rotations_wxyz", "scales", "opacities", "sh"):
            stored.update(getattr(gaussians, name).tobytes())
        return cls(folder, stored.hexdigest(), gaussians.count, config.directions)

    @property
    def _state_path(self) -> Path:
        return self.folder / "materials.npz"

    @property
    def _incident_path(self) -> Path:
        return self.folder / "light.npz"

    def write(self, found: SearchState) -> None:
        """Writes the state of the material search to its file.

        Raises:
            FormatError: The file cannot be written.
        """
        arrays = {f"{_OF_START}{key}": getattr(found.start, name) for name, key in _MATERIAL_KEYS.items()}
        arrays |= {f"{_OF_FIT}{name}": values for name, values in found.fit.items()}
        arrays["errors"] = np.array(found.errors, np.float64)
        about = {"mark": self.fingerprint, "iteration": found.iteration, "too_light": found.too_light}
        write_state(self._state_path, arrays, about)

    def read(self) -> SearchState | None:
        """Returns the stored state of a material search; None if the file is missing, damaged or of another search."""
        content = self._read(self._state_path)
        if content is None:
            return None
        stored, arrays = content
        moved = {"albedo": (self.count, 3), "roughness": (self.count,), "sky": (self.directions, 3)}
        shapes = moved | {"normals": (self.count, 3)}
        try:
            start = Materials(
                *(
                    checked_array(arrays, f"{_OF_START}{key}", shapes[key], np.float64)
                    for key in _MATERIAL_KEYS.values()
                )
            )
            names = {name.removeprefix(_OF_FIT) for name in arrays if name.startswith(_OF_FIT)}
            expected = {f"{name}{part}": shape for name, shape in moved.items() for part in ("", ".first", ".second")}
            if names and names != expected.keys():
                raise ValueError("not the state of a fit")
            fit = {name: checked_array(arrays, f"{_OF_FIT}{name}", expected[name], np.float64) for name in names}
            errors = tuple(checked_array(arrays, "errors", (None,), np.float64).tolist())
            iteration = int(stored["iteration"])
            if iteration < 0 or (iteration > 0) != bool(names):
                raise ValueError("iteration does not match the state")
            return SearchState(start, float(stored["too_light"]), iteration, fit, errors)
        except (KeyError, TypeError, ValueError, OverflowError):
            self._warn_of_restart(self._state_path)
            return None

    def write_incident(self, incident: IncidentRadiance) -> None:
        """Writes the traced incident radiance of all Gaussians: a large file that is removed when the search ends.

        Raises:
            FormatError: The file cannot be written.
        """
        arrays = {name: getattr(incident, name) for name in IncidentRadiance.__slots__}
        write_state(self._incident_path, arrays, {"mark": self.fingerprint})

    def read_incident(self) -> IncidentRadiance | None:
        """Returns the stored incident radiance; None if the file is missing, damaged or of another search."""
        content = self._read(self._incident_path)
        if content is None:
            return None
        pairs = self.count, self.directions
        try:
            return IncidentRadiance(
                directions=checked_array(content[1], "directions", (self.directions, 3), np.float64),
                open=checked_array(content[1], "open", pairs, np.float32),
                seen=checked_array(content[1], "seen", (*pairs, 3), np.float32),
            )
        except ValueError:
            self._warn_of_restart(self._incident_path)
            return None

    def remove_incident(self) -> None:
        """Removes the file with the traced incident radiance, if there is one."""
        self._incident_path.unlink(missing_ok=True)

    def _read(self, path: Path) -> tuple[dict[str, Any], dict[str, Any]] | None:
        """Returns metadata and arrays of a state file; None if the file is missing, damaged or of another search."""
        try:
            arrays = read_arrays(path, "the state of a material search")
            stored: dict[str, Any] = json.loads(str(arrays.pop("about")))
            if stored["mark"] == self.fingerprint:
                return stored, arrays
        except MissingFileError:
            return None
        except FormatError as error:
            if "is damaged" not in error.problem:
                raise
        except (ValueError, LookupError, TypeError, RecursionError):
            pass
        self._warn_of_restart(path)
        return None

    @staticmethod
    def _warn_of_restart(path: Path) -> None:
        _log.warning(
            "%s: is damaged, or of another capture, other images or settings: the material search starts again", path
        )
