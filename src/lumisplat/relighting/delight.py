"""A capture's own light taken out of it (docs/method/delighting.md): steps and their order."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from threadpoolctl import threadpool_limits

from lumisplat.config import DelightConfig, Pipeline, RenderConfig
from lumisplat.config.checks import check_kind
from lumisplat.constants import GAUSSIANS_LEAST, OPACITY_SEEN, RADIANCE_LEAST
from lumisplat.errors import SceneError
from lumisplat.io.images.radiance import write_radiance
from lumisplat.math.arrays import Doubles, Flags, FloatArray, Rows, read_only_view
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
)
from lumisplat.relighting.capture_measures import measure_surface, no_surface_message
from lumisplat.relighting.incident import SIDE_DIRECTIONS, IncidentRays, Smoother, neighbours_of
from lumisplat.relighting.irradiance import Irradiance, median_outgoing
from lumisplat.relighting.roughness_fit import Lobes, Roughness, RoughnessFit, arriving_light
from lumisplat.renderer.renderer import create_renderer
from lumisplat.scene.checks import check_argument
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.colors import colors_along
from lumisplat.scene.ops.neighbours import Pairs, cross_pairs
from lumisplat.scene.ops.normals import agreeing_signs, shortest_axes

BRIGHT_CELLS = 6
"""Cells of the sky that are divided further: those that shine most."""

BRIGHT_PARTS = 4
"""Into so many times so many parts."""

BRIGHT_REFINEMENTS = 2
"""Times that this is done."""

CLIPPED = 0.985
"""Display-referred value of all channels from which on a Gaussian may have been brighter than could be captured."""

EMITTERS_MAX = 8
"""Groups of such Gaussians whose light is found apart."""

EMITTER_GAP = 4.0
"""Distance between Gaussians of one group, in median scales of such Gaussians."""

PAIRS = 24_000
"""Pairs of neighbours whose albedos are compared, at most."""

IRRADIANCE_KNOWN = 0.03
"""Light at a Gaussian, as a share of the median, below which its albedo is that of its neighbours."""

MATT_LEAST = 0.2
"""Share of what Gaussians show that is left, at least, when what they mirror is taken away."""

CONFIDENT = 0.8
"""Sureness of a roughness from which on highlights are said to tell it."""

TOO_LIGHT = 0.02
"""Share of Gaussians beyond what is possible, or not explained, from which on it is worth a remark."""

RESIDUAL_LARGE = 0.25
"""Unexplained share of a captured colour that counts for that."""

ENVIRONMENT_IMAGE_ROWS = 64
"""Of the image of the sky that was found."""

_log = logging.getLogger("lumisplat")


def delight(
    gaussians: Gaussians,
    config: DelightConfig | None = None,
    *,
    device: str = "auto",
    threads: int | None = None,
    progress: Progress | None = None,
) -> Gaussians:
    """A capture with materials: ``albedo`` without the light in which it was taken, ``roughness`` and ``normals``.

    As `estimate_materials`, which also tells what light was found, and how sure that is.

    Args:
        gaussians: A capture with display-referred colours; if it has an albedo, that is replaced.
        config: Settings; None: the defaults.
        device: As for `create_renderer`.
        threads: Likewise.
        progress: Called with a label and the fraction done, 0..1.

    Returns:
        The same Gaussians in the same order.

    Raises:
        ConfigError: A setting is of the wrong kind.
        DeviceError: There is no such device, or it is out of memory.
        SceneError: There is no surface, or it is as bright as display white everywhere.
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
    """Materials of a capture and the light in which it was taken, found from the capture alone.

    The light that reaches a Gaussian is largely seen in the capture itself: rays find it. What is not, the sky and
    lamps that were too bright for a display, is such that Gaussians which may have one albedo have it. Where
    colours change with the direction of view, highlights tell the roughness: of dielectrics, and not by lamps in
    rooms. They stay in the albedo. Source: docs/method/delighting.md.

    How bright the sky or lamps were and what albedos surfaces have is only known together: the lightest surfaces are
    taken to reflect 0.8. Of a room, bounces between its walls tell them apart a little.

    Args:
        gaussians: A capture with display-referred colours; if it has an albedo, that is replaced.
        config: Settings; None: the defaults.
        device: As for `create_renderer`.
        threads: Likewise.
        progress: Called with a label and the fraction done, 0..1.

    Raises:
        ConfigError: A setting is of the wrong kind.
        DeviceError: There is no such device, or it is out of memory.
        SceneError: There is no surface, or it is as bright as display white everywhere.
    """
    config = config or DelightConfig()
    check_argument("delight", gaussians, Gaussians, "Gaussians")
    check_kind("config", config, DelightConfig)
    visible = int(np.count_nonzero(gaussians.opacities >= OPACITY_SEEN))
    if visible < GAUSSIANS_LEAST:
        raise SceneError(
            f"no surface whose material could be told: {visible} of {gaussians.count} Gaussians have an opacity of "
            f"{OPACITY_SEEN} or more, expected {GAUSSIANS_LEAST} at least"
        )
    if gaussians.albedo is not None:
        _log.warning("the capture has an albedo already: it is replaced by one from its captured colours")
    origin, gaussians = gaussians.origin, replace(gaussians, origin=(0.0, 0.0, 0.0))
    renderer = create_renderer(RenderConfig(pipeline=Pipeline.TRACE, lighting=False), device, threads=threads)
    if not np.ptp(gaussians.means, axis=0).any():
        raise SceneError("no surface whose material could be told: all Gaussians are in one place")
    surface = measure_surface(gaussians, renderer, config.seed)
    if surface.has_no_surface:
        raise SceneError(
            "no surface whose material could be told: light passes between round Gaussians, or is lost in them bit by "
            "bit, as in fog (of a training that was stopped early, more steps make surfaces)"
        )
    if surface.fault:
        _log.warning("%s", no_surface_message(surface.fault))
    report = progress or no_progress
    pace = StagedProgress(report, _LABEL)
    rays = IncidentRays(gaussians, renderer, config.seed, traced=pace.add)
    # More threads of BLAS change the last bits. They save a fifth of the time on two free cores, but wait for each
    # other on busy ones, up to nine times as long.
    with threadpool_limits(1, user_api="blas"):
        found = _Delighter(gaussians, config, rays, pace).run()
    report(_LABEL, 1.0)
    return replace(found, gaussians=replace(found.gaussians, origin=origin))


