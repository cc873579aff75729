"""Packages of the extra ``metrics``, imported when a metric needs them."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from lumisplat.errors import MissingExtraError


def import_extra(module: str, metric: str) -> Any:
    """Imports a module that a metric needs.

    Raises:
        MissingExtraError: The package is not installed.
    """
    try:
        return import_module(module)
    except ImportError:
        raise MissingExtraError(metric, "metrics") from None
