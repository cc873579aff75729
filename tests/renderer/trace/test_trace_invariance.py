"""Changes that must not change a traced image: order, hidden Gaussians, packets, passes, threads, coordinates."""

from __future__ import annotations

import functools
import itertools
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.device.bvh.packet import PACKET_OPTIONS
from lumisplat.renderer.trace import gaussian_trace, gaussian_trace_kernels, tile_trace_kernels
from lumisplat.runtime.launcher import Launcher
from support.compare.backends import LISTS_AND_BVHS, renderer_of
from support.compare.images import assert_close, assert_images_alike
from support.scenes.raster_scenes import (
    front_camera,
    joined,
    octahedron,
    one_gaussian,
    quad,
    random_gaussians,
    similarity,
)

BACKENDS = ["cpu", "cpu as cuda", *(device.alias for device in wp.get_cuda_devices())]
STRATEGIES = list(ls.config.TraceStrategy)
SORTED, HIT, PASS = STRATEGIES
IMAGES = ("color", "alpha", "depth", "normal", "gaussian_index", "instance_index")
FISHEYE, ORTHOGRAPHIC = ls.CameraModel.FISHEYE, ls.CameraModel.ORTHOGRAPHIC


@pytest.fixture(params=BACKENDS)
def backend(request: pytest.FixtureRequest) -> str:
    """Returns one backend that traces a frame."""
    return request.param


def settings(strategy: ls.config.TraceStrategy = SORTED, seed: int = 0, **changes: object) -> ls.RenderConfig:
    """Returns settings of the ray tracer; ``changes`` are fields of ``TraceConfig``."""
    trace = replace(ls.TraceConfig(strategy=strategy), **changes)
    return ls.RenderConfig(pipeline=ls.Pipeline.TRACE, lighting=False, trace=trace, seed=seed)


@functools.cache
def renderer(backend: str, config: ls.RenderConfig, lists: bool = True) -> ls.Renderer:
    """Returns a renderer that all tests with these settings share."""
    return renderer_of(backend, config, lists=lists)


def render(
    backend: str, scene: ls.Scene, camera: ls.Camera, config: ls.RenderConfig | None = None, *, lists: bool = True
) -> ls.Frame:
    """Renders a traced frame, whose camera rays find Gaussians in lists by tiles or in BVHs."""
    return renderer(backend, config or settings(), lists).render(scene, camera)


make_kernel = gaussian_trace_kernels.gaussian_trace_kernel.__wrapped__
make_tile_kernel = tile_trace_kernels.tile_trace_kernel.__wrapped__


@functools.cache
def unfused_kernel(lanes: int, *stack: int, by_tiles: bool = False) -> wp.Kernel:
    """Returns a tracing kernel with every multiplication and addition rounded separately."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PACKET_OPTIONS, "cpu_compiler_flags", "-march=native -ffp-contract=off")
        return make_tile_kernel(lanes) if by_tiles else make_kernel(lanes, *stack)


@functools.cache
def unfused_renderer(backend: str, config: ls.RenderConfig, *, lists: bool) -> ls.Renderer:
    """Returns a renderer that traces with ``unfused_kernel``, with or without lists of Gaussians by tiles."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gaussian_trace_kernels, "gaussian_trace_kernel", unfused_kernel)
        patch.setattr(tile_trace_kernels, "tile_trace_kernel", functools.partial(unfused_kernel, by_tiles=True))
        return renderer_of(backend, config, lists=lists)


def view(width: int = 24, height: int = 18, focal: float = 22.0, **changes: object) -> ls.Camera:
    """Returns a small camera towards (0, 0, 4)."""
    return front_camera(width, height, focal, **changes)


def assert_equal(actual: ls.Frame, expected: ls.Frame, names: tuple[str, ...] = IMAGES) -> None:
    """Asserts bit-equal images."""
    for name in names:
        np.testing.assert_array_equal(getattr(actual, name), getattr(expected, name), err_msg=name)


