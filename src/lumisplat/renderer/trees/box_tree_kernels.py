"""Kernels that build BVHs over boxes level by level from the root, and refit their boxes.

``split_by_area`` (CPU) and ``split_by_code`` (CUDA) have one thread per node of a level. Items that are split by area
are ordered child by child. ``link_nodes`` and ``refit_nodes`` have one thread per node of a level, ``write_links`` one
per node.
"""

import warp as wp

from lumisplat.constants import NODE_WIDTH
from lumisplat.device.structs.bvh import FAR, NO_CHILD, Box, ChildLinks, Children, Node

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

SAH_BINS = 16
"""Number of bins per axis. The build tries to split a node at the edges of the bins (Wald 2007)."""

MORTON_ITEMS_MIN = 256
"""Number of items above which CUDA splits a node by Morton codes, and up to which by the surface area heuristic.

In two captures, warps visit 2 and 7 % more nodes than if all nodes were split by the heuristic (ADR 0108)."""

WIDTH = wp.constant(NODE_WIDTH)
AREA_ITEMS = wp.constant(MORTON_ITEMS_MIN)
BINS = wp.constant(SAH_BINS)

BinFloats = wp.types.vector(length=3 * SAH_BINS, dtype=wp.float32)
BinInts = wp.types.vector(length=3 * SAH_BINS, dtype=wp.int32)
Edges = wp.types.vector(length=NODE_WIDTH + 1, dtype=wp.int32)


@wp.func
def empty_box() -> Box:
    """Returns an inverted box, which contains nothing."""
    box = Box()
    box.low = wp.vec3(FAR)
    box.high = wp.vec3(-FAR)
    return box


@wp.func
def union(a: Box, b: Box) -> Box:
    """Returns the smallest box that contains two boxes."""
    box = Box()
    box.low = wp.min(a.low, b.low)
    box.high = wp.max(a.high, b.high)
    return box


@wp.func
def half_area(low: wp.vec3, high: wp.vec3) -> float:
    """Returns half the surface area of a box; 0 for an inverted box."""
    size = wp.max(high - low, wp.vec3(0.0))
    return size[0] * size[1] + size[1] * size[2] + size[2] * size[0]


@wp.func
def partition_range(boxes: wp.array[Box], items: wp.array[int], begin: int, end: int, axis: int, middle2: float) -> int:
    """Moves boxes with their ``items`` to the front if their doubled centre along ``axis`` is below ``middle2``.

    Returns the index after these boxes.
    """
    low = int(begin)
    high = int(end)
    while low < high:
        box = boxes[low]
        if box.low[axis] + box.high[axis] < middle2:
            low += 1
        else:
            high -= 1
            item = items[low]
            boxes[low] = boxes[high]
            items[low] = items[high]
            boxes[high] = box
            items[high] = item
    return low


