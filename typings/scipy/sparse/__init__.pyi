"""The part of scipy.sparse that Lumisplat calls; SciPy ships no types."""

from typing import Any

def __getattr__(name: str) -> Any: ...
