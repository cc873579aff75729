"""3D Gaussians: the asset that a capture file stores."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import field, replace
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import Range
from lumisplat.config.setting import frozen, given
from lumisplat.constants import ALPHA_MAX, KERNEL_DEGREE, KERNEL_DEGREE_MAX, ORIGIN_LOSS
from lumisplat.errors import SceneError, check_shapes
from lumisplat.math.arrays import (
    Doubles,
    FloatArray,
    box_text,
    normalise_rows,
    read_only_view,
    refuse_outside_unit,
    refuse_rows,
    to_floats,
    to_floats_or_none,
)
from lumisplat.math.transforms import transform_points
from lumisplat.scene.camera import Camera, camera_pose
from lumisplat.scene.checks import take_scene_fields
from lumisplat.scene.lights import to_vector
from lumisplat.scene.placing import Vector, up_vector, up_vector_or_none

SH_DEGREE_FROM_COUNT = {1: 0, 4: 1, 9: 2, 16: 3}

_log = logging.getLogger("lumisplat")

_REQUIRED = ("means", "rotations_wxyz", "scales", "opacities", "sh")
_OPTIONAL = ("normals", "albedo", "roughness", "metallic", "albedo_error", "roughness_error", "incident")


@frozen(weakref_slot=True)
class Gaussians:
    """N anisotropic 3D Gaussians with view-dependent, display-referred colour (Kerbl et al. 2023).

    Arrays become read-only float32; an array that already is read-only float32 is not copied. Arrays must be finite and
    of matching shapes, with at least one Gaussian; scales must be positive; opacities, albedo, roughness and metallic
    must be in 0..1, errors at least 0. Quaternions and normals may have any length above 0, and are normalised.

    Raises:
        SceneError: A value breaks one of these rules; the message names the array and counts its invalid values.
    """

    means: FloatArray = given(converter=to_floats)
    """Centres, scene units, shape (N, 3)."""
    rotations_wxyz: FloatArray = given(converter=to_floats)
    """Unit quaternions, object from Gaussian, scalar first, shape (N, 4)."""
    scales: FloatArray = given(converter=to_floats)
    """Standard deviations along the three axes of each Gaussian, scene units, > 0, shape (N, 3)."""
    opacities: FloatArray = given(converter=to_floats)
    """Opacity at the centre, 0..1, shape (N,)."""
    sh: FloatArray = given(converter=to_floats)
    """SH coefficients of display-referred sRGB in INRIA's order and signs, shape (N, K, 3) with K = 1, 4, 9 or 16
    coefficients per channel. The colour is max(SH sum + 0.5, 0)."""
    normals: FloatArray | None = given(converter=to_floats_or_none, default=None)
    """Unit surface normals in object space, shape (N, 3), outward; None: not stored, and lighting uses the normals of
    the Gaussians' shapes, turned towards the viewer."""
    albedo: FloatArray | None = given(converter=to_floats_or_none, default=None)
    """Linear Rec.709 base colour, 0..1, shape (N, 3). Lighting uses it if the instance's material reflects light and
    has no ``emissive``; otherwise, or with None, lighting uses the captured colour, decoded to linear."""
    roughness: FloatArray | None = given(converter=to_floats_or_none, default=None)
    """Perceptual roughness, 0..1, shape (N,); None: lighting uses the roughness of the `MaterialPbr`."""
    metallic: FloatArray | None = given(converter=to_floats_or_none, default=None)
    """Metalness, 0..1, shape (N,); None: lighting uses the metalness of the `MaterialPbr`."""
    albedo_error: FloatArray | None = given(converter=to_floats_or_none, default=None, kw_only=True)
    """Half width of the 90 % interval of log albedo, at least 0, shape (N,): with a probability of 0.9, the true albedo
    lies between ``albedo * exp(-albedo_error)`` and ``albedo * exp(albedo_error)``, up to one factor per channel that
    the whole capture shares. None: unknown."""
    roughness_error: FloatArray | None = given(converter=to_floats_or_none, default=None, kw_only=True)
    """Half width of the 90 % interval of ``roughness``, at least 0, shape (N,); None: unknown."""
    antialiased: bool = field(default=False, kw_only=True)
    """True if the capture was trained with Mip-Splatting's opacity compensation. Rendering then applies it, too, unless
    the setting ``antialiasing`` of the rasteriser or ray tracer is not ``AUTO``."""
    kernel_degree: Annotated[int, Range(0, KERNEL_DEGREE_MAX)] = field(default=KERNEL_DEGREE, kw_only=True)
    """Exponent of the distance in the kernel that the capture was trained with: 0 is linear, 2 the Gaussian of
    ordinary captures, 5 quintic. Only rays use this degree, including shadow rays of all pipelines, unless
    ``ResponseConfig.kernel_degree`` replaces it; the rasteriser draws every capture with degree 2."""
    comments: tuple[str, ...] = field(default=(), kw_only=True)
    """Comment lines of the file from which the capture was read; conversions to other file formats keep the lines."""
    incident: FloatArray | None = given(converter=to_floats_or_none, default=None, kw_only=True)
    """Indirect light at each Gaussian when the images were taken, as Relightable 3D Gaussians trains it in addition to
    the environment: SH coefficients of incident linear radiance, which is max(SH sum, 0). Shape (N, J, 3) with J = 1,
    4, 9 or 16 coefficients per channel. Lumisplat stores the coefficients for other programs and does not light with
    them."""

    up: Vector | None = given(converter=up_vector_or_none, default=None, kw_only=True)
    """Unit vector that points up in the capture, object space; None: unknown. Accepts an axis name or a direction, as
    `lumisplat.Scene` does."""
    first_view: Camera | None = field(default=None, kw_only=True)
    """Default camera for looking at the capture, object space, such as the camera of one of its images; None: unknown.
    The camera's ``focus_distance`` is the depth of the point at which the camera looks."""

    origin: Vector = given(converter=to_vector, default=(0.0, 0.0, 0.0), kw_only=True)
    """World position of the capture's coordinate origin, scene units, float64; a transform given to an instance
    replaces it. The means and the first view are relative to this origin. Captures in map coordinates need it, because
    float32 would round absolute positions to 0.5 units."""

    def __post_init__(self) -> None:
        take_scene_fields(self)
        check_shapes(
            means=(self.means, "N 3"),
            rotations_wxyz=(self.rotations_wxyz, "N 4"),
            scales=(self.scales, "N 3"),
            opacities=(self.opacities, "N"),
            sh=(self.sh, "N K 3"),
            normals=(self.normals, "N 3"),
            albedo=(self.albedo, "N 3"),
            roughness=(self.roughness, "N"),
            metallic=(self.metallic, "N"),
            albedo_error=(self.albedo_error, "N"),
            roughness_error=(self.roughness_error, "N"),
            incident=(self.incident, "N J 3"),
        )
        if self.count == 0:
            raise SceneError("zero Gaussians, expected at least one")
        for name, values in (("sh", self.sh), ("incident", self.incident)):
            if values is not None and values.shape[1] not in SH_DEGREE_FROM_COUNT:
                raise SceneError(f"{name} has {values.shape[1]} coefficients, expected 1, 4, 9 or 16 (degree 0 to 3)")
        refuse_rows("scales", "not positive", self.scales.min(axis=1) <= 0.0)
        for name in ("opacities", "albedo", "roughness", "metallic"):
            values = getattr(self, name)
            if values is not None:
                refuse_outside_unit(name, values)
        for name in ("albedo_error", "roughness_error"):
            values = getattr(self, name)
            if values is not None:
                refuse_rows(name, "negative", values < 0.0)
        object.__setattr__(self, "rotations_wxyz", normalise_rows("rotations_wxyz", self.rotations_wxyz))
        if self.normals is not None:
            object.__setattr__(self, "normals", normalise_rows("normals", self.normals))

    def __len__(self) -> int:
        return self.count

    def __repr__(self) -> str:
        extras = "".join(f", {name}" for name in _OPTIONAL if getattr(self, name) is not None)
        antialiased = ", antialiased" if self.antialiased else ""
        kernel = f", kernel_degree={self.kernel_degree}" if self.kernel_degree != KERNEL_DEGREE else ""
        bounds = box_text(*self.bounds())
        about = f", origin=({', '.join(f'{value:.12g}' for value in self.origin)})" if any(self.origin) else ""
        details = f"bounds={bounds}{about}{antialiased}{kernel}{extras}"
        return f"Gaussians(count={self.count}, sh_degree={self.sh_degree}, {details})"

    @property
    def count(self) -> int:
        """Number of Gaussians, N."""
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Degree of the SH coefficients that the capture stores, 0 to 3."""
        return SH_DEGREE_FROM_COUNT[self.sh.shape[1]]

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Corners (min, max) of the bounding box of the means, object space, shape (3,) each."""
        return self.means.min(axis=0), self.means.max(axis=0)

    def arrays(self) -> dict[str, FloatArray]:
        """Returns the per-Gaussian arrays by field name; optional arrays that are None are left out."""
        named = {name: getattr(self, name) for name in (*_REQUIRED, *_OPTIONAL)}
        return {name: values for name, values in named.items() if values is not None}

    def subset(self, rows: npt.NDArray[np.bool_] | npt.NDArray[np.integer]) -> Gaussians:
        """Returns the Gaussians that ``rows`` selects, a mask or indices; with indices, in the order of the indices."""
        return replace(self, **{name: read_only_view(values[rows]) for name, values in self.arrays().items()})