_LABEL = "delighting"
_SIDES, _RAYS, _LIGHT, _HIGHLIGHTS = "finding sides", "tracing the light", "finding the light", "finding highlights"
_BRIGHT = tuple(
    (f"tracing the bright sky ({number} of {BRIGHT_REFINEMENTS})", f"{_LIGHT} ({number} of {BRIGHT_REFINEMENTS})")
    for number in range(1, BRIGHT_REFINEMENTS + 1)
)
_FIT_COST, _HIGHLIGHT_COST = 5e6, 500.0
"""What a fit of the light takes, and the highlights of a Gaussian, in rays that take as long (20,000 Gaussians)."""


def _costs(count: int, config: DelightConfig, *, inside: bool, shines: bool) -> dict[str, float]:
    """Returns the stages and what each is expected to take, in rays, for some number of Gaussians."""
    costs = {_SIDES: 1.0 * SIDE_DIRECTIONS * count, _RAYS: 1.0 * config.cells**2 * count, _LIGHT: _FIT_COST}
    for bright, light in () if inside else _BRIGHT:
        costs |= {bright: 1.0 * BRIGHT_CELLS * BRIGHT_PARTS**2 * count, light: 2.0 * _FIT_COST}
    return costs | ({_HIGHLIGHTS: _HIGHLIGHT_COST * count} if shines else {})


