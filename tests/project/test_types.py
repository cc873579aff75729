"""What is written for the type checker alone is true: signatures of dataclasses, and stubs of other packages."""

from __future__ import annotations

import ast
import importlib
import inspect
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
STUBS = sorted((ROOT / "typings").glob("*.pyi"))
WIDER = ("npt.ArrayLike", "npt.ArrayLike | None", "str | npt.ArrayLike | None", "Iterable[")
"""Beginnings of the types that a parameter may have in place of its field's."""


@dataclass(frozen=True)
class Parameter:
    """A parameter of ``__init__``; the default as written, None if there is none, "..." if a factory makes it."""

    name: str
    default: str | None
    keyword_only: bool


def signatures(source: str) -> Iterator[tuple[ast.ClassDef, ast.FunctionDef]]:
    """Classes with an ``__init__`` under ``if TYPE_CHECKING:``, and that ``__init__``."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ClassDef):
            for block in node.body:
                if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING":
                    yield from ((node, one) for one in block.body if isinstance(one, ast.FunctionDef))


def generated(kind: ast.ClassDef) -> dict[Parameter, str]:
    """Parameters of the ``__init__`` that ``@dataclass`` makes, in its order, and their types."""
    keywords_only = any("kw_only=True" in ast.unparse(decorator) for decorator in kind.decorator_list)
    found: dict[Parameter, str] = {}
    for node in kind.body:
        if isinstance(node, ast.AnnAssign) and not ast.unparse(node.annotation).startswith("ClassVar"):
            options: dict[str | None, str] = {}
            default = node.value and ast.unparse(node.value)
            if isinstance(node.value, ast.Call) and ast.unparse(node.value.func) == "field":
                options = {option.arg: ast.unparse(option.value) for option in node.value.keywords}
                default = options.get("default", "..." if "default_factory" in options else None)
            keyword_only = keywords_only or options.get("kw_only") == "True"
            found[Parameter(ast.unparse(node.target), default, keyword_only)] = ast.unparse(node.annotation)
    return dict(sorted(found.items(), key=lambda item: item[0].keyword_only))


def declared(init: ast.FunctionDef) -> dict[Parameter, str]:
    """Parameters of a written ``__init__``, in order, and their types."""
    given = init.args
    ordered = [None] * (len(given.args) - len(given.defaults)) + given.defaults
    every = [*zip(given.args, ordered, [False] * len(given.args), strict=True)][1:]
    every += zip(given.kwonlyargs, given.kw_defaults, [True] * len(given.kwonlyargs), strict=True)
    return {
        Parameter(one.arg, default and ast.unparse(default), keyword_only): ast.unparse(one.annotation or one)
        for one, default, keyword_only in every
    }


def mistakes(source: str) -> list[str]:
    """Classes whose written ``__init__`` is not the one that ``@dataclass`` makes, but for wider types."""
    wrong = []
    for kind, init in signatures(source):
        made, written = generated(kind), declared(init)
        same_types = all(
            annotation == made.get(one) or annotation.startswith(WIDER) for one, annotation in written.items()
        )
        if list(made) != list(written) or not same_types:
            wrong.append(kind.name)
    return wrong


def test_signatures_for_the_type_checker_are_those_of_the_fields() -> None:
    """Names, order, defaults and keywords agree, so that a call that pyright accepts runs, and the reverse."""
    sources = {path: path.read_text() for path in (ROOT / "src").rglob("*.py")}
    assert any(list(signatures(source)) for source in sources.values())
    assert [f"{path.name}: {name}" for path, source in sources.items() for name in mistakes(source)] == []


@pytest.mark.parametrize(
    ("init", "is_right"),
    [
        ("self, a: npt.ArrayLike, b: int = 2, *, c: int = ...", True),
        ("self, a: npt.ArrayLike, b: int = 3, *, c: int = ...", False),
        ("self, a: npt.ArrayLike, b: str = 2, *, c: int = ...", False),
        ("self, a: npt.ArrayLike, b: int, *, c: int = ...", False),
        ("self, a: npt.ArrayLike, b: int = 2, c: int = ...", False),
        ("self, b: int, a: npt.ArrayLike = 2, *, c: int = ...", False),
        ("self, a: npt.ArrayLike, b: int = 2", False),
        ("self, a: npt.ArrayLike, b: int = 2, d: int = 4, *, c: int = ...", False),
    ],
)
def test_wrong_signatures_are_found(init: str, is_right: bool) -> None:
    """Another default, type, order or kind of parameter, one too few and one too many."""
    fields = "c: int = field(default_factory=int, kw_only=True)\n    a: FloatArray\n    b: int = 2"
    source = (
        f"@dataclass\nclass Kind:\n    {fields}\n    if TYPE_CHECKING:\n        def __init__({init}) -> None: ...\n"
    )
    assert mistakes(source) == ([] if is_right else ["Kind"])


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
