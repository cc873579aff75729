"""Lists all benchmarks with a line each: ``python -m bench``."""

from __future__ import annotations

import ast
from pathlib import Path


def benchmarks() -> dict[str, str]:
    """Returns the commands of this folder by name, each with the first line of its module's docstring."""
    here = Path(__file__).parent
    found: dict[str, str] = {}
    for path in sorted(here.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        if path == Path(__file__) or '__name__ == "__main__"' not in text:
            continue
        module = path.parent if path.name == "__main__.py" else path.with_suffix("")
        name = ".".join(("bench", *module.relative_to(here).parts))
        found[name] = (ast.get_docstring(ast.parse(text)) or "").partition("\n")[0]
    return found


if __name__ == "__main__":
    for name, line in benchmarks().items():
        print(f"python -m {name:26} {line}")