def full_scene() -> ls.Scene:
    """Returns two instances and two meshes, one of them crossed by Gaussians."""
    asset = random_gaussians(70, 120, degree=2, center=(0.0, 0.0, 0.0), extent=(1.0, 1.0, 1.0))
    placed = [ls.SplatInstance(asset, similarity((1, 1, 0), 0.4 + i, 0.8, (i - 0.5, 0.2 * i, 4.0))) for i in range(2)]
    return ls.Scene(placed, [octahedron((0.1, 0.1, 4.0), 0.6), quad(5.5, tilt=0.3)])


def faint_gaussians(count: int = 400, seed: int = 61) -> ls.Gaussians:
    """Returns faint Gaussians at distinct distances, a hundred or more on every ray, around and before the origin."""
    gaussians = random_gaussians(seed, count, 1, (0.0, 0.0, 1.5), (0.6, 0.6, 2.5), scale_range=(0.4, 1.2))
    return replace(gaussians, opacities=np.random.default_rng(seed).uniform(0.01, 0.02, count))


# --- Order ---


@LISTS_AND_BVHS
@pytest.mark.parametrize("hit_distance", list(ls.config.HitDistance))
def test_traced_frame_does_not_depend_on_the_order_of_gaussians_in_their_set(
    backend: str, hit_distance: ls.config.HitDistance, lists: bool
) -> None:
    """Shuffled Gaussians give the same image to the bit, except for their indices, in one pass and in many.

    On a GPU, peaks of two faint Gaussians can round to one distance: the order of the set then decides.
    """
    swapped = 0.02**2 if backend.startswith("cuda") and hit_distance is ls.config.HitDistance.PEAK else 0.0
    for gaussians in (random_gaussians(71, 300, degree=1), faint_gaussians()):
        order = np.random.default_rng(0).permutation(gaussians.count)
        config = settings(hit_distance=hit_distance)
        frame = render(backend, ls.Scene([gaussians]), view(), config, lists=lists)
        shuffled = render(backend, ls.Scene([gaussians.subset(order)]), view(), config, lists=lists)
        for name in ("color", "normal"):
            np.testing.assert_allclose(getattr(shuffled, name), getattr(frame, name), rtol=0.0, atol=swapped)
        assert_equal(shuffled, frame, ("alpha", "depth", "instance_index"))
        found = shuffled.gaussian_index >= 0
        assert found.mean() > 0.3
        np.testing.assert_array_equal(order[shuffled.gaussian_index[found]], frame.gaussian_index[found])


@LISTS_AND_BVHS
def test_gaussians_at_equal_distance_are_traced_in_the_order_of_the_scene(backend: str, lists: bool) -> None:
    """Among Gaussians at one distance, the first of a set is in front, and the first of the instances."""
    red = one_gaussian(opacity=0.9, color=(1.0, 0.0, 0.0))
    blue = one_gaussian(opacity=0.9, color=(0.0, 0.0, 1.0))
    camera = front_camera(cx=32.5, cy=24.5)
    for scene in (ls.Scene([joined(red, blue)]), ls.Scene([red, blue])):
        assert render(backend, scene, camera, lists=lists).color[24, 32] == pytest.approx([0.9, 0.0, 0.09], abs=1e-5)
    for scene in (ls.Scene([joined(blue, red)]), ls.Scene([blue, red])):
        assert render(backend, scene, camera, lists=lists).color[24, 32] == pytest.approx([0.09, 0.0, 0.9], abs=1e-5)


@pytest.mark.parametrize("hit_distance", list(ls.config.HitDistance))
def test_gaussian_set_split_into_instances_is_traced_like_the_whole_set(
    backend: str, hit_distance: ls.config.HitDistance
) -> None:
    """Colour, alpha, depth and normal are equal."""
    gaussians = joined(random_gaussians(72, 200, degree=1), faint_gaussians(300))
    firsts = np.array([0, 170, 330, 500])
    parts = [gaussians.subset(np.arange(*span)) for span in itertools.pairwise(firsts)]
    config = settings(hit_distance=hit_distance)
    whole = render(backend, ls.Scene([gaussians]), view(), config)
    cut = render(backend, ls.Scene(parts), view(), config)
    assert_equal(cut, whole, ("color", "alpha", "depth", "normal"))
    found = whole.gaussian_index >= 0
    in_scene = firsts[cut.instance_index[found]] + cut.gaussian_index[found]
    np.testing.assert_array_equal(in_scene, whole.gaussian_index[found])