@wp.func
def split_range(boxes: wp.array[Box], items: wp.array[int], begin: int, end: int) -> int:
    """Splits a range of boxes in two at the lowest surface area cost (Wald 2007), and returns the split index.

    If all centres coincide, the split is in the middle. The code is not divided into functions, because its three loops
    share the bins, and calls would copy the bins.
    """
    center_low = wp.vec3(wp.inf)
    center_high = wp.vec3(-wp.inf)
    for i in range(begin, end):
        center = boxes[i].low + boxes[i].high
        center_low = wp.min(center_low, center)
        center_high = wp.max(center_high, center)
    size = center_high - center_low
    to_bin = wp.vec3(0.0)
    for axis in range(3):
        if size[axis] > 0.0:
            to_bin[axis] = wp.min(float(BINS) * (1.0 - 1.0e-6) / size[axis], 1.0e30)

    count = BinInts(0)
    low_x = BinFloats(FAR)
    low_y = BinFloats(FAR)
    low_z = BinFloats(FAR)
    high_x = BinFloats(-FAR)
    high_y = BinFloats(-FAR)
    high_z = BinFloats(-FAR)
    for i in range(begin, end):
        box = boxes[i]
        center = box.low + box.high
        for axis in range(3):
            b = axis * BINS + wp.clamp(int((center[axis] - center_low[axis]) * to_bin[axis]), 0, BINS - 1)
            count[b] = count[b] + 1
            low_x[b] = wp.min(low_x[b], box.low[0])
            low_y[b] = wp.min(low_y[b], box.low[1])
            low_z[b] = wp.min(low_z[b], box.low[2])
            high_x[b] = wp.max(high_x[b], box.high[0])
            high_y[b] = wp.max(high_y[b], box.high[1])
            high_z[b] = wp.max(high_z[b], box.high[2])

    best_cost = float(wp.inf)
    best_axis = int(-1)
    best_bin = int(0)
    for axis in range(3):
        if size[axis] > 0.0:
            right_cost = BinFloats(0.0)  # cost of all bins from this one on
            low = wp.vec3(FAR)
            high = wp.vec3(-FAR)
            items_right = int(0)
            for step in range(BINS):
                b = axis * BINS + BINS - 1 - step
                low = wp.min(low, wp.vec3(low_x[b], low_y[b], low_z[b]))
                high = wp.max(high, wp.vec3(high_x[b], high_y[b], high_z[b]))
                items_right += count[b]
                right_cost[BINS - 1 - step] = float(items_right) * half_area(low, high)
            low = wp.vec3(FAR)
            high = wp.vec3(-FAR)
            items_left = int(0)
            for step in range(BINS - 1):
                b = axis * BINS + step
                low = wp.min(low, wp.vec3(low_x[b], low_y[b], low_z[b]))
                high = wp.max(high, wp.vec3(high_x[b], high_y[b], high_z[b]))
                items_left += count[b]
                cost = float(items_left) * half_area(low, high) + right_cost[step + 1]
                if items_left > 0 and items_left < end - begin and cost < best_cost:
                    best_cost = cost
                    best_axis = axis
                    best_bin = step + 1
    middle = int((begin + end) // 2)
    if best_axis >= 0:
        middle2 = center_low[best_axis] + float(best_bin) / to_bin[best_axis]
        split = partition_range(boxes, items, begin, end, best_axis, middle2)
        if split > begin and split < end:
            middle = split
    return middle


@wp.func
def range_area(boxes: wp.array[Box], begin: int, end: int) -> float:
    """Returns half the surface area of the smallest box that contains a range of boxes."""
    low = wp.vec3(FAR)
    high = wp.vec3(-FAR)
    for i in range(begin, end):
        low = wp.min(low, boxes[i].low)
        high = wp.max(high, boxes[i].high)
    return half_area(low, high)


@wp.func
def edges_by_area(boxes: wp.array[Box], items: wp.array[int], begin: int, end: int, by_area: int, leaf: int) -> Edges:
    """Splits a range of items into up to eight children, and returns the first item of each; `split_by_area` has more.

    ``boxes`` and ``items`` are reordered child by child. Children of up to ``leaf`` items are not split.
    """
    edges = Edges(end)
    edges[0] = begin
    used = int(1)
    if leaf == 1 and end - begin <= WIDTH:
        used = end - begin
        for i in range(used):
            edges[i] = begin + i
    else:
        areas = Children(0.0)
        areas[0] = 1.0
        while used < WIDTH:
            largest = int(-1)
            for c in range(used):
                if areas[c] >= 0.0 and edges[c + 1] - edges[c] > leaf:
                    if largest < 0:
                        largest = c
                    elif areas[c] > areas[largest]:
                        largest = c
            if largest < 0:
                break
            middle = int((edges[largest] + edges[largest + 1]) // 2)
            if by_area != 0:
                middle = split_range(boxes, items, edges[largest], edges[largest + 1])
            for move in range(used - largest):
                edges[used + 1 - move] = edges[used - move]
                areas[wp.min(used - move, WIDTH - 1)] = areas[used - 1 - move]
            edges[largest + 1] = middle
            areas[largest] = float(middle - edges[largest])
            areas[largest + 1] = float(edges[largest + 2] - middle)
            if by_area != 0:
                areas[largest] = range_area(boxes, edges[largest], middle)
                areas[largest + 1] = range_area(boxes, middle, edges[largest + 2])
            used += 1
    return edges


@wp.func
def inner_children(edges: Edges, leaf: int) -> int:
    """Returns how many children of a node have more than ``leaf`` items, and are therefore nodes."""
    inner = int(0)
    for c in range(WIDTH):
        if edges[c + 1] - edges[c] > leaf:
            inner += 1
    return inner


@wp.kernel
def split_by_area(
    start: int,
    node_first: int,
    by_area: int,
    leaf: int,
    begins: wp.array[int],
    ends: wp.array[int],
    boxes_inout: wp.array[Box],
    items_inout: wp.array[int],
    edges_out: wp.array[Edges],
    inner_counts_out: wp.array[int],
):
    """Per node of a level: splits its items into up to eight children; the child of largest area is split next.

    ``edges_out`` holds the first item of each child. Each split minimises the surface area heuristic. If ``by_area`` is
    0, the child with the most items is split in the middle instead. Children of up to ``leaf`` items are leaves.
    """
    node = start + wp.tid()
    edges = edges_by_area(boxes_inout, items_inout, begins[node_first + node], ends[node_first + node], by_area, leaf)
    edges_out[node] = edges
    inner_counts_out[node] = inner_children(edges, leaf)


@wp.func
def first_with_digit(codes: wp.array[int], begin: int, end: int, shift: int, digit: int) -> int:
    """Returns the index of the first sorted code whose octal digit at ``shift`` is at least ``digit``.

    All codes in the range agree in the higher digits.
    """
    low = int(begin)
    high = int(end)
    while low < high:
        middle = (low + high) // 2
        if ((codes[middle] >> shift) & 7) < digit:
            low = middle + 1
        else:
            high = middle
    return low


@wp.func
def edges_by_code(codes: wp.array[int], begin: int, end: int) -> Edges:
    """Splits a range of items by the first octal digit in which their Morton codes differ (Karras 2012).

    One octal digit is three levels of a binary radix tree. Items with equal codes are distributed evenly.
    """
    edges = Edges(end)
    differ = codes[begin] ^ codes[end - 1]
    shift = int(-3)
    while differ != 0:
        differ = differ >> 3
        shift += 3
    for c in range(WIDTH):
        if shift < 0:
            edges[c] = begin + (end - begin) // WIDTH * c + wp.min(c, (end - begin) % WIDTH)
        else:
            edges[c] = first_with_digit(codes, begin, end, shift, c)
    return edges


@wp.kernel
def split_by_code(
    start: int,
    node_first: int,
    by_area: int,
    leaf: int,
    begins: wp.array[int],
    ends: wp.array[int],
    codes: wp.array[int],
    boxes_inout: wp.array[Box],
    items_inout: wp.array[int],
    edges_out: wp.array[Edges],
    inner_counts_out: wp.array[int],
):
    """Per node of a level: splits its items by Morton code, or as ``split_by_area`` if it has at most AREA_ITEMS.

    Large nodes are split without reading their items, small ones by many threads at a time.
    """
    node = start + wp.tid()
    begin = begins[node_first + node]
    end = ends[node_first + node]
    edges = Edges()
    if end - begin <= AREA_ITEMS:
        edges = edges_by_area(boxes_inout, items_inout, begin, end, by_area, leaf)
    else:
        edges = edges_by_code(codes, begin, end)
    edges_out[node] = edges
    inner_counts_out[node] = inner_children(edges, leaf)


@wp.kernel
def link_nodes(
    start: int,
    node_first: int,
    child_first: int,
    leaf: int,
    edges: wp.array[Edges],
    inner_ends: wp.array[int],
    inner_counts: wp.array[int],
    begins_out: wp.array[int],
    ends_out: wp.array[int],
    links_out: wp.array[ChildLinks],
):
    """Per node of a level: gives its inner children node indices and the range of their items.

    A leaf's link is ``~index`` of its first item.
    """
    n = start + wp.tid()
    ranges = edges[n]
    child = child_first + inner_ends[n] - inner_counts[n]
    links = ChildLinks(NO_CHILD)
    for c in range(WIDTH):
        begin = ranges[c]
        end = ranges[c + 1]
        if end - begin > leaf:
            begins_out[child] = begin
            ends_out[child] = end
            links[c] = child
            child += 1
        elif end > begin:
            links[c] = ~begin
    links_out[node_first + n] = links


@wp.kernel
def write_links(start: int, links: wp.array[ChildLinks], nodes_out: wp.array[Node]):
    """Per node: writes it with the links to its children; ``refit_nodes`` adds the boxes."""
    n = start + wp.tid()
    node = Node()
    node.link = links[n]
    nodes_out[n] = node


@wp.kernel
def refit_nodes(
    start: int,
    node_first: int,
    boxes: wp.array[Box],
    nodes_inout: wp.array[Node],
    areas_out: wp.array[float],
):
    """Per node of a level: writes the boxes of its children; deeper levels must be refitted earlier."""
    n = node_first + start + wp.tid()
    node = nodes_inout[n]
    whole = empty_box()
    for c in range(WIDTH):
        link = node.link[c]
        box = empty_box()
        if link < 0:
            box = boxes[~link]
        elif link != NO_CHILD:
            child = nodes_inout[link]
            box.low = wp.vec3(wp.min(child.low_x), wp.min(child.low_y), wp.min(child.low_z))
            box.high = wp.vec3(wp.max(child.high_x), wp.max(child.high_y), wp.max(child.high_z))
        node.low_x[c] = box.low[0]
        node.low_y[c] = box.low[1]
        node.low_z[c] = box.low[2]
        node.high_x[c] = box.high[0]
        node.high_y[c] = box.high[1]
        node.high_z[c] = box.high[2]
        whole = union(whole, box)
    nodes_inout[n] = node
    areas_out[n] = half_area(whole.low, whole.high)
