"""Structs that several packages of device code exchange, and the decorator that declares them."""

from typing import TYPE_CHECKING, TypeVar

import warp as wp

if TYPE_CHECKING:
    Struct = TypeVar("Struct")

    def struct(struct_type: type[Struct]) -> type[Struct]:
        """Declares a Warp struct; type checkers see the class itself, because host code uses it as a normal class."""
        return struct_type
else:
    struct = wp.struct
