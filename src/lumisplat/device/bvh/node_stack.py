"""The nodes that a packet of rays still has to visit, the next one on top of a stack."""

import functools
from dataclasses import dataclass
from typing import Any

import warp as wp

from lumisplat.constants import NODE_WIDTH
from lumisplat.device.bvh.local_arrays import storage_of
from lumisplat.device.bvh.node_test import lesser
from lumisplat.device.structs.bvh import FAR, NO_CHILD, WORLD, ChildLinks, Children, Node
from lumisplat.device.structs.packet import WaitingNode

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

WIDTH = wp.constant(NODE_WIDTH)

NEAR_FIRST = wp.constant(wp.float32(1.0))
"""Order of siblings: the one that is entered nearest is visited first."""

FAR_FIRST = wp.constant(wp.float32(-1.0))
"""It is visited last."""


@dataclass(frozen=True, slots=True)
class NodeStack:
    """What stacks of a size need."""

    storage: Any
    """The type of a variable in which the nodes lie."""
    node_stack: Any


@functools.cache
def node_stack_of(entries: int) -> NodeStack:
    """What stacks of so many entries need."""
    ENTRIES = entries
    NodeStackStorage = storage_of(WaitingNode, entries)

    @wp.func
    def node_stack(storage: wp.ref[NodeStackStorage]) -> wp.array[WaitingNode]:
        """The stack whose nodes lie in a variable."""
        return wp.array(ptr=wp.address_of(storage), shape=(ENTRIES,), dtype=WaitingNode)

    return NodeStack(NodeStackStorage, node_stack)


@wp.func
def push_root(stack: wp.array[WaitingNode]) -> int:
    """Makes the root of the tree over the instances all that waits; returns the height of the stack, 1."""
    root = WaitingNode()
    root.instance = WORLD
    stack[0] = root
    return 1


@wp.func
def push_children(
    stack: wp.array[WaitingNode],
    top: wp.ref[int],
    leaves: wp.ref[ChildLinks],
    node: Node,
    instance: int,
    entries: Children,
    reach: float,
    order: float,
) -> int:
    """Pushes the children of a node that are nodes, and collects those that are Gaussians.

    Args:
        stack: The stack.
        top: Its height.
        leaves: Receives the places of the Gaussians among the particles of the asset.
        node: The node.
        instance: The instance whose tree it is of, or WORLD.
        entries: Distances at which the packet enters the children.
        reach: Children that are entered farther away are left out.
        order: NEAR_FIRST or FAR_FIRST.

    Returns:
        The number of leaves.
    """
    links = node.link
    base = int(top)
    leaf_count = int(0)
    for c in range(WIDTH):
        # Rays without a direction enter all boxes, also those of no child.
        if entries[c] <= reach and links[c] != NO_CHILD:
            if links[c] >= 0 or instance == WORLD:
                child = WaitingNode()
                child.entry = entries[c]
                # An instance waits as the root of its tree.
                child.link = wp.max(links[c], 0)
                child.instance = wp.where(links[c] < 0, ~links[c], instance)
                insert_node(stack, base, top, child, order)
                top += 1
            else:
                leaves[leaf_count] = ~links[c]
                leaf_count += 1
    if order == NEAR_FIRST:
        set_floors(stack, base, top)
    return leaf_count


@wp.func
def insert_node(stack: wp.array[WaitingNode], base: int, top: int, node: WaitingNode, order: float):
    """Puts a node in its place among its siblings, which lie from ``base`` up to ``top``."""
    j = int(top)
    while j > base and order * stack[j - 1].entry < order * node.entry:
        stack[j] = stack[j - 1]
        j -= 1
    stack[j] = node


@wp.func
def set_floors(stack: wp.array[WaitingNode], base: int, top: int):
    """Sets the floors of siblings, which lie from ``base`` up to ``top``."""
    below = float(FAR)
    if base > 0:
        below = stack[base - 1].floor
    for j in range(base, top):
        stack[j].floor = lesser(stack[j].entry, below)
