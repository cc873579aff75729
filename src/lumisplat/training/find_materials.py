"""Finds the materials of a capture and the light of its images: ``lumisplat.inverse.find_materials``."""

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
from lumisplat.relighting.irradiance import mean_outgoing
from lumisplat.renderer.gradients.differentiable_renderer import DifferentiableRenderer
from lumisplat.renderer.renderer import Renderer, create_renderer
from lumisplat.runtime.interrupts import deferred_interrupt
from lumisplat.scene.checks import check_argument
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import LightEnvironment
from lumisplat.scene.local_frame import LocalFrame
from lumisplat.scene.scene import Scene
from lumisplat.training.lit_gaussians import IncidentRadiance, Materials, rendered_normals, traced_incident
from lumisplat.training.material_fit import (
    MaterialFit,
    environment_image,
    fit_environment,
    materials_of,
    white_radiance,
)
from lumisplat.training.run_folder import RunFolder, write_state
from lumisplat.training.train import CHECKPOINT_EVERY_S
from lumisplat.training.views import TargetPixels, TrainingView

EXPOSURE_VIEWS = 24
"""Photographs whose exposures are compared, at most."""

EXPOSURE_PIXELS = 64
"""Of a photograph, at least, for it to tell."""

EXPOSURE_RANGE = (0.08, 0.92)
"""Display values between which neither black nor white has cut off what was there."""

