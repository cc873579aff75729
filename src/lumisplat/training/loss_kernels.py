"""L1 and SSIM loss between a frame and a training image, and its gradient with respect to the frame's pixels.

A thread works on a run of consecutive pixels of a row: the whole row on CPUs, where loops become vector instructions,
and one pixel on CUDA.

SSIM is that of Wang et al. 2004 with a Gaussian window of 11 pixels. Images are mirrored at their borders
(d c b a | a b c d), which makes the blur its own adjoint. The equations are in docs/method/training.md.
"""

import math

import warp as wp

from lumisplat.constants import FUSED_FLAGS, SSIM_SIGMA_PX, SSIM_WINDOW_PX
from lumisplat.device.training import LossGrid, LossMaps, LossWeights, TargetImage, masked_color, pixel_weight

wp.set_module_options({"enable_backward": False, "max_unroll": 16, "cpu_compiler_flags": FUSED_FLAGS})

SSIM_C1 = 0.01**2

SSIM_C2 = 0.03**2
"""Second stabilisation constant of SSIM for images in 0..1 (Wang et al. 2004, section III-C)."""

COVERED_MIN = 1e-6
"""Alpha is clamped to this number and 1 minus it in the cross entropy, whose logarithm would be infinite at 0 and 1.
Gao et al. 2024, code."""

