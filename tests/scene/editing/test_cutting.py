"""Captures are cut by region, value and neighbours, and remaining Gaussians stay unchanged."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import SH_C0
from support.scenes.raster_scenes import random_gaussians


def rows_of(part: ls.Gaussians, whole: ls.Gaussians) -> list[int]:
    """Returns the indices of a part's Gaussians in a capture, found by means, and checks all other properties."""
    index = {bytes(mean): row for row, mean in enumerate(np.ascontiguousarray(whole.means))}
    rows = [index[bytes(mean)] for mean in np.ascontiguousarray(part.means)]
    for name, values in part.arrays().items():
        np.testing.assert_array_equal(values, whole.arrays()[name][rows])
    return rows


@pytest.fixture
def capture() -> ls.Gaussians:
    """Returns a hundred Gaussians in a box, with materials."""
    rng = np.random.default_rng(5)
    return random_gaussians(3, count=100, degree=2, roughness=rng.random(100), metallic=rng.random(100))


def test_crop_keeps_the_gaussians_inside_a_box(capture: ls.Gaussians) -> None:
    """Corners may come in any order, faces belong to the inside, and the outside is the complement."""
    low, high = np.array([-1.0, -0.5, 3.5]), np.array([0.5, 1.0, 5.0])
    expected = [i for i, mean in enumerate(capture.means) if (mean >= low).all() and (mean <= high).all()]
    assert 5 < len(expected) < 95
    assert rows_of(ls.editing.crop(capture, box=(low, high)), capture) == expected
    mixed = ([low[0], high[1], low[2]], [high[0], low[1], high[2]])
    assert rows_of(ls.editing.crop(capture, box=mixed), capture) == expected
    assert rows_of(ls.editing.crop(capture, box=(low, high), outside=True), capture) == sorted(
        {*range(100)} - {*expected}
    )
    one = capture.means[7]
    assert rows_of(ls.editing.crop(capture, box=(one, one)), capture) == [7]


def test_crop_by_a_box_and_a_sphere_keeps_their_intersection(capture: ls.Gaussians) -> None:
    """A sphere keeps Gaussians within its radius; box and sphere together keep the intersection."""
    center, radius = np.array([0.2, 0.1, 4.0]), 1.2
    inside = np.linalg.norm(capture.means.astype(np.float64) - center, axis=1) <= radius
    assert rows_of(ls.editing.crop(capture, sphere=(center, radius)), capture) == np.flatnonzero(inside).tolist()
    box = ((-9, -9, -9), (9, 9, 4))
    both = inside & (capture.means[:, 2] <= 4)
    assert rows_of(ls.editing.crop(capture, box=box, sphere=(center, radius)), capture) == np.flatnonzero(both).tolist()


def test_edit_that_removes_no_gaussian_returns_the_capture_object_itself(capture: ls.Gaussians) -> None:
    """A cut that removes nothing copies nothing."""
    assert ls.editing.crop(capture, sphere=((0, 0, 4), 100.0)) is capture
    assert ls.editing.select(capture, opacity=(0.0, 1.0)) is capture
    assert ls.editing.limit_sh_degree(capture, 2) is capture
    padded = ls.editing.limit_sh_degree(capture, 3, pad=True)
    assert padded.sh.shape[1] == 16 and not padded.sh[:, capture.sh.shape[1] :].any()
    np.testing.assert_array_equal(padded.sh[:, : capture.sh.shape[1]], capture.sh)
    assert ls.editing.limit_sh_degree(capture, capture.sh_degree, pad=True) is capture
    assert ls.editing.decimate(capture, 100) is capture


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("opacity", lambda g: g.opacities),
        ("scale_min", lambda g: g.scales.min(axis=1)),
        ("scale_max", lambda g: g.scales.max(axis=1)),
        ("x", lambda g: g.means[:, 0]),
        ("y", lambda g: g.means[:, 1]),
        ("z", lambda g: g.means[:, 2]),
        ("red", lambda g: 0.5 + SH_C0 * g.sh[:, 0, 0]),
        ("green", lambda g: 0.5 + SH_C0 * g.sh[:, 0, 1]),
        ("blue", lambda g: 0.5 + SH_C0 * g.sh[:, 0, 2]),
        ("roughness", lambda g: g.roughness),
        ("metallic", lambda g: g.metallic),
    ],
)
def test_select_accepts_for_each_property_a_lower_or_an_upper_limit_or_both(
    capture: ls.Gaussians, name: str, values: Any
) -> None:
    """Each value can be limited on one side or both."""
    all_values = values(capture)
    low, high = (float(x) for x in np.quantile(all_values, (0.313, 0.717)))
    for limits in ((low, None), (None, high), (low, high)):
        in_range = all_values >= (low if limits[0] is not None else -np.inf)
        in_range &= all_values <= (high if limits[1] is not None else np.inf)
        selected = ls.editing.select(capture, **{name: limits})
        assert rows_of(selected, capture) == np.flatnonzero(in_range).tolist()