EXPOSURE_SPREAD_MAX = 0.25
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
    images: TrainingImages | str | os.PathLike[str],
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
        images: Of it, a folder or what `lumisplat.io.load_training_images` has read; those of pinholes.
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
    if not isinstance(images, TrainingImages):
        images = load_training_images(images)
    origin, frame = gaussians.origin, LocalFrame(np.asarray(gaussians.origin))
    gaussians = replace(gaussians, origin=(0.0, 0.0, 0.0))
    views = [TrainingView.of(image) for image in images.training]
    views = [replace(view, camera=frame.camera(view.camera)) for view in views]
    for view in views:
        if is_curvilinear(view.camera):
            raise ConfigError(f"photograph {view.name} is of a lens that bends: load photographs straightened")
    files = None
    if output is not None:
        folder = RunFolder.of(Path(output)).path
        files = MaterialFiles.of(folder, gaussians, images.fingerprint, config)
    search = _Search(gaussians, views, config, files, device=device, threads=threads, progress=progress or no_progress)
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
        )
        environment = LightEnvironment(
            environment_image(even_directions(self._config.directions), materials.environment)
        )
        error = float(np.mean(errors)) if errors else float("nan")
        return FoundMaterials(relightable, environment, error, state.too_light)

    def _initial_state(self) -> tuple[SearchState, IncidentRadiance]:
        """Where steps begin, and what was traced for them."""
        config, gaussians = self._config, self._gaussians
        settings = RenderConfig(pipeline=Pipeline.RASTER, lighting=False)
        renderer = DifferentiableRenderer(settings, self._device, threads=self._threads, progress=self._progress)
        normals, weights = self._normals(renderer)
        self._warn_of_exposures(renderer)
        directions = even_directions(config.directions)
        incident = self._incident(normals)
        white, outgoing = incident.irradiance(normals), mean_outgoing(gaussians, normals)
        rng = np.random.default_rng([config.seed, 8])
        environment = fit_environment(
            outgoing, white, weights, directions, steps=config.sky_steps, rng=rng, report=self._progress
        )
        albedo = outgoing / white_radiance(white, environment)
        too_light = float(np.average(albedo.max(axis=1) > 1.0, weights=weights))
        roughness = np.full(gaussians.count, config.roughness)
        state = SearchState(Materials(albedo_in_range(albedo), roughness, normals, environment), too_light)
        if self._files is not None:
            if config.iterations:
                self._files.write_incident(incident)
            self._files.write(state)
        return state, incident

    def _normals(self, renderer: DifferentiableRenderer) -> tuple[Doubles, Doubles]:
        """Of Gaussians, and how much of the photographs these are."""
        cameras = [view.camera for view in self._views]
        normals, weights = rendered_normals(self._gaussians, cameras, renderer, self._progress)
        if not weights.any():
            raise SceneError("no photograph shows anything of the capture: they are of something else, or elsewhere")
        return normals, weights

    def _warn_of_exposures(self, renderer: DifferentiableRenderer) -> None:
        """Says so if photographs are brighter or darker than what the capture shows."""
        spread = exposure_spread(self._gaussians, self._views, renderer, self._progress)
        if spread > EXPOSURE_SPREAD_MAX:
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

    def _refined(self, state: SearchState, incident: IncidentRadiance | None) -> tuple[Materials, tuple[float, ...]]:
        """Materials and sky after all steps, and their last errors; Ctrl C ends after a step.

        Args:
            state: From where they go on.
            incident: What was traced; None: it is read, or traced again.
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
        """Keeps what was found until now."""
        if self._files is not None:
            self._files.write(replace(state, iteration=fit.iteration, fit=fit.state, errors=tuple(errors)))


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
        stops += _stops_brighter(view.read(), renderer.render(scene, view.camera))
    return float(np.std(stops)) if len(stops) >= 3 else 0.0


def _stops_brighter(target: TargetPixels, frame: Frame) -> list[float]:
    """By how many stops a photograph is brighter: the ratio of medians over pixels that neither end has cut off.

    Returns:
        Nothing where these are few.
    """
    image, shown = target.color.mean(axis=2), frame.color.mean(axis=2)
    inside = frame.alpha > _INSIDE
    for brightness in (image, shown):
        inside = inside & (brightness > EXPOSURE_RANGE[0]) & (brightness < EXPOSURE_RANGE[1])
    for share in (target.weight, target.alpha):
        if share is not None:
            inside = inside & (share > _INSIDE)
    if inside.sum() < EXPOSURE_PIXELS:
        return []
    medians = [float(np.median(decode_srgb(one[inside]))) for one in (image, shown)]
    return [math.log2(medians[0] / medians[1])]


VERSION = 1
_OF_START, _OF_FIT = "start.", "fit."
_MATERIAL_KEYS = {"albedo": "albedo", "roughness": "roughness", "normals": "normals", "environment": "sky"}
"""Array names in the file, by field of `Materials`."""


@dataclass(frozen=True, slots=True, eq=False)
class SearchState:
    """Everything that the next step depends on, but for settings, photographs, the capture and traced light."""

    start: Materials
    """Where steps begin."""
    too_light: float
    """Of the start, as of `FoundMaterials`."""
    iteration: int = 0
    """Steps that were made."""
    fit: dict[str, Doubles] = field(default_factory=dict[str, Doubles])
    """What moves, and its moments; empty before the first step."""
    errors: tuple[float, ...] = ()
    """Of the last steps, at most as many as there are photographs."""


@dataclass(frozen=True, slots=True)
class MaterialFiles:
    """The files of one search.

    A file of another search, or a damaged one, is as good as none: then the search begins anew, and a log line says so.
    """

    folder: Path
    fingerprint: str
    """What tells the search from others."""
    count: int
    """Gaussians of the capture."""
    directions: int
    """Directions in which light is traced."""

    @classmethod
    def of(cls, folder: Path, gaussians: Gaussians, images: str, config: MaterialsConfig) -> MaterialFiles:
        """Those of a capture, photographs with this fingerprint, and settings."""
        stored = hashlib.sha256(json.dumps([VERSION, images, asdict(config), gaussians.antialiased]).encode())
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
        """Writes what was found so far.

        Raises:
            FormatError: It cannot be written.
        """
        arrays = {f"{_OF_START}{key}": getattr(found.start, name) for name, key in _MATERIAL_KEYS.items()}
        arrays |= {f"{_OF_FIT}{name}": values for name, values in found.fit.items()}
        arrays["errors"] = np.array(found.errors, np.float64)
        about = {"mark": self.fingerprint, "iteration": found.iteration, "too_light": found.too_light}
        write_state(self._state_path, arrays, about)

    def read(self) -> SearchState | None:
        """What was found so far, if anything."""
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
                raise ValueError("no state of a fit")
            fit = {name: checked_array(arrays, f"{_OF_FIT}{name}", expected[name], np.float64) for name in names}
            errors = tuple(checked_array(arrays, "errors", (None,), np.float64).tolist())
            iteration = int(stored["iteration"])
            if iteration < 0 or (iteration > 0) != bool(names):
                raise ValueError("steps that do not fit the state")
            return SearchState(start, float(stored["too_light"]), iteration, fit, errors)
        except (KeyError, TypeError, ValueError, OverflowError):
            self._warn_anew(self._state_path)
            return None

    def write_incident(self, incident: IncidentRadiance) -> None:
        """Writes what was traced: large, and only needed until the end.

        Raises:
            FormatError: It cannot be written.
        """
        arrays = {name: getattr(incident, name) for name in IncidentRadiance.__slots__}
        write_state(self._incident_path, arrays, {"mark": self.fingerprint})

    def read_incident(self) -> IncidentRadiance | None:
        """What was traced, if it is still there."""
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
            self._warn_anew(self._incident_path)
            return None

    def remove_incident(self) -> None:
        """Removes what was traced."""
        self._incident_path.unlink(missing_ok=True)

    def _read(self, path: Path) -> tuple[dict[str, Any], dict[str, Any]] | None:
        """What a file tells and holds; None: it is not there, or not of this search."""
        try:
            arrays = read_arrays(path, "what was found so far")
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
        self._warn_anew(path)
        return None

    @staticmethod
    def _warn_anew(path: Path) -> None:
        _log.warning(
            "%s: is damaged, or of another capture, other photographs or settings: materials are found anew", path
        )
