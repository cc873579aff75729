"""Captures sampled as lights in real time: pdf of their boxes, their light, and which captures count as lights."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.config.render import PATH_PARTS
from lumisplat.constants import SH_C0
from lumisplat.device.gi.captured_emitters import EmitterBox
from lumisplat.math.transforms import rotation_from_degrees
from lumisplat.renderer.scene.captured_emitters import boxes_of, is_separate_emitter
from lumisplat.runtime.struct_tables import table_dtype
from support.kinds import for_splats
from support.probes import probe_captured_emitter_kernels as probe
from support.scenes.path_scenes import diffuse

RNG = np.random.default_rng(7)
FLOOR = ls.MeshInstance(ls.plane(8.0, 8.0, material=diffuse(0.5)))
CAPTURED_LIGHT = ls.gaussians_from_mesh(ls.plane(1.0, 1.0, material=diffuse(1.0)), 1500)
"""White captured square of radiance 1, visible from both sides."""


def placed(height: float, turn: float = 0.0, **settings: Any) -> ls.SplatInstance:
    """Returns the captured square above the origin, rotated about the x axis by ``turn`` degrees."""
    transform = np.eye(4)
    transform[:3, :3] = rotation_from_degrees(np.array((turn, 0.0, 0.0)))
    transform[1, 3] = height
    return ls.SplatInstance(CAPTURED_LIGHT, world_from_object=transform, **settings)


# --- The boxes ---


def box_rows() -> np.ndarray:
    """Returns three boxes, one of them flat, one around the origin."""
    rows = np.zeros(3, table_dtype(EmitterBox))
    rows["center"] = (0.0, 0.1, 0.0), (2.0, 1.0, 0.5), (-1.0, -1.5, 1.0)
    rows["half"] = (0.5, 0.4, 0.3), (0.7, 0.001, 0.6), (0.3, 0.6, 0.2)
    rotations = [
        rotation_from_degrees(np.array(angles)) for angles in ((0.0, 0.0, 0.0), (30.0, 10.0, 70.0), (15.0, 80.0, 5.0))
    ]
    rows["box_from_world"] = rotations
    rows["power"] = 1.0, 3.0, 0.5
    return rows


def pdf_reference(rows: np.ndarray, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Returns the pdf of directions by definition: volume integrals along each ray, weighted by distance squared."""
    away = ((points[:, None] - rows["center"]) ** 2).sum(axis=2)
    weights = rows["power"] / np.maximum(away, (rows["half"].astype(np.float64) ** 2).sum(axis=1))
    shares = weights / weights.sum(axis=1, keepdims=True)
    total = np.zeros(len(points))
    for k, row in enumerate(rows):
        start = (points - row["center"]) @ row["box_from_world"].T.astype(np.float64)
        along = directions @ row["box_from_world"].T.astype(np.float64)
        with np.errstate(divide="ignore"):
            ends = np.stack([(-row["half"] - start) / along, (row["half"] - start) / along])
        near, far = np.maximum(ends.min(axis=0).max(axis=1), 0.0), ends.max(axis=0).min(axis=1)
        cubes = np.where(far > near, far**3 - near**3, 0.0)
        total += shares[:, k] * cubes / (3.0 * 8.0 * np.prod(row["half"], dtype=np.float64))
    return total


