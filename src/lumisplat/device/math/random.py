"""Counter-based random numbers: a pure function of (pixel, sample, dimension, seed), identical on every device.

Each step mixes a counter, adds the result to the previous state, and mixes the sum. Mixing is the two-round permutation
of 32 bits that the hash prospector finds least biased (https://github.com/skeeto/hash-prospector,
[16 21f0aaad 15 d35a2d97 15]). A step is one-to-one in its counter, so that the samples of a pixel, the pixels of a
sample and the dimensions of a key never share a word. Adding the counter without mixing it first would be cheaper, but
counters that differ only in high bits would then give correlated words.

Bit operations are function calls instead of operators, so that the functions also run as plain Python.

The equations are in docs/method/random_numbers.md.
"""

import warp as wp

MULTIPLIER_1 = wp.constant(wp.uint32(0x21F0AAAD))
MULTIPLIER_2 = wp.constant(wp.uint32(0xD35A2D97))
ORIGIN = wp.constant(wp.uint32(0x6C756D69))
"""Initial state of the hash that makes all random keys: any number except 0, because ``mix`` maps 0 to 0."""

BITS_20 = wp.constant(wp.uint32(20))
BITS_16 = wp.constant(wp.uint32(16))
BITS_15 = wp.constant(wp.uint32(15))
BITS_12 = wp.constant(wp.uint32(12))
BITS_8 = wp.constant(wp.uint32(8))
BITS_4 = wp.constant(wp.uint32(4))
BITS_2 = wp.constant(wp.uint32(2))
LOW_4 = wp.constant(wp.uint32(15))
ONE = wp.constant(wp.uint32(1))
UNIT = wp.constant(wp.float32(2.0**-24))
KARRAS_1 = wp.constant(wp.uint32(0x6C50B47C))
KARRAS_2 = wp.constant(wp.uint32(0xB82F1E52))
KARRAS_3 = wp.constant(wp.uint32(0xC7AFE638))
KARRAS_4 = wp.constant(wp.uint32(0x8D22F6E6))

# Dimensions below 2^31 belong to Gaussians, by their index in the scene. Other dimensions count down from the last.
LENS_RADIUS = wp.constant(wp.uint32(0xFFFFFFFF))
"""Dimension of a sample's random number for the distance of the camera ray's origin from the lens centre."""
LENS_ANGLE = wp.constant(wp.uint32(0xFFFFFFFE))
"""Dimension of a sample's random number for the angle of the camera ray's origin around the lens centre."""
BRANCH_LAST = wp.constant(wp.uint32(0xFFFFFFFD))
"""Dimension from which the random key of branch 0 of a ray is drawn; branch n uses ``BRANCH_LAST - n``."""
CAPTURED_OR_RELIT = wp.constant(wp.uint32(0x80000000))
"""Dimension of the random number that decides whether a ray shows captured or relit splat sets.

It is the first dimension after those of the Gaussians.
"""


@wp.func
def mix(word: wp.uint32) -> wp.uint32:
    """Hashes a 32-bit word one-to-one, such that flipping an input bit flips about half of the output bits."""
    word = wp.bit_xor(word, wp.rshift(word, BITS_16)) * MULTIPLIER_1
    word = wp.bit_xor(word, wp.rshift(word, BITS_15)) * MULTIPLIER_2
    return wp.bit_xor(word, wp.rshift(word, BITS_15))


@wp.func
def pixel_key_of(pixel: int, seed: wp.uint32) -> wp.uint32:
    """Returns the key of the random numbers that all samples of a pixel share; ``pixel = y * width + x``."""
    return mix(mix(ORIGIN + mix(seed)) + mix(wp.uint32(pixel)))


@wp.func
def sample_key_of(pixel: int, sample: int, seed: wp.uint32) -> wp.uint32:
    """Returns the key of the random numbers of one sample of a pixel."""
    return mix(pixel_key_of(pixel, seed) + mix(wp.uint32(sample)))


@wp.func
def branch_key(sample_key: wp.uint32, branch: int) -> wp.uint32:
    """Returns the random key of branch ``branch`` of a ray, independent of the ray's own and of other branches.

    Branch 0 is the reflected and 1 the refracted ray; other numbers are for other uses.
    """
    return mix(sample_key + mix(BRANCH_LAST - wp.uint32(branch)))


@wp.func
def draw_mixed(sample_key: wp.uint32, mixed: wp.uint32) -> float:
    """Returns ``draw(sample_key, d)`` for the dimension d whose hash ``mix(d)`` is ``mixed``.

    ``mixed`` is computed once for the many keys that share the dimension.
    """
    return float(int(wp.rshift(mix(sample_key + mixed), BITS_8))) * UNIT


@wp.func
def draw(sample_key: wp.uint32, dimension: wp.uint32) -> float:
    """Draws a uniform random number in [0, 1), a multiple of 2^-24, by key and dimension.

    For numbers that belong to a Gaussian, the dimension is the Gaussian's index over all splat instances.
    """
    return draw_mixed(sample_key, mix(dimension))