def merge_gaussians(sets: Sequence[Gaussians]) -> Gaussians:
    """Joins Gaussian sets in one common space into one set, in order. An optional array stays if every set has it.

    SH of lower degree are padded with zeros. Comments come from the first set; up and first view come from the first
    set that has them.

    Antialiased sets can be merged with ordinary sets only if all antialiased sets are opaque, as Gaussians made from
    meshes are. The result is then not antialiased.

    Raises:
        SceneError: The list is empty; antialiased sets that are not all opaque are mixed with ordinary sets; kernel
            degrees differ; or the sets are so far from each other that float32 holds no common origin.
    """
    if not sets:
        raise SceneError("zero Gaussian sets, expected at least one")
    if len({one.antialiased for one in sets}) > 1:
        if any(one.antialiased and one.opacities.min() < ALPHA_MAX for one in sets):
            raise SceneError("cannot merge antialiased captures with others: their opacities are defined differently")
        _log.warning(
            "antialiased Gaussians (such as those of meshes) merged with ordinary captures: they are now dilated, too"
        )
        sets = [replace(one, antialiased=False) for one in sets]
    degrees = sorted({one.kernel_degree for one in sets})
    if len(degrees) > 1:
        listed = ", ".join(map(str, degrees))
        raise SceneError(f"cannot merge captures of kernel degrees {listed}: their scales are defined differently")
    origin = next((one.origin for one in sets if any(one.origin)), sets[0].origin)
    columns = [_with_origin(one, origin).arrays() for one in sets]
    shared = [name for name in columns[0] if all(name in column for column in columns)]
    for name in {"sh", "incident"}.intersection(shared):
        most = max(column[name].shape[1] for column in columns)
        for column in columns:
            column[name] = np.pad(column[name], ((0, 0), (0, most - column[name].shape[1]), (0, 0)))
    joined = {name: read_only_view(np.concatenate([column[name] for column in columns])) for name in shared}
    stated = {
        name: next((value for one in sets if (value := getattr(_with_origin(one, origin), name)) is not None), None)
        for name in ("up", "first_view")
    }
    return replace(sets[0], **(dict.fromkeys(_OPTIONAL) | joined | stated), origin=origin)