@dataclass(frozen=True, slots=True)
class _Delighter:
    """Takes the light out of a capture."""

    gaussians: Gaussians
    config: DelightConfig
    rays: IncidentRays
    pace: StagedProgress

    def run(self) -> MaterialEstimate:
        """All steps."""
        count, may_shine = self.gaussians.count, self.gaussians.sh_degree > 0 and not self.config.matt
        self.pace.plan(_costs(count, self.config, inside=bool(self.config.inside), shines=may_shine))
        self.pace.begin(_SIDES)
        near = neighbours_of(self.gaussians)
        given = self.gaussians.normals
        axes = _agreeing_axes(self.gaussians) if given is None else given.astype(np.float64)
        normals, inside = self.rays.facing(axes, near, self.config.inside, has_normals=given is not None)
        white = is_white(self.gaussians, normals)
        outgoing = self._checked_outgoing(normals, white)
        # What is white on an object reflects.
        emitters = emitters_of(self.gaussians, white) if inside else np.full(self.gaussians.count, -1)
        smoother = Smoother.of(near, normals, emitters)
        cells = EnvironmentCells.even(self.config.cells)
        # Where a lamp's light comes from is not kept apart: highlights of it are not known.
        shines = may_shine and emitters.max(initial=-1) < 0
        self.pace.plan(_costs(count, self.config, inside=inside, shines=shines))
        self.pace.begin(_RAYS)
        incident = smoother.incident(self.rays.incident(normals, emitters, cells, stores_directions=shines))
        if inside:  # what no wall stops in a room are gaps between Gaussians
            cells, incident = cells.of(np.empty(0, int)), replace(incident, environment=incident.environment[:, :0])
        pairs = albedo_pairs(near, np.flatnonzero(~white), PAIRS, np.random.default_rng([self.config.seed, 5]))
        self.pace.begin(_LIGHT)
        light = AlbedoPairFit(outgoing, incident, pairs, cells).solved(initial_light(outgoing, incident))
        for tracing, finding in () if inside else _BRIGHT:
            self.pace.begin(tracing)
            cells, incident, light = self._finer(normals, smoother, cells, incident, light)
            self.pace.begin(finding)
            light = AlbedoPairFit(outgoing, incident, pairs, cells).solved(light)
        if not inside:
            light = with_typical_albedos(light, outgoing, incident)
        rough, lobes = Roughness.unknown(self.gaussians.count), Lobes.of(self.gaussians.sh_degree)
        if shines:
            fit = RoughnessFit(self.gaussians, normals, near, lobes)
            self.pace.begin(_HIGHLIGHTS)
            arriving = arriving_light(normals, cells, incident, light)
            rough = fit.fitted(arriving, lambda tried: self.pace.add(_HIGHLIGHT_COST * tried))
        irradiance = incident.total(light.environment, light.emitters)
        reflectance = outgoing / np.maximum(irradiance, RADIANCE_LEAST)
        matt, mirrored = self._parts(rough.value, lobes)
        albedo = filled(np.maximum(reflectance - mirrored, MATT_LEAST * reflectance) / matt, irradiance, near)
        explained = (albedo_in_range(albedo) * matt + np.minimum(mirrored, reflectance)) * irradiance
        observed = incident.observed.mean(axis=1) / np.maximum(irradiance.mean(axis=1), RADIANCE_LEAST)
        return MaterialEstimate(
            gaussians=self._with_materials(albedo, normals, rough.value),
            cells=cells,
            sky=light.environment,
            emitters=light.emitters,
            emitter_of=emitters,
            residual=_unexplained(outgoing, explained),
            confidence=np.clip(observed, 0.0, 1.0).astype(np.float32),
            sureness=rough.confidence,
            is_inside=inside,
            out_of_range=(albedo > 1.0).any(axis=1) & (emitters < 0),
            is_white=white & (emitters < 0),
            is_too_dark=np.asarray((reflectance < mirrored).any(axis=1)),
        )

    def _checked_outgoing(self, normals: Doubles, white: Flags) -> Doubles:
        """Radiance of Gaussians, shape (N, 3).

        Raises:
            SceneError: It is that of display white or of black everywhere.
        """
        if white.all():
            raise SceneError("all Gaussians are as bright as display white: no material can be told of any")
        outgoing = median_outgoing(self.gaussians, normals)
        if outgoing.max() < RADIANCE_LEAST:
            raise SceneError("all Gaussians are black: no light fell on them that could tell a material")
        return outgoing

    def _parts(self, roughness: FloatArray, lobes: Lobes) -> tuple[Doubles, Doubles]:
        """Shares of light that Gaussians of albedo 1 scatter and mirror, as if it came evenly, shape (N, 1) both."""
        if self.config.matt:
            return np.ones((len(roughness), 1)), np.zeros((len(roughness), 1))
        matt, mirrored = lobes.in_constant_environment(roughness)
        return matt[:, None], mirrored[:, None]

    def _finer(
        self, normals: Doubles, smoother: Smoother, cells: EnvironmentCells, incident: Irradiance, light: Light
    ) -> tuple[EnvironmentCells, Irradiance, Light]:
        """The cells of the sky that shine most in parts."""
        power = light.environment.mean(axis=1) * cells.solid_angles
        bright = np.argsort(-power, kind="stable")[:BRIGHT_CELLS]
        others = np.setdiff1d(np.arange(len(cells)), bright)
        parts = cells.of(bright).parts(BRIGHT_PARTS)
        found = smoother.mean(self.rays.from_environment(normals, parts))
        environment = np.concatenate([incident.environment[:, others], found], axis=1)
        radiances = np.concatenate(
            [light.environment[others], np.repeat(light.environment[bright], BRIGHT_PARTS**2, axis=0)]
        )
        return (
            cells.of(others).joined(parts),
            replace(incident, environment=environment),
            replace(light, environment=radiances),
        )

    def _with_materials(self, albedo: Doubles, normals: Doubles, roughness: FloatArray) -> Gaussians:
        """The capture with what was found."""
        return replace(
            self.gaussians,
            albedo=read_only_view(albedo_in_range(albedo).astype(np.float32)),
            roughness=roughness,
            metallic=None,
            normals=read_only_view(normals.astype(np.float32)),
        )


