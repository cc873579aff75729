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
    "metrics",
    "rays",
    "training",
)
"""Public modules by topic, for everything beyond the first ten minutes."""

PUBLIC = [("", name) for name in ls.__all__ if name not in SUBMODULES] + [
    (module, name) for module in SUBMODULES for name in getattr(ls, module).__all__
]
"""Pairs of submodule and public name; "" is the top level."""


def test_top_level_has_few_sorted_names() -> None:
    """``ls`` has what the first programs use, and the submodules."""
    assert len(ls.__all__) <= 95
    assert ls.__all__ == sorted(ls.__all__)
    assert set(SUBMODULES) <= set(ls.__all__) <= set(dir(ls))


@pytest.mark.parametrize(("module", "name"), PUBLIC)
def test_every_name_resolves(module: str, name: str) -> None:
    """Every public name exists, has this ``__name__``, and has a docstring."""
    value = getattr(getattr(ls, module) if module else ls, name)
    assert inspect.getdoc(value)
    assert callable(value)
    if inspect.isclass(value) or inspect.isfunction(value):
        assert value.__name__ == name


def test_a_name_means_the_same_in_all_modules() -> None:
    """Names in several modules are the same object."""
    values: dict[str, object] = {}
    for module, name in PUBLIC:
        value = getattr(getattr(ls, module) if module else ls, name)
        assert values.setdefault(name, value) is value, name


@pytest.mark.parametrize(
    "first", ["ls.Frame", "ls.load", "ls.render", "ls.create_renderer", "__import__('lumisplat.frame.frame')"]
)
def test_names_resolve_in_any_import_order(first: str) -> None:
    """Every name may be the first one used; `render` also after the package of that name is loaded."""
    program = f"import lumisplat as ls; {first}; ls.create_renderer; assert callable(ls.render), ls.render"
    subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)


def test_star_import_gives_the_public_names() -> None:
    """``from lumisplat import *`` imports exactly ``__all__``."""
    names: dict[str, object] = {}
    exec("from lumisplat import *", names)
    assert set(names) - {"__builtins__"} == set(ls.__all__)


def test_unknown_names_are_refused() -> None:
    """A typo raises an AttributeError that names it."""
    with pytest.raises(AttributeError, match="no attribute 'rendre'"):
        _ = cast(Any, ls).rendre


def test_missing_name_points_to_its_submodule() -> None:
    """The AttributeError of a name that moved to a submodule says where it is."""
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
def test_errors_have_the_expected_base_classes(error: str, builtin: type) -> None:
    """Every error is a LumisplatError and the built-in error that callers expect."""
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
def test_settings_are_checked(settings: dict[str, float], message: str) -> None:
    """The error names the setting, its value and its range."""
    with pytest.raises(ls.ConfigError, match=message):
        replace(ls.RasterConfig(), **settings)


@pytest.mark.parametrize("background", [(0.0, 0.0), (0.0, 0.0, 1.1), (0.0, -0.1, 0.0), (float("nan"), 0.0, 0.0)])
def test_backgrounds_are_checked(background: tuple[float, ...]) -> None:
    """A background is three numbers in 0..1."""
    with pytest.raises(ls.ConfigError, match="background"):
        ls.RenderConfig(background=background)  # pyright: ignore[reportArgumentType]


def test_missing_devices_are_named() -> None:
    """The error lists the available devices."""
    with pytest.raises(ls.DeviceError, match=r"there is no device 'cuda:97' on this machine: use auto or one of cpu"):
        ls.create_renderer(device="cuda:97")
    with pytest.raises(ls.DeviceError, match="no device 'tpu'"):
        ls.create_renderer(device="tpu")