def _with_origin(gaussians: Gaussians, origin: Vector) -> Gaussians:
    """Returns a capture at the same world position, stored relative to another origin."""
    if gaussians.origin == origin:
        return gaussians
    move = np.eye(4)
    move[:3, 3] = np.subtract(gaussians.origin, origin)
    means = transform_points(move, gaussians.means).astype(np.float32)
    width = float(np.median(gaussians.scales.max(axis=1)))
    if np.spacing(np.abs(np.median(means, axis=0)).max()) > ORIGIN_LOSS * width:
        apart = float(np.linalg.norm(move[:3, 3]))
        raise SceneError(
            f"captures {apart:g} units apart cannot be merged, because float32 cannot represent both: move one with "
            "transform(), or put both into one Scene"
        )
    return replace(gaussians, means=means, origin=origin, **moved_orientation(gaussians, move))


def moved_orientation(gaussians: Gaussians, new_from_old: Doubles) -> dict[str, Any]:
    """Returns ``up`` and ``first_view`` of a capture after an affine transform, shape (4, 4), as a dict of fields.

    ``up`` is rotated by the rotation nearest to the matrix; the first view's eye and target are transformed as points.
    A field that is None in the capture is left out.
    """
    if gaussians.up is None and gaussians.first_view is None:
        return {}
    left, _, right = np.linalg.svd(new_from_old[:3, :3])
    rotation = left @ right
    up, view = gaussians.up, gaussians.first_view
    if view is not None:
        _, down, forward = view.camera_from_world[:3, :3]
        eye, target = transform_points(new_from_old, np.stack([view.eye, view.eye + view.focus_distance * forward]))
        distance = float(np.linalg.norm(target - eye))
        side = np.cross(rotation @ down, target - eye)
        pose = camera_pose(eye, side / np.linalg.norm(side), (target - eye) / distance)
        factor = distance / view.focus_distance
        view = replace(view, camera_from_world=pose, focus_distance=distance, near=factor * view.near)
    return {"up": None if up is None else up_vector(np.round(rotation @ up, 12) + 0.0), "first_view": view}