def _agreeing_axes(gaussians: Gaussians) -> Doubles:
    """Shortest axes, shape (N, 3), turned to one side: they stay so where no ray tells, as of a sheet on its own."""
    axes = shortest_axes(gaussians)
    return agreeing_signs(axes)[:, None] * axes


def filled(albedo: Doubles, irradiance: Doubles, near: Pairs) -> Doubles:
    """Albedos; where hardly any light was found, those of neighbours, shape (N, 3)."""
    light = irradiance.mean(axis=1)
    certainty = np.clip(light / (IRRADIANCE_KNOWN * float(np.median(light)) + 1e-12) - 1.0, 0.0, 1.0)
    weights = certainty[near.second] + 1e-6
    total = np.bincount(near.first, weights, len(albedo))
    sums = [np.bincount(near.first, weights * channel[near.second], len(albedo)) for channel in albedo.T]
    around = np.stack(sums, axis=1) / total[:, None]
    return certainty[:, None] * albedo + (1.0 - certainty)[:, None] * around


def _unexplained(outgoing: Doubles, explained: Doubles) -> FloatArray:
    """By how much what is explained differs from radiances, as a share of these, shape (N,)."""
    difference = np.abs(explained - outgoing).mean(axis=1)
    return (difference / np.maximum(outgoing.mean(axis=1), RADIANCE_LEAST)).astype(np.float32)


def is_white(gaussians: Gaussians, normals: Doubles) -> Flags:
    """Which Gaussians are as bright as could be captured, seen from before them: they may have been brighter; (N,)."""
    return (colors_along(gaussians, -normals) >= CLIPPED).all(axis=1) & (gaussians.opacities > 0.0)


