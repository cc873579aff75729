"""Estimates a capture's materials and removes the captured light from its colours (docs/method/delighting.md)."""

from __future__ import annotations

import logging
import os
import time
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from threadpoolctl import threadpool_limits

from lumisplat.config import DelightConfig, Pipeline, RenderConfig, TraceConfig
from lumisplat.config.checks import check_kind
from lumisplat.constants import GAUSSIANS_LEAST, RADIANCE_LEAST, SURFACE_OPACITY_MIN
from lumisplat.errors import SceneError
from lumisplat.io.images.radiance import write_radiance
from lumisplat.math.arrays import Doubles, Flags, FloatArray, Rows, read_only_view, weighted_quantile
from lumisplat.math.color import albedo_in_range
from lumisplat.math.directions import panorama_directions
from lumisplat.math.transforms import rotation_matrix
from lumisplat.progress import Progress, StagedProgress, no_progress
from lumisplat.relighting.albedo_fit import (
    AlbedoPairFit,
    EnvironmentCells,
    Light,
    albedo_pairs,
    initial_light,
    with_typical_albedos,
    with_white_balance,
)
from lumisplat.relighting.capture_measures import measure_surface, no_surface_message
from lumisplat.relighting.incident import SIDE_DIRECTIONS, IncidentRays, Smoother, neighbours_of
from lumisplat.relighting.irradiance import Irradiance, median_outgoing
from lumisplat.relighting.material_errors import AlbedoErrors, roughness_error
from lumisplat.relighting.roughness_fit import ROUGHNESS_UNKNOWN, Lobes, RoughnessFit, arriving_light
from lumisplat.relighting.seen_normals import VIEWS, normals_from_around
from lumisplat.renderer.gradients.differentiable_renderer import DifferentiableRenderer
from lumisplat.renderer.renderer import create_renderer
from lumisplat.scene.checks import check_argument
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.colors import colors_along
from lumisplat.scene.ops.neighbours import Pairs, cross_pairs
from lumisplat.scene.ops.normals import agreeing_signs, shortest_axes

BRIGHT_CELLS = 6
"""Number of environment cells that one refinement divides: the cells that give the most light."""

BRIGHT_PARTS = 4
"""Side of the grid of smaller cells into which a refinement divides an environment cell."""

BRIGHT_REFINEMENTS = 2
"""Number of refinements of the environment. Each one divides the `BRIGHT_CELLS` cells that give most light, and
repeats the fit."""

CLIPPED = 0.985
"""Display value that all channels of a Gaussian must reach for it to count as white: possibly too bright for the
camera.
"""

EMITTERS_MAX = 8
"""Maximum number of emitters (groups of white Gaussians) whose radiances are fitted; the Gaussians of further, smaller
groups are treated as white surfaces."""

EMITTER_GAP = 4.0
"""Two white Gaussians belong to one emitter if their distance is at most this times the median largest scale of white
Gaussians."""

PAIRS = 24_000
"""Maximum number of pairs of neighbouring Gaussians in the albedo fit."""

IRRADIANCE_KNOWN = 0.03
"""A Gaussian's albedo is replaced by its neighbours' if its irradiance, relative to the median, is below this, and
kept entirely from twice this value on."""

MATT_LEAST = 0.2
"""Lower bound of the diffuse reflectance that is left when a Gaussian's specular reflection is subtracted, as a
fraction of its total reflectance."""

ALBEDO_KNOWN, LITTLE_KNOWN = 1.5, 0.1
"""`MaterialEstimate.remarks` reports how much of the surface has an albedo within the first, a factor, and advises to
find materials from images if it is less than the second, a fraction."""

ROUGHNESS_KNOWN = 0.2
"""Largest ``roughness_error`` at which `MaterialEstimate.remarks` counts the roughness of a Gaussian as known."""

OPEN_ERRORS = AlbedoErrors(least=0.16, apart=1.07, dim=0.44)
"""Sources of error of albedos in open scenes of opaque Gaussians, fitted to five baked captures of a cow and a teapot
under sky and in the sun (decision 0143)."""

ROOM_ERRORS = AlbedoErrors(least=0.28, apart=2.1, dim=0.09)
"""Sources of error of albedos in rooms of opaque Gaussians, fitted to one baked room (decision 0143)."""

