"""Tests declarations of settings: refused and accepted values, and help that is made of a declaration."""

from __future__ import annotations

import math
import pickle
import pydoc
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, fields, is_dataclass
from enum import Enum
from typing import Annotated, Any

import numpy as np
import pytest
from hypothesis import given as drawn, strategies as st

import lumisplat as ls
from lumisplat import config
from lumisplat.config.checks import OneOf, Range, plain
from lumisplat.config.setting import Setting, Span, all_settings, frozen, given, settings_of, take_fields
from lumisplat.scene.camera import Camera
from lumisplat.scene.scene import SplatInstance
from support.scenes.raster_scenes import random_gaussians

CONFIGS = [kind for kind in vars(config).values() if isinstance(kind, type) and is_dataclass(kind)]
GIVEN: dict[type, dict[str, Any]] = {
    ls.LightPoint: {"position": (0, 0, 0)},
    ls.LightSpot: {"position": (0, 0, 0), "direction": (0, 0, 1), "outer_angle": 1.5707},
    ls.LightDirectional: {"direction": (0, 0, 1)},
    ls.LightSphere: {"position": (0, 0, 0), "radius": 1.0},
    ls.LightDisk: {"position": (0, 0, 0), "direction": (0, 0, 1)},
    ls.LightRect: {"position": (0, 0, 0), "edge_u": (1, 0, 0), "edge_v": (0, 1, 0)},
    ls.LightEnvironment: {},
    ls.MaterialPbr: {},
    ls.MaterialSimple: {},
    Camera: {"width": 8, "height": 8, "fx": 8.0, "fy": 8.0, "cx": 4.0, "cy": 4.0, "camera_from_world": np.eye(4)},
    SplatInstance: {"gaussians": random_gaussians(0, 1)},
    ls.Animation: {"scene": ls.Scene()},
    ls.Actor: {"subject": random_gaussians(0, 1)},
}
"""Scene classes whose fields are settings, and the arguments that each class requires."""
RELATED = {"inner_angle", "outer_angle", "window", "kernel_degree", "grow_turn", "flatness", "normals", "depth_spread",
           "normal_smoothness", "projection", "frame_count"}  # fmt: skip
"""Fields whose values other fields restrict further."""
ALL = [*CONFIGS, *GIVEN]
ERRORS = (ls.ConfigError, ls.SceneError)


def numeric() -> Iterator[Any]:
    """Yields every number that a class declares."""
    for kind in ALL:
        for one in settings_of(kind):
            if one.kind in ("whole", "number"):
                yield pytest.param(kind, one, id=f"{kind.__name__}.{one.name}")


def made(kind: Any, one: Setting, value: object) -> Any:
    """Returns the field of an object that was created with a value."""
    return getattr(kind(**{**GIVEN.get(kind, {}), one.name: value}), one.name)


def good(one: Setting) -> float:
    """Returns a number that a setting accepts."""
    if one.numbers:
        return one.numbers[0]
    low = one.range.low if math.isfinite(one.range.low) else 1.0
    high = one.range.high if math.isfinite(one.range.high) else low + 2.0
    middle = 0.5 * (low + high)
    if one.kind == "number":
        return float(np.float32(middle))
    return int(middle) - int(middle) % one.range.step


@pytest.mark.parametrize(("kind", "one"), list(numeric()))
def test_settings_convert_numbers_of_every_type_to_python_numbers(kind: Any, one: Setting) -> None:
    """NumPy scalars, zero-dimensional arrays, and integers for floats are accepted; bools are refused."""
    plain_kind = int if one.kind == "whole" else float
    value = float(np.float32(one.default)) if one.name.endswith("_angle") else good(one)
    if one.name in RELATED and one.default is not None and not one.name.endswith("_angle"):
        value = one.default
    kinds = [np.int64, np.array] if plain_kind is int else [np.float32, np.float64, np.array]
    for number in (make(value) for make in kinds):
        taken = made(kind, one, number)
        assert type(taken) is plain_kind and taken == value
    for wrong in (True, np.True_, "1", [value], math.nan, np.array([value]), object()):
        with pytest.raises(ERRORS, match=rf"{one.name} is .*, expected "):
            made(kind, one, wrong)