TAPS = wp.constant(SSIM_WINDOW_PX)
REACH = wp.constant(SSIM_WINDOW_PX // 2)
C1 = wp.constant(wp.float32(SSIM_C1))
C2 = wp.constant(wp.float32(SSIM_C2))
COVERED_LEAST = wp.constant(wp.float32(COVERED_MIN))

_RAW = [math.exp(-0.5 * ((k - SSIM_WINDOW_PX // 2) / SSIM_SIGMA_PX) ** 2) for k in range(SSIM_WINDOW_PX)]
WINDOW = wp.constant(wp.types.vector(length=SSIM_WINDOW_PX, dtype=wp.float32)(*(weight / sum(_RAW) for weight in _RAW)))


@wp.func
def mirrored(x: int, size: int) -> int:
    """Returns a pixel's column or row, mirrored at the borders of an image with ``size`` columns or rows."""
    if x < 0:
        x = -1 - x
    if x >= size:
        x = 2 * size - 1 - x
    return wp.clamp(x, 0, size - 1)


@wp.func
def sign(x: float) -> float:
    """Returns the derivative of the absolute value: 0 at 0, where Warp's sign is 1."""
    return wp.where(x > 0.0, 1.0, wp.where(x < 0.0, -1.0, 0.0))


@wp.func
def entropy(alpha: float, wanted: float) -> float:
    """Returns the binary cross entropy between rendered and target alpha (Gao et al. 2024, code)."""
    a = wp.clamp(alpha, COVERED_LEAST, 1.0 - COVERED_LEAST)
    return -(wanted * wp.log(a) + (1.0 - wanted) * wp.log(1.0 - a))


@wp.func
def entropy_derivative(alpha: float, wanted: float) -> float:
    """Returns the derivative of `entropy` with respect to the rendered alpha; 0 where that alpha is clamped."""
    if alpha < COVERED_LEAST or alpha > 1.0 - COVERED_LEAST:
        return 0.0
    return (alpha - wanted) / (alpha * (1.0 - alpha))


@wp.func
def run_of(item: int, grid: LossGrid):
    """Returns the row, first column and end column (exclusive) of the run of pixels that thread ``item`` works on."""
    runs = (grid.width + grid.run - 1) // grid.run
    left = (item % runs) * grid.run
    return item // runs, left, wp.min(left + grid.run, grid.width)


@wp.kernel
def blur_rows(start: int, grid: LossGrid, color: wp.array[wp.vec3], target: TargetImage, maps_out: LossMaps):
    """Blurs the two images, their squares and their product along rows, for SSIM. One thread per run of pixels."""
    y, left, right = run_of(start + wp.tid(), grid)
    width = grid.width
    row = y * width
    for x in range(left, right):
        shown = wp.vec3(0.0)
        squared = wp.vec3(0.0)
        product = wp.vec3(0.0)
        wanted = wp.vec3(0.0)
        wanted_squared = wp.vec3(0.0)
        for k in range(TAPS):
            i = row + mirrored(x + k - REACH, width)
            p = masked_color(color[i], target, i)
            q = target.color[i]
            w = WINDOW[k]
            shown += w * p
            squared += w * wp.cw_mul(p, p)
            product += w * wp.cw_mul(p, q)
            wanted += w * q
            wanted_squared += w * wp.cw_mul(q, q)
        maps_out.shown[row + x] = shown
        maps_out.squared[row + x] = squared
        maps_out.product[row + x] = product
        maps_out.target[row + x] = wanted
        maps_out.target_squared[row + x] = wanted_squared


@wp.kernel
def compare_rows(start: int, grid: LossGrid, maps: LossMaps, maps_out: LossMaps, ssim_out: wp.array[float]):
    """Computes SSIM, and its derivatives with respect to blurred values, squares and products. One thread per run.

    A run is consecutive pixels of a row. The maps that `blur_rows` blurred along rows are blurred along columns first.
    The SSIM is summed over the run.
    """
    item = start + wp.tid()
    y, left, right = run_of(item, grid)
    width = grid.width
    total = float(0.0)
    for x in range(left, right):
        mp = wp.vec3(0.0)
        pp = wp.vec3(0.0)
        pq = wp.vec3(0.0)
        mq = wp.vec3(0.0)
        qq = wp.vec3(0.0)
        for k in range(TAPS):
            i = mirrored(y + k - REACH, grid.height) * width + x
            w = WINDOW[k]
            mp += w * maps.shown[i]
            pp += w * maps.squared[i]
            pq += w * maps.product[i]
            mq += w * maps.target[i]
            qq += w * maps.target_squared[i]
        by_mean = wp.vec3(0.0)
        by_square = wp.vec3(0.0)
        by_product = wp.vec3(0.0)
        for c in range(3):
            a = 2.0 * mp[c] * mq[c] + C1
            b = 2.0 * (pq[c] - mp[c] * mq[c]) + C2
            d = mp[c] * mp[c] + mq[c] * mq[c] + C1
            e = pp[c] - mp[c] * mp[c] + qq[c] - mq[c] * mq[c] + C2
            s = a * b / (d * e)
            total += s
            by_square[c] = -s / e
            by_product[c] = 2.0 * a / (d * e)
            by_mean[c] = 2.0 * mq[c] * (b - a) / (d * e) + 2.0 * mp[c] * s * (1.0 / e - 1.0 / d)
        i = y * width + x
        maps_out.shown[i] = by_mean
        maps_out.squared[i] = by_square
        maps_out.product[i] = by_product
    ssim_out[item] = total


@wp.kernel
def spread_rows(start: int, grid: LossGrid, maps: LossMaps, maps_out: LossMaps):
    """Blurs the derivatives of SSIM along rows, as the adjoint of `blur_rows`. One thread per run of pixels."""
    y, left, right = run_of(start + wp.tid(), grid)
    width = grid.width
    row = y * width
    for x in range(left, right):
        by_mean = wp.vec3(0.0)
        by_square = wp.vec3(0.0)
        by_product = wp.vec3(0.0)
        for k in range(TAPS):
            i = row + mirrored(x + k - REACH, width)
            w = WINDOW[k]
            by_mean += w * maps.shown[i]
            by_square += w * maps.squared[i]
            by_product += w * maps.product[i]
        maps_out.shown[row + x] = by_mean
        maps_out.squared[row + x] = by_square
        maps_out.product[row + x] = by_product


@wp.kernel
def differentiate_rows(
    start: int,
    grid: LossGrid,
    loss_weights: wp.array[LossWeights],
    color: wp.array[wp.vec3],
    alpha: wp.array[float],
    target: TargetImage,
    maps: LossMaps,
    by_color_out: wp.array[wp.vec3],
    by_alpha_out: wp.array[float],
    sums_out: wp.array[wp.vec4],
):
    """Writes the loss gradient of each pixel of a run, and the run's sums of four error terms. One thread per run.

    A run is consecutive pixels of a row. The terms are L1, squared error, absolute alpha error and cross entropy of
    alpha.
    """
    item = start + wp.tid()
    y, left, right = run_of(item, grid)
    width = grid.width
    weights = loss_weights[0]
    sums = wp.vec4(0.0)
    for x in range(left, right):
        by_mean = wp.vec3(0.0)
        by_square = wp.vec3(0.0)
        by_product = wp.vec3(0.0)
        for k in range(TAPS):
            i = mirrored(y + k - REACH, grid.height) * width + x
            w = WINDOW[k]
            by_mean += w * maps.shown[i]
            by_square += w * maps.squared[i]
            by_product += w * maps.product[i]
        i = y * width + x
        q = target.color[i]
        p = masked_color(color[i], target, i)
        by_ssim = by_mean + 2.0 * wp.cw_mul(p, by_square) + wp.cw_mul(q, by_product)
        share = pixel_weight(target, i)
        error = color[i] - q
        gradient = weights.l1 * wp.vec3(sign(error[0]), sign(error[1]), sign(error[2])) - weights.ssim * by_ssim
        by_color_out[i] = share * gradient
        magnitude = wp.abs(error[0]) + wp.abs(error[1]) + wp.abs(error[2])
        sums += share * wp.vec4(magnitude, wp.dot(error, error), 0.0, 0.0)
        by_alpha_out[i] = 0.0
        if target.alpha.shape[0] > 0:
            missed = alpha[i] - target.alpha[i]
            wanted = target.alpha[i]
            by_alpha = weights.alpha * sign(missed) + weights.entropy * entropy_derivative(alpha[i], wanted)
            by_alpha_out[i] = share * by_alpha
            sums[2] = sums[2] + share * wp.abs(missed)
            sums[3] = sums[3] + share * entropy(alpha[i], wanted)
    sums_out[item] = sums


@wp.kernel
def add_rows(
    start: int,
    grid: LossGrid,
    ssim: wp.array[float],
    sums: wp.array[wp.vec4],
    rows_out: wp.array[float],
):
    """Adds the error sums of all pixel runs of a row: SSIM, and the four of `differentiate_rows`. One thread per row.

    A row's five sums are consecutive elements.
    """
    y = start + wp.tid()
    runs = (grid.width + grid.run - 1) // grid.run
    total = float(0.0)
    totals = wp.vec4(0.0)
    for i in range(y * runs, (y + 1) * runs):
        total += ssim[i]
        totals += sums[i]
    rows_out[5 * y] = total
    for k in range(4):
        rows_out[5 * y + 1 + k] = totals[k]
