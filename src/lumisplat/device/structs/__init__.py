"""Data that several rooms of the device exchange; one struct is one noun of the method."""

from typing import TYPE_CHECKING, TypeVar

import warp as wp

if TYPE_CHECKING:
    Noun = TypeVar("Noun")

    def struct(noun: type[Noun]) -> type[Noun]:
        """Type checkers see a plain class, which is how host code uses it."""
        return noun
else:
    struct = wp.struct
