"""The ray tracer against its float64 twin, frame by frame."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import trace_oracle
from trace_scenes import Case, cases
from ways import renderer_of

CASES = {case.name: case for case in cases()}
SURE = 0.75
"""Share of the pixels at which the twin must leave little room, or the comparison would prove nothing."""


@cache
def twin_of(name: str) -> dict[str, np.ndarray]:
    """The twin's frame of a case, the same for every way."""
    case = CASES[name]
    return trace_oracle.render(case.scene, case.camera, case.config)


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_frame_equals_twin(case: Case, way: str) -> None:
    """Every image of a frame is the twin's, but for what rounding may change of it by the twin's own account.

    Colours, alpha and normals everywhere; index and distance of the surface where it cannot be another one.
    """
    frame = renderer_of(way, case.config).render(case.scene, case.camera)
    twin = twin_of(case.name)
    for name, atol, slack, much in (
        ("color", 5e-6, twin["slack"], 0.02),
        ("alpha", 5e-6, twin["slack"], 0.02),
        ("normal", 1e-5, twin["normal_slack"], 0.1),
    ):
        assert (slack < much).mean() >= SURE, f"{name}: too much room to compare"
        assert_within(getattr(frame, name), twin[name], atol + slack, name)

    sure = ~twin["band"]
    assert sure.mean() >= SURE, "too many surfaces are in doubt to compare"
    for name in ("gaussian_index", "instance_index"):
        assert_within(getattr(frame, name)[sure], twin[name][sure], np.zeros(np.count_nonzero(sure)), name)
    found = sure & np.isfinite(twin["depth"])
    np.testing.assert_array_equal(np.isfinite(frame.depth) & sure, found)
    for name in ("depth", "depth_z"):
        expected = twin[name][found]
        assert_within(getattr(frame, name)[found], expected, 1e-5 * np.abs(expected) + twin["depth_slack"][found], name)


def assert_within(actual: np.ndarray, expected: np.ndarray, room: np.ndarray, name: str) -> None:
    """No value of a pixel is farther off than the pixel's ``room``, and none is NaN."""
    assert not np.isnan(actual).any(), f"{name} has {np.isnan(actual).sum()} NaN"
    error = np.abs(actual.astype(np.float64) - expected).reshape(*room.shape, -1 if actual.size else 1).max(axis=-1)
    off = np.argwhere(error > room)
    assert not len(off), (
        f"{name} differs at {len(off)} pixels, first at {tuple(off[0].tolist())}: {actual[tuple(off[0])]} for "
        f"{expected[tuple(off[0])]}, {error[tuple(off[0])]:.3g} where {room[tuple(off[0])]:.3g} is room"
    )
