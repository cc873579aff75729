"""Limits on the memory that a file may need, checked by its header before anything is allocated."""

from __future__ import annotations

from dataclasses import dataclass

from lumisplat.constants import DECODED_BYTES_FREE, EXPANSION_MAX, TEXTURE_BYTES_FREE
from lumisplat.errors import FormatError
from lumisplat.io.files.source import PathLike
from lumisplat.memory import usable_memory


def check_expansion(path: PathLike, what: str, decoded_bytes: int, stored_bytes: int) -> None:
    """Refuses a file that claims far more content than its size can hold.

    Args:
        path: The file.
        what: Name of the content, for the message.
        decoded_bytes: Memory that reading it would take.
        stored_bytes: Size of the compressed content.

    Raises:
        FormatError: The content would be large, and more than any compression can store in that size.
    """
    if decoded_bytes > max(DECODED_BYTES_FREE, EXPANSION_MAX * stored_bytes):
        raise FormatError(
            path,
            f"{what} would take {decoded_bytes:,} bytes of memory, but only {stored_bytes:,} bytes are stored: "
            "the file is damaged, or made to exhaust memory",
        )


@dataclass(slots=True)
class TextureBytes:
    """The bytes of all textures of a file: many small images may hold as much as a large one."""

    path: PathLike
    decoded: int = 0
    stored: int = 0

    def add(self, what: str, decoded: int, stored: int) -> None:
        """Counts a texture before it is decoded.

        Args:
            what: The texture, for the message.
            decoded: Bytes of its texels.
            stored: Bytes of the encoded image.

        Raises:
            FormatError: The textures so far are large, and more than images of their size hold.
        """
        self.decoded += decoded
        self.stored += stored
        if self.decoded > max(TEXTURE_BYTES_FREE, EXPANSION_MAX * self.stored):
            raise FormatError(
                self.path,
                f"textures up to {what} would take {self.decoded:,} bytes of memory, but only {self.stored:,} bytes "
                "are stored: the file is damaged, or made to exhaust memory",
            )


def check_gaussian_count(path: PathLike, count: int, sh_coefficients: int, stored_bytes: int) -> None:
    """Refuses a compressed capture whose header claims no Gaussians, or absurdly many.

    Args:
        path: The file.
        count: Number of Gaussians that the header claims.
        sh_coefficients: SH coefficients per channel.
        stored_bytes: Size of the compressed content.

    Raises:
        FormatError: There are zero Gaussians, or far more than the file can hold.
    """
    if count <= 0:
        raise FormatError(path, "holds zero Gaussians: there is nothing to render")
    floats = 3 + 4 + 3 + 1 + 3 * sh_coefficients
    check_expansion(path, f"{count:,} Gaussians", count * floats * 4, stored_bytes)


def check_memory(path: PathLike, what: str, needed_bytes: int, remedy: str) -> None:
    """Refuses what is larger than the memory there is, where that is known.

    Args:
        path: The file.
        what: Name of the content, for the message.
        needed_bytes: Memory that it takes.
        remedy: What to do.

    Raises:
        FormatError: It does not fit.
    """
    there = usable_memory()
    if there is not None and needed_bytes > there:
        raise FormatError(
            path, f"{what} would take {needed_bytes / 1e9:.1f} GB of memory, of {there / 1e9:.1f} GB: {remedy}"
        )
