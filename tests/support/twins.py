"""Stores the results of float64 oracles ("twins"), which take longer to compute than the kernels they check.

The key of a stored result is a hash of the oracle's arguments and of its code, including imported oracles; docstrings,
comments, formatting and imports from `lumisplat` do not count. A result can only be stale in what an oracle takes from
the package, such as defaults of settings. Therefore a tenth of the results is recomputed and compared, a different
tenth each day, and `make test-deep` recomputes all. A missing result is computed; `tools/make_twins.py` stores all
results.
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
"""Remainder modulo ten of the hashes whose results are recomputed today."""

Result = dict[str, np.ndarray]


class Twins:
    """Reads stored results for tests, and records which results this run computed."""

    def __init__(self) -> None:
        self.recompute_all = False
        self.computed: dict[str, Result] = {}
        """All results computed in this run, keyed by their hashes."""
        self.missing = 0
        """Number of results that were not stored and had to be computed."""

    def result(self, compute: Callable[..., Result], *arguments: Any) -> Result:
        """Returns the result of an oracle's function, read from its file if stored and computed otherwise.

        Args:
            compute: Function of a module of `support.oracles` that returns a dictionary of arrays.
            *arguments: Arguments of the function: dataclasses, arrays, numbers, text and containers of these.

        Raises:
            AssertionError: A recomputed result differs from the stored one.
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
            message = f"{name} of a stored twin differs from what {compute.__module__} computes now; run {COMMAND}"
            np.testing.assert_allclose(found[name][pixels], values[pixels], rtol=1e-5, atol=1e-6, err_msg=message)
        return now


def decided(result: Result) -> Any:
    """Returns a mask of the pixels that agree on every machine: those where the slack for rounding is finite."""
    return np.isfinite(result["slack"]) if "slack" in result else ...


TWINS = Twins()


# --- Hashes ---


def described(value: Any) -> bytes:
    """Returns a value as bytes, equal for equal values; dataclass fields at their defaults are left out.

    Doubles are rounded to single precision, since their last bits may differ between machines.
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
    raise TypeError(f"cannot hash a {type(value).__name__} as an oracle's argument")


def code_of(source: str) -> str:
    """Returns a module's syntax tree as text, without imports, docstrings, comments and formatting.

    The text is equal for every version of Python, which `ast.dump` and `ast.unparse` do not promise.
    """
    return _node_text(ast.parse(source))


def _node_text(node: Any) -> str:
    """Returns a node of a syntax tree as text; empty fields are left out, since versions of Python differ in them."""
    if isinstance(node, list):
        return f"[{','.join(_node_text(one) for one in node if not _is_text_or_import(one))}]"
    if isinstance(node, ast.AST):
        fields = (f"{name}={_node_text(value)}" for name, value in ast.iter_fields(node) if value not in (None, []))
        return f"{type(node).__name__}({','.join(fields)})"
    return repr(node)


def _is_text_or_import(node: Any) -> bool:
    """Returns True for docstrings, other statements that are only a string, and imports from the package."""
    is_text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    return is_text or (isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "lumisplat")


@cache
def source_of(module: str) -> bytes:
    """Returns the code of an oracle and of all oracles that the oracle imports, directly or indirectly."""
    names, texts = [module], []
    for name in names:
        text = inspect.getsource(importlib.import_module(name))
        texts.append(code_of(text))
        others = re.findall(r"^from (support\.oracles\.\w+) import", text, re.M)
        for line in re.findall(r"^from support\.oracles import (.*)", text, re.M):
            others += [f"support.oracles.{name.strip()}" for name in line.split(",")]
        names += [other for other in others if other not in names]
    return "".join(texts).encode()


# --- Files: one .npz for each result, floating-point arrays in single precision ---


def stored(key: str) -> Result | None:
    """Returns a stored result in double precision, or None if there is none for this key."""
    path = FOLDER / f"{key}.npz"
    if not path.exists():
        return None
    with np.load(path) as file:
        return {
            name: values.astype(np.float64) if values.dtype.kind == "f" else values for name, values in file.items()
        }


def store(results: dict[str, Result]) -> int:
    """Replaces all stored results, and returns the total size of their files in bytes."""
    FOLDER.mkdir(exist_ok=True)
    for path in FOLDER.glob("*.npz"):
        path.unlink()
    for key, result in results.items():
        arrays: dict[str, Any] = {
            name: np.float32(values) if values.dtype.kind == "f" else values for name, values in result.items()
        }
        np.savez_compressed(FOLDER / f"{key}.npz", **arrays)
    return sum(path.stat().st_size for path in FOLDER.glob("*.npz"))
