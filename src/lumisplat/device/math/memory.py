"""Memory helpers for kernels: aligned struct access, arrays on a thread's stack, and sums over CUDA warps."""

from typing import Any

import warp as wp

# --- Structs of whole 16-byte words, which CUDA reads and writes by wide accesses ---
#
# Warp declares structs with the alignment of their members, and compilers may not assume more. The arrays here come
# from allocators that align memory to at least 64 bytes, and are never sliced. On CPUs these are plain accesses.

_ELEMENT = "*static_cast<decltype(items.data)>(__builtin_assume_aligned(items.data + i, 16))"


def _on_cuda(wide: str, plain: str) -> str:
    """Returns C++ code that runs the statement ``wide`` on CUDA and ``plain`` on CPUs."""
    check = 'static_assert(sizeof(item) % 16 == 0, "the size of this struct must be a multiple of 16 bytes");'
    return f"{check}\n#if defined(__CUDA_ARCH__)\n{wide};\n#else\n{plain};\n#endif\n"


def aligned_load_of(struct_type: Any) -> Any:
    """Builds a function that reads element i of a struct array into a variable, on CUDA by wide aligned accesses."""

    @wp.func_native(_on_cuda(f"item = {_ELEMENT}", "item = items.data[i]"))
    def load_aligned(items: wp.array[struct_type], i: int, item: wp.ref[struct_type]): ...

    return load_aligned


def aligned_store_of(struct_type: Any) -> Any:
    """Builds a function that writes a variable to element i of a struct array, on CUDA by wide aligned accesses."""

    @wp.func_native(_on_cuda(f"{_ELEMENT} = item", "items.data[i] = item"))
    def store_aligned(items: wp.array[struct_type], i: int, item: wp.ref[struct_type]): ...

    return store_aligned


def prefetch_of(struct_type: Any) -> Any:
    """Builds a function that makes a CPU fetch element i of a struct array into its cache; on CUDA, it does nothing."""

    @wp.func_native("#if !defined(__CUDA_ARCH__)\n__builtin_prefetch(items.data + i);\n#endif\n")
    def prefetch(items: wp.array[struct_type], i: int): ...

    return prefetch


# --- Indices ---


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    __builtin_assume(i >= 0);
#endif
    return i;
""")
def from_zero(i: int) -> int:
    """Returns ``i`` and promises that it is not negative: Warp's arrays then skip their test for negative indices."""
    ...


# --- Arrays of constant size on the stack of a thread, which functions can share ---
#
# Warp passes vectors by value, and copies a vector of a struct to read one element. Functions therefore share arrays
# that are stored in a local variable of the kernel: ``wp.array(ptr=wp.address_of(variable), ...)``. Warp's own local
# arrays, from ``wp.zeros``, hide their memory from the optimiser, and kernels take twice as long.


def storage_of(struct_type: Any, count: int) -> Any:
    """Returns a vector type for a kernel's local variable with room for ``count`` structs, aligned to 4 bytes."""
    return wp.types.vector(length=count * wp.types.type_size_in_bytes(struct_type) // 4, dtype=wp.int32)


# --- Sums over the threads of each CUDA warp, in shared memory, without barriers ---
#
# ``wp.tile_sum`` sums over whole thread blocks, with barriers and an atomic count for each sum. Here each warp has its
# own element in the row of each of many sums; after one barrier, the block reads the rows and adds the warps' parts in
# order.

_DECLARED = """
    constexpr int LENGTH = {length}, WARPS = {warps}, STRIDE = {rows} + 1;  // elements of a sum lie in different banks
"""

_MEMORY = (
    _DECLARED
    + """
#if defined(__CUDA_ARCH__)
    __shared__ float sums[WARPS * LENGTH * STRIDE];
#else
    static float sums[WARPS * LENGTH * STRIDE];
#endif
    return reinterpret_cast<wp::uint64>(sums);
"""
)

_EXCHANGES = "".join(
    f"""
        #pragma unroll
        for (int i = 0; i < {half}; ++i) {{
            const float low = v[i], high = v[i + {half}];
            const bool upper = lane & {2 * half};
            v[i] = (upper ? high : low) + __shfl_xor_sync(all, upper ? low : high, {2 * half});
        }}
"""
    for half in (8, 4, 2, 1)
)

_ADD = (
    _DECLARED
    + """
    const int lane = WP_TILE_THREAD_IDX % 32, warp = WP_TILE_THREAD_IDX / 32;
    float* out = reinterpret_cast<float*>(memory) + warp * LENGTH * STRIDE + row;
#if defined(__CUDA_ARCH__)
    const unsigned all = 0xffffffffu;
    if (__any_sync(all, has_part)) {
        float v[16];
        #pragma unroll
        for (int i = 0; i < 16; ++i)
            v[i] = has_part && i < LENGTH ? part[i] : 0.0f;
        // Lanes exchange halves until each pair of lanes holds all terms of one element.
        EXCHANGES
        const float total = v[0] + __shfl_xor_sync(all, v[0], 1);
        if (lane % 2 == 0 && lane / 2 < LENGTH)
            out[(lane / 2) * STRIDE] = total;
    } else if (lane < LENGTH) {
        out[lane * STRIDE] = 0.0f;
    }
#else
    static float parts[WARPS * 32][LENGTH];
    for (int i = 0; i < LENGTH; ++i)
        parts[WP_TILE_THREAD_IDX][i] = has_part ? part[i] : 0.0f;
    WP_TILE_SYNC();
    if (lane < LENGTH) {
        out[lane * STRIDE] = 0.0f;
        for (int other = 0; other < 32; ++other)
            out[lane * STRIDE] += parts[warp * 32 + other][lane];
    }
    WP_TILE_SYNC();
#endif
"""
).replace("EXCHANGES", _EXCHANGES)

_READ = (
    _DECLARED
    + """
    const float* sums = reinterpret_cast<const float*>(memory) + row;
    for (int i = 0; i < LENGTH; ++i) {
        total[i] = 0.0f;
        for (int warp = 0; warp < WARPS; ++warp)
            total[i] += sums[(warp * LENGTH + i) * STRIDE];
    }
"""
)


def warp_sums(vector: Any, warps: int, rows: int) -> tuple[Any, Any]:
    """Builds functions that sum vectors over the 32 threads of each CUDA warp, in shared memory, without barriers.

    Args:
        vector: Warp type of the summed vectors, at most 16 float32.
        warps: CUDA warps in a thread block.
        rows: Number of sums stored at a time.

    Returns:
        ``add_up(row, part, has_part)``, which all threads of the block call with the same rows (CUDA warps may run
        ahead of each other), and ``sum_of(row)``, which any thread may call after a block barrier.
    """

    def filled(snippet: str) -> str:
        sizes = {"length": vector._length_, "warps": warps, "rows": rows}
        for name, size in sizes.items():
            snippet = snippet.replace("{" + name + "}", str(size))
        return snippet

    @wp.func_native(filled(_MEMORY))
    def sums_of_block() -> wp.uint64: ...

    @wp.func_native(filled(_ADD))
    def add_to_row(memory: wp.uint64, row: int, part: vector, has_part: bool): ...

    @wp.func_native(filled(_READ))
    def read_row(memory: wp.uint64, row: int, total: wp.ref[vector]): ...

    @wp.func
    def add_up(row: int, part: vector, has_part: bool):
        add_to_row(sums_of_block(), row, part, has_part)

    @wp.func
    def sum_of(row: int) -> vector:
        total = vector()
        read_row(sums_of_block(), row, total)
        return total

    return add_up, sum_of
