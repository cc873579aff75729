"""Constants of OpenUSD files."""

USD_INSTANCES_MAX = 1_000_000
"""Most prims that a file may have, and most instances of point instancers: instances of instances multiply, so that a
small file could ask for any number."""

USD_MEMORY = 3 * 2**28
"""Memory, bytes, that the process that reads a stage may take at least: the library and Warp take 0.2 GB of it."""

USD_ASSETS_MEMORY = 2 * 2**30
"""Further bytes of memory from the first texture on, which are bounded by themselves (`TEXTURE_BYTES_FREE`)."""

USD_MEMORY_A_BYTE = 40
"""Further bytes of memory for each byte of layers and textures: text of 8 digits becomes doubles, which are held three
times."""

USD_CPU_SECONDS = 30
"""Processor time, seconds, that reading a stage may take at least: references nested 16 deep took minutes."""

USD_CPU_SECONDS_A_MEGABYTE = 1.0
"""Further seconds for each 2^20 bytes of the files: text is read in 0.1 s."""

USD_WALL_FACTOR = 10.0
"""Time on the clock after which reading ends, as a factor of its processor time: on machines that are busy."""

USD_START_SECONDS = 300.0
"""Time on the clock, seconds, in which that process must have loaded the library: 0.2 s on a machine that is idle."""

USD_IDLE_SECONDS = 60.0
"""Time without a request, seconds, after which the process that has loaded the library ends."""

USD_LAYERS_MAX = 10_000
"""Most layers of a stage."""

USD_POINT_RADIUS = 1e-3
"""Radius of the sphere that a point light is written as, metres; who reads ``treatAsPoint`` does not use it."""

USD_FILM_WIDTH = 0.036
"""Width of the film of cameras that are written, metres: that of small-format film, whose focal lengths people know."""

USD_PACKAGE_BYTES_MAX = 2**32 - 1
"""Size, bytes, of the largest package and of what is in it: those of zip without its extension, which USD does not
read."""
