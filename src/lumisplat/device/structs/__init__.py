"""Data that several rooms of the device exchange; one struct is one noun of the method."""

from typing import TYPE_CHECKING, TypeVar

import warp as wp

if TYPE_CHECKING:
    Struct = TypeVar("Struct")

    def struct(struct_type: type[Struct]) -> type[Struct]:
        """Type checkers see a plain class, which is how host code uses it."""
        return struct_type
else:
    struct = wp.struct
