"""BVHs of Gaussians, by surface area and by Morton code: content, bounds, cost and updates."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.constants import ALPHA_MIN, BOX_MARGIN, NODE_WIDTH, TRAVERSE_STACK
from lumisplat.device.structs.bvh import FAR, NO_CHILD
from lumisplat.renderer.scene.assets import upload_gaussians
from lumisplat.renderer.scene.instance_tables import kernel_data
from lumisplat.renderer.trees.box_tree import TREE_SURFACE_LEVELS, HostBoxTree
from lumisplat.renderer.trees.gaussian_bvh import GaussianBvh
from lumisplat.runtime.launcher import Launcher
from support.compare.backends import renderer_of, without_lists
from support.oracles import raster_oracle as oracles
from support.scenes.raster_scenes import front_camera, random_gaussians

BUILDERS = ["area", "code", *(device.alias for device in wp.get_cuda_devices())]
TRACE = ls.RenderConfig(pipeline=ls.Pipeline.TRACE)
MORTON_LEVELS = 10


@pytest.fixture(params=BUILDERS)
def launcher(request: pytest.FixtureRequest) -> Launcher:
    """Returns a launcher whose BVHs are split by surface area or by Morton code."""
    if request.param in ("area", "code"):
        return Launcher("cpu", threads=2, parallel=request.param == "code")
    return Launcher(request.param)


def tree_of(launcher: Launcher, gaussians: ls.Gaussians) -> GaussianBvh:
    """Returns a new BVH of the Gaussians."""
    return GaussianBvh(launcher, upload_gaussians(gaussians, launcher.device), kernel_data(gaussians, TRACE))


@dataclass
class Walked:
    """A BVH, read back and checked."""

    items: np.ndarray  # Gaussian index in the order of the BVH
    low: np.ndarray  # (N, 3), box of each Gaussian in its leaf
    high: np.ndarray
    depth: int  # levels


def walked(tree: GaussianBvh, count: int) -> Walked:
    """Follows all links; asserts that each Gaussian has one leaf, and that boxes contain their subtrees."""
    nodes, particles = tree.nodes.numpy(), tree.particles.numpy()
    low = np.stack([nodes[f"low_{axis}"] for axis in "xyz"], axis=-1)
    high = np.stack([nodes[f"high_{axis}"] for axis in "xyz"], axis=-1)
    links = nodes["link"]
    empty = links == NO_CHILD
    assert (low[empty] == np.float32(FAR)).all() and (high[empty] == -np.float32(FAR)).all()
    positions = ~links[links < 0]
    np.testing.assert_array_equal(np.sort(positions), np.arange(count), "not every entry has one leaf")
    np.testing.assert_array_equal(np.sort(particles["index"]), np.arange(count), "not every Gaussian has one entry")
    inner = (links >= 0) & ~empty
    np.testing.assert_array_equal(np.sort(links[inner]), np.arange(1, len(nodes)), "not every node has one parent")
    if count > 1:
        assert ((~empty).sum(axis=1) >= 2).all(), "a node with a single child"
    depths = np.zeros(len(nodes), int)
    for node in range(len(nodes)):
        for c in np.flatnonzero(inner[node]):
            child = links[node, c]
            assert child > node, "children come after their parents"
            depths[child] = depths[node] + 1
            np.testing.assert_array_equal(low[node, c], low[child].min(axis=0))
            np.testing.assert_array_equal(high[node, c], high[child].max(axis=0))
    owner, lane = np.nonzero(links < 0)
    by_item = np.argsort(particles["index"][~links[owner, lane]])
    return Walked(particles["index"], low[owner, lane][by_item], high[owner, lane][by_item], int(depths.max()) + 1)


def spread_over(means: np.ndarray, seed: int = 0, scale: float = 0.05) -> ls.Gaussians:
    """Returns random Gaussians with the given means."""
    return replace(random_gaussians(seed, len(means), scale_range=(0.3 * scale, scale)), means=means)


def inputs() -> dict[str, ls.Gaussians]:
    """Returns inputs that are difficult for BVH builders."""
    random = np.random.default_rng(1)
    line = np.outer(np.linspace(0.0, 1.0, 1000), (1.0, 2.0, -3.0))
    faint = random_gaussians(2, 300)
    stray = random.normal(size=(3000, 3))
    stray[1234] = (1e7, -1e7, 1e7)
    exponential = np.zeros((300, 3))
    exponential[:, 0] = 2.0 ** np.linspace(-60.0, 60.0, 300)
    clusters = np.repeat(random.normal(size=(5, 3)) * 100.0, 200, axis=0)
    return {
        **{f"{count}": random_gaussians(count, count) for count in (1, 2, 3, 7, 8, 9, 15, 16, 17, 63, 64, 65, 1000)},
        "one position": spread_over(np.full((1000, 3), 0.3)),
        "one box": replace(
            random_gaussians(0, 500),
            **{name: np.repeat(values[:1], 500, axis=0) for name, values in random_gaussians(0, 500).arrays().items()},
        ),
        "line": spread_over(line),
        "line along an axis": spread_over(line * (1.0, 0.0, 0.0)),
        "stray": spread_over(stray),
        "exponential": replace(spread_over(exponential), scales=np.full((300, 3), 1e-18)),
        "five positions": spread_over(clusters),
        "grid": spread_over(np.stack(np.meshgrid(*[np.arange(10.0)] * 3), axis=-1).reshape(-1, 3)),
        "faint among others": replace(faint, opacities=np.where(np.arange(300) % 3 == 0, 0.0039, faint.opacities)),
        "all faint": replace(faint, opacities=np.full(300, 0.0039)),
        "all sizes": random_gaussians(3, 1000, scale_range=(1e-7, 1e3)),
        "far away": random_gaussians(4, 500, center=(1e6, -1e6, 1e6)),
        "tiny": random_gaussians(
            5, 300, center=(0.0, 0.0, 0.0), extent=(1e-15, 1e-15, 1e-15), scale_range=(1e-18, 1e-16)
        ),
        "huge": random_gaussians(6, 300, center=(0.0, 0.0, 0.0), extent=(1e12, 1e12, 1e12), scale_range=(1e10, 1e12)),
    }


INPUTS = inputs()


@pytest.mark.parametrize("name", INPUTS)
def test_bvh_contains_every_gaussian_once_in_tight_boxes(launcher: Launcher, name: str) -> None:
    """For every input, boxes contain their subtrees, the depth is bounded, and leaves are tight."""
    gaussians = INPUTS[name]
    count = gaussians.count
    tree = tree_of(launcher, gaussians)
    found = walked(tree, count)
    below = math.ceil(math.log(max(count, 2), NODE_WIDTH) - 1e-9)
    assert found.depth <= (MORTON_LEVELS if launcher.is_parallel else TREE_SURFACE_LEVELS) + below
    seen = gaussians.opacities >= np.float32(ALPHA_MIN)
    quaternions = gaussians.rotations_wxyz.astype(np.float64)
    rotations = oracles.rotation_from_quaternion(oracles.normalized(quaternions))
    reach = np.sqrt(2.0 * np.log(np.maximum(gaussians.opacities.astype(np.float64), ALPHA_MIN) / ALPHA_MIN))
    variances = np.einsum("nij,nj->ni", rotations**2, gaussians.scales.astype(np.float64) ** 2)
    half, means = reach[:, None] * np.sqrt(variances), gaussians.means.astype(np.float64)
    slack = 3.0 * BOX_MARGIN * (half.max(axis=1, keepdims=True) + np.abs(means)) + 1e-5 * half
    for sign, box in ((-1.0, found.low), (1.0, found.high)):
        out = sign * (box - (means + sign * half))[seen]
        assert (out >= 0.0).all() and (out <= slack[seen]).all()
        assert (sign * box[~seen] == -np.float32(FAR)).all()
    low, high = tree.bounds()
    np.testing.assert_array_equal(low, found.low.min(axis=0))
    np.testing.assert_array_equal(high, found.high.max(axis=0))


def test_deepest_possible_bvh_fits_the_traversal_stack() -> None:
    """The deepest BVH lies under the deepest top-level tree."""
    most = math.ceil(math.log(2.0**31, NODE_WIDTH))
    asset = max(TREE_SURFACE_LEVELS, MORTON_LEVELS) + most
    assert (NODE_WIDTH - 1) * (asset + most) + 1 <= TRAVERSE_STACK


def waiting_of(links: np.ndarray) -> list[int]:
    """Returns the largest stack size during traversal, with children in order, reversed, and at random."""
    most = []
    for order in ("first", "last", *range(20)):
        rng = np.random.default_rng(order if isinstance(order, int) else 0)
        stack, height = [0], 1
        while stack:
            children = [link for link in links[stack.pop()].tolist() if link >= 0 and link != NO_CHILD]
            if order == "last":
                children.reverse()
            elif order != "first":
                rng.shuffle(children)
            stack += children
            height = max(height, len(stack))
        most.append(height)
    return most


def test_worst_traversal_of_a_bvh_fills_its_stated_stack_size_and_none_exceeds_it(launcher: Launcher) -> None:
    """No order of visits exceeds the size, and the worst path reaches it."""
    rng = np.random.default_rng(8)
    clumps = (rng.normal(size=(3000, 3)) * np.exp(-rng.uniform(0.0, 12.0, (3000, 1)))).astype(np.float32)
    for count, means in ((1, None), (2, None), (9, None), (700, None), (3000, clumps)):
        gaussians = random_gaussians(9, count)
        gaussians = gaussians if means is None else replace(gaussians, means=means)
        tree = tree_of(launcher, gaussians)
        links = tree.nodes.numpy()["link"]
        assert max(waiting_of(links)) <= tree.stack_size <= TRAVERSE_STACK
        assert tree.stack_size == worst(links, 0)


def worst(links: np.ndarray, node: int) -> int:
    """Returns the largest stack size below a node: its children, or all but one and the subtree of that one."""
    children = [link for link in links[node].tolist() if link >= 0 and link != NO_CHILD]
    return max([1, len(children), *(len(children) - 1 + worst(links, child) for child in children)])


def test_expected_number_of_bvh_nodes_that_a_random_ray_visits_is_small(launcher: Launcher) -> None:
    """In a BVH over random groups, rays would visit most nodes."""
    gaussians = random_gaussians(7, 4000, extent=(4.0, 4.0, 4.0), scale_range=(0.01, 0.03))
    tree = tree_of(launcher, gaussians)
    assert tree.cost < 0.02 * tree.nodes.shape[0]
    jumbled = gaussians.subset(np.random.default_rng(0).permutation(4000))
    tree._fit(upload_gaussians(jumbled, launcher.device))
    assert tree.cost > 0.3 * tree.nodes.shape[0]


def test_morton_bvh_costs_at_most_15_percent_more_than_one_split_by_area_everywhere() -> None:
    """Morton codes split only the few large nodes. On a sphere of Gaussians, they alone would cost 30 % more."""
    directions = np.random.default_rng(7).normal(size=(20_000, 3))
    gaussians = spread_over(directions / np.linalg.norm(directions, axis=1, keepdims=True), scale=0.01)
    by_code, by_area = (tree_of(Launcher("cpu", threads=2, parallel=parallel), gaussians) for parallel in (True, False))
    assert by_code.cost < 1.15 * by_area.cost


def test_distant_outlier_does_not_degrade_the_bvh_of_other_gaussians(launcher: Launcher) -> None:
    """A Gaussian a thousand extents away hardly raises the cost of the others."""
    gaussians = random_gaussians(8, 4000, extent=(4.0, 4.0, 4.0), scale_range=(0.01, 0.03))
    alone = tree_of(launcher, gaussians)
    far = gaussians.means.copy()
    far[17] = (4e3, -4e3, 4e3)
    strayed = tree_of(launcher, replace(gaussians, means=far))
    inner, inner_strayed = (np.sort(tree._areas.numpy())[-200:-20].sum() for tree in (alone, strayed))
    assert inner_strayed < 1.1 * inner


def test_morton_bvh_of_70000_gaussians_is_complete_and_has_low_cost() -> None:
    """There are more Gaussians than samples that define the Morton grid; cells are as fine as for few Gaussians."""
    gaussians = random_gaussians(9, 70_000, extent=(4.0, 4.0, 4.0), scale_range=(0.001, 0.003))
    tree = tree_of(Launcher("cpu", threads=2, parallel=True), gaussians)
    np.testing.assert_array_equal(np.sort(tree.particles.numpy()["index"]), np.arange(70_000))
    links = tree.nodes.numpy()["link"]
    np.testing.assert_array_equal(np.sort(~links[links < 0]), np.arange(70_000))
    assert tree.cost < 0.02 * tree.nodes.shape[0]


def test_bvh_builds_are_deterministic_on_any_number_of_threads(launcher: Launcher) -> None:
    """Equal input gives equal bits on any number of threads."""
    gaussians = random_gaussians(10, 3000)
    first = tree_of(launcher, gaussians)
    again = [launcher]
    if not launcher.is_cuda:
        again += [Launcher("cpu", threads=threads, parallel=launcher.is_parallel) for threads in (1, 3)]
    for other in again:
        tree = tree_of(other, gaussians)
        assert tree.nodes.numpy().tobytes() == first.nodes.numpy().tobytes()
        assert tree.particles.numpy().tobytes() == first.particles.numpy().tobytes()


# --- Refit ---


def wavy(gaussians: ls.Gaussians, amount: float = 0.1) -> ls.Gaussians:
    """Returns a smooth deformation: means move, axes rotate, sizes and opacities change slightly."""
    x, y, z = gaussians.means.T
    means = gaussians.means + amount * np.stack([np.sin(2.0 * y), np.cos(3.0 * z), np.sin(x + y)], axis=-1)
    turned = gaussians.rotations_wxyz + 0.5 * amount * np.stack([np.sin(x), np.cos(y), np.sin(z), np.cos(x)], axis=-1)
    scales = gaussians.scales * (1.0 + amount * np.sin(x + 2.0 * z))[:, None]
    return replace(
        gaussians,
        means=means,
        rotations_wxyz=turned,
        scales=scales,
        opacities=gaussians.opacities * (1.0 - 0.2 * amount),
    )


def shuffled(gaussians: ls.Gaussians) -> ls.Gaussians:
    """Returns the Gaussians with permuted positions."""
    order = np.random.default_rng(0).permutation(gaussians.count)
    return replace(gaussians, means=gaussians.means[order])


@pytest.mark.parametrize("count", [1, 2, 9, 800])
def test_leaf_boxes_of_a_refitted_bvh_equal_those_of_a_new_bvh(launcher: Launcher, count: int) -> None:
    """After a smooth deformation, inner boxes contain those of a new BVH, and no link changes."""
    gaussians = random_gaussians(11, count)
    tree = tree_of(launcher, gaussians)
    positions, links, built = tree.particles.numpy()["index"].copy(), tree.nodes.numpy()["link"].copy(), tree.cost_built
    moved = wavy(gaussians)
    tree.refit(upload_gaussians(moved, launcher.device))
    found = walked(tree, count)
    assert tree.cost_built == built
    np.testing.assert_array_equal(found.items, positions)
    np.testing.assert_array_equal(tree.nodes.numpy()["link"], links)
    fresh = walked(tree_of(launcher, moved), count)
    np.testing.assert_array_equal(found.low, fresh.low)
    np.testing.assert_array_equal(found.high, fresh.high)


def test_bvh_is_rebuilt_and_not_refitted_after_large_moves_of_gaussians(launcher: Launcher) -> None:
    """When all Gaussians swap positions, the result is that of a new BVH."""
    gaussians = random_gaussians(12, 2000, scale_range=(0.01, 0.05))
    tree = tree_of(launcher, gaussians)
    built = tree.cost_built
    jumbled = shuffled(gaussians)
    tree.refit(upload_gaussians(jumbled, launcher.device))
    fresh = tree_of(launcher, jumbled)
    assert tree.cost_built != built
    assert tree.cost == tree.cost_built == fresh.cost
    assert walked(tree, 2000).items.tolist() == walked(fresh, 2000).items.tolist()


def test_bvh_is_rebuilt_when_gaussians_that_were_invisible_become_visible(launcher: Launcher) -> None:
    """The new BVH has the cost of one built over the visible Gaussians."""
    gaussians = random_gaussians(13, 1000, extent=(4.0, 4.0, 4.0), scale_range=(0.01, 0.05))
    tree = tree_of(launcher, replace(gaussians, opacities=np.zeros(1000)))
    tree.refit(upload_gaussians(gaussians, launcher.device))
    walked(tree, 1000)
    assert tree.cost <= 1.5 * tree_of(launcher, gaussians).cost


def test_refitting_a_bvh_allocates_no_memory(launcher: Launcher) -> None:
    """Neither bytes nor the number of allocations change, however often Gaussians move."""
    gaussians = random_gaussians(14, 1000)
    tree = tree_of(launcher, gaussians)
    before = tree.bytes, tree._buffers.allocations, tree.nodes.ptr
    for amount in (0.02, 0.05, 0.1):
        tree.refit(upload_gaussians(wavy(gaussians, amount), launcher.device))
        assert (tree.bytes, tree._buffers.allocations, tree.nodes.ptr) == before


@pytest.mark.parametrize("backend", ["cpu", "cpu as cuda", *(device.alias for device in wp.get_cuda_devices())])
def test_images_traced_with_refitted_bvhs_equal_those_with_new_bvhs(backend: str) -> None:
    """Gaussians are deformed step by step and then shuffled; each image has the bits of a new renderer."""
    gaussians = random_gaussians(15, 600, degree=1)
    warm, trees = without_lists(renderer_of(backend, TRACE)), []
    steps = [gaussians, wavy(gaussians), wavy(wavy(gaussians)), shuffled(gaussians), gaussians]
    for step in steps:
        shown = warm.render(ls.Scene([step]), front_camera(24, 18, 22.0))
        fresh = without_lists(renderer_of(backend, TRACE)).render(ls.Scene([step]), front_camera(24, 18, 22.0))
        for name in ("color", "alpha", "depth", "normal", "gaussian_index"):
            np.testing.assert_array_equal(getattr(shown, name), getattr(fresh, name), err_msg=name)
        tree = warm._scene.bvh._cached[0].bvh
        trees.append((id(tree), tree.cost_built))
    assert len({number for number, _ in trees}) == 1, "followed by one tree"
    costs = [cost for _, cost in trees]
    assert costs[0] == costs[1] == costs[2] != costs[3]


@pytest.mark.parametrize("parallel", [False, True])
def test_cost_of_a_tree_over_boxes_on_the_host_equals_the_areas_of_its_nodes(parallel: bool) -> None:
    """Several trees are built together; the cost is that of their boxes after a refit."""
    rng = np.random.default_rng(1)
    counts = np.array([5, 40, 1, 90])
    low = rng.uniform(-3.0, 3.0, (counts.sum(), 3))
    high = low + rng.uniform(0.0, 0.5, low.shape)
    tree = HostBoxTree(Launcher("cpu", threads=1, parallel=parallel), low, high, counts)
    for scale in (1.0, 2.0):
        tree.refit(scale * low, scale * high + 1.0)
        nodes = tree.nodes.numpy()
        corners = [np.stack([nodes[f"{side}_{axis}"] for axis in "xyz"], axis=1) for side in ("low", "high")]
        sides = np.maximum(corners[1].max(axis=2) - corners[0].min(axis=2), 0.0)
        areas = (sides * np.roll(sides, 1, axis=1)).sum(axis=1)
        assert tree.cost == pytest.approx(areas.sum() / areas[0], rel=1e-5)
