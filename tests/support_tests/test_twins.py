"""Stored results of a float64 oracle (twins) stay valid until the oracle's code changes."""

from __future__ import annotations

from support.twins import code_of

SOURCE = '''
"""Doubles numbers."""
import numpy as np
from lumisplat.a import double

FACTOR = 2.0
"""Exact."""


def doubled(x):
    """Returns twice x."""
    return FACTOR * x + double(0)  # never zero
'''


def test_key_of_stored_oracle_results_ignores_docstrings_package_imports_and_formatting() -> None:
    """Edits of docstrings, comments, imports from the package and formatting leave an oracle's code as it was."""
    bare = "import numpy as np\nFACTOR=2.0\ndef doubled(x):\n  return (FACTOR*x+double(0))"
    edited = (
        SOURCE.replace("Returns twice", "Gives 2").replace("Exact", "An even number").replace("# never", "# is not")
    )
    assert code_of(bare) == code_of(edited.replace("lumisplat.a", "lumisplat.b.c")) == code_of(SOURCE)


def test_key_of_stored_oracle_results_changes_if_the_code_is_edited() -> None:
    """A different constant, operator, name or import of another package makes the stored results stale."""
    for old, new in (("import numpy", "import cupy"), ("2.0", "3.0"), ("* x", "/ x"), ("def doubled", "def twice")):
        assert code_of(SOURCE.replace(old, new)) != code_of(SOURCE)
