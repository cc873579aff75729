"""Lists all benchmarks with a line each: ``python -m bench``."""

from __future__ import annotations

import ast
from pathlib import Path


def benchmarks() -> dict[str, str]:
    """Returns the commands of this folder, by name, each with the first line of its module's docstring."""
    here = Path(__file__).parent
    found: dict[str, str] = {}
    for path in sorted(here.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        is_package = path.name == "__main__.py"
        if path == Path(__file__) or not (is_package or '__name__ == "__main__"' in text):
            continue
        module = path.parent if is_package else path.with_suffix("")
        name = ".".join(("bench", *module.relative_to(here).parts))
        own = path.with_name("__init__.py").read_text(encoding="utf-8") if name == "bench.first_light" else text
        found[name] = (ast.get_docstring(ast.parse(own)) or "").partition("\n")[0]
    return found


if __name__ == "__main__":
    for name, line in benchmarks().items():
        print(f"python -m {name:32} {line}")
