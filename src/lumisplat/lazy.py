"""Lazy imports: the public names of a package import their modules at first use."""

from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Callable
from pathlib import Path


def names_of_stub(package: str, file: str) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """Resolves the names that a package's stub imports at their first use.

    The stub, ``__init__.pyi``, is the only list of the package's public names; type checkers read the stub, too.
    Importing the package imports none of the modules that define these names, so that ``import lumisplat`` and
    ``lumisplat --help`` stay quick.

    Args:
        package: Name of the package, ``__name__``.
        file: The package's ``__file__``; the stub lies beside it.

    Returns:
        ``__getattr__``, ``__dir__`` and ``__all__`` of the package.
    """
    modules: dict[str, str | None] = {}
    for node in ast.parse(Path(file).with_suffix(".pyi").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom) and node.module != "__future__":
            assert node.module is not None and node.level == 0
            for alias in node.names:
                modules[alias.name] = None if node.module == "lumisplat" else node.module

    def elsewhere(name: str) -> str:
        """Returns the end of the error message for an unknown name: which submodule has it, or an empty text."""
        submodules = [module for module, home in modules.items() if home is None and not name.startswith("_")]
        found = [module for module in submodules if name in importlib.import_module(f"{package}.{module}").__all__]
        return f": it is {package}.{found[0]}.{name}" if found else ""

    def get(name: str) -> object:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}{elsewhere(name)}")
        home = modules[name]
        value = (
            importlib.import_module(f"lumisplat.{name}")
            if home is None
            else getattr(importlib.import_module(home), name)
        )
        setattr(sys.modules[package], name, value)  # also in place of a module that has the same name
        return value

    names = sorted(modules)
    return get, lambda: names, names
