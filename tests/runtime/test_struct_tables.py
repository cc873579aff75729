"""Tables of structs in device memory."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import warp as wp

from lumisplat.device.structs.shading import SplatAttributes
from lumisplat.runtime.struct_tables import upload_structs


def attributes(count: int) -> SplatAttributes:
    """Makes a row with one array."""
    row = SplatAttributes()
    row.scales = wp.zeros(count, dtype=wp.vec3, device="cpu")
    return row


def test_device_table_of_structs_has_the_given_rows_in_order() -> None:
    """Each row of the table is the given struct, with the addresses of its arrays."""
    rows = [attributes(count) for count in (3, 1, 2)]
    table = upload_structs(rows, SplatAttributes, "cpu")
    stored = table.numpy()
    np.testing.assert_array_equal(stored["scales"]["shape"][:, 0], [3, 1, 2])
    np.testing.assert_array_equal(stored["scales"]["data"], [row.scales.ptr for row in rows])


def test_struct_table_without_rows_has_a_valid_device_address() -> None:
    """A table without rows has one struct with empty arrays."""
    table = upload_structs([], SplatAttributes, "cpu")
    assert table.ptr
    assert table.numpy()["scales"]["data"].tolist() == [0]


def test_arrays_named_in_a_device_table_of_structs_live_as_long_as_the_table() -> None:
    """The table contains addresses, so that the arrays must not be freed before the table."""
    row = attributes(4)
    array = weakref.ref(row.scales)
    table = upload_structs([row], SplatAttributes, "cpu")
    del row
    gc.collect()
    assert array() is not None
    del table
    gc.collect()
    assert array() is None
