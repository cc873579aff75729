"""Narrows declared types to those that a test expects, at run time and for the type checker."""

from __future__ import annotations

from typing import TypeVar

from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.mesh import Mesh

_T = TypeVar("_T")


def expect_kind(kind: type[_T], value: object) -> _T:
    """Returns ``value``, which must be an instance of ``kind``."""
    assert isinstance(value, kind), f"a {type(value).__name__}, expected a {kind.__name__}"
    return value


def present(value: _T | None) -> _T:
    """Returns ``value``, which must not be None."""
    assert value is not None
    return value


def pbr_of(mesh: Mesh) -> MaterialPbr:
    """Returns the material of a mesh, which must be a `MaterialPbr`."""
    return expect_kind(MaterialPbr, mesh.material)
