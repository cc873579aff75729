"""Normals stored with Gaussians, where the surface curves away from the eye."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.device.splat.projection import HORIZON_COSINE
from lumisplat.math.sh import even_directions
from support.oracles.bsdf_oracle import evaluate
from support.scenes.pipelines import DIRECT
from support.scenes.raster_scenes import flat_sh

EYE = np.array([0.0, 0.0, -4.0])
CAMERA = ls.Camera.look_at(EYE, (0.0, 0.0, 0.0), (0.0, -1.0, 0.0), width=48, height=48, fov_y=0.6)
PAPER = ls.MaterialPbr(roughness=1.0, specular=0.0)


def ball(count: int = 3000) -> ls.Gaussians:
    """Returns a white unit ball of round Gaussians with outward normals."""
    outwards = even_directions(count)
    spread = np.full((count, 3), 0.03)
    wxyz = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    white = np.ones((count, 3))
    return ls.Gaussians(outwards, wxyz, spread, np.full(count, 0.9), flat_sh(white), normals=outwards, albedo=white)


def seen(capture: ls.Gaussians, pipeline: ls.Pipeline, light: ls.LightDirectional) -> ls.Frame:
    """Renders a frame of the capture, lit without shadows."""
    scene = ls.Scene(splats=[ls.SplatInstance(capture, material=PAPER)], lights=[light])
    config = ls.RenderConfig(pipeline=pipeline, lighting=True, shadows=ls.Shadows.OFF, background=None)
    return ls.render(scene, CAMERA, config, device="cpu")


def silhouette(frame: ls.Frame) -> tuple[np.ndarray, np.ndarray]:
    """Returns the mask of pixels whose rays miss the ball but hit its Gaussians, and each ray's outward direction."""
    directions = CAMERA.ray_directions().astype(np.float64) @ CAMERA.camera_from_world[:3, :3]
    nearest = EYE - (directions @ EYE)[..., None] * directions
    distance = np.linalg.norm(nearest, axis=-1, keepdims=True)
    missed = (distance[..., 0] > 1.0) & (distance[..., 0] < 1.1) & (frame.alpha > 0.3)
    assert missed.sum() > 200
    return missed, nearest / np.maximum(distance, 1e-9)


@pytest.mark.parametrize("pipeline", DIRECT)
def test_normal_layer_of_gaussians_with_stored_normals_is_right_up_to_the_silhouette(pipeline: ls.Pipeline) -> None:
    """Gaussians from just behind the horizon are visible, and their normals must not cancel those in front.

    Opaque Gaussians reach 3.3 scales, 0.1 units here: visible ones are at most acos(0.9) = 26 degrees from the horizon.
    """
    frame = seen(ball(), pipeline, ls.LightDirectional((0.0, 0.0, 1.0)))
    missed, outwards = silhouette(frame)
    cosines = (frame.normal * outwards).sum(axis=-1)[missed]
    assert np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))).max() < 26.0


def sheet(spread: float) -> ls.Gaussians:
    """Returns a sheet of overlapping Gaussians that faces `EYE`, with stored normals tilted by ``spread`` radians."""
    rng, count = np.random.default_rng(3), 6000
    means = np.column_stack([rng.uniform(-1.2, 1.2, (count, 2)), rng.normal(0.0, 0.01, count)])
    normals = np.column_stack([spread * rng.normal(size=(count, 2)), np.full(count, -1.0)])
    wxyz, size = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)), np.full((count, 3), 0.05)
    white = np.ones((count, 3))
    return ls.Gaussians(means, wxyz, size, np.full(count, 0.4), flat_sh(white), normals=normals, albedo=white)


METAL = ls.MaterialPbr(roughness=0.3, metallic=1.0)
GLOSS = ls.MaterialSimple(emissive=(0, 0, 0), diffuse=(0, 0, 0), specular=(0.5, 0.5, 0.5), shininess=40.0)


@pytest.mark.parametrize("material", [METAL, GLOSS], ids=["pbr", "simple"])
@pytest.mark.parametrize("spread", [0.0, 0.25])
def test_highlight_of_gaussians_is_as_wide_as_the_spread_of_their_normals(
    material: ls.MaterialPbr | ls.MaterialSimple, spread: float
) -> None:
    """Blended Gaussians shine as single ones in the mean, which paths show; with equal normals, both are equal."""
    small = ls.Camera.look_at(EYE, (0.0, 0.0, 0.0), (0.0, -1.0, 0.0), width=16, height=16, fov_y=0.5)
    config = ls.RenderConfig(lighting=True, shadows=ls.Shadows.OFF, background=None)
    paths = replace(config, pipeline=ls.Pipeline.PATH, samples=64, max_bounces=0)
    for degrees in (0.0, 20.0):
        turn = np.radians(degrees)
        sun = ls.LightDirectional((np.sin(turn), 0.0, np.cos(turn)), intensity=np.pi)
        scene = ls.Scene([ls.SplatInstance(sheet(spread), material=material)], lights=[sun])
        found, expected = (ls.render(scene, small, one, device="cpu").color for one in (config, paths))
        if spread == 0.0:
            assert found.mean() == pytest.approx(expected.mean(), rel=0.02)
        else:
            assert 0.9 < found.mean() / expected.mean() < 1.6
            assert found.std() / found.mean() < 0.9 * expected.std() / expected.mean()


