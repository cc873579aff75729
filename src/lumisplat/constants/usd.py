"""Constants of OpenUSD files."""

USD_INSTANCES_MAX = 1_000_000
"""Most prims that a file may have, and most instances of point instancers: instances of instances multiply, so that a
small file could ask for any number."""

USD_ENTRIES_A_BYTE = 1024
"""Most entries in a byte of a binary layer: integers take two bits at least, and LZ4 makes no more than 255 bytes of
one. Eleven million in 93 bytes took 20 seconds and 740 MB before the library noticed."""

LZ4_EXPANSION_MAX = 256
"""Bytes that LZ4 makes of one at most, and some."""

USD_ENTRY_BYTES = 40
"""Memory that an entry takes while it is checked, bytes: four million paths took 142 MB."""

USD_NESTING_MAX = 64
"""How deep values of a binary layer may lie in others: dictionaries in dictionaries, which the library reads by
recursion."""

USD_LAYERS_MAX = 10_000
"""Most layers of a stage."""

USD_POINT_RADIUS = 1e-3
"""Radius of the sphere that a point light is written as, metres; who reads ``treatAsPoint`` does not use it."""

USD_FILM_WIDTH = 0.036
"""Width of the film of cameras that are written, metres: that of small-format film, whose focal lengths people know."""

USD_PACKAGE_BYTES_MAX = 2**32 - 1
"""Size, bytes, of the largest package and of what is in it: those of zip without its extension, which USD does not
read."""