TRAINED_ERRORS = AlbedoErrors(least=1.62, apart=1.76, dim=0.0)
"""Sources of error of albedos of translucent Gaussians, whose colours are parts of a blend; fitted to one trained
capture of a glossy cow (decision 0143)."""

OPAQUE = 0.9
"""Median opacity of a capture above which its Gaussians count as opaque: baked ones have 0.995, trained ones 0.1."""

ROUGHNESS_ERRORS = 0.09, 1.22
"""``least`` and ``slope`` of `roughness_error`, fitted to three baked captures and a trained one (decision 0143)."""

TOO_LIGHT = 0.02
"""`MaterialEstimate.remarks` reports a problem, such as an albedo above 1, if more than this fraction of the Gaussians
have it.
"""

RESIDUAL_LARGE = 0.25
"""`MaterialEstimate.remarks` counts a Gaussian as unexplained if modelled and captured radiance differ by more than
this fraction of the captured radiance."""

TRANSMITTANCE_LEAST = 0.01
"""Transmittance at which rays end; only means over many of them matter, and rays that end later cost a quarter more."""

ENVIRONMENT_IMAGE_ROWS = 64
"""Height of the image of the estimated environment, pixels."""

_log = logging.getLogger("lumisplat")


def delight(
    gaussians: Gaussians,
    config: DelightConfig | None = None,
    *,
    device: str = "auto",
    threads: int | None = None,
    progress: Progress | None = None,
) -> Gaussians:
    """Estimates ``albedo``, ``roughness`` and ``normals`` of a capture, with the light of the capture removed.

    `estimate_materials` estimates the same materials, and also returns the estimated light.

    Args:
        gaussians: A capture with display-referred colours; an existing albedo is replaced.
        config: Settings; None: the defaults.
        device: As for `create_renderer`.
        threads: As for `create_renderer`.
        progress: Called with a label and the fraction done, 0..1.

    Returns:
        The same Gaussians in the same order, with materials and their errors.

    Raises:
        ConfigError: A setting is of the wrong kind.
        DeviceError: There is no such device, or it is out of memory.
        SceneError: The capture has no surface, or its surface is as bright as display white everywhere.
    """
    return estimate_materials(gaussians, config, device=device, threads=threads, progress=progress).gaussians


def estimate_materials(
    gaussians: Gaussians,
    config: DelightConfig | None = None,
    *,
    device: str = "auto",
    threads: int | None = None,
    progress: Progress | None = None,
) -> MaterialEstimate:
    """Estimates the materials of a capture, and the light in which the capture was taken, from the capture alone.

    Most of the light that reaches a Gaussian is visible in the capture, where rays gather it. The rest comes from the
    environment, and from emitters too bright for a display. The radiances of environment and emitters are fitted so
    that Gaussians of similar chromaticity get similar albedos. Where colours change with the view direction, highlights
    determine the roughness of dielectrics, unless the capture is a room with emitters: there, highlights stay in the
    albedo. Source: docs/method/delighting.md.

    Only the product of light and albedo is visible, so the lightest surfaces are assumed to have an albedo of 0.8. In a
    room, interreflections determine the scale a little.

    Args:
        gaussians: A capture with display-referred colours; an existing albedo is replaced.
        config: Settings; None: the defaults.
        device: As for `create_renderer`.
        threads: As for `create_renderer`.
        progress: Called with a label and the fraction done, 0..1.

    Raises:
        ConfigError: A setting is of the wrong kind.
        DeviceError: There is no such device, or it is out of memory.
        SceneError: The capture has no surface, or its surface is as bright as display white everywhere.
    """
    config = config or DelightConfig()
    check_argument("delight", gaussians, Gaussians, "Gaussians")
    check_kind("config", config, DelightConfig)
    visible = int(np.count_nonzero(gaussians.opacities >= SURFACE_OPACITY_MIN))
    if visible < GAUSSIANS_LEAST:
        raise SceneError(
            f"no surface to estimate materials of: {visible} of {gaussians.count} Gaussians have an opacity of at "
            f"least {SURFACE_OPACITY_MIN}, expected {GAUSSIANS_LEAST} or more"
        )
    if gaussians.albedo is not None:
        _log.warning("the albedo of the capture is replaced by one estimated from its captured colours")
    origin, gaussians = gaussians.origin, replace(gaussians, origin=(0.0, 0.0, 0.0))
    trace = TraceConfig(transmittance_min=TRANSMITTANCE_LEAST)
    config_of_rays = RenderConfig(pipeline=Pipeline.TRACE, lighting=False, trace=trace)
    renderer = create_renderer(config_of_rays, device, threads=threads)
    if not np.ptp(gaussians.means, axis=0).any():
        raise SceneError("no surface to estimate materials of: all Gaussians are at one position")
    surface = measure_surface(gaussians, renderer, config.seed)
    if surface.has_no_surface:
        raise SceneError(
            "no surface to estimate materials of: Gaussians are isotropic and rays lose their transmittance gradually, "
            "as in haze (after a training that was stopped early, more steps form surfaces)"
        )
    if surface.fault:
        _log.warning("%s", no_surface_message(surface.fault))
    report = progress or no_progress
    pace = StagedProgress(report, _LABEL)
    given = gaussians.normals
    axes = _agreeing_axes(gaussians) if given is None else given.astype(np.float64)
    rays = IncidentRays(gaussians, axes, renderer, config.seed, traced=pace.add)
    raster = DifferentiableRenderer(RenderConfig(pipeline=Pipeline.RASTER, lighting=False), device, threads=threads)
    # More BLAS threads change the last bits. They save a fifth of the time on two idle cores, but on busy ones they
    # wait for each other and take up to nine times as long.
    with threadpool_limits(1, user_api="blas"):
        found = _Delighter(gaussians, config, rays, raster, pace).run()
    report(_LABEL, 1.0)
    return replace(found, gaussians=replace(found.gaussians, origin=origin))


