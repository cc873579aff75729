"""Light estimated from captures: emitters, brightness of the environment, its image, and median radiance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import SH_C0
from lumisplat.math.color import encode_srgb
from lumisplat.math.directions import panorama_directions, panorama_lookup
from lumisplat.math.sh import sh_basis
from lumisplat.math.transforms import rotation_matrix
from lumisplat.relighting.albedo_fit import EnvironmentCells, Light, initial_light, with_typical_albedos
from lumisplat.relighting.delight import emitters_of, is_white
from lumisplat.relighting.incident import IncidentRays, Smoother, neighbours_of
from lumisplat.relighting.irradiance import Irradiance, median_outgoing

EMITTER, FLOOR = 60, 200


def with_color(gaussians: ls.Gaussians, linear: float) -> ls.Gaussians:
    """Returns the set with one captured grey of a linear value."""
    sh = np.full((gaussians.count, 1, 3), (float(encode_srgb(np.array(linear))) - 0.5) / SH_C0, np.float32)
    return replace(gaussians, sh=sh, albedo=None, roughness=None, normals=None)


def emitter_over_floor(*, screen: bool = False) -> tuple[ls.Gaussians, np.ndarray]:
    """Returns a white square facing down above a dark floor, optionally a black screen between, and the normals."""
    sets = [
        ls.transform(ls.gaussians_from_mesh(ls.plane(0.5, 0.5), EMITTER), translation=(0.0, 1.0, 0.0)),
        ls.gaussians_from_mesh(ls.plane(2.0, 2.0), FLOOR),
        ls.transform(ls.gaussians_from_mesh(ls.plane(1.5, 1.5), FLOOR), translation=(0.0, 0.5, 0.0)),
    ]
    colored = [with_color(one, linear) for one, linear in zip(sets, (1.0, 0.001, 0.0), strict=True)]
    both = ls.merge(colored if screen else colored[:2])
    down = np.arange(both.count)[:, None] < EMITTER
    return both, np.where(down, (0.0, -1.0, 0.0), (0.0, 1.0, 0.0))


def incident(gaussians: ls.Gaussians, normals: np.ndarray, emitters: np.ndarray) -> Irradiance:
    """Returns the irradiance of the Gaussians of a set by ray tracing."""
    renderer = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.TRACE, lighting=False), "cpu")
    smoother = Smoother.of(neighbours_of(gaussians), normals, emitters)
    return IncidentRays(gaussians, normals, renderer, 0).incident(smoother, normals, emitters, EnvironmentCells.even(8))


def test_observed_irradiance_in_delight_excludes_gaussians_that_count_as_emitters() -> None:
    """Observed irradiance includes the light of a white square only if the square does not count as an emitter."""
    both, normals = emitter_over_floor()
    groups = emitters_of(both, is_white(both, normals))
    assert (groups[:EMITTER] == 0).all() and (groups[EMITTER:] == -1).all()
    as_white, as_emitter = (incident(both, normals, some) for some in (np.full(both.count, -1), groups))
    assert as_white.observed[EMITTER:].mean() > 0.03
    assert as_emitter.observed[EMITTER:].mean() < 0.05 * as_white.observed[EMITTER:].mean()
    assert as_emitter.emitters[EMITTER:, 0].min() > 0.0 and not as_white.emitters.size
    # An emitter with the captured radiance gives the observed irradiance, although its Gaussians overlap.
    assert np.isclose(as_emitter.emitters[EMITTER:, 0].mean(), as_white.observed[EMITTER:].mean(), rtol=0.05)
    np.testing.assert_array_equal(as_emitter.environment, as_white.environment)


def test_captured_emitters_that_delight_finds_are_one_sided_and_cast_shadows() -> None:
    """Surfaces below a screen, and above an emitter that faces down, receive no light from it."""
    both, normals = emitter_over_floor(screen=True)
    groups = emitters_of(both, is_white(both, normals))
    lit = incident(both, normals, groups).emitters[:, 0]
    floor, screen = lit[EMITTER : EMITTER + FLOOR], lit[EMITTER + FLOOR :]
    middle = np.abs(both.means[EMITTER : EMITTER + FLOOR, [0, 2]]).max(axis=1) < 0.4
    assert middle.sum() > 20 and floor[middle].max() < 0.02 * screen.max()
    above = replace(
        both, means=both.means + (0.0, 2.0, 0.0) * (groups < 0)[:, None]
    )  # moves all Gaussians but the emitter's above it
    facing_it = np.tile([0.0, -1.0, 0.0], (both.count, 1))
    assert not incident(above, facing_it, groups).emitters[EMITTER:].any()


def test_transparent_white_gaussians_do_not_count_as_emitters() -> None:
    """Gaussians of opacity 0, as 8-bit formats store them, have no area."""
    both, normals = emitter_over_floor()
    clear = replace(both, opacities=np.where(np.arange(both.count) < EMITTER, 0.0, both.opacities))
    assert (emitters_of(clear, is_white(clear, normals)) == -1).all()


def test_delight_divides_bright_environment_cells_and_locates_the_sun_to_10_degrees() -> None:
    """The brightest cells are divided; a ball in the sun loses its shading."""
    plain = ls.gaussians_from_mesh(ls.sphere(1.0), 400)
    albedo = np.where(np.sin(6.0 * plain.means[:, 1]) > 0.0, 0.8, 0.4)
    sun = np.array((0.3, 0.8, 0.52)) / np.linalg.norm((0.3, 0.8, 0.52))  # away from the centres of the 16 cells
    light = 0.25 + 0.7 * np.maximum(np.asarray(plain.normals, np.float64) @ sun, 0.0)
    sh = (encode_srgb(albedo * light) - 0.5)[:, None, None] / SH_C0 * np.ones(3)
    captured = replace(plain, sh=sh.astype(np.float32), albedo=None, roughness=None, normals=None)
    found = ls.inverse.estimate_materials(captured, ls.config.DelightConfig(cells=4, matt=True), device="cpu")
    brightest = found.cells.directions[found.environment.mean(axis=1).argmax()]
    assert np.degrees(np.arccos(brightest @ sun)) < 10.0
    assert np.log(np.asarray(found.gaussians.albedo).mean(axis=1) / albedo).std() < 0.1


def test_delight_scales_light_so_that_the_lightest_surfaces_have_albedo_0_8() -> None:
    """The 95th percentile of each albedo's largest channel becomes 0.8, in the presence of observed light."""
    rng = np.random.default_rng(1)
    some = Irradiance(np.full((400, 3), 0.4), rng.random((400, 9), np.float32), np.zeros((400, 0), np.float32))
    true = Light(rng.uniform(0.2, 2.0, (9, 3)), np.zeros((0, 3)))
    outgoing = rng.uniform(0.1, 1.0, (400, 3)) * some.total(true.environment, true.emitters)
    for start in (Light(5.0 * true.environment, true.emitters), Light(0.3 * true.environment, true.emitters)):
        light = with_typical_albedos(start, outgoing, some)
        lightest = (outgoing / some.total(light.environment, light.emitters)).max(axis=1)
        assert np.quantile(lightest, 0.95) == pytest.approx(0.8, rel=1e-3)
        np.testing.assert_allclose(light.environment / true.environment, (light.environment / true.environment)[0, 0])
    grey = initial_light(outgoing, some)
    assert np.ptp(grey.environment) == 0.0
    lightest = (outgoing / some.total(grey.environment, grey.emitters)).max(axis=1)
    assert np.quantile(lightest, 0.95) == pytest.approx(0.8, rel=0.01)


