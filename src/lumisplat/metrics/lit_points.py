"""Points with normals and colours, the input of the metrics of lighting; from Gaussians or from anything else."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import is_number, quoted
from lumisplat.constants import SH_C0
from lumisplat.errors import ConfigError, SceneError, check_shapes
from lumisplat.math.arrays import Doubles, FloatArray, float_array, normalise_rows, refuse_rows
from lumisplat.math.color import decode_srgb
from lumisplat.metrics.chromaticity import luminance
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.scene import Scene, SplatInstance

Lit = Gaussians | SplatInstance | Scene
"""What `LitPoints.of` takes."""


@dataclass(frozen=True, slots=True, eq=False)
class LitPoints:
    """N points of lit surfaces. Arrays become read-only float32; normals are normalised.

    Raises:
        SceneError: There is no point, shapes do not fit, values are not finite, or a colour is negative.
    """

    positions: FloatArray
    """World space, metres, shape (N, 3)."""
    normals: FloatArray
    """Unit normals, world space, shape (N, 3)."""
    rgb: FloatArray
    """Linear Rec.709, white 1, at least 0, shape (N, 3)."""

    if TYPE_CHECKING:  # what is accepted; the fields above are what it becomes

        def __init__(
            self,
            positions: npt.ArrayLike,
            normals: npt.ArrayLike,
            rgb: npt.ArrayLike,
        ) -> None: ...

    def __post_init__(self) -> None:
        for name in ("positions", "normals", "rgb"):
            object.__setattr__(self, name, float_array(name, getattr(self, name)))
        check_shapes(positions=(self.positions, "N 3"), normals=(self.normals, "N 3"), rgb=(self.rgb, "N 3"))
        if self.count == 0:
            raise SceneError("zero points: there is no light to compare")
        refuse_rows("rgb", "negative", np.asarray((self.rgb < 0.0).any(axis=1)))
        object.__setattr__(self, "normals", normalise_rows("normals", self.normals))

    @classmethod
    def of(cls, subject: Lit, *, around: npt.ArrayLike | None = None, radius: float | None = None) -> LitPoints:
        """Makes points from the Gaussians of a set, an instance or a scene, in world space.

        Colours are those of SH degree 0, the mean over all directions, decoded to linear light. Normals are those of
        the set, else `estimate_normals`.

        Args:
            subject: Gaussians, an instance of them, or a scene, all splat instances of which count; meshes do not.
            around: Use only Gaussians near this point in world space, shape (3,), and turn estimated normals towards
                it, like the walls of a room around a person. None: use all, with outward normals.
            radius: Largest distance from ``around``, metres; required with it.

        Raises:
            ConfigError: ``radius`` is not above 0.
            SceneError: There are no Gaussians, or none is near enough (the message says how far the nearest one is), or
                ``around`` is not a point.
        """
        ball = None if around is None else _Ball.of(around, radius)
        parts = list(_instances(subject))
        if not parts:
            raise SceneError("the scene has no Gaussians: there is no light to compare")
        selections = [np.ones(part.gaussians.count, np.bool_) if ball is None else ball.holds(part) for part in parts]
        if ball is not None and not any(rows.any() for rows in selections):
            nearest = min(float(ball.distances(part).min()) for part in parts)
            listed = ", ".join(f"{value:.3g}" for value in ball.center.tolist())
            raise SceneError(
                f"no Gaussian of the scene is within {ball.radius:g} of the avatar's centre ({listed}), the nearest is "
                f"{nearest:.3g} away: is the avatar where it should be, and the unit a metre?"
            )
        made = [_points(part, rows, ball) for part, rows in zip(parts, selections, strict=True) if rows.any()]
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


def check_radius(radius: object) -> float:
    """Returns ``radius``; raises a `ConfigError` unless it is a finite number above 0."""
    if not is_number(radius) or not 0.0 < radius < np.inf:
        raise ConfigError(f"radius is {quoted(radius)}, expected metres above 0")
    return radius


class _Ball(NamedTuple):
    """The part of space that counts."""

    center: Doubles
    radius: float

    @classmethod
    def of(cls, center: npt.ArrayLike, radius: object) -> _Ball:
        checked = check_radius(radius)
        point = float_array("around", center).astype(np.float64)
        check_shapes(around=(point, "3"))
        return cls(point, checked)

    def distances(self, instance: SplatInstance) -> Doubles:
        """Distances of the means from the centre, shape (N,)."""
        return np.linalg.norm(instance.world_means - self.center, axis=1)

    def holds(self, instance: SplatInstance) -> npt.NDArray[np.bool_]:
        """Which means are inside, shape (N,)."""
        return self.distances(instance) <= self.radius


def _instances(subject: object) -> Iterator[SplatInstance]:
    if isinstance(subject, Scene):
        yield from subject.splats
    elif isinstance(subject, SplatInstance):
        yield subject
    elif isinstance(subject, Gaussians):
        yield SplatInstance(subject)
    else:
        raise SceneError(f"metrics of lighting take Gaussians or LitPoints, got a {type(subject).__name__}")


def _points(
    instance: SplatInstance, rows: npt.NDArray[np.bool_], ball: _Ball | None
) -> tuple[Doubles, npt.NDArray[np.floating], npt.NDArray[np.floating]]:
    """Positions, normals and linear colours of the Gaussians of an instance that a mask selects."""
    selected = instance.gaussians if rows.all() else instance.gaussians.subset(rows)
    positions = instance.world_means[rows]
    own_normals = selected.normals
    if own_normals is None:
        from lumisplat.scene.ops.estimate_normals import estimate_normals

        own_normals = estimate_normals(selected)
    # The similarity rotates normals; its scale is removed when they are normalised.
    normals = own_normals @ instance.transform[:3, :3].T
    if selected.normals is None and ball is not None:
        away = np.einsum("ij,ij->i", normals, ball.center - positions) < 0.0
        normals = np.where(away[:, None], -normals, normals)
    display = np.maximum(SH_C0 * selected.sh[:, 0].astype(np.float64) + 0.5, 0.0)
    return positions, normals, decode_srgb(display)
