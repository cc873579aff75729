"""Gradients of light probes: of irradiance, of relit Gaussians, and of probes captured in a scene, in float64.

The equations are in docs/method/relighting.md#gradients-of-probes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from lumisplat.config import RelightConfig
from lumisplat.constants import NEAR_PLANE, PROBE_FACE_PX
from lumisplat.errors import ConfigError, SceneError, check_instance, check_shapes
from lumisplat.math.arrays import Doubles, finite_array, refuse_rows, three_numbers
from lumisplat.math.color import decode_slope
from lumisplat.math.sh import sh_basis, sh_gradient
from lumisplat.relighting.probe import PROBE_RIDGE, EnvironmentProbe, cosine_factors, fit_gradient
from lumisplat.relighting.probe_transfer import NO_LIGHT, NORMALS_AT_ONCE, direction_grid, light_scales, relight
from lumisplat.renderer.cubemap import cube_views
from lumisplat.renderer.gradients.arrays import SetGradient
from lumisplat.renderer.gradients.differentiable_renderer import DifferentiableRenderer
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.colors import scale_light_gradient
from lumisplat.scene.scene import Scene


@dataclass(frozen=True, slots=True, eq=False)
class ProbeIrradiance:
    """Irradiance of surfaces in the light of a probe, with what its gradients need."""

    irradiance: Doubles
    """Irradiance at each of N normals, linear Rec.709, shape (N, 3)."""
    _probe: EnvironmentProbe
    _normals: _Normals

    def gradients(self, dL_dirradiance: npt.ArrayLike) -> tuple[Doubles, Doubles]:
        """Returns the gradients of a loss by the probe's coefficients and by the normals.

        Args:
            dL_dirradiance: Gradient of the loss by ``irradiance``, shape (N, 3).

        Returns:
            Gradient by the K coefficients of the probe, shape (K, 3), and by the normals, shape (N, 3). The latter are
            perpendicular to the normals, whose length does not count.

        Raises:
            SceneError: The shape is not (N, 3), or values are not finite.
        """
        upstream = _upstream("dL_dirradiance", dL_dirradiance, self.irradiance.shape)
        return _by_irradiance(self._probe, self._normals, upstream)


@dataclass(frozen=True, slots=True, eq=False)
class RelitGaussians:
    """Gaussians in the light of a probe, with what their gradients need."""

    gaussians: Gaussians
    """The N relit Gaussians, to the bit as `lumisplat.relight` returns them. Only their ``sh`` differ from the given
    ones."""
    _captured: Gaussians
    _probe: EnvironmentProbe
    _normals: _Normals
    _config: RelightConfig

    def gradients(self, dL_dsh: npt.ArrayLike) -> tuple[Doubles, Doubles, Doubles]:
        """Returns the gradients of a loss by the probe's coefficients, by the normals and by the captured SH.

        Where a channel's factor of light is clipped, at 0 or at ``scale_max``, its gradients by coefficients and normal
        are 0. For an exponent below 1, the factor has no finite derivative where a direction of the grid lies in a
        surface; there it is that of the directions above the surface.

        Args:
            dL_dsh: Gradient of the loss by ``gaussians.sh``, such as `SetGradient.sh` of a frame, shape (N, M, 3).

        Returns:
            Gradient by the K coefficients of the probe, shape (K, 3); by the normals, shape (N, 3), perpendicular to
            them, for their length does not count; and by the SH of the Gaussians before relighting, shape (N, M, 3).

        Raises:
            SceneError: The shape is not that of ``gaussians.sh``, or values are not finite.
        """
        upstream = _upstream("dL_dsh", dL_dsh, self.gaussians.sh.shape)
        scales = light_scales(self._probe, self._normals.unit, self._config)
        is_inside = (scales > 0.0) & (scales < np.float32(self._config.scale_max))
        gamma = 1.0 if self._config.gamma is None else self._config.gamma
        by_factors, by_captured = scale_light_gradient(self._captured, gamma * scales.astype(np.float64), upstream)
        by_scales = np.where(is_inside, gamma * by_factors, 0.0)
        if self._config.exponent == 1.0:
            by_coefficients, by_normals = _by_irradiance(self._probe, self._normals, by_scales / np.pi)
        else:
            by_coefficients, by_normals = _by_lobes(self._probe, self._normals, self._config, by_scales)
        return by_coefficients, by_normals, by_captured


@dataclass(frozen=True, slots=True, eq=False)
class CapturedProbe:
    """A probe captured in a scene, with what its gradients need."""

    probe: EnvironmentProbe
    """The probe, as `EnvironmentProbe.capture` returns it."""
    _scene: Scene
    _position: Doubles
    _renderer: DifferentiableRenderer

    def gradients(self, dL_dcoefficients: npt.ArrayLike) -> tuple[tuple[SetGradient, ...], Doubles]:
        """Renders the probe's cube map again, and returns the gradients of a loss by Gaussians and by the position.

        They are exact up to the edges of footprints, as for `lumisplat.splat_gradients`.

        Args:
            dL_dcoefficients: Gradient of the loss by ``probe.coefficients``, shape (K, 3).

        Returns:
            Gradients by the Gaussian sets of the scene, as `SplatGradients.sets` has them, and by the position of the
            probe, world space, shape (3,).

        Raises:
            SceneError: The shape is not (K, 3), or values are not finite.
        """
        upstream = _upstream("dL_dcoefficients", dL_dcoefficients, self.probe.coefficients.shape)
        views = cube_views(self._position, PROBE_FACE_PX, NEAR_PLANE)
        by_radiance = fit_gradient(views.directions, views.weights, upstream, PROBE_RIDGE)
        by_face = by_radiance.reshape(len(views.cameras), PROBE_FACE_PX, PROBE_FACE_PX, 3)
        faces: list[tuple[SetGradient, ...]] = []
        by_position = np.zeros(3)
        for camera, by_pixels in zip(views.cameras, by_face, strict=True):
            frame = self._renderer.render(self._scene, camera)
            found = self._renderer.gradients(by_pixels * decode_slope(frame.color), pose=True)
            assert found.camera_from_world is not None
            faces.append(found.sets)
            by_position -= camera.camera_from_world[:3, :3].T @ found.camera_from_world[:3, 3]
        return tuple(_sum(of_set) for of_set in zip(*faces, strict=True)), by_position


def probe_irradiance(probe: EnvironmentProbe, normals: npt.ArrayLike) -> ProbeIrradiance:
    """Computes the irradiance of surfaces in the light of a probe, with gradients by its coefficients and the normals.

    Args:
        probe: The probe; ``EnvironmentProbe(coefficients)`` makes one of SH coefficients.
        normals: N world-space normals of any length, shape (N, 3).

    Returns:
        The irradiance, as `EnvironmentProbe.irradiance` has it, and a method for its gradients.

    Raises:
        SceneError: The probe is of another type, or normals are not finite, of length 0 or not of shape (N, 3).
    """
    check_instance(probe, EnvironmentProbe, "expected an EnvironmentProbe")
    given = _Normals.of(normals)
    scaled = probe.coefficients * cosine_factors(probe.degree)[:, None]
    irradiance = np.concatenate([sh_basis(given.unit[rows], probe.degree) @ scaled for rows in given.chunks()])
    return ProbeIrradiance(irradiance, probe, given)


def relit_gaussians(
    gaussians: Gaussians, probe: EnvironmentProbe, normals: npt.ArrayLike, config: RelightConfig | None = None
) -> RelitGaussians:
    """Relights Gaussians by a probe, with gradients by the probe's coefficients, the normals and the captured colours.

    With a `lumisplat.DifferentiableRenderer`, images determine a probe or materials::

        relit = ls.gradients.relit_gaussians(gaussians, probe, normals)
        frame = renderer.render(ls.Scene([relit.gaussians]), camera)
        found = renderer.gradients(2.0 * (frame.color - image)).sets[0]
        by_coefficients, by_normals, by_sh = relit.gradients(found.sh)

    Args:
        gaussians: N Gaussians in world space.
        probe: Radiance at the position of the Gaussians.
        normals: Outward normals of any length, shape (N, 3), such as those of `lumisplat.estimate_normals`.
        config: As for `lumisplat.relight`.

    Returns:
        The relit Gaussians, and a method for their gradients.

    Raises:
        ConfigError: ``config`` is no RelightConfig.
        SceneError: An argument is of another type, or normals are not finite, of length 0 or of another number.
    """
    check_instance(gaussians, Gaussians, "relit_gaussians takes Gaussians")
    relit = relight(gaussians, probe, config, normals)
    return RelitGaussians(relit, gaussians, probe, _Normals.of(normals), config or RelightConfig())


def captured_probe(
    scene: Scene, position: npt.ArrayLike, degree: int = 3, renderer: DifferentiableRenderer | None = None
) -> CapturedProbe:
    """Captures a probe of an unlit scene, with gradients by the scene's Gaussians and by the probe's position.

    Lights and materials of the scene are ignored, as by `lumisplat.DifferentiableRenderer`.

    Args:
        scene: The scene that gives the light.
        position: As for `EnvironmentProbe.capture`.
        degree: As for `EnvironmentProbe.capture`.
        renderer: Renders the cube map; reuse one for several probes. Its settings need a background. None: a new one
            with the default settings.

    Returns:
        The probe, and a method for its gradients.

    Raises:
        ConfigError: ``degree`` is out of its range, or the renderer has no background.
        DeviceError: The device is out of memory.
        SceneError: The scene is of another type, or the position is not three finite numbers.
    """
    renderer = DifferentiableRenderer() if renderer is None else renderer
    check_instance(renderer, DifferentiableRenderer, "expected a DifferentiableRenderer")
    if renderer.config.background is None:
        raise ConfigError("captured_probe needs a background: RenderConfig(background=(0, 0, 0))")
    probe = EnvironmentProbe.capture(scene, position, degree, renderer=renderer)
    return CapturedProbe(probe, scene, three_numbers("position", position), renderer)


@dataclass(frozen=True, slots=True)
class _Normals:
    """Normals of N surfaces."""

    unit: Doubles
    """The normals at unit length, shape (N, 3)."""
    length: Doubles
    """Their lengths as given, shape (N, 1)."""

    @classmethod
    def of(cls, normals: npt.ArrayLike) -> _Normals:
        """Checks and normalises given normals.

        Raises:
            SceneError: Normals are not finite, of length 0 or not of shape (N, 3).
        """
        given = finite_array("normals", normals, np.float64)
        check_shapes(normals=(given, "N 3"))
        length = np.linalg.norm(given, axis=1, keepdims=True)
        refuse_rows("normals", "of zero length", length[:, 0] == 0.0)
        return cls(given / length, length)

    def chunks(self) -> Iterator[slice]:
        """Yields slices of the normals, `NORMALS_AT_ONCE` each; one that is empty if there are none."""
        for first in range(0, max(len(self.unit), 1), NORMALS_AT_ONCE):
            yield slice(first, first + NORMALS_AT_ONCE)


def _by_irradiance(probe: EnvironmentProbe, normals: _Normals, upstream: Doubles) -> tuple[Doubles, Doubles]:
    """Returns the gradients by coefficients, (K, 3), and by normals, (N, 3), from those by the irradiance, (N, 3)."""
    factors = cosine_factors(probe.degree)[:, None]
    by_coefficients, by_normals = np.zeros_like(probe.coefficients), np.zeros_like(normals.unit)
    for rows in normals.chunks():
        unit = normals.unit[rows]
        by_coefficients += factors * (sh_basis(unit, probe.degree).T @ upstream[rows])
        by_functions = upstream[rows] @ (probe.coefficients * factors).T
        by_normals[rows] = np.einsum("nki,nk->ni", sh_gradient(unit, probe.degree), by_functions)
    return by_coefficients, by_normals / normals.length


def _by_lobes(
    probe: EnvironmentProbe, normals: _Normals, config: RelightConfig, upstream: Doubles
) -> tuple[Doubles, Doubles]:
    """Returns the gradients by coefficients and normals, from those by `light_scales` before they are clipped."""
    grid = direction_grid(config.rows)
    basis = sh_basis(grid.directions, probe.degree)
    radiance = basis @ probe.coefficients
    by_radiance, by_normals = np.zeros_like(radiance), np.zeros_like(normals.unit)
    for rows in normals.chunks():
        cosines = normals.unit[rows] @ grid.directions.T
        slopes = np.power(cosines, config.exponent - 1.0, out=np.zeros_like(cosines), where=cosines > 0.0)
        slopes *= grid.weights
        lobes = slopes * cosines
        total = lobes.sum(axis=1, keepdims=True) + NO_LIGHT
        share = upstream[rows] / total
        by_radiance += lobes.T @ share
        by_lobes = share @ radiance.T - (share * (lobes @ radiance / total)).sum(axis=1, keepdims=True)
        by_normals[rows] = config.exponent * (slopes * by_lobes) @ grid.directions
    return basis.T @ by_radiance, by_normals / normals.length


def _upstream(name: str, values: npt.ArrayLike, shape: tuple[int, ...]) -> Doubles:
    """Returns a caller's gradient in float64.

    Raises:
        SceneError: The shape is another one, or values are not finite.
    """
    upstream = finite_array(name, values, np.float64)
    if upstream.shape != shape:
        raise SceneError(f"{name} has shape {upstream.shape}, expected {shape}")
    return upstream


def _sum(gradients: tuple[SetGradient, ...]) -> SetGradient:
    """Returns the sum of the gradients of one Gaussian set."""
    return SetGradient(
        *(np.sum([getattr(one, field.name) for one in gradients], axis=0) for field in fields(SetGradient))
    )
