"""Arrays of callers, also those of packages that are not needed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.renderer.gradients.arrays import given_array


class Tensor:
    """An array of another package that has gradients."""

    def __dlpack_device__(self) -> tuple[int, int]:
        return 1, 0

    def __dlpack__(self, **_: Any) -> object:
        raise BufferError("Can't export tensors that require gradient, use tensor.detach()")


class TensorOfNumPy(Tensor):
    """The same, of a package that knows NumPy."""

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
def test_what_cannot_be_read_is_one_line(given: Any, problem: str) -> None:
    """With what its package says, and what to do."""
    remedy = "; expected an array of numbers; detach tensors with gradients"
    with pytest.raises(ls.SceneError, match=f"^dL_dcolor cannot be read as an array: {problem}{remedy}$") as found:
        given_array("dL_dcolor", given, (2, 2))
    assert "\n" not in str(found.value)
