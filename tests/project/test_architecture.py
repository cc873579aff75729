"""The rules of the house, read off the source: which way imports point, and where launches and allocations happen."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[2] / "src" / "lumisplat"
FILES = sorted(PACKAGE.rglob("*.py"))

BASE = {"constants", "errors", "config"}
MAY_IMPORT = {
    "constants": set(),
    "errors": set(),
    "config": {"constants", "errors", "config"},
    "scene": BASE | {"scene"},
    "io": BASE | {"scene", "io"},
    "metrics": BASE | {"scene", "metrics"},
    "device": {"constants", "device"},
    "launcher": {"constants", "errors"},
    "buffers": {"constants", "errors"},
    "kernels": {"constants", "device"},
    "render": BASE | {"scene", "device", "launcher", "buffers", "kernels", "render"},
    "shadowmaps": BASE | {"scene", "device", "launcher", "buffers", "kernels", "shadowmaps"},
    "relight": BASE | {"scene", "launcher", "render", "shadowmaps", "relight"},
    "cli": {"public", "cli"},
    "__main__": {"cli"},
}
"""Layer -> the layers of ours that its modules may import. ``public`` is ``import lumisplat`` and its names."""

LAZY = {
    "render.frame": {"io"},
    "relight.probe": {"io"},
    "shadowmaps.storage": {"io"},
    "metrics.lit_points": {"relight"},
}
"""What modules import inside the functions that need it: the writers of files, and how normals are estimated."""


def module_name(path: Path) -> str:
    """Dotted name below the package, e.g. ``scene.camera``."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__")


def layer(name: str) -> str:
    """The layer that a module belongs to: its kind of file, or its top folder."""
    return "kernels" if name.endswith("_kernels") else name.partition(".")[0] or "public"


def tree(path: Path) -> ast.Module:
    """A file's syntax."""
    return ast.parse(path.read_text(), filename=str(path))


def is_type_checking(node: ast.AST) -> bool:
    """``if TYPE_CHECKING:``."""
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


def imports(node: ast.AST, lazy: bool = False) -> Iterator[tuple[str, bool]]:
    """Full names of what a file imports at run time, and whether inside a function."""
    for child in ast.iter_child_nodes(node):
        if is_type_checking(child):
            continue
        if isinstance(child, ast.Import):
            yield from ((alias.name, lazy) for alias in child.names)
        elif isinstance(child, ast.ImportFrom):
            assert child.level == 0, "imports are absolute"
            yield from ((f"{child.module}.{alias.name}", lazy) for alias in child.names)
        else:
            yield from imports(child, lazy or isinstance(child, ast.FunctionDef | ast.Lambda))


def imported_layers(path: Path) -> Iterator[tuple[str, bool]]:
    """The layers of ours that a file imports, and whether lazily."""
    for full, lazy in imports(tree(path)):
        if full.split(".")[0] == "lumisplat":
            rest = full.split(".")[1:]
            # ``from lumisplat.render import raster_kernels``: the longest prefix that is a module.
            while rest and not (
                PACKAGE.joinpath(*rest).is_dir() or PACKAGE.joinpath(*rest).with_suffix(".py").exists()
            ):
                rest = rest[:-1]
            yield layer(".".join(rest)), lazy


def calls(path: Path) -> Iterator[tuple[str, int]]:
    """Dotted names of what a file calls, and on which line."""
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), node.lineno


def relative(paths: list[Path]) -> list[str]:
    """Readable test ids."""
    return [str(path.relative_to(PACKAGE)) for path in paths]


@pytest.mark.parametrize("path", FILES, ids=relative(FILES))
def test_imports_point_one_way(path: Path) -> None:
    """A module imports from the layers below it only; writers of files are imported where a file is written."""
    name = module_name(path)
    if not name:
        assert not [full for full, lazy in imports(tree(path)) if full.startswith("lumisplat.") and not lazy]
        return
    allowed = MAY_IMPORT[layer(name)]
    for target, lazy in imported_layers(path):
        assert target in allowed or (lazy and target in LAZY.get(name, set())), (
            f"{name} ({layer(name)}) imports from {target}"
        )


