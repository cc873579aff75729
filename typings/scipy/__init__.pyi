"""SciPy ships no types: these are of the parts that src/lumisplat calls."""

from typing import Any

def __getattr__(name: str) -> Any: ...
