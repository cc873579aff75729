"""Structs that several packages of device code exchange, and the decorator that declares them."""

from typing import TYPE_CHECKING, TypeVar

import warp as wp

if TYPE_CHECKING:
    Struct = TypeVar("Struct")

    def struct(struct_type: type[Struct]) -> type[Struct]:
        """Keeps the class as it is for type checkers, because host code uses the struct as a plain class."""
        return struct_type
else:
    struct = wp.struct
