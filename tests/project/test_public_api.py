"""Public names: all exist, sorted and documented."""

from __future__ import annotations

import inspect
import subprocess
import sys
from dataclasses import replace
from typing import Any, cast

import pytest

import lumisplat as ls

SUBMODULES = (
    "avatars",
    "config",
    "dataset",
    "diagnostics",
    "editing",
    "errors",
    "farm",
    "gradients",
    "inverse",
    "io",
    "layers",
    "lights",
    "metrics",
    "rays",
    "training",
)
"""Public submodules, one for each topic."""

PUBLIC = [("", name) for name in ls.__all__ if name not in SUBMODULES] + [
    (module, name) for module in SUBMODULES for name in getattr(ls, module).__all__
]
"""Pairs of submodule and public name; "" is the top level."""


def test_public_names_of_lumisplat_are_at_most_95_and_sorted() -> None:
    """``ls`` has what first programs use, and the submodules."""
    assert len(ls.__all__) <= 95
    assert ls.__all__ == sorted(ls.__all__)
    assert set(SUBMODULES) <= set(ls.__all__) <= set(dir(ls))


@pytest.mark.parametrize(("module", "name"), PUBLIC)
def test_every_public_name_exists_with_a_docstring(module: str, name: str) -> None:
    """The ``__name__`` of an object is its public name."""
    value = getattr(getattr(ls, module) if module else ls, name)
    assert inspect.getdoc(value)
    assert callable(value)
    if inspect.isclass(value) or inspect.isfunction(value):
        assert value.__name__ == name


def test_public_name_exported_by_several_modules_is_the_same_object_in_each() -> None:
    """Top-level names and names of submodules are compared."""
    values: dict[str, object] = {}
    for module, name in PUBLIC:
        value = getattr(getattr(ls, module) if module else ls, name)
        assert values.setdefault(name, value) is value, name


@pytest.mark.parametrize(
    "first", ["ls.Frame", "ls.load", "ls.render", "ls.create_renderer", "__import__('lumisplat.frame.frame')"]
)
def test_public_names_resolve_in_any_import_order(first: str) -> None:
    """Every name may be the first one used; `render` also after the package of that name is loaded."""
    program = f"import lumisplat as ls; {first}; ls.create_renderer; assert callable(ls.render), ls.render"
    subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)


def test_star_import_gives_exactly_the_public_names() -> None:
    """``from lumisplat import *`` imports ``__all__``."""
    names: dict[str, object] = {}
    exec("from lumisplat import *", names)
    assert set(names) - {"__builtins__"} == set(ls.__all__)


def test_attribute_error_for_a_misspelt_name_of_lumisplat_contains_it() -> None:
    """A typo raises an AttributeError."""
    with pytest.raises(AttributeError, match="no attribute 'rendre'"):
        _ = cast(Any, ls).rendre


def test_attribute_error_of_a_moved_name_points_to_its_submodule() -> None:
    """`psnr` is now in `lumisplat.metrics`."""
    with pytest.raises(AttributeError, match=r"no attribute 'psnr': it is lumisplat\.metrics\.psnr"):
        _ = cast(Any, ls).psnr


@pytest.mark.parametrize(
    ("error", "builtin"),
    [
        ("ConfigError", ValueError),
        ("SceneError", ValueError),
        ("FormatError", ls.SceneError),
        ("DeviceError", RuntimeError),
    ],
)
def test_every_error_is_a_lumisplat_error_and_a_built_in_error(error: str, builtin: type) -> None:
    """Callers may catch `LumisplatError` or the built-in error."""
    assert issubclass(getattr(ls, error), ls.LumisplatError)
    assert issubclass(getattr(ls, error), builtin)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"dilation": -1.0}, "dilation is -1.0, expected 0.0 to 10.0"),
        ({"sh_degree": 4}, "sh_degree is 4"),
        ({"transmittance_min": float("nan")}, "transmittance_min is nan"),
        ({"depth_iso_transmittance": 1.5}, "depth_iso_transmittance is 1.5"),
    ],
)
def test_raster_settings_out_of_range_are_refused(settings: dict[str, float], message: str) -> None:
    """The error names the setting, its value and its range."""
    with pytest.raises(ls.ConfigError, match=message):
        replace(ls.RasterConfig(), **settings)


@pytest.mark.parametrize("background", [(0.0, 0.0), (0.0, 0.0, 1.1), (0.0, -0.1, 0.0), (float("nan"), 0.0, 0.0)])
def test_background_setting_is_three_numbers_from_0_to_1(background: tuple[float, ...]) -> None:
    """Two numbers, 1.1, -0.1 and NaN are refused."""
    with pytest.raises(ls.ConfigError, match="background"):
        ls.RenderConfig(background=background)  # pyright: ignore[reportArgumentType]


def test_error_for_a_missing_render_device_lists_the_available_ones() -> None:
    """The devices are cuda:97 and tpu."""
    with pytest.raises(ls.DeviceError, match=r"there is no device 'cuda:97' on this machine: use auto or one of cpu"):
        ls.create_renderer(device="cuda:97")
    with pytest.raises(ls.DeviceError, match="no device 'tpu'"):
        ls.create_renderer(device="tpu")
