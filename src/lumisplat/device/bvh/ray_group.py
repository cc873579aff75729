"""Threads of a CUDA warp that traverse the trees in step, as the lanes of a packet do on a CPU.

A group is a mask of the warp's lanes, of rays that start and point alike. Whatever its threads decide together follows
from numbers that they have agreed on here, so that all of them go the same way. A thread alone is the group 0; on CPUs
all are.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


GROUP_MIN = 8
"""Fewer rays than these go alone: what they would visit together is more than what they share."""


def _on_cuda(code: str, otherwise: str) -> str:
    """A body for CUDA, and a statement for CPUs."""
    return f"#if defined(__CUDA_ARCH__)\n{code}\n#else\n{otherwise}\n#endif\n"


_GROUP = """
const unsigned all = __activemask(), self = 1u << (threadIdx.x & 31);
unsigned waiting = all, group = 0;
while (waiting) {
    const int leader = __ffs(waiting) - 1;
    float apart = 0.0f, bend = 0.0f;
    for (int k = 0; k < 3; ++k) {
        const float from_origin = origin[k] - __shfl_sync(all, origin[k], leader);
        const float from_direction = direction[k] - __shfl_sync(all, direction[k], leader);
        apart += from_origin * from_origin;
        bend += from_direction * from_direction;
    }
    const bool is_alike = apart <= radius * radius && bend <= spread * spread;
    const unsigned taken = waiting & (__ballot_sync(all, is_alike) | 1u << leader);
    if (taken & self) group = taken;
    waiting &= ~taken;
}
return __popc(group) < GROUP_MIN ? 0 : static_cast<int>(group);
"""

# Floats in the order of integers: the hardware finds the largest of these in one instruction, from sm_80 on.
_LARGEST = """
if (group == 0) return number;
#if __CUDA_ARCH__ >= 800
const int bits = __float_as_int(number);
const int most = __reduce_max_sync(static_cast<unsigned>(group), bits < 0 ? bits ^ 0x7fffffff : bits);
return __int_as_float(most < 0 ? most ^ 0x7fffffff : most);
#else
float most = number;
for (unsigned rest = static_cast<unsigned>(group); rest; rest &= rest - 1)
    most = fmaxf(most, __shfl_sync(static_cast<unsigned>(group), number, __ffs(rest) - 1));
return most;
#endif
"""


@wp.func_native(_on_cuda(_GROUP.replace("GROUP_MIN", str(GROUP_MIN)), "return 0;"))
def group_of(origin: wp.vec3, direction: wp.vec3, radius: float, spread: float) -> int:
    """The group of a thread's ray: those of its warp of which a first one differs at most by these.

    All threads of the warp that have a ray call it together.
    """
    ...


@wp.func_native(_on_cuda(_LARGEST, "return number;"))
def largest_of(group: int, number: float) -> float:
    """The largest of the numbers of a group's threads, which all call it."""
    ...


@wp.func
def least_of(group: int, number: float) -> float:
    """The least of them."""
    return -largest_of(group, -number)


@wp.func
def largest_vector(group: int, numbers: wp.vec3) -> wp.vec3:
    """The largest of them, component by component."""
    return wp.vec3(largest_of(group, numbers[0]), largest_of(group, numbers[1]), largest_of(group, numbers[2]))


@wp.func
def least_vector(group: int, numbers: wp.vec3) -> wp.vec3:
    """The least of them, component by component."""
    return -largest_vector(group, -numbers)