def test_warp_stays_out_of_scene_and_io() -> None:
    """No module of scene and io names Warp, and importing all of them does not load it by a detour."""
    for path in FILES:
        if layer(module_name(path)) in {"scene", "io", "config", "errors", "constants"}:
            assert not [full for full, _ in imports(tree(path)) if full.split(".")[0] == "warp"], path
    names = [
        f"lumisplat.{module_name(p)}" for p in FILES if layer(module_name(p)) in {"scene", "io", "config", "errors"}
    ]
    program = f"""
import importlib, sys
for name in {names!r}:
    importlib.import_module(name)
import lumisplat
lumisplat.load, lumisplat.Camera, lumisplat.Scene, lumisplat.RenderConfig
assert "warp" not in sys.modules, "warp was imported"
assert "lumisplat.render" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_import_is_light() -> None:
    """``import lumisplat`` alone loads neither NumPy nor anything heavier."""
    program = (
        "import sys, lumisplat; print(sorted({'numpy', 'warp', 'gsply', 'PIL', 'OpenEXR', 'rich'} & set(sys.modules)))"
    )
    assert subprocess.check_output([sys.executable, "-c", program], text=True).strip() == "[]"


@pytest.mark.parametrize("path", FILES, ids=relative(FILES))
def test_launches_and_kernels_have_one_home(path: Path) -> None:
    """Launches and graph captures happen in launcher.py only, kernels are defined in *_kernels.py only."""
    if path.name != "launcher.py":
        launched = [
            (call, line)
            for call, line in calls(path)
            if call.startswith(("wp.launch", "warp.launch", "wp.capture", "wp.ScopedCapture", "wp.ScopedTimer"))
        ]
        assert not launched
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.FunctionDef):
            decorators = {ast.unparse(d).split("(")[0] for d in node.decorator_list}
            if "wp.kernel" in decorators:
                assert path.name.endswith("_kernels.py"), f"{node.name} is a kernel"
            if "wp.func" in decorators:
                assert path.parent.name == "device" or path.name.endswith("_kernels.py"), f"{node.name} is a wp.func"


ALLOCATORS = {f"wp.{name}" for name in ("zeros", "empty", "full", "ones", "array", "clone", "from_numpy")}
ALLOCATORS |= {f"wp.{name}_like" for name in ("zeros", "empty", "full", "ones")}


@pytest.mark.parametrize("path", FILES, ids=relative(FILES))
def test_frames_allocate_in_buffers_only(path: Path) -> None:
    """Device memory is asked for in buffers.py, and in device_scene.py and upload.py for what is uploaded once."""
    if path.name in ("buffers.py", "device_scene.py", "upload.py"):
        return
    # In the signatures of kernels and functions, wp.array(dtype=...) is a type.
    is_device_code = path.name.endswith("_kernels.py") or path.parent.name == "device"
    allocators = ALLOCATORS - {"wp.array"} if is_device_code else ALLOCATORS
    assert not [(call, line) for call, line in calls(path) if call in allocators]


@pytest.mark.parametrize("path", FILES, ids=relative(FILES))
def test_public_code_is_documented(path: Path) -> None:
    """Every module, and every public class, function, method and property, says what it is."""
    module = tree(path)
    assert ast.get_docstring(module) or not module.body, "the module has no docstring"
    classes = (node for node in module.body if isinstance(node, ast.ClassDef))
    bodies = [module, *(node for node in classes if not node.name.startswith("_"))]
    for body in bodies:
        for node in body.body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                assert ast.get_docstring(node), f"{node.name} has no docstring"


@pytest.mark.parametrize("path", FILES, ids=relative(FILES))
def test_files_stay_small(path: Path) -> None:
    """A file holds one idea in at most 400 lines."""
    limit = 800 if path.name == "constants.py" else 400  # the one place of all thresholds
    assert len(path.read_text().splitlines()) <= limit


def test_config_fields_are_documented() -> None:
    """Every setting says what it does, right below its name."""
    for node in (node for path in PACKAGE.glob("config/*.py") for node in ast.walk(tree(path))):
        if isinstance(node, ast.ClassDef):
            for field, after in zip(node.body, [*node.body[1:], None], strict=True):
                if isinstance(field, ast.AnnAssign):
                    documented = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
                    assert documented, f"{node.name}.{ast.unparse(field.target)} has no docstring"


def test_the_rules_can_fail(tmp_path: Path) -> None:
    """The reader of imports and calls finds what is there, and skips what is for type checkers only."""
    path = tmp_path / "sample.py"
    path.write_text(
        "from typing import TYPE_CHECKING\nimport warp as wp\n"
        "if TYPE_CHECKING:\n    from lumisplat.frame.frame import Frame\n"
        "from lumisplat.render import raster_kernels\n"
        "def f():\n    from lumisplat.io import image\n    wp.launch(k, 1)\n"
    )
    assert list(imported_layers(path)) == [("kernels", False), ("io", True)]
    assert ("wp.launch", 8) in list(calls(path))