@pytest.mark.parametrize(("kind", "one"), list(numeric()))
def test_settings_accept_exactly_their_declared_range(kind: Any, one: Setting) -> None:
    """Ends are accepted unless excluded, and the next number outside is refused."""
    limits = one.range
    whole = one.kind == "whole"
    for end, out, excluded in ((one.low, -1, limits.above), (one.high, 1, limits.below)):
        if end is None or one.numbers:
            continue
        outside = int(end) + out * limits.step if whole else math.nextafter(end, out * math.inf)
        for value in (outside, *([end] if excluded else [])):
            with pytest.raises(ERRORS, match=rf"{one.name} is .*, expected "):
                made(kind, one, value)
        inside = (int(end) if whole else end) if not excluded else math.nextafter(end, -out * math.inf)
        if one.name not in RELATED:
            assert made(kind, one, inside) == inside


@pytest.mark.parametrize("kind", ALL, ids=lambda kind: kind.__name__)
def test_docstring_of_every_setting_exists_and_does_not_repeat_its_range(kind: Any) -> None:
    """Ranges and units are declared beside the setting, and added to the help automatically."""
    undocumented = {"position", "color", "enabled", "casts_shadow", "name", "wrap_v", "scene", "subject", "gaussians",
                    "actors", "cameras", "alpha", "alpha_mode", "alpha_cutoff"}  # fmt: skip
    for one in settings_of(kind):
        assert one.help or (kind in GIVEN and one.name in undocumented), one.name
        assert ".." not in one.help.replace("...", "") or kind in GIVEN, one.name


@pytest.mark.parametrize(("kind", "one"), list(numeric()))
def test_error_of_a_refused_setting_has_the_name_of_the_setting(kind: Any, one: Setting) -> None:
    """The attribute ``setting`` is the field, also behind a prefix such as camera in the message."""
    with pytest.raises(ERRORS) as caught:
        made(kind, one, "many")
    assert caught.value.setting == one.name
    assert pickle.loads(pickle.dumps(caught.value)).setting == one.name


@pytest.mark.parametrize("kind", CONFIGS, ids=lambda kind: kind.__name__)
def test_help_of_a_settings_class_describes_each_field(kind: Any) -> None:
    """Help has the docstring below the field, and its range."""
    text = " ".join(pydoc.plain(pydoc.render_doc(kind)).replace("|", "").split())
    for one in settings_of(kind):
        described = " ".join(f"{one.name}: {one.help} {one.limits}".split())
        assert described in text


@pytest.mark.parametrize("kind", ALL, ids=lambda kind: kind.__name__)
def test_default_settings_pass_their_checks_unchanged(kind: Any) -> None:
    """Settings check defaults only in this test, not when created."""
    for one, field in zip(settings_of(kind), fields(kind), strict=True):
        if field.default is MISSING or one.kind == "other":
            continue
        default = field.default
        again = (*default,) if isinstance(default, tuple) else default
        if isinstance(again, float) and one.kind == "number":
            again = np.float64(again)  # a new object, which is checked again
        if isinstance(again, Enum):
            again = again.value
        if one.name in ("direction", "edge_u", "edge_v"):
            continue  # (0, 0, 0): none is given
        taken = made(kind, one, again)
        assert taken == default and type(taken) is type(default), one.name


@dataclass(frozen=True)
class Numbers:
    """Settings that this package does not have."""

    whole: Annotated[int, Range(-5, 5)] = 0
    """A whole number."""
    share: Annotated[float, Range(0.0, 1.0, above=True, below=True)] = 0.5
    """A number."""
    few: Annotated[int, OneOf((1, 2, 4))] | None = None
    """A few numbers."""
    span: Annotated[Span, Range(-1.0, 1.0)] = (0.0, 0.0)
    """Two numbers."""

    __post_init__ = take_fields


SCALARS = st.one_of(
    st.integers(-10, 10),
    st.floats(),
    st.booleans(),
    st.text(max_size=2),
    st.none(),
    st.integers(-10, 10).map(np.int8),
    st.floats(width=32).map(np.float32),
    st.floats(-2, 2).map(np.array),
    st.lists(st.floats(-2, 2), max_size=3).map(np.array),
)