def sampled(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Samples one direction a point; returns the directions and their pdfs."""
    count = len(points)
    directions, pdfs = wp.zeros(count, wp.vec3, device="cpu"), wp.zeros(count, wp.vec2, device="cpu")
    inputs = wp.array(box_rows(), dtype=EmitterBox, device="cpu"), wp.array(points, dtype=wp.vec3, device="cpu")
    random = wp.array(RNG.random((count, 4)), dtype=wp.vec4, device="cpu")
    wp.launch(probe.sample_boxes, count, inputs=[0, *inputs, random, directions, pdfs], device="cpu")
    return directions.numpy().astype(np.float64), pdfs.numpy().astype(np.float64)[:, 0]


def test_pdf_of_a_direction_to_captured_lights_is_that_of_uniform_points_in_their_boxes() -> None:
    """The points include some inside a box, and one of the boxes is flat."""
    points = np.concatenate([RNG.uniform(-3.0, 3.0, (3000, 3)), RNG.uniform(-0.2, 0.2, (1000, 3))])
    directions, pdfs = sampled(points)
    reference = pdf_reference(box_rows(), points, directions)
    assert (pdfs > 0.0).mean() > 0.999
    good = (reference > 0.0) & (pdfs > 0.0)
    np.testing.assert_allclose(pdfs[good], reference[good], rtol=0.02)


def test_mean_of_1_over_pdf_of_captured_light_samples_is_the_sampled_solid_angle() -> None:
    """The mean of 1 / pdf over a cone that the boxes cover is the cone's solid angle, also from inside a box."""
    points = np.zeros((200_000, 3))
    directions, pdfs = sampled(points)
    for axis in np.eye(3):
        inside = directions @ axis > np.cos(0.5)
        assert (inside / pdfs).mean() == pytest.approx(2.0 * np.pi * (1.0 - np.cos(0.5)), rel=0.02)


def test_sampling_boxes_of_a_captured_light_contain_all_its_gaussians() -> None:
    """Each mean is in one of 16 boxes; each Gaussian, to three standard deviations, is in the box of the capture."""
    rotated = ls.gaussians_from_mesh(ls.sphere(1.0), 3000)
    boxes = boxes_of(rotated)
    offsets = rotated.means[:, None].astype(np.float64) - boxes.centers
    inside = (np.abs(np.einsum("nkx,kax->nka", offsets, boxes.axes)) <= boxes.halves + 1e-6).all(axis=2)
    assert inside[:, 1:].any(axis=1).all()
    assert inside[:, 0].all()
    assert (boxes.powers > 0.0).all()
    assert len(boxes.powers) == 17


def test_capture_of_a_single_gaussian_has_boxes_for_light_sampling() -> None:
    """One Gaussian cannot be split, so that it has one box besides the box around the capture."""
    one = ls.Gaussians(
        np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]]), np.full((1, 3), 0.1), np.ones(1), np.zeros((1, 1, 3))
    )
    assert len(boxes_of(one).powers) == 2


# --- Which captures are lights ---


def test_captures_that_surround_lit_surfaces_are_not_sampled_as_lights() -> None:
    """A capture above a floor is a light; a captured room around a mesh is not."""
    corners = np.column_stack([RNG.uniform(-4.0, 4.0, (100, 3)), np.ones(100)])
    flat, around = np.array(((-0.5, -0.1, -0.5), (0.5, 0.1, 0.5))), np.array(((-5.0,) * 3, (5.0,) * 3))
    assert is_separate_emitter(placed(1.0), flat, corners)
    assert not is_separate_emitter(placed(1.0), around, corners)
    assert not is_separate_emitter(placed(1.0), flat, np.zeros((0, 4)))


def test_realtime_pipeline_takes_no_direct_light_from_a_captured_room_around_a_mesh() -> None:
    """Direct light appears only if another capture beside the mesh is a light."""
    room = ls.SplatInstance(ls.gaussians_from_mesh(ls.box(10.0, material=diffuse(0.3)), 3000))
    ball = ls.MeshInstance(ls.sphere(0.5, material=diffuse(0.5)))
    camera = ls.Camera.look_at((0.0, 1.0, 3.0), (0.0, 0.0, 0.0), width=32, height=24, fov_y=0.6)
    surrounded, both = (after(ls.Scene(sets, [ball]), 2, camera) for sets in ([room], [room, placed(1.5)]))
    assert surrounded.direct_diffuse is not None
    assert both.direct_diffuse is not None
    assert not surrounded.direct_diffuse.any()
    assert both.direct_diffuse.any()


# --- The light ---


def view(width: int = 64, height: int = 48) -> ls.Camera:
    """Returns a camera that sees the floor from above, in front of the captured light."""
    return ls.Camera.look_at((0.0, 2.5, 4.0), (0.0, 0.0, 1.0), width=width, height=height, fov_y=0.6)


def after(scene: ls.Scene, frames: int, camera: ls.Camera, **settings: Any) -> ls.Frame:
    """Returns the last of ``frames`` real-time frames."""
    given = ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, aovs=PATH_PARTS, **settings)
    renderer = ls.create_renderer(given, "cpu")
    for _ in range(frames - 1):
        renderer.render(scene, camera)
    return renderer.render(scene, camera)


def paths(scene: ls.Scene, samples: int, camera: ls.Camera, **settings: Any) -> ls.Frame:
    """Path-traces the same scene."""
    config = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=samples, **settings)
    return ls.create_renderer(config, "cpu").render(scene, camera)