def emitters_of(gaussians: Gaussians, white: Flags) -> Rows:
    """The group of white Gaussians that each is in, largest first, shape (N,); -1: none, or beyond the last."""
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
    """Materials of a capture of N Gaussians, and the light in which it was taken."""

    gaussians: Gaussians
    """The capture, Gaussian by Gaussian, with ``albedo`` (linear), ``roughness`` and ``normals``."""
    cells: EnvironmentCells
    """Of the sky, K of them; none if the capture was taken from inside of it."""
    sky: Doubles
    """Radiance of each, linear, in units of display white, shape (K, 3)."""
    emitters: Doubles
    """Radiances of groups of Gaussians that were as bright as could be captured, likewise, shape (L, 3)."""
    emitter_of: Rows
    """The group of each Gaussian, -1: none, shape (N,)."""
    residual: FloatArray
    """What materials and light leave unexplained of each Gaussian's captured radiance, as a share of it, 0.., (N,)."""
    confidence: FloatArray
    """How much of the light at a Gaussian was seen in the capture rather than found, 0..1, shape (N,)."""
    sureness: FloatArray
    """By how much highlights narrow down the roughness of each Gaussian, 0..1, shape (N,). At 0 it is 0.8, which is not
    found but taken: nothing tells, as in a capture whose colours do not change with the direction of view."""
    is_inside: bool
    """Whether the capture was taken from inside of it, as that of a room is."""
    out_of_range: Flags
    """Gaussians whose albedo would be above 1 in a channel: more light reached them than was found. They are darkened
    in all channels by one factor, to 1 in the lightest, so that they keep their hue; shape (N,)."""
    is_white: Flags
    """Gaussians, but for lamps, that may have been brighter than could be captured: their albedo is a guess; (N,)."""
    is_too_dark: Flags
    """Gaussians that are darker in a channel than what a surface as they have mirrors: relit, they come out lighter
    there, and saturated colours paler; shape (N,)."""

    def sky_image(self, rotation_wxyz: npt.ArrayLike = (1.0, 0.0, 0.0, 0.0)) -> FloatArray:
        """The sky as a latitude-longitude image for `LightEnvironment`, shape (H, 2 H, 3); black if there is none.

        Args:
            rotation_wxyz: World from image, such as ``scene.upright_wxyz``; a `LightEnvironment` that is turned by it
                shines as the sky did.
        """
        directions = (
            panorama_directions(ENVIRONMENT_IMAGE_ROWS, 2 * ENVIRONMENT_IMAGE_ROWS) @ rotation_matrix(rotation_wxyz).T
        )
        if not len(self.cells):
            return np.zeros(directions.shape, np.float32)
        cosines = directions @ self.cells.directions.T
        within = np.cos(np.sqrt(self.cells.solid_angles / np.pi))
        # The cell in whose disc a direction lies deepest; cells of all sizes count by their own.
        nearest = np.argmax((cosines - 1.0) / (1.0 - within), axis=-1)
        return self.sky[nearest].astype(np.float32)

    def save_sky(self, path: str | os.PathLike[str], rotation_wxyz: npt.ArrayLike = (1.0, 0.0, 0.0, 0.0)) -> None:
        """Writes `sky_image` as an EXR.

        Args:
            path: File to write, .exr.
            rotation_wxyz: As for `sky_image`.

        Raises:
            FormatError: The file cannot be written.
        """
        write_radiance(path, self.sky_image(rotation_wxyz))

    @property
    def remarks(self) -> tuple[str, ...]:
        """What to know about the result, a sentence each."""
        observed = float(self.confidence.mean())
        lines = [
            "a closed room, for much of it sees no sky (if not: --inside no, inside=False): light is what it shows"
            if self.is_inside
            else f"open: {1.0 - observed:.0%} of the light comes from where the capture shows nothing, and is found as "
            "a sky, whose brightness is a guess (a closed room: --inside yes, inside=True)"
        ]
        if len(self.emitters):
            brightness = ", ".join(f"{emitter.mean():.3g}" for emitter in self.emitters)
            lines.append(f"lamps, times as bright as display white: {brightness}")
        if self.sureness.any():
            share = float((self.sureness > CONFIDENT).mean())
            lines.append(
                f"views from all sides tell the roughness of {share:.0%} of the Gaussians; else it is nearer to 0.8"
            )
        else:
            lines.append("roughness is 0.8 everywhere: colours do not change with the view, or lamps are in it")
        if (share := float(self.out_of_range.mean())) > TOO_LIGHT:
            lines.append(
                f"{share:.1%} of the Gaussians would reflect more than all light: albedo ends at 1, in the same hue"
            )
        if (share := float(self.is_white.mean())) > TOO_LIGHT:
            lines.append(f"{share:.1%} of the Gaussians are as bright as display white: their albedo is a guess")
        if (share := float(self.is_too_dark.mean())) > TOO_LIGHT:
            lines.append(
                f"{share:.1%} of the Gaussians are darker, in a channel at least, than what they would mirror, and "
                "come out lighter and paler: --matt, or matt=True, is for what mirrors nothing"
            )
        if (share := float((self.residual > RESIDUAL_LARGE).mean())) > TOO_LIGHT:
            lines.append(f"the captured colour of {share:.1%} of the Gaussians is not explained")
        return tuple(lines)
