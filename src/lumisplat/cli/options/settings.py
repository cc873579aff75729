"""From options that were given to settings of the library."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

from tyro.conf import arg

import lumisplat as ls

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Changes = dict[str, Any]
"""Settings by the names of `lumisplat.RenderConfig`; those of a group are a dictionary under the group's name."""


def setting(metavar: str, default: str) -> object:
    """Marks an option that is None unless given: then the scene file's value holds, or the library's default.

    Args:
        metavar: What may be given.
        default: The library's value, for the help.
    """
    return arg(metavar=metavar, help_behavior_hint=f"(default: {default})")


def changed_config(base: ls.RenderConfig, *changes: Changes) -> ls.RenderConfig:
    """Settings with changes, one after the other.

    Raises:
        ConfigError: A value is out of its range.
    """
    for change in changes:
        nested = {
            name: replace(getattr(base, name), **value) if isinstance(value, Mapping) else value
            for name, value in change.items()
        }
        base = replace(base, **nested)
    return base


def without_none(settings: Mapping[str, Any]) -> Changes:
    """The settings that were given."""
    return {name: value for name, value in settings.items() if value is not None}


def given_options(options: DataclassInstance, names: Sequence[str] | None = None) -> list[str]:
    """The options that were given, as they are typed.

    Args:
        options: A command, or a group of options.
        names: Only these of its fields; None: all.
    """
    return [
        f"--{field.name.replace('_', '-')}"
        for field in fields(options)
        if getattr(options, field.name) != field.default and (names is None or field.name in names)
    ]
