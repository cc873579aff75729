"""Narrows a declared type to what a test knows: asserted when it runs, and known to the type checker."""

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
    """The material of a mesh, which must be a physically based one."""
    return expect_kind(MaterialPbr, mesh.material)
