"""What is written for the type checker alone is true: stubs of other packages."""

from __future__ import annotations

import ast
import importlib
import inspect
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
STUBS = sorted((ROOT / "typings").glob("*.pyi"))


def unknown_names(stub: str, module: ModuleType) -> list[str]:
    """Constants, classes, attributes, methods and parameters of a stub that its package does not have."""
    missing = []
    for node in ast.parse(stub).body:
        if isinstance(node, ast.AnnAssign) and not hasattr(module, ast.unparse(node.target)):
            missing.append(ast.unparse(node.target))
        if isinstance(node, ast.ClassDef):
            kind = getattr(module, node.name, None)
            missing += [f"{node.name}.{name}" for name in _names(node) if kind is None or not _has(kind, name)]
            missing += [node.name] * (kind is None)
    return missing


def _names(kind: ast.ClassDef) -> Iterator[str]:
    """Attributes and methods of a class of a stub, and ``method(parameter)`` for each parameter by name."""
    for node in kind.body:
        if isinstance(node, ast.AnnAssign):
            yield ast.unparse(node.target)
        elif isinstance(node, ast.FunctionDef):
            yield node.name
            yield from (f"{node.name}({one.arg})" for one in node.args.args[1:])


def _has(kind: type, name: str) -> bool:
    """Whether a class has an attribute, or a method that parameter; methods in C++ name theirs in their docstrings."""
    name, _, parameter = name.rstrip(")").partition("(")
    known: Any = getattr(kind, "__dataclass_fields__", {})
    if not parameter:
        return name in known or hasattr(kind, name) or name in inspect.signature(kind).parameters
    method = getattr(kind, name, None)
    try:
        return method is not None and parameter in inspect.signature(method).parameters
    except ValueError:
        return f"{parameter}: " in (method.__doc__ or "")


@pytest.mark.parametrize("path", STUBS, ids=lambda path: path.stem)
def test_stubs_describe_what_there_is(path: Path) -> None:
    """Everything that a stub names exists in the package that is installed."""
    assert unknown_names(path.read_text(), importlib.import_module(path.stem)) == []


def test_wrong_stubs_are_found() -> None:
    """A constant, a class, an attribute, a method and a parameter that do not exist."""
    stub = (
        "ONE: int\nclass Two: ...\nclass Node:\n    mesh: int\n    three: int\n    def to_json(self, four: int): ...\n"
    )
    wrong = unknown_names(stub + "    def five(self): ...\n", importlib.import_module("pygltflib"))
    assert wrong == ["ONE", "Two", "Node.three", "Node.to_json(four)", "Node.five"]
