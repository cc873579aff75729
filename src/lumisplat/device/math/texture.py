"""Texture lookup, bilinear: colours, and alpha. (0, 0) is the texture's top left corner."""

import warp as wp

from lumisplat.device.structs.scene import WRAP_CLAMP, WRAP_REPEAT, TextureData

wp.set_module_options({"enable_backward": False})

BYTE = wp.constant(wp.uint32(255))


@wp.func
def texel_color(texels: wp.array[wp.uint32], value_of_byte: wp.array[float], index: int) -> wp.vec3:
    """Colour of one RGBA8 texel, red in the low byte; ``value_of_byte`` decodes its channels."""
    rgba = texels[index]
    return wp.vec3(
        value_of_byte[int(rgba & BYTE)],
        value_of_byte[int((rgba >> wp.uint32(8)) & BYTE)],
        value_of_byte[int((rgba >> wp.uint32(16)) & BYTE)],
    )


@wp.func
def texel_alpha(texels: wp.array[wp.uint32], index: int) -> float:
    """Alpha of one RGBA8 texel, 0..1."""
    return float(int(texels[index] >> wp.uint32(24))) / 255.0


@wp.func
def wrapped(x: float, mode: int) -> float:
    """A coordinate within the texture, 0..1."""
    if mode == WRAP_REPEAT:
        return x - wp.floor(x)
    if mode == WRAP_CLAMP:
        return wp.clamp(x, 0.0, 1.0)
    return 1.0 - wp.abs(x - 2.0 * wp.floor(0.5 * x) - 1.0)


@wp.func
def neighbour(k: int, size: int, mode: int) -> int:
    """The texel next to an edge, ``k`` from -1 to ``size``: across it in the same texture, or that at the edge."""
    if mode == WRAP_REPEAT:
        return (k + size) % size
    return wp.clamp(k, 0, size - 1)


@wp.func
def texel_window(texture: TextureData, uv: wp.vec2) -> wp.vec4i:
    """Indices of the four texels around ``uv``: the upper two from left to right, then the lower ones."""
    x0 = int(wp.floor(wrapped(uv[0], texture.wrap_u) * float(texture.width) - 0.5))
    y0 = int(wp.floor(wrapped(uv[1], texture.wrap_v) * float(texture.height) - 0.5))
    left = neighbour(x0, texture.width, texture.wrap_u)
    right = neighbour(x0 + 1, texture.width, texture.wrap_u)
    row0 = texture.first + neighbour(y0, texture.height, texture.wrap_v) * texture.width
    row1 = texture.first + neighbour(y0 + 1, texture.height, texture.wrap_v) * texture.width
    return wp.vec4i(row0 + left, row0 + right, row1 + left, row1 + right)


@wp.func
def texel_shares(texture: TextureData, uv: wp.vec2) -> wp.vec2:
    """Shares of the right and of the lower texels in ``texel_window``."""
    x = wrapped(uv[0], texture.wrap_u) * float(texture.width) - 0.5
    y = wrapped(uv[1], texture.wrap_v) * float(texture.height) - 0.5
    return wp.vec2(x - wp.floor(x), y - wp.floor(y))


@wp.func
def sample_texture(
    texels: wp.array[wp.uint32], value_of_byte: wp.array[float], texture: TextureData, uv: wp.vec2
) -> wp.vec3:
    """Colour at ``uv``, of decoded texels."""
    window = texel_window(texture, uv)
    shares = texel_shares(texture, uv)
    top = wp.lerp(
        texel_color(texels, value_of_byte, window[0]), texel_color(texels, value_of_byte, window[1]), shares[0]
    )
    bottom = wp.lerp(
        texel_color(texels, value_of_byte, window[2]), texel_color(texels, value_of_byte, window[3]), shares[0]
    )
    return wp.lerp(top, bottom, shares[1])


@wp.func
def sample_alpha(texels: wp.array[wp.uint32], texture: TextureData, uv: wp.vec2) -> float:
    """Alpha at ``uv``, 0..1."""
    window = texel_window(texture, uv)
    shares = texel_shares(texture, uv)
    top = wp.lerp(texel_alpha(texels, window[0]), texel_alpha(texels, window[1]), shares[0])
    bottom = wp.lerp(texel_alpha(texels, window[2]), texel_alpha(texels, window[3]), shares[0])
    return wp.lerp(top, bottom, shares[1])