def test_highlight_of_gaussians_with_roughness_of_their_own_is_not_widened() -> None:
    """Such roughness was found together with the normals: the highlight is that of the blended normal, brighter."""
    capture = sheet(0.25)
    own = replace(capture, roughness=np.full(capture.count, 0.3))
    sun = ls.LightDirectional((0.0, 0.0, 1.0), intensity=np.pi)
    config = ls.RenderConfig(lighting=True, shadows=ls.Shadows.OFF, background=None)
    widened, kept = (
        ls.render(ls.Scene([ls.SplatInstance(one, material=material)], lights=[sun]), CAMERA, config, device="cpu")
        for one, material in ((capture, METAL), (own, replace(METAL, roughness=1.0)))
    )
    assert kept.color.mean() > 3.0 * widened.color.mean()


@pytest.mark.parametrize("pipeline", DIRECT)
def test_gaussian_ball_lit_from_one_side_is_black_at_the_silhouette_of_the_other_side(pipeline: ls.Pipeline) -> None:
    """If normals at the silhouette were flipped, they would be lit from behind the ball."""
    frame = seen(ball(), pipeline, ls.LightDirectional((-1.0, 0.0, 0.0), intensity=np.pi))
    missed, outwards = silhouette(frame)
    shown = frame.straight()[..., 0]
    towards, away = missed & (outwards[..., 0] > 0.95), missed & (outwards[..., 0] < -0.5)
    assert min(towards.sum(), away.sum()) > 10
    assert shown[towards].min() > np.cos(np.radians(26.0 + 18.2))
    assert shown[away].max() < 1e-3


@pytest.mark.parametrize("pipeline", DIRECT)
def test_stored_normals_that_face_away_by_more_than_30_degrees_are_flipped(pipeline: ls.Pipeline) -> None:
    """Normals less than 30 degrees behind the horizon are bent to the horizon instead."""
    for beyond, shown in ((70.0, "turned"), (40.0, "turned"), (20.0, "bent"), (1.0, "bent"), (-10.0, "kept")):
        along, across = np.sin(np.radians(beyond)), np.cos(np.radians(beyond))
        normal = np.array([across, 0.0, along])
        wanted = {"turned": -normal, "bent": np.array([1.0, 0.0, -HORIZON_COSINE]), "kept": normal}[shown]
        gaussian = replace(ball(1), means=np.zeros((1, 3)), normals=normal[None])
        frame = seen(gaussian, pipeline, ls.LightDirectional((0.0, 0.0, 1.0)))
        np.testing.assert_allclose(frame.normal[24, 24], wanted, atol=0.01)


@pytest.mark.parametrize("pipeline", [*DIRECT, ls.Pipeline.PATH])
def test_gaussian_whose_normal_faces_slightly_away_is_shaded_as_if_mirrored_to_the_viewer(
    pipeline: ls.Pipeline,
) -> None:
    """The surface reflects as if the eye were as far above its horizon as it is below, for any light.

    Shaded from just above the horizon, a glossy surface would be a mirror at every angle.
    """
    gloss, to_eye = ls.MaterialPbr(roughness=0.5), -CAMERA.ray_directions()[24, 24].astype(np.float64)
    to_eye = to_eye @ CAMERA.camera_from_world[:3, :3]
    material = {"model": "pbr", "diffuse": [1.0] * 3, "specular": [0.04] * 3, "grazing": 1.0}
    material |= {"dielectric": 1.0, "eta": 1.0 / 1.5, "alpha": 0.25}
    for beyond in (25.0, 10.0, 1.0):
        along, across = np.sin(np.radians(beyond)), np.cos(np.radians(beyond))
        normal = np.array([across, 0.0, along])
        gaussian = replace(ball(1), means=np.zeros((1, 3)), normals=normal[None])
        view = to_eye - 2.0 * (to_eye @ normal) * normal
        assert view @ normal == pytest.approx(along, abs=0.02) and to_eye @ normal < 0.0
        for light in ([0.2, 0.1, 1.0], [1.0, 0.3, 0.4], [1.0, -0.5, -0.6]):
            towards = np.array(light) / np.linalg.norm(light)
            source = ls.LightDirectional(tuple(-towards))
            scene = ls.Scene(splats=[ls.SplatInstance(gaussian, material=gloss)], lights=[source])
            config = ls.RenderConfig(pipeline=pipeline, shadows=ls.Shadows.OFF, background=None, max_bounces=0)
            if pipeline is ls.Pipeline.PATH:
                config = replace(config, samples=64, jitter=False)
            frame = ls.render(scene, CAMERA, config, device="cpu")
            expected = evaluate(material, normal, view, towards) * max(towards @ normal, 0.0)
            np.testing.assert_allclose(frame.straight()[24, 24], expected, rtol=2e-3)