def test_delight_estimates_an_emitters_radiance_without_surfaces_hidden_from_it() -> None:
    """A tenth of the Gaussians receive a fifth of the estimated light; equal weights would double the emitter."""
    rng = np.random.default_rng(3)
    lit, albedo = (
        rng.uniform(0.02, 0.06, (4000, 1)),
        rng.uniform(0.1, 0.84, (4000, 1)),
    )  # the 95th percentile of the albedo is 0.8
    outgoing = albedo * (0.2 + 30.0 * lit) * np.ones(3)
    hidden = np.arange(4000)[:, None] % 10 == 0
    found = lit * np.where(hidden, rng.uniform(0.1, 0.3, (4000, 1)), 1.0)
    some = Irradiance(np.full((4000, 3), 0.2), np.zeros((4000, 0), np.float32), found.astype(np.float32))
    assert initial_light(outgoing, some).emitters == pytest.approx(np.full((1, 3), 30.0), rel=0.12)
    # Equal weights of all Gaussians would give a much brighter emitter.
    wanted = (outgoing[:, 0] / 0.8 - 0.2) / found[:, 0]
    assert np.quantile(wanted, 0.95) > 60.0


def test_few_dark_surfaces_close_to_an_emitter_do_not_decide_its_estimated_radiance() -> None:
    """A dark lampshade of 1 % of the Gaussians receives fifty times the light of the walls."""
    rng = np.random.default_rng(4)
    lit, albedo = rng.uniform(0.02, 0.06, (4000, 1)), rng.uniform(0.1, 0.84, (4000, 1))
    lit[:40], albedo[:40] = 2.0, 0.05
    some = Irradiance(np.full((4000, 3), 0.2), np.zeros((4000, 0), np.float32), lit.astype(np.float32))
    outgoing = albedo * (0.2 + 30.0 * lit) * np.ones(3)
    assert initial_light(outgoing, some).emitters == pytest.approx(np.full((1, 3), 30.0), rel=0.12)


