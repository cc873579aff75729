"""Lights of a known scene, and its base colours, from photographs of it: ``lumisplat.fit_lights``."""

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
"""Pixels along the longer side of the pictures in which lights are fitted: light is smooth, and shadows are wide."""

COARSE_SIZE = 40
"""The same where lamps are looked for: shadows that are coarse have no edges to be caught at."""

COARSE_SAMPLES = 0.25
"""Of the samples, there."""

LATTICE_SIDES = (3, 4)
"""Lamps are tried at so many places along each side of the box that holds the scene, cubed, one lattice after the
other: from one alone, three lamps of one photograph ended in a wrong place."""

STEPS_EXPECTED = 8
"""Steps that searches mostly take, to say how far a fit is: two that were far away took 11 and 22, others 2 to 8."""

_log = logging.getLogger("lumisplat")

ImageLike = npt.NDArray[np.floating] | npt.NDArray[np.unsignedinteger] | str | os.PathLike[str]

_LABEL = "fitting lights"
_SEARCHING, _RENDERING, _REFINING, _ERRORS = "looking for lamps", "a picture of each", "step by step", "errors"
"""Stages, of which the pictures take the time."""
_COST_RATIO_MAX = 0.9
"""A lamp that was found elsewhere has to leave less than this share of the cost of one found near where it was."""


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
    """Finds the lights of a scene, whose surfaces are known, from photographs of it.

    A photograph is taken for ``gain (own + sum_l power_l picture_l)``: what shines by itself, and pictures of lights,
    rendered one by one. Powers, at least 0, follow by least squares, robust against what the scene lacks;
    positions and what else pictures are not proportional to by Gauss-Newton, from where the scene has the lights and
    from a lattice of other places. Source: docs/method/relighting.md#lights-of-a-photograph.

    Only products are seen of a light's strength and a surface's colour, and of both and the exposure. So base colours
    are known unless they are asked for; if those of all materials are, their product over the materials stays, by
    channel, as the scene has it. Exposures are known unless they are asked for; if nothing in the scene shines by
    itself, that of the first photograph stays.

    Args:
        scene: Meshes, and captures with materials; its lights, where they are thought to be. Those that are not enabled
            stay so.
        cameras: One, or one a photograph, of the same aspect ratio.
        images: Files or arrays (H, W, 3), uint8 or 0..1: one, or several in a list. Display-referred sRGB; .exr
            and .hdr are linear.
        masks: One a photograph, files or arrays (H, W): what is at least half white counts. None, also in place of one:
            all does.
        environment_degree: Of an environment in spherical harmonics in place of the scene's own, 0 to 4 (1 to 25
            coefficients); None: none, and the scene's own keeps its image. ``"auto"``: 2, unless the scene's own has an
            image, or intensities are not asked for.
        intensities: Whether to find the lights' intensities and colours; else they are as the scene has them.
        keep_hues: Whether each light keeps its colour, so that only its intensity is found.
        positions: Whether to find positions of lights, and directions of spots and suns.
        radii: Whether to find radii of points, spots and spheres that have one.
        angles: Whether to find cones of spots.
        base_colors: Whether to find base colours: of meshes' materials, and one factor a channel for the colours of
            each capture whose material reflects and does not shine. All, or those of these names (of a material, else
            of its instance or mesh; of a capture's instance, else "capture 0" by its number), the others being known.
            Not found: roughness, textures, and colours of single Gaussians.
        exposure: Of the photographs, stops: one, or one for each, or ``"fit"``; None: those of the cameras.
        linear: Whether arrays hold linear light; None: they do not.
        tone_map: What display-referred photographs went through.
        size: Pixels along the longer side of the pictures that are compared, 16 to 4096.
        config: How light behaves. None: paths, 64 samples for each light, as in reality. A photograph that was rendered
            by another pipeline is explained by the same one. Shadows of lights with a size are soft if it says so.
        device: As for ``create_renderer``.
        progress: Called with what is being done and the fraction done, 0..1.

    Raises:
        ConfigError: A setting is out of its range, or nothing is asked for.
        DeviceError: There is no such device, or it is out of memory.
        FormatError: A photograph or a mask cannot be read.
        SceneError: The scene has no lights, cameras and photographs do not match, values are not finite, a photograph
            is black, or no pixel counts; the message says which.
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
            "the photographs show nothing that the lights light, but what is clipped or masked: captures "
            "without a material keep their look, whatever the light; give them one"
        )
    start, gains = task.scene, task.gains
    if any(parameter.kind == "position" for parameter in task.light_parameters):
        pace.begin(_SEARCHING)
        quick = LightLayers(config, device, COARSE_SAMPLES, rendered=lambda: pace.add(tiny_cost))
        coarse = PowerFitter(task, tiny, quick)
        if not coarse.observed.counts.any():  # large pixels that are whole: what is clipped may lie everywhere
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
    """Pictures that the stages of a fit are expected to take.

    Args:
        task: What is unknown.
        tiny: What a picture costs in which lamps are looked for, of one of the fit's size.
    """
    moved = {parameter.light for parameter in task.light_parameters}
    placed = {parameter.light for parameter in task.light_parameters if parameter.kind == "position"}
    every = 1 + len(task.lights) + (0 if task.degree is None else (task.degree + 1) ** 2)
    slopes = 2 * (len(task.light_parameters) + len(task.base_colors))
    steps = STEPS_EXPECTED * (slopes + (every if task.base_colors else len(moved))) if slopes else 0
    searches = every + (1 + len(LATTICE_SIDES)) * steps + sum(side**3 for side in LATTICE_SIDES) * len(placed)
    return {_SEARCHING: tiny * searches if placed else 0.0, _RENDERING: every, _REFINING: steps, _ERRORS: slopes}


def _coarse_search(fitter: PowerFitter) -> tuple[Scene, Doubles]:
    """Where lamps are about, by small pictures, and exposures: the best of searches from several places."""
    best = search(fitter, fitter.begin(fitter.task.scene, fitter.task.gains))
    for side in LATTICE_SIDES:
        scene = lattice_search(fitter, best, side)
        if scene is best.scene:
            continue
        other = search(fitter, fitter.moved(best, scene, best.gains))
        costs = [huber_cost(fitter.observed, one.solution.model, best.solution.deviation) for one in (best, other)]
        best = other if costs[1] < _COST_RATIO_MAX * costs[0] else best
    return best.scene, best.gains
