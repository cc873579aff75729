"""Computes the results of the float64 twins in all tests, and stores them: python tools/make_twins.py.

Needed after a change of an oracle or of its scenes; takes a few minutes. The tests run meanwhile, so the stored results
are those that the tests were compared with.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parents[1] / "tests"
sys.path.insert(0, str(TESTS))


def main() -> int:
    """Runs the tests that read stored twins, including deep ones, and stores the results if they pass."""
    from support.twins import FOLDER, TWINS, store

    asking = [str(path) for path in sorted(TESTS.rglob("test_*.py")) if "TWINS.result(" in path.read_text()]
    store({})
    failed = pytest.main(["-q", "-m", "", "--recompute-twins", *asking])
    if failed:
        print(
            f"a test fails, so nothing is stored: `git checkout {FOLDER.relative_to(TESTS.parent)}` restores the files"
        )
        return int(failed)
    size = store(TWINS.computed)
    print(f"{len(TWINS.computed)} results, {size / 2**20:.2f} MiB in {FOLDER.relative_to(TESTS.parent)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
