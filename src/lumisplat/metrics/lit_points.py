"""Points with normals and colours: what metrics of lighting take, of Gaussians or of anything else."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import is_number, quoted
from lumisplat.constants import SH_C0
from lumisplat.errors import ConfigError, SceneError, check_shapes
from lumisplat.math.arrays import FloatArray, float_array, normalised, refuse_rows
from lumisplat.math.color import decode_srgb
from lumisplat.metrics.chromaticity import luminance
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.scene import Scene, SplatInstance

Lit = Gaussians | SplatInstance | Scene
"""What `LitPoints.of` takes."""


@dataclass(frozen=True, slots=True, eq=False)
class LitPoints:
    """N points of surfaces as light has left them. Arrays become read-only float32, normals are normalised.

    Raises:
        SceneError: There is no point, shapes do not fit, values are not finite, or a colour is negative.
    """

    positions: FloatArray
    """World space, metres, shape (N, 3)."""
    normals: FloatArray
    """Unit normals, world space, shape (N, 3)."""
    rgb: FloatArray
    """Linear Rec.709, white 1, at least 0, shape (N, 3)."""

    def __post_init__(self) -> None:
        for name in ("positions", "normals", "rgb"):
            object.__setattr__(self, name, float_array(name, getattr(self, name)))
        check_shapes(positions=(self.positions, "N 3"), normals=(self.normals, "N 3"), rgb=(self.rgb, "N 3"))
        if self.count == 0:
            raise SceneError("zero points: there is no light to compare")
        refuse_rows("rgb", "negative", np.asarray((self.rgb < 0.0).any(axis=1)))
        object.__setattr__(self, "normals", normalised("normals", self.normals))

    @classmethod
    def of(cls, subject: Lit, *, around: npt.ArrayLike | None = None, radius: float | None = None) -> LitPoints:
        """The Gaussians of a set, an instance or a scene, in world space.

        Colours are those of degree 0, the mean over all directions, decoded to linear light. Normals are those that a
        set has, else `estimate_normals`.

        Args:
            subject: Gaussians, an instance of them, or a scene, of which all instances count; meshes do not.
            around: Only those near this point, world space, shape (3,), with estimated normals turned towards it: the
                sides of a room that face who stands in it. None: all, and outwards.
            radius: How near, metres; with ``around``.

        Raises:
            ConfigError: ``radius`` is not above 0.
            SceneError: There are no Gaussians, or none is near (says where the nearest one is); ``around`` is no point.
        """
        center = None
        if around is not None:
            check_radius(radius)
            center = float_array("around", around).astype(np.float64)
            check_shapes(around=(center, "3"))
        parts = list(_instances(subject))
        if not parts:
            raise SceneError("the scene has no Gaussians: there is no light to compare")
        near = [_near(part, center, radius) for part in parts]
        if not any(rows.any() for rows in near):
            nearest = min(float(_distances(part, center).min()) for part in parts)
            told = ", ".join(f"{value:.3g}" for value in np.asarray(center).tolist())
            raise SceneError(
                f"no Gaussian of the scene is within {radius:g} of the avatar's centre ({told}), the nearest is "
                f"{nearest:.3g} away: is the avatar where it should be, and the unit a metre?"
            )
        made = [_points(part, rows, center) for part, rows in zip(parts, near, strict=True) if rows.any()]
        positions, normals, colors = (np.concatenate(arrays) for arrays in zip(*made, strict=True))
        return cls(positions, normals, colors)

    @property
    def count(self) -> int:
        """Number of points, N."""
        return self.positions.shape[0]

    @property
    def luminance(self) -> npt.NDArray[np.float64]:
        """CIE Y, linear, white 1, shape (N,)."""
        return luminance(self.rgb)


def check_radius(radius: object) -> None:
    """Refuses what is no length.

    Raises:
        ConfigError: ``radius`` is not a finite number above 0.
    """
    if not is_number(radius) or not 0.0 < radius < np.inf:
        raise ConfigError(f"radius is {quoted(radius)}, expected metres above 0")


def _instances(subject: Lit) -> Iterator[SplatInstance]:
    if isinstance(subject, Scene):
        yield from subject.splats
    elif isinstance(subject, SplatInstance):
        yield subject
    elif isinstance(subject, Gaussians):
        yield SplatInstance(subject)
    else:
        raise SceneError(f"metrics of lighting take Gaussians or LitPoints, got a {type(subject).__name__}")


def _distances(instance: SplatInstance, center: npt.NDArray | None) -> npt.NDArray[np.float64]:
    return np.linalg.norm(instance.world_means - (0.0 if center is None else center), axis=1)


def _near(instance: SplatInstance, center: npt.NDArray | None, radius: float | None) -> npt.NDArray[np.bool_]:
    if center is None or radius is None:
        return np.ones(instance.gaussians.count, np.bool_)
    return _distances(instance, center) <= radius


def _points(
    instance: SplatInstance, rows: npt.NDArray[np.bool_], center: npt.NDArray | None
) -> tuple[npt.NDArray, npt.NDArray, npt.NDArray]:
    """Positions, normals and linear colours of some of an instance's Gaussians."""
    kept = instance.gaussians if rows.all() else instance.gaussians.subset(rows)
    positions = instance.world_means[rows]
    normals = kept.normals
    if normals is None:
        from lumisplat.scene.ops.estimate_normals import estimate_normals

        normals = estimate_normals(kept)
    # A similarity turns normals as it turns everything else; its scale goes when they are normalised.
    normals = normals @ instance.transform[:3, :3].T
    if kept.normals is None and center is not None:
        away = np.einsum("ij,ij->i", normals, center - positions) < 0.0
        normals = np.where(away[:, None], -normals, normals)
    display = np.maximum(SH_C0 * kept.sh[:, 0].astype(np.float64) + 0.5, 0.0)
    return positions, normals, decode_srgb(display)