def test_select_keeps_only_gaussians_within_all_given_property_ranges(capture: ls.Gaussians) -> None:
    """A selected Gaussian is within all given ranges."""
    both = ls.editing.select(capture, opacity=(0.5, None), z=(None, 4.0))
    assert rows_of(both, capture) == np.flatnonzero((capture.opacities >= 0.5) & (capture.means[:, 2] <= 4)).tolist()


def cloud_with_strays() -> tuple[ls.Gaussians, int]:
    """Returns a sheet of small Gaussians, wide background ones and three small strays, and the count without strays."""
    rng = np.random.default_rng(1)
    sheet = np.column_stack([rng.uniform(-1, 1, (2000, 2)), np.full(2000, 4.0)])
    far = np.column_stack([10.0 * np.indices((5, 5)).reshape(2, -1).T - 20.0, np.full(25, 50.0)])
    strays = np.array([[0, 0, 2.0], [0.5, 0.3, 6.0], [-3, 2, 4.0]])
    means = np.concatenate([sheet, far, strays])
    scales = np.concatenate([np.full(2000, 0.05), np.full(25, 8.0), np.full(3, 0.05)])
    count = len(means)
    sh = np.zeros((count, 1, 3))
    rotations = np.tile([1.0, 0, 0, 0], (count, 1))
    return ls.Gaussians(means, rotations, np.repeat(scales[:, None], 3, axis=1), np.full(count, 0.8), sh), count - 3


def test_remove_floaters_removes_isolated_small_gaussians_and_keeps_isolated_wide_ones() -> None:
    """Background Gaussians are as isolated as strays, but so wide that they reach their neighbours."""
    cloud, solid = cloud_with_strays()
    progress: list[float] = []
    assert rows_of(ls.editing.remove_floaters(cloud, progress=progress.append), cloud) == list(range(solid))
    assert progress == sorted(progress) and progress[-1] == 1.0


@pytest.mark.parametrize(("neighbours", "reach"), [(1, 1.0), (4, 3.0), (20, 2.0)])
def test_remove_floaters_counts_neighbours_as_brute_force_does(neighbours: int, reach: float) -> None:
    """The reference compares each Gaussian with every other."""
    capture = random_gaussians(8, count=700, scale_range=(0.001, 0.9))
    capture = replace(capture, scales=capture.scales * 0.5)
    largest = capture.scales.max(axis=1)
    radii = np.float32(reach) * np.maximum(largest, np.median(largest).astype(np.float32))
    steps = capture.means[:, None] - capture.means[None]
    others = (np.einsum("ijk,ijk->ij", steps, steps) <= radii[:, None] ** 2).sum(axis=1) - 1
    expected = np.flatnonzero(others >= neighbours)
    assert 0 < expected.size < 700
    assert rows_of(ls.editing.remove_floaters(capture, neighbours, reach), capture) == expected.tolist()


def test_limit_sh_degree_leaves_the_lower_degrees_unchanged(capture: ls.Gaussians) -> None:
    """SH coefficients above the limit are removed."""
    for degree in (0, 1):
        limited = ls.editing.limit_sh_degree(capture, degree)
        assert limited.sh_degree == degree
        np.testing.assert_array_equal(limited.sh, capture.sh[:, : (degree + 1) ** 2])
        assert limited.means is capture.means


