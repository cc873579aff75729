"""BVHs of a scene: which assets get one, when a BVH is refitted, and the top-level tree over the instances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.constants import NODE_WIDTH, TRAVERSE_STACK, TRAVERSE_STACK_SMALL
from lumisplat.device.structs.bvh import FAR, NO_CHILD
from lumisplat.renderer.scene import assets, bvh_scene
from lumisplat.renderer.scene.bvh_scene import tree_of_boxes, waiting_in_tree
from support.compare.backends import renderer_of, without_lists
from support.compare.graph_launcher import GraphLauncher
from support.compare.images import assert_close, assert_images_alike
from support.kinds import present
from support.oracles.raster_oracle import rotation_from_quaternion
from support.scenes.raster_scenes import front_camera, joined, one_gaussian, random_gaussians, similarity

BACKENDS = ["cpu", "cpu as cuda", *(device.alias for device in wp.get_cuda_devices())]
TRACE = ls.RenderConfig(pipeline=ls.Pipeline.TRACE)
IMAGES = ("color", "alpha", "depth", "normal", "gaussian_index", "instance_index")


@pytest.fixture(params=BACKENDS)
def backend(request: pytest.FixtureRequest) -> str:
    """Returns one backend that traces a frame."""
    return request.param


def view() -> ls.Camera:
    """Returns a small camera towards (0, 0, 4)."""
    return front_camera(24, 18, 22.0)


def tracer_of(backend: str, config: ls.RenderConfig = TRACE) -> ls.Renderer:
    """Returns a renderer whose camera rays traverse BVHs."""
    return without_lists(renderer_of(backend, config))


def assert_as_new(warm: ls.Renderer, backend: str, scene: ls.Scene) -> None:
    """Asserts that the image equals that of a new renderer to the bit."""
    shown, fresh = (renderer.render(scene, view()) for renderer in (warm, tracer_of(backend, warm.config)))
    for name in IMAGES:
        np.testing.assert_array_equal(getattr(shown, name), getattr(fresh, name), err_msg=name)


def bvh_ids(renderer: ls.Renderer) -> list[int]:
    """Returns the identities of the BVHs, by asset."""
    return [id(one.bvh) for one in renderer._scene.bvh._cached]


# --- Assets ---


def test_instances_of_one_gaussian_set_share_its_bvh(backend: str) -> None:
    """Three instances of two sets have two BVHs, which are built once."""
    first, second = random_gaussians(1, 50), random_gaussians(2, 30)
    positions = [similarity((1.0, 2.0, 0.5), 0.4 * i, 0.5 + i, (0.1 * i, 0.2, 0.3)) for i in range(3)]
    scene = ls.Scene(
        [ls.SplatInstance(g, transform) for g, transform in zip((first, second, first), positions, strict=True)]
    )
    renderer = tracer_of(backend)
    renderer.render(scene, view())
    trees = bvh_ids(renderer)
    assert len(trees) == 2
    rows = renderer._scene.splat_instances.numpy()
    assert rows["asset"].tolist() == [0, 1, 0] and rows["first"].tolist() == [0, 50, 80]
    for row, transform in zip(rows, positions, strict=True):
        inverse = np.linalg.inv(transform)
        np.testing.assert_allclose(row["object_from_world"], inverse[:3, :3], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(row["object_from_world_offset"], inverse[:3, 3], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(row["world_from_object"] @ row["world_from_object"].T, np.eye(3), atol=1e-6)
    moved = ls.Scene([ls.SplatInstance(first, positions[1]), ls.SplatInstance(second, positions[0])])
    assert_as_new(renderer, backend, moved)
    assert bvh_ids(renderer) == trees, "poses are no reason to build"


def test_replacing_a_gaussian_set_by_one_of_equal_count_refits_its_bvh(backend: str) -> None:
    """BVHs of other sets are unchanged."""
    first, second = random_gaussians(3, 60), random_gaussians(4, 60)
    warm = tracer_of(backend)
    assert_as_new(warm, backend, ls.Scene([first, second]))
    trees = bvh_ids(warm)
    second_nodes = warm._scene.bvh._cached[1].bvh.nodes.numpy().tobytes()
    moved = replace(first, means=first.means + np.float32(0.05))
    assert_as_new(warm, backend, ls.Scene([moved, second]))
    assert bvh_ids(warm) == trees
    assert warm._scene.bvh._cached[1].bvh.nodes.numpy().tobytes() == second_nodes


@pytest.mark.parametrize(
    "change", ["count", "degree", "other still there", "other index", "order", "one more", "one less", "none", "back"]
)
def test_bvh_of_a_gaussian_set_is_kept_when_sets_of_the_scene_are_rearranged(backend: str, change: str) -> None:
    """BVHs stay with their sets; a set that replaces none gets a new BVH."""
    first, second = random_gaussians(5, 60), random_gaussians(6, 60)
    warm = tracer_of(backend)
    warm.render(ls.Scene([first, second]), view())
    a, b = bvh_ids(warm)
    old_bvhs = warm._scene.bvh._cached  # keeps old BVHs alive, so that no new BVH gets the id of an old one
    other = random_gaussians(7, 60)
    scenes: dict[str, tuple[list[ls.Gaussians], list[int | None]]] = {
        "count": ([random_gaussians(7, 61), second], [None, b]),
        "degree": ([replace(other, kernel_degree=3), second], [None, b]),
        "other still there": ([other, first], [None, a]),
        "other index": ([second, other], [b, None]),
        "order": ([second, first], [b, a]),
        "one more": ([first, other, second], [a, None, b]),
        "one less": ([second], [b]),
        "none": ([], []),
        "back": ([second, first, second], [b, a]),
    }
    splats, expected = scenes[change]
    assert_as_new(warm, backend, ls.Scene(splats))
    for tree, old in zip(bvh_ids(warm), expected, strict=True):
        assert tree == old if old is not None else tree not in (a, b), change
    assert_as_new(warm, backend, ls.Scene([first, second]))
    assert [one.gaussians for one in old_bvhs] == [first, second]


def test_each_capture_is_traced_with_the_kernel_degree_it_stores(backend: str) -> None:
    """A kernel degree in the settings replaces that of all captures."""
    left, right = one_gaussian((-0.9, 0.0, 4.0), 0.2, 0.9), one_gaussian((0.9, 0.0, 4.0), 0.2, 0.9)
    sharp = replace(right, kernel_degree=5)
    mixed = tracer_of(backend).render(ls.Scene([left, sharp]), view())
    soft = tracer_of(backend).render(ls.Scene([left, right]), view())
    np.testing.assert_array_equal(mixed.alpha[:, :12], soft.alpha[:, :12])
    assert np.abs(mixed.alpha[:, 12:] - soft.alpha[:, 12:]).max() > 0.1
    forced = replace(TRACE, response=ls.config.ResponseConfig(kernel_degree=2))
    np.testing.assert_array_equal(tracer_of(backend, forced).render(ls.Scene([left, sharp]), view()).alpha, soft.alpha)


def test_reported_memory_of_a_renderer_includes_its_bvhs() -> None:
    """The memory covers particles and nodes."""
    gaussians = random_gaussians(8, 3000)
    renderer = tracer_of("cpu")
    frame = renderer.render(ls.Scene([gaussians]), view())
    assert frame.stats is not None
    assert frame.stats.memory_bytes >= 64 * 3000 + renderer._scene.bvh.bytes > 64 * 3000 + 224 * 3000 / NODE_WIDTH


@pytest.mark.parametrize(
    "stray",
    [
        one_gaussian(scale=1e20, opacity=0.02),
        one_gaussian(scale=(0.1, 1e37, 0.1), opacity=0.02),
        one_gaussian((3e38, 0.0, 0.0), 0.2),
        one_gaussian((1e20, -1e20, 1e20), 1e19, 0.02),
    ],
    ids=["vast", "endless", "lost", "vast and lost"],
)
def test_gaussian_whose_bounds_overflow_does_not_change_other_gaussians(backend: str, stray: ls.Gaussians) -> None:
    """The overflowing Gaussian may be drawn or not."""
    gaussians = random_gaussians(13, 100)
    renderer = tracer_of(backend)
    expected = tracer_of(backend).render(ls.Scene([gaussians]), view())
    for scene in (ls.Scene([joined(gaussians, stray)]), ls.Scene([joined(stray, gaussians)])):
        frame = renderer.render(scene, view())
        assert_close(frame.alpha, expected.alpha, atol=0.021, name="alpha")
        assert_close(frame.color, expected.color, atol=0.05, name="color")


# --- Stacks ---


@pytest.mark.parametrize("pipeline", [ls.Pipeline.TRACE, ls.Pipeline.HYBRID])
def test_frames_are_equal_with_the_larger_traversal_stack_for_deep_bvhs(
    pipeline: ls.Pipeline, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Kernels with the largest stack give equal frames, also from graphs."""
    ball = ls.gaussians_from_mesh(ls.sphere(), 900, seed=3)
    positions = [similarity(offset=(0.3 * i - 1.5, 0.0, 4.0 + 0.1 * i), scale=0.5) for i in range(12)]
    light = ls.LightPoint((0.0, -3.0, 0.0), intensity=20.0)
    few, many = (
        ls.Scene([ls.SplatInstance(ball, transform, ls.MaterialPbr()) for transform in positions[:n]], lights=[light])
        for n in (1, 12)
    )
    settings = ls.RenderConfig(pipeline=pipeline, samples=1)
    frames = []
    for limit in (TRAVERSE_STACK_SMALL, 0):
        monkeypatch.setattr(bvh_scene, "TRAVERSE_STACK_SMALL", limit)
        renderer = without_lists(ls.Renderer(settings, GraphLauncher()))
        frames.append([renderer.render(scene, view()).color for scene in (few, few, few, many, many, many, few)])
        assert renderer._scene.bvh.stack == (limit or TRAVERSE_STACK)
    np.testing.assert_array_equal(*frames)