def blob_irradiance(points: np.ndarray, center: np.ndarray, sigma: float, opacity: float) -> np.ndarray:
    """Returns a floor's irradiance from a round Gaussian of radiance 1, by quadrature of its alpha."""
    polar, turn = (np.arange(count) + 0.5 for count in (200, 200))
    cosines, angles = 1.0 - polar / 200.0, 2.0 * np.pi * turn / 200.0
    sines = np.sqrt(1.0 - cosines**2)
    directions = np.stack(
        [np.outer(sines, np.cos(angles)), np.outer(cosines, np.ones(200)), np.outer(sines, np.sin(angles))], axis=-1
    ).reshape(-1, 3)
    offsets = center - points
    along = offsets @ directions.T
    distance2 = (offsets**2).sum(axis=1)[:, None] - along**2
    response = np.exp(-0.5 * distance2 / sigma**2)
    alpha = opacity * np.where((response > 0.0113) & (along > 0.0), response, 0.0)
    irradiance: np.ndarray = (alpha @ directions[:, 1]) * 2.0 * np.pi / len(directions)
    return irradiance


def test_realtime_irradiance_of_a_captured_gaussian_integrates_its_alpha() -> None:
    """Without bounces, the frame is within 2 % in the mean, and within 8 % RMS over blocks of pixels."""
    center, sigma, opacity = np.array((0.0, 1.0, 0.5)), 0.2, 0.9
    white = np.full((1, 1, 3), 0.5 / SH_C0)
    blob = ls.Gaussians(center[None], np.array([[1.0, 0, 0, 0]]), np.full((1, 3), sigma), np.array([opacity]), white)
    camera = ls.Camera.look_at((0.0, 3.0, 4.0), (0.0, 0.0, 1.5), width=64, height=48, fov_y=0.5)
    frame = after(ls.Scene([ls.SplatInstance(blob)], [FLOOR]), 32, camera, max_bounces=0)
    assert frame.direct_diffuse is not None
    assert frame.position is not None
    floor = frame.instance_index == 1
    truth = np.zeros(floor.shape)
    truth[floor] = 0.5 / np.pi * blob_irradiance(frame.position[floor].astype(np.float64), center, sigma, opacity)
    found = frame.direct_diffuse.mean(axis=2)
    assert found[floor].mean() == pytest.approx(truth[floor].mean(), rel=0.02)
    whole = floor.reshape(6, 8, 8, 8).all(axis=(1, 3))
    ratio = (found.reshape(6, 8, 8, 8).mean(axis=(1, 3)) / truth.reshape(6, 8, 8, 8).mean(axis=(1, 3)))[whole]
    assert np.sqrt(((ratio - 1.0) ** 2).mean()) < 0.08


def upright(back: float = 0.35) -> ls.Scene:
    """Returns a captured panel on a floor, with a mesh plate behind it whose front it does not light."""
    plate = ls.box((1.2, 0.6, 0.05), material=diffuse(0.7))
    captured_light = placed(0.5, 90.0)
    return ls.Scene([captured_light], [FLOOR, ls.MeshInstance(plate, position=(0.0, 0.3, back))])


def test_realtime_contact_shadows_of_captured_lights_match_the_path_tracer() -> None:
    """Blocks of floor and plate are within 13 % RMS of the path tracer, including the noise of either image."""
    camera = ls.Camera.look_at((2.2, 1.2, 2.0), (0.0, 0.2, 0.2), width=64, height=48, fov_y=0.8)
    truth, frame = paths(upright(), 400, camera), after(upright(), 32, camera)
    lit = (frame.instance_index >= 1).reshape(6, 8, 8, 8).all(axis=(1, 3))
    found, expected = (one.color.reshape(6, 8, 8, 8, 3).mean(axis=(1, 3, 4))[lit] for one in (frame, truth))
    errors = (found - expected) / np.maximum(expected, 0.3 * expected.mean())
    assert np.sqrt((errors**2).mean()) < 0.13
    assert found.mean() == pytest.approx(expected.mean(), rel=0.03)


def test_captured_light_beside_a_much_brighter_lamp_keeps_its_mean_on_a_floor() -> None:
    """The captured light, the difference from a floor under a black capture, is within 3 % of paths."""
    black = ls.gaussians_from_mesh(ls.plane(1.0, 1.0, material=diffuse(0.0)), 1500)
    lamp = ls.LightPoint(position=(1.5, 2.0, 1.0), intensity=30.0)
    scenes = [ls.Scene([replace(placed(1.0), gaussians=of)], [FLOOR], [lamp]) for of in (CAPTURED_LIGHT, black)]
    camera = ls.Camera.look_at((0.0, 0.6, 3.0), (0.0, 0.0, 0.2), width=48, height=32, fov_y=0.4)
    frames = [after(scene, 32, camera, max_bounces=0) for scene in scenes]
    truths = [paths(scene, 128, camera, max_bounces=0) for scene in scenes]
    floor = frames[0].instance_index == 1
    (lit, unlit), (truth, dark) = ([float(one.color[floor].mean()) for one in of] for of in (frames, truths))
    assert truth < 1.2 * dark
    assert lit - unlit == pytest.approx(truth - dark, rel=0.03)


