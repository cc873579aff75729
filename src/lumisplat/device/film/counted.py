"""What counts of a photograph, and of the frame that is compared with it."""

import warp as wp

from lumisplat.device.structs.training import Photograph

wp.set_module_options({"enable_backward": False})


@wp.func
def share_of(photograph: Photograph, i: int) -> float:
    """How much a pixel counts, 0..1."""
    if photograph.weight.shape[0] > 0:
        return photograph.weight[i]
    return 1.0


@wp.func
def counted(shown: wp.vec3, photograph: Photograph, i: int) -> wp.vec3:
    """What a frame shows where it counts, the photograph elsewhere."""
    return wp.lerp(photograph.color[i], shown, share_of(photograph, i))
