"""Stubs of other packages match the installed packages."""

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
    """Returns constants, classes, attributes, methods and parameters of a stub that its package lacks."""
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
    """Returns attributes and methods of a stub class, and ``method(parameter)`` for each parameter by name."""
    for node in kind.body:
        if isinstance(node, ast.AnnAssign):
            yield ast.unparse(node.target)
        elif isinstance(node, ast.FunctionDef):
            yield node.name
            yield from (f"{node.name}({one.arg})" for one in node.args.args[1:])


def _has(kind: type, name: str) -> bool:
    """Returns whether a class has an attribute or a method parameter; C++ methods list theirs in docstrings."""
    name, _, parameter = name.rstrip(")").partition("(")
    dataclass_fields: Any = getattr(kind, "__dataclass_fields__", {})
    if not parameter:
        return name in dataclass_fields or hasattr(kind, name) or name in inspect.signature(kind).parameters
    method = getattr(kind, name, None)
    try:
        return method is not None and parameter in inspect.signature(method).parameters
    except ValueError:
        return f"{parameter}: " in (method.__doc__ or "")


@pytest.mark.parametrize("path", STUBS, ids=lambda path: path.stem)
def test_type_stubs_declare_only_names_that_the_installed_packages_have(path: Path) -> None:
    """Stubs are in ``typings``; names are constants, classes, attributes, methods and parameters."""
    assert unknown_names(path.read_text(), importlib.import_module(path.stem)) == []


def test_check_of_type_stubs_lists_each_declared_name_that_is_missing() -> None:
    """A constant, a class, an attribute, a method and a parameter are missing."""
    stub = (
        "ONE: int\nclass Two: ...\nclass Node:\n    mesh: int\n    three: int\n    def to_json(self, four: int): ...\n"
    )
    wrong = unknown_names(stub + "    def five(self): ...\n", importlib.import_module("pygltflib"))
    assert wrong == ["ONE", "Two", "Node.three", "Node.to_json(four)", "Node.five"]