@wp.func
def shuffled_16(k: wp.uint32, word: wp.uint32) -> wp.uint32:
    """Maps the number ``k``, 0..15, by a pseudo-random permutation of 0..15 that ``word`` selects.

    Each step of the computation is one-to-one modulo 16.
    """
    k = wp.bit_and(k * wp.bit_or(wp.rshift(word, BITS_4), ONE) + word, LOW_4)
    k = wp.bit_xor(k, wp.rshift(k, BITS_2))
    k = wp.bit_and(k * wp.bit_or(wp.rshift(word, BITS_12), ONE) + wp.rshift(word, BITS_8), LOW_4)
    k = wp.bit_xor(k, wp.rshift(k, ONE))
    return wp.bit_and(k + wp.rshift(word, BITS_16), LOW_4)


@wp.func
def draw_stratified(key: wp.uint32, sample: int, dimension: int) -> float:
    """Draws a stratified random number in [0, 1), a multiple of 2^-24.

    Among 16 consecutive samples of one key that begin with a multiple of 16, each sixteenth of the range receives one
    number. The numbers of different dimensions are independent.
    """
    word = mix(key + mix(wp.uint32(dimension)))
    stratum = wp.bit_and(wp.uint32(sample), LOW_4)
    within = wp.rshift(mix(word + mix(stratum)), BITS_12)
    return float(int(wp.lshift(shuffled_16(stratum, word), BITS_20) + within)) * UNIT


@wp.func
def swapped_bits(word: wp.uint32, mask: wp.uint32, shift: wp.uint32) -> wp.uint32:
    """Exchanges the bits of a word that ``mask`` selects with the bits that are ``shift`` positions above them."""
    return wp.bit_or(wp.lshift(wp.bit_and(word, mask), shift), wp.bit_and(wp.rshift(word, shift), mask))


@wp.func
def reversed_bits(word: wp.uint32) -> wp.uint32:
    """Reverses the order of the bits of a word."""
    word = swapped_bits(word, wp.uint32(0x0000FFFF), BITS_16)
    word = swapped_bits(word, wp.uint32(0x00FF00FF), BITS_8)
    word = swapped_bits(word, wp.uint32(0x0F0F0F0F), wp.uint32(4))
    word = swapped_bits(word, wp.uint32(0x33333333), wp.uint32(2))
    return swapped_bits(word, wp.uint32(0x55555555), wp.uint32(1))


@wp.func
def scrambled(word: wp.uint32, key: wp.uint32) -> wp.uint32:
    """Owen-scrambles a number; ``word`` and the result have its bits in reverse order (Laine and Karras 2011).

    Whether a bit flips depends on the key and on the lower bits of the word, which are the number's higher bits.
    """
    word = word + key
    word = wp.bit_xor(word, word * KARRAS_1)
    word = wp.bit_xor(word, word * KARRAS_2)
    word = wp.bit_xor(word, word * KARRAS_3)
    return wp.bit_xor(word, word * KARRAS_4)


@wp.func
def second_sobol(index: wp.uint32) -> wp.uint32:
    """Returns point ``index`` of the second Sobol dimension as 32 bits in reverse order.

    Bit j of the point is a sum, modulo 2, of bits of the index: of each bit k for which the binomial coefficient of k
    over j is odd. By Lucas's theorem, these are the k whose binary digits include the digits of j. The sums are
    therefore formed in five steps, one for each binary digit of k.
    """
    index = wp.bit_xor(index, wp.rshift(index, BITS_16))
    index = wp.bit_xor(index, wp.bit_and(wp.rshift(index, BITS_8), wp.uint32(0x00FF00FF)))
    index = wp.bit_xor(index, wp.bit_and(wp.rshift(index, BITS_4), wp.uint32(0x0F0F0F0F)))
    index = wp.bit_xor(index, wp.bit_and(wp.rshift(index, BITS_2), wp.uint32(0x33333333)))
    return wp.bit_xor(index, wp.bit_and(wp.rshift(index, ONE), wp.uint32(0x55555555)))


@wp.func
def sobol_2d(key: wp.uint32, sample: int) -> wp.vec2:
    """Returns point ``sample`` of a low-discrepancy sequence in the unit square; each key has its own sequence.

    The first two Sobol dimensions are shuffled and scrambled (Burley 2020, Practical Hash-based Owen Scrambling). Any
    2^n consecutive points that start at a multiple of 2^n are stratified, and sequences of different keys are
    practically independent.
    """
    key = mix(key)
    index = reversed_bits(scrambled(reversed_bits(wp.uint32(sample)), key))
    key = mix(key + wp.uint32(1))
    x = reversed_bits(scrambled(index, key))
    y = reversed_bits(scrambled(second_sobol(index), mix(key + wp.uint32(1))))
    return wp.vec2(float(int(wp.rshift(x, BITS_8))) * UNIT, float(int(wp.rshift(y, BITS_8))) * UNIT)