HIDDEN = {
    "behind": random_gaussians(73, 50, center=(0.0, 0.0, -4.0)),
    "outside": random_gaussians(75, 50, center=(60.0, 0.0, 4.0)),
    "faint": one_gaussian(opacity=1.0 / 256.0),
    "nothing": one_gaussian(opacity=0.0),
    "too near": one_gaussian((0.0, 0.0, 0.005), 0.001, 1.0),
    "occluded": random_gaussians(74, 50, center=(0.0, 0.0, 12.0), extent=(0.2, 0.2, 1.0), scale_range=(0.01, 0.1)),
}


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_invisible_gaussians_do_not_change_a_traced_frame(backend: str, strategy: ls.config.TraceStrategy) -> None:
    """Every image keeps its bits, although every tree differs."""
    wall = [one_gaussian((0.0, 0.0, 8.0 + 0.1 * i), 6.0, 1.0) for i in range(4)]
    visible = joined(random_gaussians(76, 150), *wall)
    frame = render(backend, ls.Scene([visible]), view(), settings(strategy), lists=False)
    for name, hidden in HIDDEN.items():
        # Rays of stochastic strategies may pass the wall at random; only sorted rays always end there.
        if strategy is SORTED or name != "occluded":
            scene = ls.Scene([joined(visible, hidden)])
            assert_equal(render(backend, scene, view(), settings(strategy), lists=False), frame)
            assert_equal(render(backend, ls.Scene([visible, hidden]), view(), settings(strategy), lists=False), frame)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_traced_view_without_visible_objects_shows_only_the_background(
    backend: str, strategy: ls.config.TraceStrategy
) -> None:
    """Without visible objects there is no alpha, surface or normal."""
    for background in ((0.2, 0.5, 1.0), None):
        config = replace(settings(strategy), background=background, lighting=False)
        behind = random_gaussians(80, 20, center=(0.0, 0.0, -5.0))
        faint = one_gaussian(opacity=0.003)
        for scene in (
            ls.Scene(),
            ls.Scene([behind]),
            ls.Scene([], [quad(-3.0)]),
            ls.Scene([faint, behind], [quad(-3.0)]),
        ):
            frame = renderer_of(backend, config).render(scene, view(13, 7))
            assert (frame.color == np.asarray(background or (0.0, 0.0, 0.0), np.float32)).all()
            assert (frame.alpha == 0.0).all() and np.isinf(frame.depth).all() and (frame.normal == 0.0).all()
            assert (frame.gaussian_index == -1).all() and (frame.instance_index == -1).all()


# --- Passes and packets ---


def discs() -> ls.Scene:
    """Returns a stack of flat Gaussians with thin boxes, so that each pass must start where the last one ended."""
    layers = [one_gaussian((0.0, 0.0, z), (2.0, 2.0, 1e-5), 0.02) for z in np.linspace(3.0, 3.2, 150)]
    return ls.Scene([joined(*layers)])


@LISTS_AND_BVHS
@pytest.mark.parametrize("hit_distance", list(ls.config.HitDistance))
def test_tracer_blends_each_of_150_nearly_coincident_gaussians_once_in_several_passes(
    backend: str, hit_distance: ls.config.HitDistance, lists: bool
) -> None:
    """The discs lie at nearly one distance; none is lost or blended twice, with hit lists of any length."""
    camera = view(3, 3, 100.0)
    for k in (4, 16):
        frame = render(backend, discs(), camera, settings(hits_per_pass=k, hit_distance=hit_distance), lists=lists)
        assert_close(frame.alpha, np.full((3, 3), 1.0 - 0.98**150), atol=1e-4, name=f"alpha in passes of {k}")