def test_sort_morton_permutes_gaussians_and_brings_neighbours_together(capture: ls.Gaussians) -> None:
    """Morton order permutes the Gaussians, and brings spatial neighbours closer in memory."""
    ordered = ls.editing.sort_morton(capture)
    assert sorted(rows_of(ordered, capture)) == list(range(100))
    walk = [np.linalg.norm(np.diff(one.means, axis=0), axis=1).mean() for one in (ordered, capture)]
    assert walk[0] < 0.5 * walk[1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (ls.editing.crop, "crop takes a box or a sphere"),
        (lambda g: ls.editing.crop(g, box=((0, 0, 0), (1, 1))), "box has the point .*, expected three finite numbers"),
        (lambda g: ls.editing.crop(g, box=cast(Any, (1, 2, 3))), "box is .*, expected two corners"),
        (lambda g: ls.editing.crop(g, sphere=((0, 0, np.nan), 1.0)), "sphere has the point"),
        (lambda g: ls.editing.crop(g, sphere=((0, 0, 0), -1.0)), "radius of sphere is -1.0, expected a number above 0"),
        (
            lambda g: ls.editing.crop(g, sphere=((99, 0, 0), 1.0)),
            r"no Gaussian of 100 is left; their means lie within \(",
        ),
        (ls.editing.select, "select takes at least one range"),
        (
            lambda g: ls.editing.select(g, opacity=(0.7, 0.3)),
            r"opacity is \(0.7, 0.3\), expected the smaller value first",
        ),
        (lambda g: ls.editing.select(g, opacity=(np.nan, None)), "expected the smaller value first"),
        (lambda g: ls.editing.select(g, x=cast(Any, 3.0)), "x is 3.0, expected its smallest and largest value"),
        (lambda g: ls.editing.select(g, opacity=(2.0, None)), "no Gaussian of 100 is left"),
        (
            lambda g: ls.editing.select(replace(g, roughness=None), roughness=(0, 1)),
            "cannot use roughness: the capture has",
        ),
        (lambda g: ls.editing.remove_floaters(g, 0), "neighbours is 0"),
        (lambda g: ls.editing.remove_floaters(g, 3, 0.0), "reach is 0.0, expected a number above 0"),
        (lambda g: ls.editing.remove_floaters(g, 1000, 1e-6), "no Gaussian of"),
        (lambda g: ls.editing.limit_sh_degree(g, 4), "degree is 4"),
        (lambda g: ls.editing.decimate(g, 0), "count is 0"),
        (lambda g: ls.editing.decimate(g, cast(Any, 0.25)), "count is 0.25, expected a whole number"),
        (lambda _: ls.editing.crop(cast(Any, "a.ply"), sphere=((0, 0, 0), 1.0)), "crop takes Gaussians, got a str"),
        (lambda _: ls.merge([]), "merge takes at least one capture"),
        (lambda g: ls.merge(cast(Any, [g, 3])), "merge takes a list of Gaussians, got a int"),
        (lambda g: ls.merge(cast(Any, g.means[0, 0])), "captures is a float32, expected a list"),
    ],
)
def test_editing_functions_refuse_invalid_arguments_with_a_one_line_error(
    capture: ls.Gaussians, change: Any, message: str
) -> None:
    """The error names the argument and what was expected."""
    with pytest.raises(ls.SceneError, match=message) as error:
        change(capture)
    assert "\n" not in str(error.value)


def test_merge_of_captures_drops_and_logs_material_properties_that_one_of_them_lacks(
    capture: ls.Gaussians, caplog: pytest.LogCaptureFixture
) -> None:
    """A log line names the material properties that only one of the captures has."""
    both = ls.merge([capture, replace(capture, roughness=None)])
    assert (both.count, both.roughness is None, both.metallic is None) == (200, True, False)
    assert [r.getMessage() for r in caplog.records] == ["merge: roughness left out, because not all captures have it"]
