"""Wide loads and stores of the structs of Gaussians that kernels read and write most."""

import warp as wp

from lumisplat.device.math.aligned_memory import aligned_load_of, aligned_store_of
from lumisplat.device.structs.bvh import Particle
from lumisplat.device.structs.raster import Splat

wp.set_module_options({"enable_backward": False})

load_particle = aligned_load_of(Particle)
load_splat, store_splat = aligned_load_of(Splat), aligned_store_of(Splat)
