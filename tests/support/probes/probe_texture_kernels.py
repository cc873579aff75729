"""Kernels that sample textures, for their tests."""

import warp as wp

from lumisplat.device.mesh.mesh_surface import sample_alpha, sample_texture
from lumisplat.device.structs.scene import TextureData

wp.set_module_options({"enable_backward": False})


@wp.kernel
def probe_texture(
    texels: wp.array(dtype=wp.uint32),
    values: wp.array(dtype=float),
    texture: TextureData,
    uvs: wp.array(dtype=wp.vec2),
    colors: wp.array(dtype=wp.vec3),
    alphas: wp.array(dtype=float),
):
    """Samples colour and alpha at texture coordinates."""
    i = wp.tid()
    colors[i] = sample_texture(texels, values, texture, uvs[i])
    alphas[i] = sample_alpha(texels, texture, uvs[i])