@LISTS_AND_BVHS
@pytest.mark.parametrize("hit_distance", list(ls.config.HitDistance))
def test_length_of_the_hit_list_does_not_change_the_traced_frame(
    hit_distance: ls.config.HitDistance, lists: bool
) -> None:
    """Lists of 4, 16 and 64 hits, for single rays and packets, give equal images of hundreds of Gaussians."""
    scene = ls.Scene([faint_gaussians()], [quad(3.5, tilt=0.3)])
    few, some = (settings(hits_per_pass=k, hit_distance=hit_distance) for k in (4, 16))
    ways = [(backend, config) for backend in ("cpu as cuda", "cpu") for config in (few, some)]
    frames = [render(backend, scene, view(), config, lists=lists) for backend, config in ways]
    fewest = np.log(1.0 - render("cpu", ls.Scene([faint_gaussians()]), view(), some).alpha) / np.log(1.0 - 0.02)
    assert np.median(fewest) > 64.0, "too few Gaussians on a ray to need a second pass of the longest list"
    for frame in frames[1:]:
        for name in IMAGES:
            assert_close(getattr(frame, name), getattr(frames[0], name), atol=2e-6, name=name)


@LISTS_AND_BVHS
@pytest.mark.parametrize("transmittance_min", [0.3, 0.03, 1e-4])
@pytest.mark.parametrize("hit_distance", list(ls.config.HitDistance))
def test_rays_that_end_early_blend_the_same_hits_with_short_lists(
    backend: str, hit_distance: ls.config.HitDistance, transmittance_min: float, lists: bool
) -> None:
    """Lists drop what lies behind enough opaque hits; lists of 2 or 5 hits may drop some of these, too."""
    gaussians = random_gaussians(62, 400, 1, (0.0, 0.0, 3.0), (1.0, 0.8, 2.0), scale_range=(0.1, 0.6))
    gaussians = replace(gaussians, opacities=np.random.default_rng(62).uniform(0.05, 0.9, 400))
    config = settings(hit_distance=hit_distance, transmittance_min=transmittance_min)
    frames: list[ls.Frame] = []
    for slots in (32, 5, 2):
        with pytest.MonkeyPatch.context() as patch:
            for name in ("HIT_BUFFER_CPU", "HIT_BUFFER_CUDA"):
                patch.setattr(gaussian_trace, name, slots)
            frames.append(renderer_of(backend, config, lists=lists).render(ls.Scene([gaussians]), view()))
    for frame in frames[1:]:
        assert_equal(frame, frames[0])
    assert np.median(frames[0].alpha) > 1.0 - transmittance_min


def inside() -> ls.Scene:
    """Returns large Gaussians around the camera: hulls begin behind it, in an order that only single rays determine."""
    random = np.random.default_rng(0)
    gaussians = random_gaussians(1, 200, center=(0.0, 0.0, 0.1), extent=(0.3, 0.3, 0.05))
    scales = np.repeat(random.uniform(0.3, 0.6, (200, 1)), 3, axis=1)
    return ls.Scene([replace(gaussians, opacities=np.full(200, 0.1), scales=scales)])


def many_scenes() -> dict[str, tuple[ls.Scene, ls.Camera]]:
    """Returns scenes and cameras with every kind of packet."""
    around = random_gaussians(61, 600, degree=1, center=(0.0, 0.0, 0.0), extent=(3.0, 3.0, 3.0))
    moving = similarity((0.0, 1.0, 0.0), 0.1, 1.0, (0.1, 0.0, 0.0))
    return {
        "plain": (full_scene(), view()),
        "faint_gaussians": (ls.Scene([faint_gaussians()]), view()),
        "inside": (inside(), view(focal=15.0)),
        "narrow": (full_scene(), view(focal=3000.0)),
        "wide": (ls.Scene([around]), view(focal=4.0)),
        "size not of blocks": (full_scene(), view(21, 15)),
        "one pixel": (full_scene(), view(1, 1)),
        "fisheye": (ls.Scene([around]), view(20, 20, 8.0, model=FISHEYE)),
        "fisheye of 200 degrees": (ls.Scene([around]), view(7, 7, 7 / np.radians(200.0), model=FISHEYE)),
        "fisheye with corners": (ls.Scene([around]), view(13, 13, 1.5, model=FISHEYE)),
        "orthographic": (full_scene(), view(24, 18, 6.0, model=ORTHOGRAPHIC)),
        "lens": (full_scene(), view(aperture=0.5, focus_distance=4.0)),
        "rolling shutter": (full_scene(), view(camera_from_world_end=moving)),
    }