def test_traversal_stack_is_large_enough_for_top_level_tree_and_deepest_bvh_together() -> None:
    """The deepest path goes through the top-level tree and the deepest BVH of a set."""
    renderer = tracer_of("cpu")
    small, large = random_gaussians(1, 5), random_gaussians(2, 3000)
    needed = []
    for sets in ([small], [large], [small, large], [small] * 9):
        positions = [ls.SplatInstance(one, similarity(offset=(0.1 * i, 0.0, 0.0))) for i, one in enumerate(sets)]
        renderer.render(ls.Scene(positions), view())
        bvh = renderer._scene.bvh
        nodes = bvh.data(renderer._scene.splat_instances).tlas_nodes
        needed.append(waiting_in_tree(nodes.numpy()) - 1 + max(one.bvh.stack_size for one in bvh.cached))
        assert bvh.stack >= needed[-1]
    assert needed[1] > needed[0] == 1
    assert needed[2] == needed[1] + 1
    assert needed[3] == 9, "seven beside a pair"


# --- Failures half-way ---


def test_bvh_tables_hold_no_addresses_of_freed_arrays_after_a_failed_upload(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sets that were freed for a scene that did not fit have new addresses when they return."""
    first, second = random_gaussians(9, 60), random_gaussians(10, 70)
    renderer = tracer_of("cpu")
    renderer.render(ls.Scene([first]), view())
    freed = renderer._scene.assets[0].data  # kept alive, so that the next upload gets another address

    def refuse(*_: object) -> None:
        raise RuntimeError("out of memory")

    with monkeypatch.context() as patch:
        patch.setattr(assets, "upload_gaussians", refuse)
        with pytest.raises(ls.DeviceError, match="too little memory"):
            renderer.render(ls.Scene([second]), view())
    renderer.render(ls.Scene([first]), view())
    row = present(renderer._scene.bvh.assets).numpy()[0]["gaussians"]["rotations"]["data"]
    assert row == renderer._scene.assets[0].data.rotations.ptr != freed.rotations.ptr


def test_frame_after_a_failed_bvh_build_equals_that_of_a_new_renderer(
    backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A BVH that was refitted before the next build failed is not reused."""
    first, second = random_gaussians(11, 60), random_gaussians(12, 70)
    renderer = tracer_of(backend)
    renderer.render(ls.Scene([first]), view())

    def refuse(*_: object) -> None:
        raise ls.DeviceError("out of memory")

    moved = replace(first, means=first.means + np.float32(0.3))
    with monkeypatch.context() as patch:
        patch.setattr(bvh_scene, "GaussianBvh", refuse)
        with pytest.raises(ls.DeviceError, match="out of memory"):
            renderer.render(ls.Scene([moved, second]), view())
    assert_as_new(renderer, backend, ls.Scene([first]))


# --- Instances ---


def boxes(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Returns random boxes."""
    random = np.random.default_rng(seed)
    center, half = random.normal(size=(count, 3)), np.exp(random.uniform(-4.0, 1.0, (count, 3)))
    return center - half, center + half


def leaves(nodes: np.ndarray) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Returns the boxes of all items by index; asserts that each node has one parent and lies in its box."""
    found: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    parents = np.zeros(len(nodes), int)
    for number, node in enumerate(nodes):
        low, high = (np.stack([node[f"{side}_{axis}"] for axis in "xyz"], axis=-1) for side in ("low", "high"))
        for c, link in enumerate(node["link"]):
            if link == NO_CHILD:
                assert (low[c] == np.float32(FAR)).all() and (high[c] == -np.float32(FAR)).all()
            elif link < 0:
                assert ~link not in found, "an item in two leaves"
                found[~link] = low[c], high[c]
            else:
                assert link > number
                parents[link] += 1
                below = nodes[link]
                full = below["link"] != NO_CHILD
                for k, axis in enumerate("xyz"):
                    assert low[c, k] <= below[f"low_{axis}"][full].min()
                    assert high[c, k] >= below[f"high_{axis}"][full].max()
    assert (parents[1:] == 1).all() and parents[0] == 0
    return found


@pytest.mark.parametrize("count", [0, 1, 2, 7, 8, 9, 17, 64, 65, 300])
def test_top_level_bvh_contains_each_instance_box_once(count: int) -> None:
    """The boxes are unchanged, and the tree has as few nodes as possible."""
    low, high = boxes(count)
    nodes = tree_of_boxes(low, high)
    found = leaves(nodes)
    assert sorted(found) == list(range(count))
    for item, (box_low, box_high) in found.items():
        np.testing.assert_array_equal(box_low, np.float32(low[item]))
        np.testing.assert_array_equal(box_high, np.float32(high[item]))
    assert len(nodes) <= 1 + count // 2


def test_top_level_bvh_leaves_out_inverted_instance_boxes() -> None:
    """Empty instances have no leaf, and coinciding boxes have one leaf each."""
    low, high = boxes(40)
    low[::3], high[::3] = np.float32(FAR), -np.float32(FAR)
    low[1::3], high[1::3] = low[1], high[1]
    assert sorted(leaves(tree_of_boxes(low, high))) == [i for i in range(40) if i % 3]
    assert leaves(tree_of_boxes(high[::3], low[::3])) != {} and leaves(tree_of_boxes(low[::3], high[::3])) == {}


def test_top_level_bvh_groups_instance_boxes_that_are_close_together() -> None:
    """For eight clusters of eight boxes, the root's children are the clusters."""
    corners = np.array([[x, y, z] for x in (0, 10) for y in (0, 20) for z in (0, 40)], float)
    low = (corners[None] + np.random.default_rng(0).uniform(0.0, 1.0, (8, 8, 3))).reshape(-1, 3)
    nodes = tree_of_boxes(low, low + 0.1)
    size = np.stack([nodes[0][f"high_{axis}"] - nodes[0][f"low_{axis}"] for axis in "xyz"])
    assert len(nodes) == 9 and (size < 1.2).all()


def baked(instance: ls.SplatInstance) -> ls.Gaussians:
    """Returns the Gaussians of an instance in world space, for view-independent colours."""
    gaussians, transform, scale = instance.gaussians, instance.transform, instance.scale
    turn = transform[:3, :3] / scale
    w = 0.5 * np.sqrt(1.0 + np.trace(turn))  # all rotations of the tests are below 180 degrees
    x, y, z = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / (4.0 * w)
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    np.testing.assert_allclose(rotation_from_quaternion(np.array([[w, x, y, z]]))[0], turn, atol=1e-9)
    return replace(
        gaussians,
        means=gaussians.means @ transform[:3, :3].T + transform[:3, 3],
        rotations_wxyz=gaussians.rotations_wxyz @ left.T,
        scales=gaussians.scales * scale,
    )


@pytest.mark.parametrize(("count", "size"), [(9, 0.1), (200, 0.02)])
def test_many_instances_are_traced_like_one_merged_set(backend: str, count: int, size: float) -> None:
    """The instances have any size and position."""
    random = np.random.default_rng(count)
    assets = [random_gaussians(seed, 20, center=(0.0, 0.0, 0.0), extent=(1.0, 1.0, 1.0)) for seed in (20, 21, 22)]
    scene = ls.Scene(
        [
            ls.SplatInstance(
                assets[i % 3],
                similarity(
                    tuple(random.normal(size=3)),
                    random.uniform(0.0, 2.0),
                    size * 10.0 ** random.uniform(0.0, 1.0),
                    (random.uniform(-1.5, 1.5), random.uniform(-1.0, 1.0), random.uniform(3.0, 6.0)),
                ),
            )
            for i in range(count)
        ]
    )
    whole = ls.Scene([joined(*(baked(instance) for instance in scene.splats))])
    shown, expected = (tracer_of(backend).render(one, view()) for one in (scene, whole))
    assert expected.alpha.mean() > 0.05
    for name in ("color", "alpha"):
        # Rounding may add or drop the rim of a Gaussian, whose alpha is 1/255.
        assert_close(getattr(shown, name), getattr(expected, name), atol=1.0 / 255.0, name=name)
        images = (getattr(one, name) for one in (shown, expected))
        assert_images_alike(*images, mean=1e-5, within=2e-5, share=0.97, name=name)
    same = shown.gaussian_index >= 0
    number = shown.instance_index * 20 + shown.gaussian_index
    assert (number[same] == expected.gaussian_index[same]).mean() > 0.98
