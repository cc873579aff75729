"""Kernel that tabulates reflection lobes of rough dielectrics (docs/method/delighting.md#roughness).

Each thread integrates one roughness, one view and one bin of incident directions over the bin's samples.
"""

import warp as wp

from lumisplat.device.material.microfacets import diffuse_factor, highlight_factor
from lumisplat.device.math.directions import PI

wp.set_module_options({"enable_backward": False})


@wp.kernel
def tabulate_lobes(
    start: int,
    spread: float,
    roughness: wp.array[float],
    views: wp.array[wp.vec3],
    samples: wp.array2d[wp.vec3],
    matt_out: wp.array[float],
    highlight_out: wp.array[float],
):
    """Tabulates a surface's diffuse and specular radiance over the irradiance / pi from a bin of directions.

    The surface has albedo 1 and normal z.

    Args:
        start: Index of the combination of roughness, view and bin that thread 0 handles.
        spread: Number added to alpha^2 of the highlights' GGX lobes, so that no lobe falls between two samples.
        roughness: Roughness of R surfaces, (R,).
        views: M unit view directions, (M,).
        samples: S directions in each of Q bins, (Q, S).
        matt_out: Diffuse radiance, (R * M * Q,).
        highlight_out: Specular radiance, (R * M * Q,).
    """
    i = start + wp.tid()
    bins = samples.shape[0]
    view = views[(i // bins) % views.shape[0]]
    rough = roughness[i // (bins * views.shape[0])]
    alpha = rough * rough
    normal = wp.vec3(0.0, 0.0, 1.0)
    matt = float(0.0)
    highlight = float(0.0)
    arriving = float(0.0)
    for k in range(samples.shape[1]):
        direction = samples[i % bins, k]
        arriving += direction[2]
        matt += direction[2] * diffuse_factor(view[2], direction[2], alpha)
        highlight += direction[2] * highlight_factor(normal, view, direction, wp.sqrt(alpha * alpha + spread))
    matt_out[i] = PI * matt / arriving
    highlight_out[i] = PI * highlight / arriving