SCENES = many_scenes()


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("hit_distance", list(ls.config.HitDistance))
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_images_traced_by_ray_packets_equal_those_of_single_rays(
    strategy: ls.config.TraceStrategy, hit_distance: ls.config.HitDistance, name: str
) -> None:
    """Sixteen rays traverse together; their hits equal those of single rays up to rounding."""
    scene, camera = SCENES[name]
    config = settings(strategy, seed=5, hit_distance=hit_distance)
    together, alone = (render(backend, scene, camera, config, lists=False) for backend in ("cpu", "cpu as cuda"))
    for image in IMAGES:
        one, other = getattr(together, image), getattr(alone, image)
        if hit_distance is not ls.config.HitDistance.HULL:
            assert_close(one, other, atol=2e-6, name=image)
        else:  # a ray that only touches a hull amplifies rounding
            assert_close(one, other, atol=2e-5, name=image)
            assert np.isclose(one, other, rtol=0.0, atol=2e-6).mean() > 0.99
    assert together.alpha.max() > 0.0


@pytest.mark.deep
@pytest.mark.parametrize("normal_method", list(ls.config.NormalMethod))
@pytest.mark.parametrize("hit_distance", [ls.config.HitDistance.PEAK, ls.config.HitDistance.HULL])
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_ray_packets_give_the_bits_of_single_rays_if_no_operations_are_fused(
    strategy: ls.config.TraceStrategy, hit_distance: ls.config.HitDistance, normal_method: ls.config.NormalMethod
) -> None:
    """Packets apply the operations of a single ray to each lane, in BVHs as in lists by tiles, which find equal hits.

    The multiplications and additions that compilers fuse depend on the vectorisation of the loop over lanes, and so on
    the processor. Without fusing, all images are bit-equal, except that lists have colours of another kernel.
    """
    config = settings(strategy, seed=5, hit_distance=hit_distance, normal_method=normal_method)
    for scene, camera in (SCENES[name] for name in ("plain", "faint_gaussians", "inside", "lens")):
        listed, together, alone, listed_alone = (
            unfused_renderer(backend, config, lists=lists).render(scene, camera)
            for backend, lists in (("cpu", True), ("cpu", False), ("cpu as cuda", False), ("cpu as cuda", True))
        )
        assert_equal(together, alone)
        assert_equal(listed, listed_alone)
        assert_equal(listed, together, ("alpha", "depth", "gaussian_index", "instance_index"))
        assert together.alpha.max() > 0.0


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_ellipsoid_normals_of_ray_packets_equal_those_of_single_rays(strategy: ls.config.TraceStrategy) -> None:
    """Normals agree except at some pixels, and differ from those of the other method of normals.

    A small alpha amplifies the rounding of weights that are divided by it, and where a ray grazes an ellipsoid, the
    normal depends on the root of a small difference. Fused operations change either; another test compares without.
    """
    config = settings(strategy, normal_method=ls.config.NormalMethod.ELLIPSOID)
    together, alone = (render(backend, full_scene(), view(), config, lists=False) for backend in ("cpu", "cpu as cuda"))
    difference = np.abs(together.normal - alone.normal).max(axis=-1)
    assert (difference <= 2e-6).mean() > 0.99 and difference.mean() < 2e-7
    blended = render("cpu", full_scene(), view(), settings(strategy), lists=False)
    assert_equal(together, blended, ("color", "alpha", "depth"))
    assert np.abs(together.normal - blended.normal).max() > 0.1


@pytest.mark.parametrize("hit_distance", list(ls.config.HitDistance))
def test_cropped_camera_traces_a_crop_of_the_image(backend: str, hit_distance: ls.config.HitDistance) -> None:
    """The crop may lie anywhere: its packets differ, its rays are the same."""
    config = settings(hit_distance=hit_distance)
    for scene in (full_scene(), ls.Scene([faint_gaussians()]), inside()):
        whole = render(backend, scene, view(), config)
        left, top = 9, 6
        part = render(backend, scene, view(24 - left, 18 - top, cx=12.0 - left, cy=9.0 - top), config)
        for name in IMAGES:
            assert_close(getattr(part, name), getattr(whole, name)[top:, left:], atol=1e-6, name=name)


