"""Arrays that callers pass in, also arrays of packages that are not dependencies."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.renderer.gradients.arrays import given_array


class Tensor:
    """An array of another package that requires gradients."""

    def __dlpack_device__(self) -> tuple[int, int]:
        return 1, 0

    def __dlpack__(self, **_: Any) -> object:
        raise BufferError("Can't export tensors that require gradient, use tensor.detach()")


class TensorOfNumPy(Tensor):
    """An array of another package that requires gradients and converts itself to NumPy."""

    def __array__(self, *_: Any, **__: Any) -> np.ndarray:
        raise RuntimeError("Can't call numpy() on Tensor that requires grad.\nUse tensor.detach().numpy() instead.")


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        (
            Tensor(),
            r"an array of type Tensor cannot be read \(Can't export .* use tensor\.detach\(\)\): copy it to the CPU",
        ),
        (TensorOfNumPy(), r"Can't call numpy\(\) on Tensor that requires grad"),
        ("red", "could not convert string to float: 'red'"),
        ([[1.0], [1.0, 2.0]], "setting an array element with a sequence.*"),
    ],
)
def test_arrays_that_cannot_be_read_raise_a_one_line_error(given: Any, problem: str) -> None:
    """The error contains the message of the array's package, and what to do."""
    remedy = "; expected an array of numbers; detach tensors with gradients"
    with pytest.raises(ls.SceneError, match=f"^dL_dcolor cannot be read as an array: {problem}{remedy}$") as found:
        given_array("dL_dcolor", given, (2, 2))
    assert "\n" not in str(found.value)
