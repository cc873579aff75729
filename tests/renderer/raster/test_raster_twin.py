"""The rasteriser compared with its float64 twin, frame by frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from support.compare.backends import renderer_of
from support.compare.images import assert_close_outside_band
from support.oracles import raster_oracle as oracles
from support.scenes.raster_scenes import Case, cases

ELLIPSOIDS = ("instances", "merged", "needles", "antialiased by the file", "no dilation", "mesh crossing")
"""Names of the cases that are drawn once more with normals of ellipsoids."""


def all_cases() -> list[Case]:
    """Returns all cases, several instances merged by the depths of their surfaces, and some with other normals."""
    by_peaks = ls.config.TraceConfig(hit_distance=ls.config.HitDistance.PEAK)
    merged = [
        replace(one, name="merged", config=replace(one.config, trace=by_peaks))
        for one in cases()
        if one.name == "instances"
    ]
    assert merged
    every = [*cases(), *merged]
    trace = {one.name: replace(one.config.trace, normal_method=ls.config.NormalMethod.ELLIPSOID) for one in every}
    return every + [
        replace(one, name=f"{one.name}, ellipsoids", config=replace(one.config, trace=trace[one.name]))
        for one in every
        if one.name in ELLIPSOIDS
    ]


@pytest.mark.parametrize("case", all_cases(), ids=lambda case: case.name)
def test_rasterised_frame_equals_the_float64_reference(case: Case, backend: str) -> None:
    """Every image equals the twin's to float32 precision, except where rounding may flip a decision.

    At such pixels, one splat of alpha 1/255 more or less may change the colour, and any surface may be chosen. At an
    edge of a mesh, or where depths are equal, the colour may be anything.
    """
    frame = renderer_of(backend, replace(case.config, lighting=False)).render(case.scene, case.camera)
    twin = oracles.render(case.scene, case.camera, case.config)
    band = twin["band"]
    for name, atol, band_atol in (
        ("color", 2e-5, 0.02),
        ("alpha", 2e-5, 0.01),
        ("normal", 5e-4, np.inf),
        ("gaussian_index", 0, np.inf),
        ("instance_index", 0, np.inf),
    ):
        tie = twin["tie"].reshape(*band.shape, *(1,) * (twin[name].ndim - 2))
        actual = np.where(tie & (np.isfinite(band_atol)), twin[name], getattr(frame, name))
        assert_close_outside_band(actual, twin[name], band, atol=atol, band_atol=band_atol, name=name)
    for name in ("depth", "depth_z"):
        ratio = relative(getattr(frame, name), twin[name])
        assert_close_outside_band(ratio, np.ones(band.shape), band, atol=1e-5, name=f"{name} ratio")


def relative(actual: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Returns the ratio of two values: 1 where both are infinite, infinite where only one is."""
    both = np.isinf(actual) & np.isinf(expected)
    one = np.isinf(actual) ^ np.isinf(expected)
    safe = np.where(np.isinf(actual) | np.isinf(expected), 1.0, actual) / np.where(np.isinf(expected), 1.0, expected)
    return np.where(both, 1.0, np.where(one, np.inf, safe))
