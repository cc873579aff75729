"""Types of the parts of OpenEXR that Lumisplat uses."""

from collections.abc import Mapping
from typing import Any

import numpy.typing as npt

ZIP_COMPRESSION: object
scanlineimage: object

class Channel:
    pixels: npt.NDArray[Any]

class File:
    def __init__(
        self,
        header: str | Mapping[str, object],
        channels: Mapping[str, npt.NDArray[Any]] = ...,
        *,
        header_only: bool = ...,
        separate_channels: bool = ...,
    ) -> None: ...
    def __enter__(self) -> File: ...
    def __exit__(self, *error: object) -> None: ...
    def header(self) -> dict[str, Any]: ...
    def channels(self) -> dict[str, Channel]: ...
    def write(self, path: str) -> None: ...