_LABEL = "delighting"
_SIDES, _NORMALS, _RAYS = "finding sides", "finding normals", "tracing the light"
_LIGHT, _HIGHLIGHTS = "finding the light", "finding highlights"
_BRIGHT = tuple(
    (f"tracing bright cells ({number} of {BRIGHT_REFINEMENTS})", f"{_LIGHT} ({number} of {BRIGHT_REFINEMENTS})")
    for number in range(1, BRIGHT_REFINEMENTS + 1)
)
_FIT_S, _HIGHLIGHT_S = 10.0, 1e-3
"""Expected seconds of one fit of the light's radiances (`_FIT_S`), and of fitting the highlights of one Gaussian
(`_HIGHLIGHT_S`), for the progress bar; measured with 20,000 Gaussians."""
_VIEWS_COST = 0.2
"""Assumed cost of all views that show normals, relative to that of `_SIDES`."""
_RAYS_PER_S = 5e5
"""Assumed rays per second, for the progress bar, before the first rays are timed; captures with many layers are 20
times slower.
"""


def _costs(
    count: int, turns: int, config: DelightConfig, *, inside: bool, shines: bool, rays_per_s: float = _RAYS_PER_S
) -> dict[str, float]:
    """Returns the expected cost of each stage of the estimate, in traced rays, by the stage's progress label.

    ``turns`` is `IncidentRays.turns`; ``inside``: the capture is a room, so no environment is refined; ``shines``:
    highlights are fitted, too.
    """
    fit, part = _FIT_S * rays_per_s, count / turns
    sides = 1.0 * SIDE_DIRECTIONS * count
    costs = {_SIDES: sides, _NORMALS: _VIEWS_COST * sides, _RAYS: config.cells**2 * part, _LIGHT: fit}
    for bright, light in () if inside else _BRIGHT:
        costs |= {bright: BRIGHT_CELLS * BRIGHT_PARTS**2 * part, light: 2.0 * fit}
    return costs | ({_HIGHLIGHTS: _HIGHLIGHT_S * rays_per_s * count} if shines else {})


