"""Optimiser step: applies Adam to the parameters, and converts parameters to the Gaussians that are rendered.

A step that cannot be completed, because a tile list was too short or the loss is not finite, sets ``stopped``. Then it
and all later steps change nothing, until the host has read that and repeats them.
"""

import warp as wp

from lumisplat.constants import ADAM_BETA_1, ADAM_BETA_2, ADAM_EPSILON, DEAD_OPACITY, FUSED_FLAGS
from lumisplat.device.math.random import draw, sample_key_of
from lumisplat.device.structs.gradients import GaussianGradient, SplatGradient
from lumisplat.device.structs.raster import TileRect
from lumisplat.device.structs.scene import GaussianData
from lumisplat.device.training import SplatParameters, SplatRecord, StepRates

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FUSED_FLAGS})

# Markov chain Monte Carlo (Kheradmand et al. 2024; values of gsplat)

NOISE_SLOPE = 100.0
"""Slope of the sigmoid over opacity that fades the MCMC noise out above `DEAD_OPACITY`."""

BETA_1 = wp.constant(wp.float32(ADAM_BETA_1))
BETA_2 = wp.constant(wp.float32(ADAM_BETA_2))
EPSILON = wp.constant(wp.float32(ADAM_EPSILON))
OPACITY_MIN = wp.constant(wp.float32(DEAD_OPACITY))
SLOPE = wp.constant(wp.float32(NOISE_SLOPE))
TWO_PI = wp.constant(wp.float32(6.283185307179586))


@wp.func
def sigmoid(x: float) -> float:
    """Maps a logit to 0..1."""
    return 1.0 / (1.0 + wp.exp(-x))


@wp.func
def step_of(rates: StepRates, rate: float, first: float, second: float) -> float:
    """Returns how much one Adam step subtracts from a parameter, with bias correction.

    Args:
        rates: Bias corrections of the step.
        rate: Learning rate of the parameter.
        first: First moment of the parameter's gradient.
        second: Second moment of the parameter's gradient.
    """
    return rate * first * rates.first_scale / (wp.sqrt(second * rates.second_scale) + EPSILON)


@wp.func
def step3_of(rates: StepRates, rate: float, first: wp.vec3, second: wp.vec3) -> wp.vec3:
    """Returns how much one Adam step subtracts from a parameter with three components; see ``step_of``."""
    return wp.vec3(
        step_of(rates, rate, first[0], second[0]),
        step_of(rates, rate, first[1], second[1]),
        step_of(rates, rate, first[2], second[2]),
    )


@wp.func
def wxyz_of(rotation: wp.quat) -> wp.vec4:
    """Reorders a Warp quaternion, scalar last, to the scalar-first order of the parameters."""
    return wp.vec4(rotation[3], rotation[0], rotation[1], rotation[2])


@wp.kernel
def activate(start: int, parameters: SplatParameters, gaussians_out: GaussianData):
    """Computes rotation, scale and opacity of each Gaussian from its trained parameters. One thread per Gaussian.

    Means and SH coefficients need no conversion: the rendered Gaussians share the parameters' arrays.
    """
    i = start + wp.tid()
    q = wp.normalize(parameters.rotations[i])
    s = parameters.log_scales[i]
    gaussians_out.rotations[i] = wp.quat(q[1], q[2], q[3], q[0])
    gaussians_out.scales[i] = wp.vec3(wp.exp(s[0]), wp.exp(s[1]), wp.exp(s[2]))
    gaussians_out.opacities[i] = sigmoid(parameters.logits[i])


@wp.kernel
def check_step(
    start: int,
    totals: wp.array[wp.int64],
    limits: wp.array[wp.int64],
    loss_rows_inout: wp.array[float],
    stopped_out: wp.array[int],
):
    """Stops the training if a list was too short or the loss is not finite. One thread per row of the image.

    ``totals`` and ``limits`` are those of `Binning`. The loss of a step with a short list becomes NaN, so that the host
    recognises it.
    """
    y = start + wp.tid()
    for k in range(5):
        if not wp.isfinite(loss_rows_inout[5 * y + k]):
            stopped_out[0] = 1
    if y == 0:
        for k in range(totals.shape[0]):
            if totals[k] > limits[k]:
                loss_rows_inout[0] = wp.NAN
                stopped_out[0] = 1


