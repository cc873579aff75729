"""Estimates the lights and base colours of a scene with known geometry from images: ``lumisplat.fit_lights``."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from typing import Literal

import numpy as np
import numpy.typing as npt

from lumisplat.config import RenderConfig, ToneMap
from lumisplat.config.checks import check_kind, check_whole, enum_member
from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles
from lumisplat.progress import Progress, StagedProgress, no_progress
from lumisplat.relighting.capture_measures import surface_remark
from lumisplat.relighting.fitting.light_layers import LightLayers, read_images
from lumisplat.relighting.fitting.parameters import Exposure, FitOptions, FitTask
from lumisplat.relighting.fitting.power_fit import PowerFitter, huber_cost
from lumisplat.relighting.fitting.results import LightFit, certainty_of, result_of
from lumisplat.relighting.fitting.search import lattice_search, search
from lumisplat.renderer.checks import check_scene
from lumisplat.scene.camera import Camera
from lumisplat.scene.scene import Scene

FIT_SIZE = 128
"""Longer side of the renders in a light fit, pixels. A small number suffices, because light is smooth and shadows are
wide."""

COARSE_SIZE = 40
"""Longer side of the renders in the search for light positions, pixels. Blurred shadows have no sharp edges at which
the search could get stuck."""

COARSE_SAMPLES = 0.25
"""Samples per pixel in the search for light positions, as a fraction of the samples in the fit."""

LATTICE_SIDES = (3, 4)
"""Lattices of trial light positions, searched one after the other: n means n^3 positions in the scene's box. A search
of only one of the lattices placed one of three lights wrongly from one image."""

STEPS_EXPECTED = 12
"""Number of Gauss-Newton steps that a search is expected to take, for the progress bar. Searches that began near the
minimum took 1 to 9 steps, searches that began far from it, as in real images, 11 to 22. If a search takes more steps
than expected, the bar waits at the end of a stage."""

_log = logging.getLogger("lumisplat")

ImageLike = npt.NDArray[np.floating] | npt.NDArray[np.unsignedinteger] | str | os.PathLike[str]

_LABEL = "fitting lights"
_SEARCHING, _RENDERING, _REFINING, _ERRORS = (
    "searching for positions",
    "rendering each light",
    "refining",
    "estimating errors",
)
"""Labels of the stages of a fit in progress reports; rendering takes nearly all of the time."""
_COST_RATIO_MAX = 0.9
"""The result of a search from a lattice replaces the best lights so far if its cost is below this times their cost."""


def fit_lights(
    scene: Scene,
    cameras: Camera | Sequence[Camera],
    images: ImageLike | Sequence[ImageLike],
    *,
    masks: ImageLike | Sequence[ImageLike | None] | None = None,
    environment_degree: int | Literal["auto"] | None = "auto",
    intensities: bool = True,
    keep_hues: bool = False,
    positions: bool = False,
    radii: bool = False,
    angles: bool = False,
    base_colors: bool | Sequence[str] = False,
    exposure: Exposure = None,
    linear: bool | None = None,
    tone_map: ToneMap | str = ToneMap.NONE,
    size: int = FIT_SIZE,
    config: RenderConfig | None = None,
    device: str = "auto",
    progress: Progress | None = None,
) -> LightFit:
    """Fits the lights of a scene with known geometry to one or more images of it.

    An image is modelled as ``gain (emitted + sum_l power_l render_l)``: the light that surfaces emit, and one render of
    each light with power 1. The powers, at least 0, are a robust linear least-squares fit, so that objects which are
    missing from the scene count little. Renders depend nonlinearly on positions, radii, angles and base colours; these
    are found by Gauss-Newton, from the given values and from a lattice of other positions. Source:
    docs/method/relighting.md#lights-of-an-image.

    Images show only the product of light power, surface colour and exposure. Base colours are therefore held unless
    ``base_colors`` asks for them. If all materials are fitted, the product of their base colours stays as in the scene,
    for each channel. Exposures are held unless ``exposure`` asks for them. If no surface of the scene emits light, the
    exposure of the first image stays.

    Args:
        scene: Meshes, and captures with materials. Its lights are the starting point; disabled lights stay disabled.
        cameras: One camera, or one for each image, with the aspect ratio of its image.
        images: One image, or several in a list: files, or arrays of shape (H, W, 3), uint8 or 0..1. They are
            display-referred sRGB; .exr and .hdr files are linear.
        masks: One mask for each image, files or arrays of shape (H, W). Pixels of at least half white are fitted. None,
            also as an item of the list: all pixels are fitted.
        environment_degree: SH degree of an environment that replaces the scene's environment, 0 to 4 (1 to 25
            coefficients). None: no SH environment, and the scene's environment keeps its image. ``"auto"``: 2, or None
            if the scene's environment has an image or ``intensities`` is False.
        intensities: Whether to fit the lights' intensities and colours; otherwise they stay as in the scene.
        keep_hues: Whether each light keeps its colour, so that only its intensity is fitted.
        positions: Whether to fit positions of lights, and directions of spots and suns.
        radii: Whether to fit radii of points, spots and spheres whose radius is above 0.
        angles: Whether to fit the cone angles of spots.
        base_colors: Base colours to fit: True for all, or a list of names; all others are held. Each material of meshes
            has one colour. Each capture with a reflecting material that does not emit has one factor per channel. The
            name of a material's colour is that of the material, or else of the instance or mesh that has it. The name
            of a capture's colour is that of its instance, or else "capture 0" by its number. Roughness, textures, and
            colours of single Gaussians are not fitted.
        exposure: Exposure of the images in stops: one number, or one for each image, or ``"fit"``. None: those of the
            cameras.
        linear: Whether arrays hold linear light; None: they do not.
        tone_map: Tone map that display-referred images were made with; the fit inverts it.
        size: Longer side of the renders that are compared with the images, pixels, 16 to 4096.
        config: How light is rendered. None: path tracing with 64 samples per pixel for each light, as for real
            photographs. Images that were rendered by another pipeline are best explained by that pipeline. Lights with
            a radius cast soft shadows if the settings say so.
        device: As for ``create_renderer``.
        progress: Called with a label of the current stage and the fraction done, 0..1.

    Raises:
        ConfigError: A setting is out of its range, or there is nothing to fit.
        DeviceError: There is no such device, or it is out of memory.
        FormatError: An image or a mask cannot be read.
        SceneError: The scene has no lights, cameras and images do not match, values are not finite, an image is black,
            or no pixel can be fitted; the message says which.
    """
    check_scene(scene)
    check_whole("size", size, 16, 4096)
    if config is not None:
        check_kind("config", config, RenderConfig)
    options = FitOptions(
        environment_degree=environment_degree,
        intensities=intensities,
        keep_hues=keep_hues,
        positions=positions,
        radii=radii,
        angles=angles,
        base_colors=base_colors,
        exposure=exposure,
    )
    curve = enum_member("tone_map", tone_map, ToneMap)
    views = read_images(cameras, images, masks, linear=linear, tone_map=curve)
    report = progress or no_progress
    for instance in scene.splats:
        if instance.material is not None and (remark := surface_remark(instance.gaussians, device=device)) is not None:
            _log.warning("%s", remark)
    report(_LABEL, 0.0)
    pace = StagedProgress(report, _LABEL)
    layers = LightLayers(config, device, rendered=lambda: pace.add(1.0))
    small = [view.scaled(size) for view in views]
    exposures = [view.camera.exposure for view in views]
    task = FitTask.of(scene, options, exposures, shines=lambda: bool(layers.render(scene, (), small).any()))
    tiny = [view.scaled(min(size, COARSE_SIZE)) for view in views]
    tiny_cost = COARSE_SAMPLES * sum(one.light.size for one in tiny) / sum(one.light.size for one in small)
    pace.plan(_costs(task, tiny_cost))
    fitter = PowerFitter(task, small, layers)
    if not fitter.observed.counts.any():
        raise SceneError(
            "no pixel of the images can be fitted: all are clipped, masked, background or unlit captures; give "
            "captures a material to be lit"
        )
    start, gains = task.scene, task.gains
    if any(parameter.kind == "position" for parameter in task.light_parameters):
        pace.begin(_SEARCHING)
        quick = LightLayers(config, device, COARSE_SAMPLES, rendered=lambda: pace.add(tiny_cost))
        coarse = PowerFitter(task, tiny, quick)
        if not coarse.observed.counts.any():  # each large pixel may contain a clipped one
            coarse = fitter
        start, gains = _coarse_search(coarse)
    pace.begin(_RENDERING)
    first = fitter.begin(start, gains)
    pace.begin(_REFINING)
    found = fitter.settled(search(fitter, first))
    pace.begin(_ERRORS)
    result = result_of(scene, options, fitter, found, certainty_of(fitter, found))
    report(_LABEL, 1.0)
    return result


def _costs(task: FitTask, tiny: float) -> dict[str, float]:
    """Returns the expected cost of each stage of a fit, by the stage's name, in renders of the fit's size.

    Args:
        task: The unknowns.
        tiny: Cost of a render in the search for positions, relative to a render of the fit's size.
    """
    moved = {parameter.light for parameter in task.light_parameters}
    placed = {parameter.light for parameter in task.light_parameters if parameter.kind == "position"}
    every = 1 + len(task.lights) + (0 if task.degree is None else (task.degree + 1) ** 2)
    slopes = 2 * (len(task.light_parameters) + len(task.base_colors))
    steps = STEPS_EXPECTED * (slopes + (every if task.base_colors else len(moved))) if slopes else 0
    searches = every + (1 + len(LATTICE_SIDES)) * steps + sum(side**3 for side in LATTICE_SIDES) * len(placed)
    return {_SEARCHING: tiny * searches if placed else 0.0, _RENDERING: every, _REFINING: steps, _ERRORS: slopes}


def _coarse_search(fitter: PowerFitter) -> tuple[Scene, Doubles]:
    """Searches at low resolution from the given lights and from lattices; returns best scene and exposure factors."""
    best = search(fitter, fitter.begin(fitter.task.scene, fitter.task.gains))
    for side in LATTICE_SIDES:
        scene = lattice_search(fitter, best, side)
        if scene is best.scene:
            continue
        other = search(fitter, fitter.moved(best, scene, best.gains))
        costs = [huber_cost(fitter.observed, one.solution.model, best.solution.deviation) for one in (best, other)]
        best = other if costs[1] < _COST_RATIO_MAX * costs[0] else best
    return best.scene, best.gains