@dataclass(frozen=True, slots=True)
class _Delighter:
    """Estimates the materials of one capture: traces rays, fits light and roughness, and reports the progress."""

    gaussians: Gaussians
    config: DelightConfig
    rays: IncidentRays
    raster: DifferentiableRenderer
    pace: StagedProgress

    def run(self) -> MaterialEstimate:
        """Traces rays, fits light and roughness, and returns the materials and the light."""
        count, may_shine = self.gaussians.count, self.gaussians.sh_degree > 0 and not self.config.matt
        costs = _costs(count, self.rays.turns, self.config, inside=bool(self.config.inside), shines=may_shine)
        self.pace.plan(costs)
        self.pace.begin(_SIDES)
        near = neighbours_of(self.gaussians)
        begun = time.perf_counter()
        normals, inside = self.rays.facing(near, self.config.inside, has_normals=self.gaussians.normals is not None)
        rays_per_s = min(
            SIDE_DIRECTIONS * count / (time.perf_counter() - begun), _RAYS_PER_S
        )  # so no progress is undone
        opaque = bool(np.median(self.gaussians.opacities) > OPAQUE)
        normals = normals if opaque else self._seen(normals, costs[_NORMALS])
        white = is_white(self.gaussians, normals)
        outgoing = self._checked_outgoing(normals, white)
        # White parts of an object are surfaces, not emitters.
        emitters = emitters_of(self.gaussians, white) if inside else np.full(self.gaussians.count, -1)
        smoother = Smoother.of(near, normals, emitters)
        cells = EnvironmentCells.even(self.config.cells)
        # Irradiance from emitters is not stored by direction, so that their highlights cannot be modelled.
        shines = may_shine and emitters.max(initial=-1) < 0
        costs = _costs(count, self.rays.turns, self.config, inside=inside, shines=shines, rays_per_s=rays_per_s)
        self.pace.plan(costs)
        self.pace.begin(_RAYS)
        incident = self.rays.incident(smoother, normals, emitters, cells, stores_directions=shines)
        if inside:  # rays that escape a room pass gaps between Gaussians
            cells, incident = cells.of(np.empty(0, int)), replace(incident, environment=incident.environment[:, :0])
        rng = np.random.default_rng([self.config.seed, 5])
        pairs, widths = albedo_pairs(near, np.flatnonzero(~white), PAIRS, rng, opaque=opaque)
        self.pace.begin(_LIGHT)
        light = AlbedoPairFit(outgoing, incident, pairs, widths, cells).solved(initial_light(outgoing, incident))
        for tracing, finding in () if inside else _BRIGHT:
            self.pace.begin(tracing)
            cells, incident, light = self._finer(normals, smoother, cells, incident, light)
            self.pace.begin(finding)
            light = AlbedoPairFit(outgoing, incident, pairs, widths, cells).solved(light)
        if not inside:
            # Photographs are white balanced, baked colours are not.
            light = with_typical_albedos(light if opaque else with_white_balance(light, incident), outgoing, incident)
        lobes = Lobes.of(self.gaussians.sh_degree)
        rough = read_only_view(np.full(count, ROUGHNESS_UNKNOWN, np.float32))
        if shines:
            fit = RoughnessFit(self.gaussians, normals, near, lobes)
            self.pace.begin(_HIGHLIGHTS)
            arriving = arriving_light(normals, cells, incident, light)
            rough = fit.fitted(arriving, lambda tried: self.pace.add(costs[_HIGHLIGHTS] * tried / count))
        irradiance = incident.total(light.environment, light.emitters)
        reflectance = outgoing / np.maximum(irradiance, RADIANCE_LEAST)
        matt, mirrored = self._parts(rough, lobes)
        albedo = filled(np.maximum(reflectance - mirrored, MATT_LEAST * reflectance) / matt, irradiance, near)
        errors = TRAINED_ERRORS
        if opaque:
            errors = ROOM_ERRORS if inside else OPEN_ERRORS
        error = errors.of(albedo_in_range(albedo), irradiance.mean(axis=1), normals, near)
        explained = (albedo_in_range(albedo) * matt + np.minimum(mirrored, reflectance)) * irradiance
        observed = incident.observed.mean(axis=1) / np.maximum(irradiance.mean(axis=1), RADIANCE_LEAST)
        return MaterialEstimate(
            gaussians=self._with_materials(albedo, normals, error, rough),
            cells=cells,
            environment=light.environment,
            emitters=light.emitters,
            emitter_of=emitters,
            residual=_unexplained(outgoing, explained),
            observed=np.clip(observed, 0.0, 1.0).astype(np.float32),
            is_inside=inside,
            out_of_range=(albedo > 1.0).any(axis=1) & (emitters < 0),
            is_white=white & (emitters < 0),
            is_too_dark=np.asarray((reflectance < mirrored).any(axis=1)),
        )

    def _seen(self, normals: Doubles, cost: float) -> Doubles:
        """Returns the capture's own normals; without any, those that views of N Gaussians show, shape (N, 3).

        ``cost``: expected cost of the views.
        """
        if self.gaussians.normals is not None:
            return normals
        self.pace.begin(_NORMALS)
        rng = np.random.default_rng([self.config.seed, 6])
        return normals_from_around(
            self.gaussians,
            normals,
            self.raster,
            self.rays.clear_distance,
            rng=rng,
            shown=lambda: self.pace.add(cost / VIEWS),
        )

    def _checked_outgoing(self, normals: Doubles, white: Flags) -> Doubles:
        """Returns the median radiance of N Gaussians over views from their normals' side, shape (N, 3).

        Raises:
            SceneError: All Gaussians are clipped at display white (``white``), or all are black.
        """
        if white.all():
            raise SceneError("all Gaussians are clipped at display white: no material can be estimated")
        outgoing = median_outgoing(self.gaussians, normals)
        if outgoing.max() < RADIANCE_LEAST:
            raise SceneError("all Gaussians are black: without light, no material can be estimated")
        return outgoing

    def _parts(self, roughness: FloatArray, lobes: Lobes) -> tuple[Doubles, Doubles]:
        """Returns N Gaussians' radiances in a constant environment, (N, 1) each: diffuse for albedo 1, and specular."""
        if self.config.matt:
            return np.ones((len(roughness), 1)), np.zeros((len(roughness), 1))
        matt, mirrored = lobes.in_constant_environment(roughness)
        return matt[:, None], mirrored[:, None]

    def _finer(
        self, normals: Doubles, smoother: Smoother, cells: EnvironmentCells, incident: Irradiance, light: Light
    ) -> tuple[EnvironmentCells, Irradiance, Light]:
        """Divides the brightest environment cells and traces rays to the parts; returns cells, irradiance and light."""
        power = light.environment.mean(axis=1) * cells.solid_angles
        bright = np.argsort(-power, kind="stable")[:BRIGHT_CELLS]
        others = np.setdiff1d(np.arange(len(cells)), bright)
        parts = cells.of(bright).parts(BRIGHT_PARTS)
        found = self.rays.from_environment(smoother, normals, parts)
        environment = np.concatenate([incident.environment[:, others], found], axis=1)
        radiances = np.concatenate(
            [light.environment[others], np.repeat(light.environment[bright], BRIGHT_PARTS**2, axis=0)]
        )
        return (
            cells.of(others).joined(parts),
            replace(incident, environment=environment),
            replace(light, environment=radiances),
        )

    def _with_materials(self, albedo: Doubles, normals: Doubles, error: FloatArray, rough: FloatArray) -> Gaussians:
        """Returns the capture with this albedo (scaled into 0..1), normals and roughness, and without metalness.

        ``error`` is that of the albedo.
        """
        return replace(
            self.gaussians,
            albedo=read_only_view(albedo_in_range(albedo).astype(np.float32)),
            roughness=rough,
            metallic=None,
            albedo_error=error,
            roughness_error=roughness_error(rough, *ROUGHNESS_ERRORS),
            normals=read_only_view(normals.astype(np.float32)),
        )