# --- Repetition ---


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_traced_frame_is_bit_equal_when_rendered_again(backend: str, strategy: ls.config.TraceStrategy) -> None:
    """The image is rendered again after another image, by another renderer and on any number of threads."""
    scene, config = full_scene(), replace(settings(strategy), samples=2)
    warm = renderer_of(backend, config)
    first = warm.render(scene, view())
    warm.render(ls.Scene([random_gaussians(77)]), view(33, 27))
    assert_equal(warm.render(scene, view()), first)
    if backend.startswith("cpu"):
        for threads in (1, 2):
            other = ls.Renderer(config, Launcher("cpu", threads=threads, parallel=backend != "cpu"))
            assert_equal(other.render(scene, view()), first)


def test_seed_changes_stochastic_frames_and_no_others(backend: str) -> None:
    """Stochastic images also differ between pixels and samples."""
    scene = ls.Scene([random_gaussians(78, 200)])
    for strategy in STRATEGIES:
        first, second = (render(backend, scene, view(), settings(strategy, seed=seed)) for seed in (0, 1))
        differs = (first.color != second.color).any(axis=-1).mean()
        assert (differs == 0.0) if strategy is SORTED else (differs > 0.1)
    flat = ls.Scene([one_gaussian((0.0, 0.0, 4.0), 100.0, 0.5)])
    accepted = render(backend, flat, view(), settings(HIT)).alpha.ravel()
    assert set(np.unique(accepted)) == {0.0, 1.0}
    assert 0.4 < accepted.mean() < 0.6
    for lag in range(1, 300):  # half of the pixel pairs differ, of at least 132
        assert 0.25 < (accepted[lag:] != accepted[:-lag]).mean() < 0.75, f"pixels {lag} apart are alike"


def test_traced_frame_does_not_change_when_the_next_frame_is_rendered(backend: str) -> None:
    """All images of the earlier frame keep their bits."""
    frame = render(backend, full_scene(), view())
    before = {name: getattr(frame, name).copy() for name in IMAGES}
    render(backend, ls.Scene([random_gaussians(78)]), view())
    for name, image in before.items():
        np.testing.assert_array_equal(getattr(frame, name), image)


def test_ray_tracer_allocates_nothing_after_the_first_frame(backend: str) -> None:
    """Later frames of the same size, or smaller, allocate nothing."""
    warm, scene = renderer_of(backend, settings()), full_scene()
    warm.render(scene, view(33, 27))
    settled = warm._buffers.allocations, warm._scene.bvh.bytes
    for size in ((33, 27), (24, 18), (33, 27)):
        warm.render(scene, view(*size))
    assert (warm._buffers.allocations, warm._scene.bvh.bytes) == settled


# --- Coordinate frame ---


@pytest.mark.parametrize("hit_distance", list(ls.config.HitDistance))
@pytest.mark.parametrize(
    ("scale", "offset"), [(1.7, (3.0, -5.0, 11.0)), (1e-3, (0.0, 0.0, 0.0)), (1e3, (1e4, 0.0, 0.0))]
)
def test_traced_frame_is_unchanged_if_scene_and_camera_move_together(
    backend: str, hit_distance: ls.config.HitDistance, scale: float, offset: tuple[float, float, float]
) -> None:
    """The images are equal when scene and camera are transformed together; depths scale."""
    move = similarity((0.2, 1.0, -0.4), 2.2, scale, offset)
    scene, camera, config = full_scene(), view(), settings(hit_distance=hit_distance)
    moved = ls.Scene(
        [ls.SplatInstance(i.gaussians, move @ i.transform) for i in scene.splats],
        [ls.MeshInstance(i.mesh, move @ i.transform) for i in scene.meshes],
    )
    pose = np.linalg.inv(move @ camera.world_from_camera)
    pose[:3, :3] /= np.cbrt(np.linalg.det(pose[:3, :3]))
    pose[:3, 3] = -pose[:3, :3] @ (move @ [*camera.eye, 1.0])[:3]
    expected = render(backend, scene, camera, config)
    frame = render(backend, moved, view(camera_from_world=pose, near=camera.near * scale), config)
    for name in ("color", "alpha"):
        images = getattr(frame, name), getattr(expected, name)
        # A few rays along an edge of the octahedron hit the other face of the edge.
        assert_images_alike(*images, mean=2e-3, within=2e-5, share=0.99, name=name)
    assert_images_alike(frame.normal @ move[:3, :3] / scale, expected.normal, mean=5e-3, within=1e-4, share=0.98)
    same = frame.gaussian_index == expected.gaussian_index
    assert same.mean() > 0.99 and (expected.gaussian_index >= 0).mean() > 0.3
    np.testing.assert_allclose(frame.depth[same] / scale, expected.depth[same], rtol=1e-4)


