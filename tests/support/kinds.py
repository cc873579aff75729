"""Narrows declared types to those that a test expects, at run time and for the type checker."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

from lumisplat.scene.materials import Material, MaterialPbr
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


def for_splats(material: Material) -> Material:
    """Returns a mesh's material for Gaussians made from the mesh, which hold its colour, roughness and metallic."""
    if not isinstance(material, MaterialPbr):
        return material
    return replace(material, base_color=None, roughness=None, metallic=None)


def with_values(material: Material | None) -> Material | None:
    """Returns a mesh's material with its values in place of None, as files store it."""
    return replace(material, **material.values_on()._asdict()) if isinstance(material, MaterialPbr) else material