def test_realtime_captured_light_through_glass_matches_the_path_tracer() -> None:
    """Glass tints the light of captures as it tints light sources, and the light counts once."""
    tinted = ls.MaterialPbr(base_color=(0.9, 0.5, 0.2), roughness=0.0, transmission=1.0, thin_walled=True)
    pane = ls.MeshInstance(ls.plane(3.0, 3.0, material=tinted), position=(0.0, 0.7, 0.0))
    scene = ls.Scene([placed(1.0)], [FLOOR, pane])
    camera = ls.Camera.look_at((0.0, 0.6, 3.0), (0.0, 0.0, 0.2), width=48, height=32, fov_y=0.4)
    truth, frame = paths(scene, 256, camera), after(scene, 32, camera)
    floor = frame.instance_index == 1
    np.testing.assert_allclose(frame.color[floor].mean(axis=0), truth.color[floor].mean(axis=0), rtol=0.05)


def test_relit_gaussians_receive_and_block_captured_light_in_real_time() -> None:
    """A relit floor below a relit plate is as bright as in the path tracer, to 6 %."""
    material = diffuse(0.5)
    rest = for_splats(material)
    floor = ls.SplatInstance(ls.gaussians_from_mesh(ls.plane(4.0, 4.0, material=material), 6000), material=rest)
    plate = ls.SplatInstance(
        ls.gaussians_from_mesh(ls.plane(0.5, 0.5, material=material), 800),
        material=rest,
        position=(0.0, 0.5, 0.6),
    )
    scene, camera = ls.Scene([placed(1.0), floor, plate]), view(48, 32)
    truth, frame = (
        paths(scene, 128, camera, path=ls.PathConfig(primary=ls.config.PathPrimary.ISO)),
        after(scene, 32, camera),
    )
    lit = frame.instance_index == 1
    assert frame.color[lit].mean() == pytest.approx(truth.color[lit].mean(), rel=0.06)


def test_capture_gain_of_two_stops_quadruples_captured_light_in_real_time() -> None:
    """The mean light of the frame is compared."""
    plain, bright = (
        after(ls.Scene([placed(1.0)], [FLOOR]), 4, view(32, 24), max_bounces=0, capture_gain=stops)
        for stops in (0.0, 2.0)
    )
    assert plain.direct_diffuse is not None
    assert bright.direct_diffuse is not None
    assert plain.direct_diffuse.any()
    assert bright.direct_diffuse.sum() == pytest.approx(4.0 * plain.direct_diffuse.sum(), rel=1e-3)


def test_realtime_frames_with_captured_lights_do_not_depend_on_thread_count() -> None:
    """The bits are equal with 1 and 3 threads."""
    frames = []
    for threads in (1, 3):
        config = ls.RenderConfig(pipeline=ls.Pipeline.REALTIME)
        renderer = ls.create_renderer(config, "cpu", threads=threads)
        frames.append([renderer.render(upright(), view(32, 24)).color for _ in range(3)][-1])
    np.testing.assert_array_equal(*frames)


def test_light_that_a_capture_casts_in_real_time_moves_with_the_capture() -> None:
    """After 12 frames, blocks are within 10 % RMS of a sequence in which the capture never moved."""
    camera, scenes = view(48, 32), []
    for x in (-0.8, 0.8):
        scenes.append(ls.Scene([ls.SplatInstance(CAPTURED_LIGHT, position=(x, 0.6, 0.0))], [FLOOR]))
    renderer = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.REALTIME), "cpu")
    for scene in [scenes[0]] * 16 + [scenes[1]] * 11:
        renderer.render(scene, camera)
    moved = renderer.render(scenes[1], camera)
    still = after(scenes[1], 28, camera)
    floor = (still.instance_index == 1).reshape(4, 8, 6, 8).all(axis=(1, 3))
    found, expected = (one.color.reshape(4, 8, 6, 8, 3).mean(axis=(1, 3, 4))[floor] for one in (moved, still))
    assert np.sqrt(((found / expected - 1.0) ** 2).mean()) < 0.1