def test_gaussians_and_meshes_between_eye_and_near_plane_are_invisible(backend: str) -> None:
    """A disc or mesh in front of the near plane changes no bit, and one right behind it is visible."""
    disc = one_gaussian((0.0, 0.0, 3.0), (0.5, 0.5, 1e-3), 0.8)
    rest = random_gaussians(79, 100, center=(0.0, 0.0, 6.0))
    both, alone = ls.Scene([joined(rest, disc)]), ls.Scene([rest])
    hidden = view(near=3.01)
    assert_equal(render(backend, both, hidden), render(backend, alone, hidden))
    shown = view(near=2.99)
    assert_equal(render(backend, both, shown), render(backend, both, view()))
    assert (render(backend, both, shown).gaussian_index == 100).sum() > 20
    wall = ls.Scene([rest], [quad(3.0)])
    assert_equal(render(backend, wall, hidden), render(backend, alone, hidden))
    assert (render(backend, wall, shown).instance_index == 1).sum() > 20
    # The near plane has constant view depth: 45 degrees off the axis, the ray to it is sqrt(2) times longer.
    wide = front_camera(21, 3, 10.0, near=3.01)
    side = ls.Scene([one_gaussian((3.0, 0.0, 3.0), (0.2, 0.2, 1e-3), 0.8)])
    flat = settings(dilation=0.0)  # a footprint would make the disc thick
    assert render(backend, side, wide, flat).alpha.max() == 0.0
    assert render(backend, side, replace(wide, near=2.99), flat).alpha.max() > 0.7


@pytest.mark.parametrize("dilation", [0.0, 0.3])
def test_raster_and_trace_pipelines_give_nearly_equal_frames_of_small_gaussians(backend: str, dilation: float) -> None:
    """The Gaussians lie side by side near the optical axis."""
    random = np.random.default_rng(4)
    x, y = np.meshgrid(np.linspace(-0.35, 0.35, 6), np.linspace(-0.25, 0.25, 5))
    count = x.size
    means = np.stack([x.ravel(), y.ravel(), random.uniform(3.8, 4.2, count)], axis=-1)
    smallest, largest = np.log((0.01, 0.025))
    scales = np.exp(random.uniform(smallest, largest, (count, 3)))
    sh = random.uniform(-1.0, 1.0, (count, 4, 3)) * np.reshape([1.0, 0.3, 0.3, 0.3], (4, 1))
    gaussians = ls.Gaussians(means, random.normal(size=(count, 4)), scales, random.uniform(0.3, 1.0, count), sh)
    camera = front_camera(128, 96, 600.0)
    config = ls.RenderConfig(raster=ls.RasterConfig(dilation=dilation))
    raster = renderer_of("cpu", config).render(ls.Scene([gaussians]), camera)
    trace = render(backend, ls.Scene([gaussians]), camera, settings(dilation=dilation))
    assert raster.alpha.mean() > 0.05
    for name in ("color", "alpha"):
        assert_close(getattr(trace, name), getattr(raster, name), atol=0.006, name=name)
        assert np.abs(getattr(trace, name) - getattr(raster, name)).mean() < 3e-4
    both = (trace.gaussian_index >= 0) & (raster.gaussian_index >= 0)
    assert both.sum() > 500 and (trace.gaussian_index == raster.gaussian_index).mean() > 0.98
    np.testing.assert_array_equal(trace.gaussian_index[both], raster.gaussian_index[both])
    assert_close(trace.depth[both], raster.depth[both], atol=0.02, name="depth")
    assert_close(trace.normal[both], raster.normal[both], atol=1e-5, name="normal")