def _agreeing_axes(gaussians: Gaussians) -> Doubles:
    """Returns the shortest axes of N Gaussians, turned to one side of a common plane, shape (N, 3).

    Rays later decide which side is visible. Where no ray can decide, such as on an isolated sheet, the axes stay so.
    """
    axes = shortest_axes(gaussians)
    return agreeing_signs(axes)[:, None] * axes


def filled(albedo: Doubles, irradiance: Doubles, near: Pairs) -> Doubles:
    """Replaces albedos of Gaussians with irradiance below `IRRADIANCE_KNOWN` by the mean of their neighbours."""
    light = irradiance.mean(axis=1)
    certainty = np.clip(light / (IRRADIANCE_KNOWN * float(np.median(light)) + 1e-12) - 1.0, 0.0, 1.0)
    weights = certainty[near.second] + 1e-6
    total = np.bincount(near.first, weights, len(albedo))
    sums = [np.bincount(near.first, weights * channel[near.second], len(albedo)) for channel in albedo.T]
    around = np.stack(sums, axis=1) / total[:, None]
    return certainty[:, None] * albedo + (1.0 - certainty)[:, None] * around


def _unexplained(outgoing: Doubles, explained: Doubles) -> FloatArray:
    """Returns ``mean(|explained - outgoing|) / mean(outgoing)`` of N Gaussians, with means over channels, (N,)."""
    difference = np.abs(explained - outgoing).mean(axis=1)
    return (difference / np.maximum(outgoing.mean(axis=1), RADIANCE_LEAST)).astype(np.float32)