@wp.kernel
def update(
    start: int,
    step_rates: wp.array[StepRates],
    stopped: wp.array[int],
    gradient: GaussianGradient,
    gaussians: GaussianData,
    parameters_inout: SplatParameters,
    first_inout: SplatParameters,
    second_inout: SplatParameters,
):
    """Converts the gradient of Gaussians to that of parameters, and makes an Adam step. One thread per Gaussian."""
    i = start + wp.tid()
    if stopped[0] != 0:
        return
    rates = step_rates[0]

    by_mean = gradient.means[i]
    m = BETA_1 * first_inout.means[i] + (1.0 - BETA_1) * by_mean
    v = BETA_2 * second_inout.means[i] + (1.0 - BETA_2) * wp.cw_mul(by_mean, by_mean)
    first_inout.means[i] = m
    second_inout.means[i] = v
    parameters_inout.means[i] = parameters_inout.means[i] - step3_of(rates, rates.means, m, v)

    raw = parameters_inout.rotations[i]
    by_rotation = wxyz_of(gradient.rotations[i]) / wp.length(raw)
    m4 = BETA_1 * first_inout.rotations[i] + (1.0 - BETA_1) * by_rotation
    v4 = BETA_2 * second_inout.rotations[i] + (1.0 - BETA_2) * wp.cw_mul(by_rotation, by_rotation)
    first_inout.rotations[i] = m4
    second_inout.rotations[i] = v4
    for k in range(4):
        raw[k] = raw[k] - step_of(rates, rates.rotations, m4[k], v4[k])
    parameters_inout.rotations[i] = raw

    by_log_scale = wp.cw_mul(gradient.scales[i] + wp.vec3(rates.by_scale), gaussians.scales[i])
    m = BETA_1 * first_inout.log_scales[i] + (1.0 - BETA_1) * by_log_scale
    v = BETA_2 * second_inout.log_scales[i] + (1.0 - BETA_2) * wp.cw_mul(by_log_scale, by_log_scale)
    first_inout.log_scales[i] = m
    second_inout.log_scales[i] = v
    parameters_inout.log_scales[i] = parameters_inout.log_scales[i] - step3_of(rates, rates.log_scales, m, v)

    opacity = gaussians.opacities[i]
    by_logit = (gradient.opacities[i] + rates.by_opacity) * opacity * (1.0 - opacity)
    m1 = BETA_1 * first_inout.logits[i] + (1.0 - BETA_1) * by_logit
    v1 = BETA_2 * second_inout.logits[i] + (1.0 - BETA_2) * by_logit * by_logit
    first_inout.logits[i] = m1
    second_inout.logits[i] = v1
    parameters_inout.logits[i] = parameters_inout.logits[i] - step_of(rates, rates.logits, m1, v1)

    for k in range(rates.sh_active):
        j = i * parameters_inout.sh_count + k
        by_sh = gradient.sh[j]
        m = BETA_1 * first_inout.sh[j] + (1.0 - BETA_1) * by_sh
        v = BETA_2 * second_inout.sh[j] + (1.0 - BETA_2) * wp.cw_mul(by_sh, by_sh)
        first_inout.sh[j] = m
        second_inout.sh[j] = v
        rate = wp.where(k == 0, rates.sh, rates.sh_rest)
        parameters_inout.sh[j] = parameters_inout.sh[j] - step3_of(rates, rate, m, v)


@wp.func
def standard_normal(key: wp.uint32) -> wp.vec3:
    """Returns three independent standard normal random numbers (Box and Muller 1958)."""
    radius = wp.sqrt(-2.0 * wp.log(1.0 - draw(key, wp.uint32(0))))
    other = wp.sqrt(-2.0 * wp.log(1.0 - draw(key, wp.uint32(1))))
    angle = TWO_PI * draw(key, wp.uint32(2))
    return wp.vec3(radius * wp.cos(angle), radius * wp.sin(angle), other * wp.cos(TWO_PI * draw(key, wp.uint32(3))))


@wp.kernel
def explore(
    start: int,
    rates: wp.array[StepRates],
    seed: wp.uint32,
    stopped: wp.array[int],
    gaussians: GaussianData,
    parameters_inout: SplatParameters,
):
    """Moves each mean by MCMC noise, normal with the Gaussian's covariance. One thread per Gaussian.

    The noise grows with transparency: opaque Gaussians stay nearly in place.
    """
    i = start + wp.tid()
    if stopped[0] != 0:
        return
    gate = rates[0].noise * sigmoid(SLOPE * (OPACITY_MIN - gaussians.opacities[i]))
    if gate > 0.0:
        axes = wp.quat_to_matrix(gaussians.rotations[i]) * wp.diag(gaussians.scales[i])
        step = axes * (wp.transpose(axes) * standard_normal(sample_key_of(i, rates[0].iteration, seed)))
        parameters_inout.means[i] = parameters_inout.means[i] + gate * step


@wp.kernel
def add_screen_gradients(
    start: int,
    half_size: wp.vec2,
    rects: wp.array[TileRect],
    gradients: wp.array[SplatGradient],
    record_inout: SplatRecord,
):
    """Adds the frame's screen-space position gradient to the densification statistics. One thread per Gaussian."""
    i = start + wp.tid()
    if record_inout.stopped[0] == 0 and rects[i].x0 < rects[i].x1:
        screen_gradient = gradients[i].center_absolute
        record_inout.motion[i] = record_inout.motion[i] + wp.length(wp.cw_mul(screen_gradient, half_size))
        record_inout.frames[i] = record_inout.frames[i] + 1.0
