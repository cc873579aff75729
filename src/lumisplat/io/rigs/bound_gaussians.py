"""Reads Gaussians that belong to a rig, with what binds them: triangles (GaussianAvatars) or skinning weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
from lumisplat.io.files.arrays import read_arrays
from lumisplat.io.files.source import PathLike, parsing, read_bytes
from lumisplat.io.ply import read_ply_element, read_ply_header
from lumisplat.math.arrays import IntArray

TRIANGLE = "binding_0"
"""Property of a Gaussian PLY with the index of a Gaussian's triangle; of GaussianAvatars (Qian et al. 2024)."""


def read_triangles(path: PathLike) -> IntArray | None:
    """Returns the triangle of each Gaussian of a PLY of GaussianAvatars, shape (N,); None for all other files."""
    path = Path(path)
    if path.suffix.lower() != ".ply":
        return None
    header = read_ply_header(path)
    for element in header.elements:
        if any(one.name == TRIANGLE for one in element.properties):
            with parsing(path, "a Gaussian PLY"):
                return np.asarray(read_ply_element(header, element)[TRIANGLE]).astype(np.int32)
    return None


def read_weights(path: PathLike) -> npt.NDArray[np.floating]:
    """Reads skinning weights: the array of a ``.npy``, or ``weights`` (or the only array) of a ``.npz``.

    Raises:
        FormatError: The file is of another kind, or holds Python objects.
        MissingFileError: There is no such file.
    """
    path = Path(path)
    if path.suffix.lower() == ".npz":
        arrays = read_arrays(path, "skinning weights", compressed=True)
        name = "weights" if "weights" in arrays else next(iter(arrays), "")
        if not arrays or (name != "weights" and len(arrays) > 1):
            raise FormatError(path, f"holds {', '.join(arrays) or 'nothing'}, expected an array named weights")
        found = arrays[name]
    elif path.suffix.lower() == ".npy":
        data = read_bytes(path)
        with parsing(path, "skinning weights"):
            found = _array(data)
    else:
        raise FormatError(
            path,
            f"unknown extension {path.suffix!r} of skinning weights, expected .npy or .npz: "
            'np.save("weights.npy", weights) writes one',
        )
    if found.dtype.kind not in "fiu":
        raise FormatError(path, f"holds {found.dtype}, expected numbers")
    return found.astype(np.float32)


def _array(data: bytes) -> npt.NDArray[np.generic]:
    import io

    return np.load(io.BytesIO(data), allow_pickle=False)
