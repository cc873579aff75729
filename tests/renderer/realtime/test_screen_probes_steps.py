"""Steps of screen probes, each against float64: placement, rays, means, reprojection and look-ups."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.config import ProbeConfig
from lumisplat.constants import SHADOW_OFFSET
from lumisplat.device.gaussian.layers import LAYER_LIFT
from lumisplat.device.gi.probe_placement import ProbeData
from lumisplat.math.directions import directions_of_square
from lumisplat.renderer.scene.camera_table import subpixel
from lumisplat.renderer.scene.motion import CHANGED_HISTORY_WEIGHT, OUTDATED_HISTORY_WEIGHT
from lumisplat.runtime.buffers import device_array
from support.oracles import screen_probe_oracle as oracle
from support.oracles.means_oracle import mean_weight
from support.probes.probe_octahedral_kernels import probe_light
from support.scenes.gi_surfaces import Doubles, VisibleSurfaces, camera_rows, sequence_row, visible_box, visible_plane
from support.scenes.probe_sequence import ProbeSequence, constant

CELLS = 64

Whole = npt.NDArray[np.int64]


def box_camera(step: float = 0.0) -> ls.Camera:
    """Returns a camera inside the cube; each step moves it."""
    eye = (0.1 + 0.03 * step, -0.4, 0.05)
    return ls.Camera.look_at(eye, (0.1, 0.5, 0.0), (0.0, 0.0, 1.0), width=160, height=96, fov_y=1.2)


def striped(origins: Doubles, directions: Doubles) -> tuple[Doubles, Doubles]:
    """Returns radiance and distances that differ by direction."""
    radiance = np.stack(
        [1.0 + np.sin(9.0 * directions[:, 0]), 1.0 + directions[:, 1], np.abs(directions[:, 2])], axis=1
    )
    return radiance, 0.3 + np.abs(directions[:, 2])


def fields(probes: ProbeData) -> dict[str, npt.NDArray[np.float64]]:
    """Returns copies of the fields of the probes."""
    with np.errstate(invalid="ignore"):  # fields of missing probes are undefined
        return {name: getattr(probes, name).numpy().astype(np.float64) for name in ProbeData.vars}  # pyright: ignore


def cells_of(sequence: ProbeSequence) -> oracle.Cells:
    """Returns copies of all cells, probe after probe."""
    steps = (np.arange(8) + 0.5) / 8
    centers = directions_of_square(np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2))
    cells = sequence.probes.cells
    values = [
        device_array(array).numpy().astype(np.float64) for array in (cells.radiance, cells.nearness, cells.samples)
    ]
    return oracle.Cells(centers, *values)


def one(cells: oracle.Cells, i: int) -> oracle.Cells:
    """Returns the cells of one probe."""
    part = slice(i * CELLS, (i + 1) * CELLS)
    return oracle.Cells(cells.direction, cells.radiance[part], cells.nearness[part], cells.samples[part])


@pytest.mark.parametrize("extent", [0.0, 0.002])
def test_screen_probes_reprojected_in_a_static_scene_keep_position_and_light(extent: float) -> None:
    """A probe that is reprojected onto itself keeps its position and its cells."""
    sequence, surfaces = ProbeSequence(striped), visible_box(box_camera(), extent)
    for _ in range(6):
        sequence.render(surfaces)
    before, cells = fields(sequence.probes.probes), cells_of(sequence)
    sequence.place(surfaces)
    after, carried = fields(sequence.probes.probes), cells_of(sequence)
    indices = np.arange(60)
    np.testing.assert_array_equal(after["source"][indices], indices)
    np.testing.assert_array_equal(after["position"][indices], before["position"][indices])
    part = slice(0, 60 * CELLS)
    np.testing.assert_allclose(carried.radiance[part], cells.radiance[part], rtol=1e-6)
    np.testing.assert_allclose(carried.nearness[part], cells.nearness[part], rtol=1e-6)
    np.testing.assert_array_equal(carried.samples[part], cells.samples[part])
    assert cells.samples[part].max() > 1.0


@pytest.mark.parametrize("extent", [0.0, 0.002])
@pytest.mark.parametrize("moves", ["sample", "camera"])
def test_screen_probes_keep_their_position_while_samples_and_camera_move(moves: str, extent: float) -> None:
    """Continued probes keep their positions and cells to the bit, although no pixel shows the same point again."""
    sequence = ProbeSequence(striped, refreshed=1.0)
    for step in range(3):
        sequence.render(visible_box(box_camera(), extent, subpixel(step)))
    before, cells = fields(sequence.probes.probes), cells_of(sequence)
    surfaces = visible_box(box_camera(0.1 * (moves == "camera")), extent, subpixel(3))
    sequence.place(surfaces)
    after, carried = fields(sequence.probes.probes), cells_of(sequence)
    continued = np.flatnonzero((after["is_placed"] == 1) & (after["source"] >= 0))
    source = after["source"][continued].astype(int)
    unmoved = (after["position"][continued] == before["position"][source]).all(1)
    assert len(continued) > 50 and unmoved.mean() > 0.9
    assert np.isin(before["position"][source][:, 0], surfaces.position[:, 0].astype(np.float32)).mean() < 0.5
    for i, j in zip(continued[unmoved].tolist(), source[unmoved].tolist(), strict=True):
        np.testing.assert_array_equal(one(carried, i).samples, one(cells, j).samples)


@pytest.mark.parametrize("extent", [0.0, 0.002])
def test_directional_cells_of_reprojected_screen_probes_match_the_reference(extent: float) -> None:
    """Most directions change when a probe moves."""
    sequence = ProbeSequence(striped, refreshed=1.0)
    for _ in range(3):
        sequence.render(visible_box(box_camera(), extent))
    before, cells = fields(sequence.probes.probes), cells_of(sequence)
    surfaces = visible_box(box_camera(1.0), extent)
    surfaces.previous = surfaces.position + 1e-5  # otherwise probes would keep their positions
    sequence.place(surfaces)
    after, carried = fields(sequence.probes.probes), cells_of(sequence)
    moved = 0
    for i in np.flatnonzero((after["is_placed"] == 1) & (after["source"] >= 0)).tolist():
        source = int(after["source"][i])
        old, new = before["position"][source], after["position"][i]
        normal = after["normal"][i]
        expected, found = oracle.carried(one(cells, source), old, new, normal, ProbeConfig().history), one(carried, i)
        same = np.isclose(found.samples, expected.samples)
        assert same.mean() > 0.96, "float32 may put directions on a border into the next cell"
        np.testing.assert_allclose(found.radiance[same].mean(), expected.radiance[same].mean(), rtol=0.02)
        np.testing.assert_allclose(found.nearness[same].mean(), expected.nearness[same].mean(), rtol=0.02)
        moved += int(np.linalg.norm(old - new) > 1e-4)
    assert moved > 20


def test_screen_probes_on_a_moving_surface_move_with_it() -> None:
    """A plane that moves sideways takes its probes and their cells along; the camera is static."""
    camera = ls.Camera.look_at((0.0, 0.0, 3.0), (0, 0, 0), (0.0, 1.0, 0.0), width=160, height=96, fov_y=0.6)
    sequence, surfaces = ProbeSequence(striped, refreshed=1.0), visible_plane(camera, (0.0, 0.0, 1.0))
    sequence.render(surfaces)
    before = fields(sequence.probes.probes)
    step = np.array([0.019375 * 2, 0.0, 0.0])  # about two pixels
    surfaces.previous = surfaces.position - step
    sequence.place(surfaces)
    after = fields(sequence.probes.probes)
    carried = np.flatnonzero((after["is_placed"] == 1) & (after["source"] >= 0))
    directions = after["position"][carried] - before["position"][after["source"][carried].astype(int)]
    assert len(carried) > 50
    assert np.mean(np.abs(directions - step).max(axis=1) < 0.02) > 0.8, "the other probes leave their tile"
    assert np.median(directions[:, 0]) == pytest.approx(step[0], abs=0.01)


def test_screen_probe_rays_are_distributed_uniformly_over_each_directional_cell() -> None:
    """Each cell above the horizon has one ray per refresh; directions are spread over the cell and do not repeat."""
    sequence = ProbeSequence(constant([1.0, 1.0, 1.0]), refreshed=1.0)
    surfaces = visible_box(box_camera(), 0.004)
    points = []
    for _ in range(4):
        sequence.place(surfaces)
        active = np.flatnonzero(device_array(sequence.probes.rays().is_active).numpy())
        sequence.trace()
        sequence.frame += 1
        first = active[active < 40 * CELLS]
        squares = np.full((40 * CELLS, 2), np.nan)
        squares[first] = [oracle.square_of(direction) * 8 for direction in sequence.rays[1][: len(first)]]
        np.testing.assert_array_equal(np.minimum(squares[first].astype(int), 7) @ [1, 8], first % CELLS)
        points.append(squares % 1.0)
    every = np.reshape(points, (-1, 2))
    every = every[np.isfinite(every).all(axis=1)]
    assert len(every) > 40 * CELLS
    counts, _, _ = np.histogram2d(*every.T, bins=4, range=((0, 1), (0, 1)))
    np.testing.assert_allclose(counts / counts.sum(), 1.0 / 16.0, atol=0.01)
    assert np.nanmean(np.abs(points[0] - points[1])) > 0.2


def test_screen_probe_rays_start_above_their_surface() -> None:
    """Rays leave outwards; those of Gaussians start above the layer and pass the Gaussians within the offset."""
    for extent in (0.0, 0.004):
        sequence, surfaces = ProbeSequence(constant([1.0, 1.0, 1.0])), visible_box(box_camera(), extent)
        sequence.place(surfaces)
        rays = sequence.probes.rays()
        active = device_array(rays.is_active).numpy()
        assert active.mean() == pytest.approx(0.5, abs=0.03)
        heights = 0.5 - np.abs(device_array(rays.origin).numpy()[active]).max(axis=1)
        assert (heights > 1e-6).all()
        if extent > 0.0:
            np.testing.assert_allclose(heights, LAYER_LIFT * SHADOW_OFFSET * extent, atol=1e-6)
        np.testing.assert_allclose(device_array(rays.t_min).numpy()[active], SHADOW_OFFSET * extent, rtol=1e-6)


def test_screen_probes_are_refreshed_in_turn_new_ones_first_then_the_oldest() -> None:
    """New probes are refreshed first, spread over the image, then the oldest, in a fixed number a frame."""
    sequence, surfaces = ProbeSequence(constant([1.0, 1.0, 1.0]), adaptive=0.0), visible_box(box_camera(), 0.002)
    rounds = np.zeros((6, 10), np.int32)
    for frame in range(12):
        sequence.render(surfaces)
        assert len(sequence.rays[0]) == pytest.approx(15 * CELLS / 2, rel=0.1), "half of the cells face the surface"
        rounds = device_array(sequence.probes.probes.refresh_count).numpy().reshape(6, 10)
        assert rounds.sum() == 15 * (frame + 1)
        if frame == 0:
            blocks = rounds.reshape(3, 2, 5, 2).sum(axis=(1, 3))
            assert (blocks == 1).all()
    np.testing.assert_array_equal(rounds, 3)


@pytest.mark.parametrize("history", [1, 4, 8])
def test_mean_light_in_directional_cells_of_screen_probes_matches_the_reference(history: int) -> None:
    """A young mean counts as half of its samples, an old one as its history; non-finite samples are dropped."""
    surfaces = visible_box(box_camera(), 0.002)
    light = [1.0, 2.0, np.nan, 6.0, *[3.0] * 7, 30.0]
    values = iter(light)

    def tracer(origins: Doubles, directions: Doubles) -> tuple[Doubles, Doubles]:
        return np.full((len(directions), 3), next(values)), np.full(len(directions), 0.5)

    sequence = ProbeSequence(tracer, refreshed=1.0, adaptive=0.0, history=history)
    mean, count = 0.0, 0
    for value in light:
        sequence.place(surfaces)
        sequence.trace()
        sequence.frame += 1
        cells = one(cells_of(sequence), 7)
        faced = cells.direction @ fields(sequence.probes.probes)["normal"][7] > 0.3
        if np.isfinite(value):
            mean += (value - mean) / (mean_weight(count, history) + 1.0)
            count = min(count + 1, history)
        np.testing.assert_allclose(cells.nearness[faced], 2.0, rtol=1e-5)
        np.testing.assert_allclose(cells.radiance[faced], mean, rtol=1e-5)
        np.testing.assert_array_equal(cells.samples[faced], count)


def test_outdated_light_of_a_screen_probe_cell_stays_until_its_next_ray_replaces_it() -> None:
    """When light changes, the next ray of a cell replaces the old mean; until then, the cell keeps its mean."""
    surfaces = visible_box(box_camera(), 0.002)
    old, new = np.array([4.0, 1.0, 0.5]), np.array([0.5, 2.0, 0.0])
    sequence = ProbeSequence(constant(old))
    for _ in range(12):
        sequence.render(surfaces)
    sequence.place(surfaces)
    sequence.probes.outdate(sequence_row(0, OUTDATED_HISTORY_WEIGHT))
    sequence.tracer = constant([np.nan] * 3)
    sequence.trace()
    np.testing.assert_allclose(sequence.look_up(surfaces), np.broadcast_to(np.pi * old, (160 * 96, 3)), rtol=4e-6)
    sequence.tracer = constant(new)
    sequence.frame += 1
    worst = []
    for _ in range(8):
        worst.append(np.abs(sequence.render(surfaces) / np.pi - new).max())
    assert worst[0] > 1.0, "not all probes are refreshed in one frame"
    assert worst[-1] < 2e-3, "a plain mean would still have a third of the old light"


def test_probes_keep_the_root_of_the_weight_of_cached_light_unless_it_changes_abruptly() -> None:
    """Light that moves leaves more of a probe's few samples than of the cache's many; a light that goes out, none."""
    surfaces = visible_box(box_camera(), 0.002)
    sequence = ProbeSequence(constant(np.ones(3)), refreshed=1.0, adaptive=0.0)
    for weight, kept in ((CHANGED_HISTORY_WEIGHT, CHANGED_HISTORY_WEIGHT**0.5), (OUTDATED_HISTORY_WEIGHT,) * 2):
        sequence.render(surfaces)
        sequence.place(surfaces)
        before = cells_of(sequence).samples
        sequence.probes.outdate(sequence_row(0, weight))
        np.testing.assert_allclose(cells_of(sequence).samples, kept * before, rtol=1e-5)
        assert before.max() > 0.5
        sequence.frame += 1


def thin_pole(camera: ls.Camera) -> VisibleSurfaces:
    """Returns the cube with a pole three pixels wide before it in every tile except the last columns."""
    surfaces = visible_box(camera)
    columns = np.tile(np.arange(camera.width), camera.height)
    pole = (columns % 16 >= 6) & (columns % 16 < 9) & (columns < 128)
    directions = (surfaces.position - camera.eye) / surfaces.distance[:, None]
    surfaces.distance = np.where(pole, 0.1, surfaces.distance)
    surfaces.position = np.where(pole[:, None], camera.eye + 0.1 * directions, surfaces.position)
    surfaces.previous = surfaces.position.copy()
    surfaces.normal = np.where(pole[:, None], -np.asarray(camera.world_from_camera[:3, 2]), surfaces.normal)
    return surfaces


def test_surfaces_of_a_tile_that_its_screen_probe_does_not_represent_get_further_probes() -> None:
    """Each surface of a tile that differs from the tile probe's gets an adaptive probe, up to a limit; they persist."""
    surfaces = thin_pole(box_camera())
    sequence = ProbeSequence(constant([1.0, 1.0, 1.0]), adaptive=1.0, refreshed=1.0)
    for _ in range(4):  # until every probe has been refreshed once and hence persists
        sequence.render(surfaces)
    first = device_array(sequence.probes.adaptive_of).numpy().copy()
    assert (first >= 60).sum() > 15
    for _ in range(2):
        sequence.render(surfaces)
    again = device_array(sequence.probes.adaptive_of).numpy()
    np.testing.assert_array_equal(first >= 0, again >= 0)
    assert (device_array(sequence.probes.probes.refresh_count).numpy()[again[again >= 0]] > 2).all()
    few = ProbeSequence(constant([1.0, 1.0, 1.0]), adaptive=0.1, refreshed=1.0)
    few.render(surfaces)
    assert (device_array(few.probes.adaptive_of).numpy() >= 0).sum() == 6
    none = ProbeSequence(constant([1.0, 1.0, 1.0]), adaptive=0.0, refreshed=1.0)
    none.render(surfaces)
    assert (device_array(none.probes.adaptive_of).numpy() == -1).all()