def is_white(gaussians: Gaussians, normals: Doubles) -> Flags:
    """Returns which of N Gaussians, seen against their normals, show at least `CLIPPED` in all channels, (N,)."""
    return (colors_along(gaussians, -normals) >= CLIPPED).all(axis=1) & (gaussians.opacities > 0.0)


def emitters_of(gaussians: Gaussians, white: Flags) -> Rows:
    """Groups neighbouring white Gaussians into emitters; returns each Gaussian's emitter, -1 for none, shape (N,).

    The emitter with most Gaussians has number 0, the next 1, and so on. Gaussians of groups after the first
    `EMITTERS_MAX` get -1.
    """
    bright = np.flatnonzero(white)
    groups = np.full(gaussians.count, -1)
    if not bright.size:
        return groups
    means = gaussians.means[bright].astype(np.float64)
    pairs = cross_pairs(means, means, EMITTER_GAP * float(np.median(gaussians.scales[bright].max(axis=1))))
    graph = csr_array((np.ones(pairs.first.size, np.bool_), (pairs.first, pairs.second)), (bright.size, bright.size))
    _, label = connected_components(graph, directed=False)
    names, sizes = np.unique(label, return_counts=True)
    for number, name in enumerate(names[np.argsort(-sizes, kind="stable")][:EMITTERS_MAX]):
        groups[bright[label == name]] = number
    return groups


