"""The names that others rely on: all there, true, sorted and documented."""

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
"""Public modules: what more than the first ten minutes needs, by topic."""

PUBLIC = [("", name) for name in ls.__all__ if name not in SUBMODULES] + [
    (module, name) for module in SUBMODULES for name in getattr(ls, module).__all__
]
"""Public names and their submodules."""


def test_the_first_names_are_few() -> None:
    """A user who types ``ls.`` finds what the first ten minutes need, and the submodules, in order."""
    assert len(ls.__all__) <= 95
    assert ls.__all__ == sorted(ls.__all__)
    assert set(SUBMODULES) <= set(ls.__all__) <= set(dir(ls))


@pytest.mark.parametrize(("module", "name"), PUBLIC)
def test_every_name_resolves(module: str, name: str) -> None:
    """Each public name is there, is called that, and has a docstring."""
    value = getattr(getattr(ls, module) if module else ls, name)
    assert inspect.getdoc(value)
    assert callable(value)
    if inspect.isclass(value) or inspect.isfunction(value):
        assert value.__name__ == name


def test_each_name_is_one_thing() -> None:
    """A name that the top and a submodule have, or two submodules, means the same in both."""
    values: dict[str, object] = {}
    for module, name in PUBLIC:
        value = getattr(getattr(ls, module) if module else ls, name)
        assert values.setdefault(name, value) is value, name


@pytest.mark.parametrize(
    "first", ["ls.Frame", "ls.load", "ls.render", "ls.create_renderer", "__import__('lumisplat.frame.frame')"]
)
def test_names_resolve_whatever_came_first(first: str) -> None:
    """Names work as the first thing that a program asks for; `render` also once the package of that name is loaded."""
    program = f"import lumisplat as ls; {first}; ls.create_renderer; assert callable(ls.render), ls.render"
    subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)


def test_star_import_gives_the_public_names() -> None:
    """``from lumisplat import *`` brings every name, and no other."""
    names: dict[str, object] = {}
    exec("from lumisplat import *", names)
    assert set(names) - {"__builtins__"} == set(ls.__all__)


def test_unknown_names_are_refused() -> None:
    """A typo is an AttributeError that names it."""
    with pytest.raises(AttributeError, match="no attribute 'rendre'"):
        _ = cast(Any, ls).rendre


def test_names_of_submodules_are_pointed_at() -> None:
    """Who asks `ls` for a name that a submodule has reads where it is."""
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
def test_errors_form_a_tree(error: str, builtin: type) -> None:
    """Every error is a LumisplatError, and what a caller who does not know us would expect."""
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
    """A setting out of range is named with its value and its range."""
    with pytest.raises(ls.ConfigError, match=message):
        replace(ls.RasterConfig(), **settings)


@pytest.mark.parametrize("background", [(0.0, 0.0), (0.0, 0.0, 1.1), (0.0, -0.1, 0.0), (float("nan"), 0.0, 0.0)])
def test_backgrounds_are_checked(background: tuple[float, ...]) -> None:
    """Three numbers in 0..1."""
    with pytest.raises(ls.ConfigError, match="background"):
        ls.RenderConfig(background=background)  # pyright: ignore[reportArgumentType]


def test_missing_devices_are_named() -> None:
    """A device that is not here is an error that lists those that are."""
    with pytest.raises(ls.DeviceError, match=r"there is no device 'cuda:97' on this machine: use auto or one of cpu"):
        ls.create_renderer(device="cuda:97")
    with pytest.raises(ls.DeviceError, match="no device 'tpu'"):
        ls.create_renderer(device="tpu")