def test_screen_probe_filter_averages_probes_that_see_distant_hits_but_not_near_ones() -> None:
    """Neighbouring probes reduce the noise of new probes."""
    surfaces = visible_box(box_camera(), 0.002)
    rng = np.random.default_rng(3)

    def noise(distance: float):
        return lambda origins, directions: (rng.exponential(size=directions.shape), np.full(len(directions), distance))

    spread = {}
    for distance in (0.01, 1e6):
        sequence = ProbeSequence(noise(distance), refreshed=1.0, adaptive=0.0)
        sequence.render(surfaces)
        traced = cells_of(sequence).samples > 0.0
        spread[distance] = np.std(device_array(sequence.probes.light.radiance).numpy()[traced])
    assert spread[1e6] < 0.75, "each cell averages up to five probes"
    assert spread[0.01] > 0.9, "near hits share nothing"


@pytest.mark.parametrize("extent", [0.0, 0.002])
def test_irradiance_that_pixels_interpolate_from_screen_probes_matches_the_reference(extent: float) -> None:
    """A pixel uses the probes of the four tiles around it that no pole occludes; some pixels have none."""
    surfaces = thin_pole(box_camera())
    surfaces.extent[:] = extent
    sequence = ProbeSequence(striped, refreshed=1.0)
    for _ in range(3):
        sequence.render(surfaces)
    pixels = np.random.default_rng(4).choice(160 * 96, 60, replace=False)
    points = np.stack([pixels % 160, pixels // 160], axis=1).astype(np.float64) + 0.5
    found = looked_up(sequence, surfaces, pixels, points, surfaces.normal[pixels], glossy=False)
    probes = fields(sequence.probes.probes)
    radiance = device_array(sequence.probes.light.radiance).numpy().astype(np.float64).reshape(-1, CELLS, 3)
    adaptive, camera = device_array(sequence.probes.adaptive_of).numpy(), surfaces.camera
    compared = cut_off = 0
    for pixel, point, light in zip(pixels, points, found, strict=True):
        around = []
        corner = np.floor(point / 16 - 0.5).astype(int)
        for x, y in ((corner[0] + dx, corner[1] + dy) for dy in (0, 1) for dx in (0, 1)):
            if not (0 <= x < 10 and 0 <= y < 6):
                continue
            for i in (y * 10 + x, adaptive[y * 10 + x]):
                if i >= 0 and probes["is_placed"][i]:
                    apart = float(np.linalg.norm(probes["pixel"][i] - point) / 16)
                    value = oracle.probe_irradiance(radiance[i], surfaces.normal[pixel], probes["normal"][i])
                    position, normal = probes["position"][i], probes["normal"][i]
                    distance, wide = float(probes["distance"][i]), float(probes["extent"][i])
                    nearer = min(distance, float(surfaces.distance[pixel]))
                    if oracle.is_cut_off(point, probes["pixel"][i], nearer, surfaces.distance.reshape(96, 160)):
                        cut_off += 1
                        continue
                    around.append((apart, oracle.Probe(position, normal, distance, wide, value)))
        distance, extent_here = float(surfaces.distance[pixel]), float(surfaces.extent[pixel])
        reach = 16 / min(camera.fx, camera.fy) * distance
        expected = oracle.near_mean(
            surfaces.position[pixel], surfaces.normal[pixel], distance, extent_here, reach, around
        )
        if expected is not None:
            np.testing.assert_allclose(light, np.maximum(expected, 0.0), rtol=5e-3, atol=5e-3)
            compared += 1
    assert compared > 40 and cut_off > 40


def test_glossy_light_from_screen_probes_is_interpolated_between_directional_cells() -> None:
    """Above the surface, look-ups are linear between cells, also across the border of the map."""
    surfaces = visible_box(box_camera(), 0.002)

    def gradient(origins: Doubles, directions: Doubles) -> tuple[Doubles, Doubles]:
        return 2.0 + directions, np.full(len(directions), np.inf)

    sequence = ProbeSequence(gradient, refreshed=1.0, history=256)
    for _ in range(24):
        sequence.render(surfaces)
    pixel = 50 * 160 + 75
    directions = oracle.spiral(800)
    directions = directions[directions @ surfaces.normal[pixel] > 0.3]
    count = len(directions)
    found = looked_up(
        sequence, surfaces, np.full(count, pixel), np.full((count, 2), (75.5, 50.5)), directions, glossy=True
    )
    assert np.sqrt(np.mean((found - 2.0 - directions) ** 2)) < 0.06
    assert np.abs(found - 2.0 - directions).max() < 0.25


def looked_up(
    sequence: ProbeSequence,
    surfaces: VisibleSurfaces,
    pixels: Whole,
    points: Doubles,
    directions: Doubles,
    *,
    glossy: bool,
) -> Doubles:
    """Returns the device's look-ups for pixels."""
    probes, count = sequence.probes, len(pixels)
    given = [
        wp.array(values.astype(kind), dtype=dtype, device="cpu")
        for values, kind, dtype in (
            (pixels, np.int32, int),
            (points, np.float32, wp.vec2),
            (directions, np.float32, wp.vec3),
        )
    ]
    found = wp.zeros(count, dtype=wp.vec3, device="cpu")
    positions = (
        probes.grid,
        camera_rows(surfaces.camera),
        surfaces.upload(),
        probes.probes,
        probes.adaptive_of,
        probes.light,
    )
    wp.launch(probe_light, count, inputs=[glossy, *positions, *given, found], device="cpu")
    return device_array(found).numpy().astype(np.float64)