@drawn(SCALARS)
def test_setting_is_accepted_if_and_only_if_in_its_range(value: Any) -> None:
    """The test states the range of each setting independently; the error is one line with name and value."""
    number = plain(value)
    is_whole, is_number = type(number) is int, type(number) in (int, float)
    taken = {
        "whole": is_whole and -5 <= number <= 5,
        "share": is_number and 0.0 < number < 1.0,
        "few": value is None or (is_whole and number in (1, 2, 4)),
        "span": (is_number and -1.0 <= number <= 1.0)
        or (isinstance(value, np.ndarray) and value.shape == (2,) and -1.0 <= value[0] <= value[1] <= 1.0),
    }
    for name, is_taken in taken.items():
        given: dict[str, Any] = {name: value}
        if is_taken:
            assert type(getattr(Numbers(**given), name)) in (int, float, tuple, type(None))
        else:
            with pytest.raises(ls.ConfigError, match=f"^{name} is "):
                Numbers(**given)


@drawn(st.floats(0.0, 1.0, exclude_min=True, exclude_max=True))
def test_number_settings_are_stored_exactly(value: float) -> None:
    """A NumPy float or a zero-dimensional array does not change the value."""
    every: tuple[Any, ...] = (value, np.float64(value), np.array(value))
    for carried in every:
        assert Numbers(share=carried).share == value


def test_settings_accept_zero_dimensional_dlpack_arrays() -> None:
    """Arrays of some packages support DLPack only."""

    class Alien:
        shape = ()

        def __init__(self, value: object) -> None:
            self._array = np.array(value)

        def __dlpack__(self, **options: Any) -> Any:
            return self._array.__dlpack__(**options)

        def __dlpack_device__(self) -> tuple[int, int]:
            return (1, 0)

    alien: Any = Alien
    assert ls.LightPoint((0, 0, 0), intensity=alien(2.0)).intensity == 2.0
    assert ls.RenderConfig(seed=alien(3)).seed == 3


@pytest.mark.parametrize("kind", [kind for kind in GIVEN if kind.__name__.startswith("Light")])
def test_intensity_settings_have_the_unit_of_their_light_type(kind: Any) -> None:
    """Tables of lights show the unit."""
    assert next(one for one in settings_of(kind) if one.name == "intensity").range.unit == kind.unit


def test_settings_in_groups_are_listed_by_dotted_name_with_range_and_unit() -> None:
    """The declaration has kind, range, unit and default."""
    named = all_settings(ls.RenderConfig)
    assert named["trace.hits_per_pass"].expected == "4, 8, 16 or 32"
    assert named["realtime.filter.frames"].range == Range(1, 1024)
    assert (named["time_limit"].range.unit, named["time_limit"].is_optional) == ("seconds", True)
    assert named["pipeline"].expected.startswith("'raster', 'trace'")
    assert named["capture_gain"].limits == "Takes -16.0 to 16.0, in stops."


def test_setting_with_a_converter_accepts_values_of_types_that_the_field_does_not_have() -> None:
    """The converter gets the value and the field's name, and errors of the converter name the field."""

    def doubled(value: str | float, name: str = "number") -> float:
        if value == "no":
            raise ls.SceneError(f"{name} is no")
        return 2.0 * float(value)

    @frozen
    class Taken:
        number: float = given(converter=doubled, default=0.0)

        __post_init__ = take_fields

    assert (Taken("4").number, Taken().number) == (8.0, 0.0)
    with pytest.raises(ls.SceneError, match=r"^number is no$"):
        Taken("no")


@pytest.mark.parametrize("stops", [np.float32(0.5), np.array(0.5), [0.5, np.float64(0.5)], np.array([0.5, 0.5])])
def test_exposures_of_fitted_images_accept_numbers_of_any_type(stops: Any) -> None:
    """One number applies to all images; a list has a number for each image."""
    from lumisplat.relighting.fitting.parameters import _stops

    assert _stops(stops, [1.0, 2.0]).tolist() == [0.5, 0.5]
    assert _stops("fit", [1.0, 2.0]).tolist() == [1.0, 2.0]
