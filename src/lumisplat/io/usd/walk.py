"""What is shown of a stage, prim by prim: placed in the world, instances and point instancers included."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from lumisplat.errors import FormatError
from lumisplat.io.usd.library import pxr
from lumisplat.io.usd.stage import UsdFile
from lumisplat.math.arrays import Doubles

USD_INSTANCES_MAX = 1_000_000
"""Most prims that a file may have, and most instances of point instancers: instances of instances multiply, so that a
small file could ask for any number."""


class Placed(NamedTuple):
    """A prim, once for each place at which it is shown."""

    prim: Any
    world_from_prim: Doubles
    """Shape (4, 4)."""
    name: str
    visible: bool
    """Whether it is shown: lights that are not are turned off, cameras take pictures all the same."""
    animated: bool = False
    """Whether its place changes with time."""
    instanced: bool = False
    """Whether a point instancer puts it there, where its own transform does not."""

    @property
    def asset(self) -> str:
        """What it shows: the same text for all instances of a prim."""
        shared = self.prim.GetPrimInPrototype() if self.prim.IsInstanceProxy() else self.prim
        return str(shared.GetPath())

    @property
    def is_flat(self) -> bool:
        """Whether its place has no volume: files hide things by scaling them to nothing."""
        linear = self.world_from_prim[:3, :3]
        size = np.abs(linear).max()
        return not np.isfinite(size) or size == 0.0 or abs(np.linalg.det(linear / size)) < 1e-9


def placed_prims(file: UsdFile) -> Iterator[Placed]:
    """All prims of a file that are active and defined, parents first, each in all its places.

    Raises:
        FormatError: There are too many instances.
    """
    walk = _Walk(file, pxr().UsdGeom.XformCache(file.time))
    yield from walk.below(file.stage.GetPseudoRoot(), file.world_from_stage, ())


def prim_name(prim: Any) -> str:
    """The name that people gave a prim, else that of its path; that of an instance for the only prim in it."""
    px, parent = pxr(), prim.GetParent()
    if prim.IsInstanceProxy() and parent.IsInstance():
        everything = px.Usd.TraverseInstanceProxies(px.Usd.PrimDefaultPredicate)
        if len(parent.GetFilteredChildren(everything)) == 1:
            prim = parent
    return str(prim.GetDisplayName() or prim.GetName())


@dataclass(slots=True)
class _Walk:
    """A walk through a stage. It ends where there is too much of it, shown or not."""

    file: UsdFile
    places: Any
    """Transforms of prims."""
    prims: int = 0
    instances: int = 0

    def below(self, root: Any, world_from_base: Doubles, inside: tuple[Any, ...]) -> Iterator[Placed]:
        """The prims at and below ``root``.

        Args:
            root: A prim.
            world_from_base: The world from the space in which the transforms of prims end, shape (4, 4).
            inside: Paths of the point instancers around: those that show themselves end here.
        """
        file, px = self.file, pxr()
        walk = iter(px.Usd.PrimRange(root, px.Usd.TraverseInstanceProxies(px.Usd.PrimDefaultPredicate)))
        for prim in walk:
            self.prims = self._counted(self.prims)
            # Types that the library does not know have no visibility of their own; one of them we read.
            imageable = px.UsdGeom.Imageable(prim if px.UsdGeom.Imageable(prim) else prim.GetParent())
            if not imageable and not _is_unknown_field(prim):
                continue
            local = np.array(self.places.GetLocalToWorldTransform(prim), dtype=np.float64).T
            world_from_prim = world_from_base @ local
            visible = not imageable or (
                imageable.ComputeVisibility(file.time) != "invisible"
                and imageable.ComputePurpose() in ("default", "render")
            )
            if not prim.IsA(px.UsdGeom.PointInstancer):
                moves = not inside and _moves(prim)
                yield Placed(prim, world_from_prim, prim_name(prim), visible, moves, instanced=bool(inside))
                continue
            walk.PruneChildren()  # its prototypes, which are not shown by themselves
            if visible and prim.GetPath() not in inside:
                yield from self._instanced(prim, world_from_prim, (*inside, prim.GetPath()))

    def _instanced(self, prim: Any, world_from_prim: Doubles, inside: tuple[Any, ...]) -> Iterator[Placed]:
        """What a point instancer shows."""
        file, px = self.file, pxr()
        instancer = px.UsdGeom.PointInstancer(prim)
        prototypes = [file.stage.GetPrimAtPath(path) for path in instancer.GetPrototypesRel().GetForwardedTargets()]
        indices = np.array(instancer.GetProtoIndicesAttr().Get(file.time) or (), dtype=np.int64)
        mask = list(instancer.ComputeMaskAtTime(file.time))
        transforms = instancer.ComputeInstanceTransformsAtTime(
            file.time, file.time, px.UsdGeom.PointInstancer.ExcludeProtoXform, px.UsdGeom.PointInstancer.IgnoreMask
        )
        if len(transforms) != len(indices):
            raise FormatError(
                file.path, f"{prim.GetPath()} has {len(indices):,} instances, but {len(transforms):,} places"
            )
        for number, (which, transform) in enumerate(zip(indices, transforms, strict=True)):
            if mask and not mask[number]:
                continue
            self.instances = self._counted(self.instances)
            if not 0 <= which < len(prototypes) or not prototypes[which]:
                raise FormatError(file.path, f"{prim.GetPath()} shows prototype {which} of {len(prototypes)}")
            root = prototypes[which]
            # Where the prototype lies in the file does not matter: its own transform does, those above it do not.
            above = np.array(self.places.GetParentToWorldTransform(root), dtype=np.float64).T
            placed = world_from_prim @ np.array(transform, dtype=np.float64).T @ np.linalg.inv(above)
            yield from self.below(root, placed, inside)

    def _counted(self, before: int) -> int:
        """One more.

        Raises:
            FormatError: It is too many.
        """
        if before >= USD_INSTANCES_MAX:
            raise FormatError(self.file.path, f"shows more than {USD_INSTANCES_MAX:,} prims: instances of instances")
        return before + 1


def _is_unknown_field(prim: Any) -> bool:
    return str(prim.GetTypeName()).startswith("ParticleField") and not pxr().UsdGeom.Imageable(prim)


def _moves(prim: Any) -> bool:
    """Whether the transform of a prim, or of one above it, changes with time."""
    px = pxr()
    while prim and not prim.IsPseudoRoot():
        xformable = px.UsdGeom.Xformable(prim)
        if xformable and xformable.TransformMightBeTimeVarying():
            return True
        if xformable and xformable.GetResetXformStack():
            return False
        prim = prim.GetParent()
    return False
