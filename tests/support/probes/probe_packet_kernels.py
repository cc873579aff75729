"""Kernels that fill the lists of ray packets: sorted hits, and stacks of waiting nodes."""

import warp as wp

from lumisplat.device.bvh.packet import buffer_hit, empty_list, push_children
from lumisplat.device.structs.bvh import ChildLinks, Children, Hit, HitList, Node, WaitingNode

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


@wp.kernel
def probe_hit_list(
    added: wp.array2d(dtype=Hit),
    blended: wp.array2d(dtype=int),
    slots: wp.array(dtype=int),
    hits: wp.array2d(dtype=Hit),
    dropped: wp.array2d(dtype=Hit),
    lists: wp.array(dtype=HitList),
):
    """Adds hits to a list; some are blended in between."""
    i = wp.tid()
    kept = empty_list(3)
    for step in range(added.shape[1]):
        dropped[i, step] = buffer_hit(hits[i], kept, slots[i], added[i, step])
        kept.head = wp.min(kept.head + blended[i, step], kept.tail)
    lists[i] = kept


@wp.kernel
def probe_push_children(
    nodes: wp.array(dtype=Node),
    instances: wp.array(dtype=int),
    entries: wp.array(dtype=Children),
    reach: float,
    order: float,
    stacks: wp.array2d(dtype=WaitingNode),
    tops: wp.array(dtype=int),
    leaves: wp.array(dtype=ChildLinks),
    leaf_counts: wp.array(dtype=int),
):
    """Pushes the children of a node onto a stack that holds other nodes."""
    i = wp.tid()
    top = tops[i]
    found = ChildLinks()
    leaf_counts[i] = push_children(stacks[i], top, found, nodes[i].link, instances[i], entries[i], reach, order)
    tops[i] = top
    leaves[i] = found