@dataclass(frozen=True, slots=True, eq=False)
class MaterialEstimate:
    """Estimated materials of a capture of N Gaussians, and the estimated light in which it was taken."""

    gaussians: Gaussians
    """The capture with ``albedo`` (linear), ``roughness``, ``normals``, ``albedo_error`` and ``roughness_error`` for
    each Gaussian. Where nothing shows the roughness, it is an assumed 0.8, as in a capture whose colours do not change
    with the view direction."""
    cells: EnvironmentCells
    """The K cells of the environment; none if the capture was taken from inside, as a room is."""
    environment: Doubles
    """Radiance of each environment cell, linear, in units of display white, shape (K, 3)."""
    emitters: Doubles
    """Radiance of each of L emitters, groups of Gaussians clipped at display white: linear, in units of display white,
    shape (L, 3)."""
    emitter_of: Rows
    """Index of the emitter that each Gaussian belongs to, -1 for none, shape (N,)."""
    residual: FloatArray
    """Absolute difference between each Gaussian's captured and modelled radiance, relative to the captured radiance,
    shape (N,)."""
    observed: FloatArray
    """Fraction of the irradiance at each Gaussian that is visible in the capture rather than estimated, 0..1, shape
    (N,)."""
    is_inside: bool
    """True if the capture was treated as taken from inside a room: all light then comes from the capture itself."""
    out_of_range: Flags
    """True for Gaussians whose albedo would exceed 1 in a channel, because they received more light than was
    estimated, shape (N,). Their albedo is scaled by one factor to a largest channel of 1, so that the hue stays."""
    is_white: Flags
    """True for Gaussians clipped at display white, except emitters, shape (N,); their albedo is a guess."""
    is_too_dark: Flags
    """True for Gaussians that in some channel are darker than a dielectric's specular reflection would be, shape (N,).
    Relighting makes them lighter in that channel, and saturated colours paler."""

    def environment_image(self, rotation_wxyz: npt.ArrayLike = (1.0, 0.0, 0.0, 0.0)) -> FloatArray:
        """Returns the environment as a latitude-longitude image, shape (H, 2 H, 3); black if there is no environment.

        Args:
            rotation_wxyz: Rotation from image to world, such as ``scene.upright_wxyz``. A `LightEnvironment` with this
                image and this rotation gives the estimated light.
        """
        directions = (
            panorama_directions(ENVIRONMENT_IMAGE_ROWS, 2 * ENVIRONMENT_IMAGE_ROWS) @ rotation_matrix(rotation_wxyz).T
        )
        if not len(self.cells):
            return np.zeros(directions.shape, np.float32)
        cosines = directions @ self.cells.directions.T
        within = np.cos(np.sqrt(self.cells.solid_angles / np.pi))
        # The cell whose disc holds the direction closest to its centre, relative to the radius of the disc.
        nearest = np.argmax((cosines - 1.0) / (1.0 - within), axis=-1)
        return self.environment[nearest].astype(np.float32)

    def save_environment(
        self, path: str | os.PathLike[str], rotation_wxyz: npt.ArrayLike = (1.0, 0.0, 0.0, 0.0)
    ) -> None:
        """Writes `environment_image` as an EXR file.

        Args:
            path: File to write, .exr.
            rotation_wxyz: As for `environment_image`.

        Raises:
            FormatError: The file cannot be written.
        """
        write_radiance(path, self.environment_image(rotation_wxyz))

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences for the user on assumptions and problems: room or open scene, emitters, guessed albedos."""
        observed = float(self.observed.mean())
        lines = [
            "taken for a closed room, as few rays escape: all light is its own (otherwise: --inside no, inside=False)"
            if self.is_inside
            else f"taken for an open scene: {1.0 - observed:.0%} of the light comes from an estimated environment, "
            "whose brightness is a guess (for a closed room: --inside yes, inside=True)"
        ]
        if len(self.emitters):
            brightness = ", ".join(f"{emitter.mean():.3g}" for emitter in self.emitters)
            lines.append(f"radiances of emitters, relative to display white: {brightness}")
        found = self.gaussians
        if found.albedo_error is not None:
            shown = np.sort(found.scales.astype(np.float64), axis=1)[:, 1:].prod(axis=1) * found.opacities
            known = float(np.average(np.exp(found.albedo_error) <= ALBEDO_KNOWN, weights=shown))
            half = np.exp(weighted_quantile(found.albedo_error.astype(np.float64), shown, 0.5))
            lines.append(
                f"albedo of {known:.0%} of the surface is within a factor of {ALBEDO_KNOWN}, of half of it within "
                f"{half:.2f} (90 % intervals)"
                + ("; images determine more: lumisplat train --relightable" if known < LITTLE_KNOWN else "")
            )
        if found.roughness is not None and (found.roughness != np.float32(ROUGHNESS_UNKNOWN)).any():
            share = 0.0 if found.roughness_error is None else float((found.roughness_error <= ROUGHNESS_KNOWN).mean())
            lines.append(
                f"highlights determine the roughness of {share:.0%} of the Gaussians to {ROUGHNESS_KNOWN} or better; "
                "for others it tends to 0.8"
            )
        else:
            lines.append("roughness is 0.8 everywhere: colours do not depend on the view, or there are emitters")
        if (share := float(self.out_of_range.mean())) > TOO_LIGHT:
            lines.append(
                f"{share:.1%} of the Gaussians would have an albedo above 1: it is scaled to 1, in the same hue"
            )
        if (share := float(self.is_white.mean())) > TOO_LIGHT:
            lines.append(f"{share:.1%} of the Gaussians are clipped at display white: their albedo is a guess")
        if (share := float(self.is_too_dark.mean())) > TOO_LIGHT:
            lines.append(
                f"{share:.1%} of the Gaussians are darker in a channel than their specular reflection, and will "
                "appear lighter and paler: use --matt, or matt=True, for surfaces without reflections"
            )
        if (share := float((self.residual > RESIDUAL_LARGE).mean())) > TOO_LIGHT:
            lines.append(f"materials and light do not explain the captured colours of {share:.1%} of the Gaussians")
        return tuple(lines)
