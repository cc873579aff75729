"""The ray tracer compared with its float64 twin, frame by frame and ray by ray."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import lumisplat as ls
from support.compare.backends import LISTS_AND_BVHS, renderer_of
from support.oracles import trace_oracle
from support.scenes.raster_scenes import quad
from support.scenes.trace_scenes import Case, cases, mirror_scene, placed_scene, trace_config
from support.twins import TWINS

CASES = {case.name: case for case in cases()}
WORLD = trace_config((0.3, 0.5, 0.9))
CERTAIN_SHARE = 0.75
"""Fraction of pixels at which the twin must leave little tolerance; otherwise the comparison proves nothing."""


@cache
def twin_of(name: str) -> dict[str, np.ndarray]:
    """Returns the twin's frame of a case, which is the same for every backend."""
    case = CASES[name]
    return TWINS.result(trace_oracle.render, case.scene, case.camera, case.config)


@LISTS_AND_BVHS
@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_traced_frame_equals_the_float64_reference(case: Case, backend: str, lists: bool) -> None:
    """Every image equals the twin's within the tolerance that the twin computes for rounding.

    Colours, alpha and normals are compared everywhere, index and distance of the surface where rounding cannot change
    them.
    """
    renderer = renderer_of(backend, replace(case.config, lighting=False), lists=lists)
    frame = renderer.render(case.scene, case.camera)
    assert_agrees(frame, twin_of(case.name), ("color", "alpha"), ("depth", "depth_z"))


@cache
def rays_and_twin() -> tuple[ls.Scene, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Returns rays in all directions, of any length, through Gaussians, meshes and a mirror, and the twin's results."""
    rng = np.random.default_rng(180)
    scene = ls.Scene(placed_scene().splats, mirror_scene().meshes + ls.Scene([], [quad(3.4, 0.6, tilt=0.4)]).meshes)
    origins = rng.normal((0.0, 0.0, 4.0), 2.5, (600, 3)).astype(np.float32)
    directions = rng.normal((0.0, 0.0, 4.0), 0.8, (600, 3)).astype(np.float32) - origins
    return scene, origins, directions, TWINS.result(trace_oracle.trace_rays, scene, origins, directions, WORLD)


def test_single_rays_equal_the_float64_reference(backend: str) -> None:
    """The rays have no common origin or direction; mirrors show the background."""
    scene, origins, directions, twin = rays_and_twin()
    hits = renderer_of(backend, WORLD).trace_rays(scene, origins, directions)
    assert_agrees(hits, twin, ("radiance", "transmittance"), ("depth",))
    assert 0.2 < np.isfinite(hits.depth).mean() < 0.9
    assert len(np.unique(hits.instance_index)) == 6


def assert_agrees(
    actual: ls.Frame | ls.RayHits, twin: dict[str, np.ndarray], colors: tuple[str, ...], depths: tuple[str, ...]
) -> None:
    """Asserts that every image is within the twin's rounding tolerance."""
    for name in colors:
        assert (twin["slack"] < 0.02).mean() >= CERTAIN_SHARE, "the tolerance is too large to prove anything"
        assert_within(getattr(actual, name), twin[name], 5e-6 + twin["slack"], name)
    assert (twin["normal_slack"] < 0.1).mean() >= CERTAIN_SHARE, "the tolerance is too large to prove anything"
    assert_within(actual.normal, twin["normal"], 1e-5 + twin["normal_slack"], "normal")
    sure = ~twin["band"]
    assert sure.mean() >= CERTAIN_SHARE, "too many surfaces are uncertain to compare"
    for name in ("gaussian_index", "instance_index"):
        assert_within(getattr(actual, name)[sure], twin[name][sure], np.zeros(np.count_nonzero(sure)), name)
    found = sure & np.isfinite(twin["depth"])
    np.testing.assert_array_equal(np.isfinite(actual.depth) & sure, found)
    for name in depths:
        expected = twin[name][found]
        tolerance = 1e-5 * np.abs(expected) + twin["depth_slack"][found]
        assert_within(getattr(actual, name)[found], expected, tolerance, name)


def assert_within(actual: np.ndarray, expected: np.ndarray, tolerance: np.ndarray, name: str) -> None:
    """Asserts that no value differs by more than the tolerance of its pixel, and that none is NaN."""
    assert not np.isnan(actual).any(), f"{name} has {np.isnan(actual).sum()} NaN"
    error = (
        np.abs(actual.astype(np.float64) - expected).reshape(*tolerance.shape, -1 if actual.size else 1).max(axis=-1)
    )
    off = np.argwhere(error > tolerance)
    assert not len(off), (
        f"{name} differs at {len(off)} pixels, first at {tuple(off[0].tolist())}: {actual[tuple(off[0])]} for "
        f"{expected[tuple(off[0])]}, {error[tuple(off[0])]:.3g} where {tolerance[tuple(off[0])]:.3g} is allowed"
    )