def test_rotation_of_the_estimated_environment_light_matches_its_image() -> None:
    """World-space radiance by direction is the same for every rotation of the image."""
    cells, environment = EnvironmentCells.even(6), np.random.default_rng(2).random((36, 3))
    floor = with_color(ls.gaussians_from_mesh(ls.plane(2.0, 2.0), 100), 0.3)
    found = replace(
        ls.inverse.estimate_materials(floor, ls.config.DelightConfig(cells=4), device="cpu"),
        cells=cells,
        environment=environment,
    )
    rotation = np.array([0.8, 0.4, -0.2, 0.4])
    directions = panorama_directions(40, 80).reshape(-1, 3)
    plain = panorama_lookup(found.environment_image(), directions)
    turned = panorama_lookup(
        found.environment_image(rotation), directions @ rotation_matrix(rotation)
    )  # rotates directions from world to image space
    assert np.median(np.abs(plain - turned)) < 0.01
    nearest = np.argmax(directions @ cells.directions.T, axis=1)
    assert np.median(np.abs(plain - environment[nearest])) < 0.01


def test_median_radiance_over_view_directions_of_a_gaussian_excludes_highlights() -> None:
    """An SH lobe in one direction changes the median far less than the radiance in that direction."""
    plain = with_color(ls.gaussians_from_mesh(ls.plane(1.0, 1.0), 20), 0.2)
    towards = np.array([0.5, 0.8, 0.2]) / np.linalg.norm([0.5, 0.8, 0.2])
    lobe = 0.1 * sh_basis(-towards, 3)[:, None] * np.ones(3)
    lobe[0] = 0.0
    sh = np.concatenate([plain.sh, np.zeros((20, 15, 3))], axis=1) + lobe
    shiny = replace(plain, sh=sh.astype(np.float32))
    normals = np.tile([0.0, 1.0, 0.0], (20, 1))
    brighter = 0.1 * float(np.square(sh_basis(towards, 3)[1:]).sum())
    assert brighter > 0.1
    before, after = (encode_srgb(median_outgoing(one, normals)) for one in (plain, shiny))
    assert np.abs(after - before).max() < 0.35 * brighter
