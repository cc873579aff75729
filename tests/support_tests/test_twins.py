"""Stored twins are found as long as what computes them is the same."""

from __future__ import annotations

from support.twins import without_imports


def test_where_the_package_has_its_names_is_no_part_of_an_oracle() -> None:
    """Imports of the package may move; what an oracle takes from elsewhere, and what it does, may not."""
    before = "import numpy as np\nfrom lumisplat.a import (\n    b,\n)\nimport lumisplat as ls\n\nx = np.pi\n"
    after = "import numpy as np\nfrom lumisplat.c.d import b\n\nx = np.pi\n"
    assert without_imports(before) == without_imports(after) == "import numpy as np\nx = np.pi"
    assert without_imports(after.replace("pi", "e")) != without_imports(after)
