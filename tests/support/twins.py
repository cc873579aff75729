"""What float64 twins compute, stored: they take longer than all that they are compared with.

A stored result is found by a hash of the arguments of its oracle and of the source of the oracle and of those that it
imports. It can be stale only in what an oracle takes from the package, defaults of settings among it: therefore a tenth
of the results, another one each day, is computed all the same and compared, and all are by `make test-deep`. A result
that is not stored is computed; `tools/make_twins.py` stores it.
"""

from __future__ import annotations

import ast
import dataclasses
import hashlib
import importlib
import inspect
import re
from collections.abc import Callable
from datetime import date
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

FOLDER = Path(__file__).parents[1] / "reference" / "twins"
COMMAND = "python tools/make_twins.py"
TENTH = date.today().toordinal() % 10
"""Results whose hash is this modulo ten are computed anew today."""

Result = dict[str, np.ndarray]


class Twins:
    """The stored results, and what this run has done with them."""

    def __init__(self) -> None:
        self.recompute_all = False
        self.computed: dict[str, Result] = {}
        """Every result that was computed, by its hash."""
        self.missing = 0
        """Results that were not stored."""

    def result(self, compute: Callable[..., Result], *arguments: Any) -> Result:
        """What an oracle's function returns, read if it is stored.

        Args:
            compute: Function of a module of `support.oracles`; returns arrays by name.
            *arguments: Its arguments: dataclasses, arrays, numbers, text, and containers of these.
        """
        key = hashlib.sha256(source_of(compute.__module__) + described((compute.__qualname__, *arguments))).hexdigest()
        found = stored(key[:16])
        if found is not None and not self.recompute_all and int(key, 16) % 10 != TENTH:
            return found
        now = compute(*arguments)
        self.computed[key[:16]] = now
        if found is None:
            self.missing += 1
            return now
        assert now.keys() == found.keys()
        pixels = decided(now)
        for name, values in now.items():
            message = f"{name} of a stored twin is not what {compute.__module__} computes: {COMMAND}"
            np.testing.assert_allclose(found[name][pixels], values[pixels], rtol=1e-5, atol=1e-6, err_msg=message)
        return now


def decided(result: Result) -> Any:
    """The pixels of a result that are the same on every machine: at others its oracle leaves all room to rounding."""
    return np.isfinite(result["slack"]) if "slack" in result else ...


TWINS = Twins()


# --- Hashes ---


def described(value: Any) -> bytes:
    """A value as bytes, equal for equal values; fields of dataclasses that have their defaults are left out.

    Doubles are rounded to single precision: they may differ in their last bits from one machine to another.
    """
    if isinstance(value, float | np.floating):
        value = np.array(value)
    if isinstance(value, np.ndarray):
        exact = value.astype(np.float32) if value.dtype.kind == "f" else value.astype(np.int64)
        return f"{exact.dtype}{exact.shape}".encode() + exact.tobytes()
    if isinstance(value, dict):
        return b"{" + b",".join(described(item) for item in value.items()) + b"}"
    if isinstance(value, tuple | list):
        return b"(" + b",".join(map(described, value)) + b")"
    if dataclasses.is_dataclass(value):
        parts = [type(value).__name__.encode()]
        for one in dataclasses.fields(value):
            part = described(getattr(value, one.name))
            default = one.default_factory() if callable(one.default_factory) else one.default
            if default is dataclasses.MISSING or described(default) != part:
                parts.append(one.name.encode() + b"=" + part)
        return b"<" + b",".join(parts) + b">"
    if isinstance(value, Enum):
        return f"{type(value).__name__}.{value.name}".encode()
    if value is None or isinstance(value, str | bool | int):
        return repr(value).encode()
    raise TypeError(f"no description of a {type(value).__name__}")


def without_imports(source: str) -> str:
    """A module's source without its imports of the package: where that has its names may change."""
    lines = source.splitlines()
    for node in ast.parse(source).body:
        names = [one.name for one in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        if any(name.partition(".")[0] == "lumisplat" for name in names):
            lines[node.lineno - 1 : node.end_lineno] = [""] * ((node.end_lineno or node.lineno) - node.lineno + 1)
    return "\n".join(line for line in lines if line)


@cache
def source_of(module: str) -> bytes:
    """Source of an oracle and of all oracles that it imports, but for what they import of the package."""
    names, texts = [module], []
    for name in names:
        text = inspect.getsource(importlib.import_module(name))
        texts.append(without_imports(text))
        others = re.findall(r"^from (support\.oracles\.\w+) import", text, re.M)
        for line in re.findall(r"^from support\.oracles import (.*)", text, re.M):
            others += [f"support.oracles.{name.strip()}" for name in line.split(",")]
        names += [other for other in others if other not in names]
    return "".join(texts).encode()


# --- Files: one a result, its arrays by name, numbers in single precision ---


def stored(key: str) -> Result | None:
    """A stored result, in double precision; None: it is not stored."""
    path = FOLDER / f"{key}.npz"
    if not path.exists():
        return None
    with np.load(path) as file:
        return {
            name: values.astype(np.float64) if values.dtype.kind == "f" else values for name, values in file.items()
        }


def store(results: dict[str, Result]) -> int:
    """Replaces all stored results; returns the size of their files, bytes."""
    FOLDER.mkdir(exist_ok=True)
    for path in FOLDER.glob("*.npz"):
        path.unlink()
    for key, result in results.items():
        arrays: dict[str, Any] = {
            name: np.float32(values) if values.dtype.kind == "f" else values for name, values in result.items()
        }
        np.savez_compressed(FOLDER / f"{key}.npz", **arrays)
    return sum(path.stat().st_size for path in FOLDER.glob("*.npz"))
