"""The nearest hits of a ray, sorted in the order in which they are blended: by distance, then by index."""

import warp as wp

from lumisplat.device.structs.bvh import FAR
from lumisplat.device.structs.packet import Hit, HitList

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


@wp.func
def is_before(t: float, index: int, other_t: float, other_index: int) -> bool:
    """Whether a hit is nearer than another one; of two at the same distance, that of the lower index is."""
    return t < other_t or (t == other_t and index < other_index)


@wp.func
def empty_list(begin: int) -> HitList:
    """A list without hits, whose first slot is ``begin``."""
    kept = HitList()
    kept.begin = begin
    kept.head = begin
    kept.tail = begin
    return kept


@wp.func
def keep_hit(hits: wp.array[Hit], kept: wp.ref[HitList], slots: int, hit: Hit) -> Hit:
    """Adds a hit to a list; if that is full, the farthest hit is dropped.

    Args:
        hits: The slots of all lists.
        kept: The list.
        slots: How many hits it may hold.
        hit: The hit.

    Returns:
        The hit that was dropped; its distance is FAR if none was.
    """
    if kept.tail == kept.begin + slots:
        move_to_begin(hits, kept)
    dropped = Hit()
    dropped.t = FAR
    if kept.tail == kept.begin + slots:
        dropped = hits[kept.tail - 1]
        if not is_before(hit.t, hit.index, dropped.t, dropped.index):
            return hit
        kept.tail -= 1
    insert_hit(hits, kept, hit)
    return dropped


@wp.func
def move_to_begin(hits: wp.array[Hit], kept: wp.ref[HitList]):
    """Moves the hits of a list to its first slots."""
    shift = kept.head - kept.begin
    if shift > 0:
        for j in range(kept.head, kept.tail):
            hits[j - shift] = hits[j]
        kept.head -= shift
        kept.tail -= shift


@wp.func
def insert_hit(hits: wp.array[Hit], kept: wp.ref[HitList], hit: Hit):
    """Puts a hit in its place in a list that has a free slot."""
    head = kept.head
    j = int(kept.tail)
    while j > head and is_before(hit.t, hit.index, hits[j - 1].t, hits[j - 1].index):
        hits[j] = hits[j - 1]
        j -= 1
    hits[j] = hit
    kept.tail += 1
