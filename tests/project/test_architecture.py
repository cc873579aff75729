"""Architecture rules checked on the source: direction of imports, and where launches and allocations are."""

from __future__ import annotations

import ast
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[2] / "src" / "lumisplat"
FILES = sorted(PACKAGE.rglob("*.py"))

LAYERS = (
    "constants",
    "errors",
    "lazy",
    "memory",
    "progress",
    "config",
    "math",
    "runtime",
    "device.structs",
    "device.math",
    "device.training",
    "device.bvh",
    "device.camera",
    "device.splat",
    "device.gaussian",
    "device.mesh",
    "device.shadow_map",
    "device.material",
    "device.light",
    "device.path",
    "device.gi",
    "device.film",
    "diagnostics",
    "palette_kernels",
    "palette",
    "scene",
    "scene.ops",
    "scene.editing",
    "scene.animation",
    "demo",
    "metrics",
    "io.files",
    "io.ply",
    "io.images",
    "io.cameras",
    "io.splats",
    "io.meshes",
    "io.gltf",
    "io.rigs",
    "io.usd",
    "io.scene_toml",
    "io",
    "io.document",
    "frame",
    "shadow_maps",
    "renderer.trees",
    "renderer.scene",
    "renderer.shadow",
    "renderer.trace",
    "renderer.light",
    "renderer.film",
    "renderer.raster",
    "renderer.realtime",
    "renderer.integrators",
    "renderer",
    "renderer.gradients",
    "relighting",
    "relighting.fitting",
    "baking",
    "dataset",
    "training",
    "public",
    "viewer.thresholds",
    "viewer.words",
    "viewer.server",
    "viewer.scene_extent",
    "viewer.session",
    "viewer.frames",
    "viewer.gizmo",
    "viewer.picking",
    "viewer.overlays",
    "viewer.notebook",
    "viewer.panels",
    "viewer",
    "cli.output",
    "cli.input",
    "cli.options",
    "cli.farm",
    "cli.commands",
    "cli",
    "__main__",
)
"""Folders from the bottom to the top; a module imports from its own folder and from earlier ones.

``public`` is ``import lumisplat`` and its names.
"""

PUBLIC = {"avatars", "editing", "farm", "gradients", "inverse", "layers", "lights", "rays"}
"""Modules that only re-export names for users; packages such as ``io`` do so lazily."""

HOST_ONLY = {
    "constants", "errors", "lazy", "memory", "progress", "config", "math", "scene", "demo", "metrics", "io", "frame"
}  # fmt: skip
"""Top folders that import neither Warp nor modules that import it."""

MORE_NARROW = {
    "constants": {"constants"},
    "device": {"constants", "device"},
    "kernels": {"constants", "device"},
    "runtime": {"constants", "errors", "lazy", "memory", "progress", "runtime"},
    "shadow_maps": {
        "constants",
        "errors",
        "progress",
        "config",
        "math",
        "runtime",
        "device",
        "scene",
        "io",
        "kernels",
        "shadow_maps",
    },
    "palette": {"constants", "errors", "runtime", "device", "kernels", "palette"},
    "io": HOST_ONLY | {"palette"},  # writing SOG needs the palette, which io imports lazily
    "viewer": {"public", "viewer"},
    "cli": {"public", "io", "cli"},  # only documented functions of io
    "__main__": {"cli"},
} | dict.fromkeys(HOST_ONLY - {"constants", "io"}, HOST_ONLY)
"""Allowed imports of a top folder or kind of file, where the order of layers alone would allow more."""


DOCUMENTED = {"config.setting", "demo.moving"}
"""Modules that every folder above them may import, including the command line and the viewer."""


def module_name(path: Path) -> str:
    """Returns the dotted name below the package, e.g. ``scene.camera``."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__")


def layer(name: str) -> str:
    """Returns the layer of a module: the longest of `LAYERS` that its dotted name starts with."""
    if not name or name in PUBLIC:
        return "public"
    return max((layer for layer in LAYERS if name == layer or name.startswith(f"{layer}.")), key=len)


def kind(name: str) -> str:
    """Returns the key of `MORE_NARROW` for a module: ``kernels``, or its top folder."""
    if name in PUBLIC:
        return "public"
    return "kernels" if name.endswith("_kernels") else name.partition(".")[0] or "public"


def tree(path: Path) -> ast.Module:
    """Returns the syntax tree of a file."""
    return ast.parse(path.read_text(), filename=str(path))


def is_type_checking(node: ast.AST) -> bool:
    """Returns whether a node is ``if TYPE_CHECKING:``."""
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


def imports(node: ast.AST, lazy: bool = False, typing: bool = False) -> Iterator[tuple[str, bool]]:
    """Yields the full name of each run-time import, and whether it is inside a function.

    ``typing`` adds the imports for type checkers.
    """
    for child in ast.iter_child_nodes(node):
        if is_type_checking(child) and not typing:
            continue
        if isinstance(child, ast.Import):
            yield from ((alias.name, lazy) for alias in child.names)
        elif isinstance(child, ast.ImportFrom):
            assert child.level == 0, "imports are absolute"
            yield from ((f"{child.module}.{alias.name}", lazy) for alias in child.names)
        else:
            yield from imports(child, lazy or isinstance(child, ast.FunctionDef | ast.Lambda), typing)


def imported_modules(path: Path, typing: bool = False) -> Iterator[str]:
    """Yields the dotted names of the modules of Lumisplat that a file imports, see `imports`."""
    for full, _ in imports(tree(path), typing=typing):
        head, *rest = full.split(".")
        if head == "lumisplat":
            # ``from lumisplat.math.color import encode_srgb``: the longest prefix that is a module.
            while rest and not (
                PACKAGE.joinpath(*rest).is_dir() or PACKAGE.joinpath(*rest).with_suffix(".py").exists()
            ):
                rest = rest[:-1]
            yield ".".join(rest)


def calls(path: Path) -> Iterator[tuple[str, int]]:
    """Yields the dotted name and line of each call in a file."""
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), node.lineno


def broken_imports(path: Path) -> Iterator[str]:
    """Yields the imports of a file that break the order of the layers."""
    name = module_name(path)
    allowed = MORE_NARROW.get(kind(name))
    for target in imported_modules(path):
        above = LAYERS.index(layer(target)) > LAYERS.index(layer(name))
        if above or (allowed is not None and kind(target) not in allowed and target not in DOCUMENTED):
            yield f"{name} imports {target}"


def test_modules_import_from_their_own_and_lower_layers_and_from_no_others() -> None:
    """The rule covers imports inside functions; ``lumisplat/__init__.py`` imports lazily."""
    inner = [path for path in FILES if module_name(path)]
    assert not [line for path in inner for line in broken_imports(path)]
    front = tree(PACKAGE / "__init__.py")
    assert not [
        full
        for full, lazy in imports(front)
        if full.startswith("lumisplat.") and not (lazy or full == "lumisplat.lazy")
    ]


def test_imports_between_modules_have_no_cycles() -> None:
    """Imports inside functions and imports for type checkers count, too."""
    targets = {module_name(path): {*imported_modules(path, typing=True)} - {module_name(path), ""} for path in FILES}
    done: set[str] = set()
    while ready := {name for name in targets.keys() - done if targets[name] & targets.keys() <= done}:
        done |= ready
    assert not targets.keys() - done


def test_host_only_folders_do_not_import_warp() -> None:
    """Folders of code for the host import Warp neither directly nor through other modules."""
    files = [path for path in FILES if kind(module_name(path)) in HOST_ONLY]
    for path in files:
        assert not [full for full, _ in imports(tree(path)) if full.split(".")[0] == "warp"], path
    names = [f"lumisplat.{module_name(path)}" for path in files]
    program = f"""
import importlib, sys
for name in {names!r}:
    importlib.import_module(name)
import lumisplat
lumisplat.load, lumisplat.Camera, lumisplat.Scene, lumisplat.RenderConfig
assert "warp" not in sys.modules, "warp was imported"
assert "lumisplat.renderer" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_importing_lumisplat_loads_no_heavy_packages() -> None:
    """``import lumisplat`` loads neither NumPy nor larger packages."""
    heavy = "{'numpy', 'warp', 'zstandard', 'PIL', 'OpenEXR', 'rich'}"
    program = f"import sys, lumisplat; print(sorted({heavy} & set(sys.modules)))"
    assert subprocess.check_output([sys.executable, "-c", program], text=True).strip() == "[]"


def is_device_code(path: Path) -> bool:
    """Returns whether Warp compiles a file: kernels, or functions and structs of ``device``."""
    return path.name.endswith("_kernels.py") or module_name(path).startswith("device.")


def misplaced_device_code(path: Path) -> Iterator[str]:
    """Yields launches, kernels and device functions outside of their files."""
    name = module_name(path)
    if name != "runtime.launcher":
        for call, line in calls(path):
            if call.startswith(("wp.launch", "warp.launch", "wp.capture", "wp.ScopedCapture", "wp.ScopedTimer")):
                yield f"{name}:{line} calls {call}"
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.FunctionDef):
            decorators = {ast.unparse(d).split("(")[0] for d in node.decorator_list}
            if "wp.kernel" in decorators and not path.name.endswith("_kernels.py"):
                yield f"{name}:{node.lineno} {node.name} is a kernel"
            if "wp.func" in decorators and not is_device_code(path):
                yield f"{name}:{node.lineno} {node.name} is a wp.func"


def test_kernels_are_launched_only_by_the_launcher_and_defined_only_in_kernel_files() -> None:
    """Launches and graph captures are in launcher.py, kernels in *_kernels.py."""
    assert not [line for path in FILES for line in misplaced_device_code(path)]


ALLOCATORS = {f"wp.{name}" for name in ("zeros", "empty", "full", "ones", "array", "clone", "from_numpy")}
ALLOCATORS |= {f"wp.{name}_like" for name in ("zeros", "empty", "full", "ones")} | {"DeviceArray"}


def test_device_memory_is_allocated_only_in_four_files() -> None:
    """Allocations are in buffers.py, assets.py, struct_tables.py, and downloads.py for host copies."""
    offenders = []
    for path in FILES:
        # In device code, wp.array(dtype=...) is the type of a parameter.
        allocators = ALLOCATORS - {"wp.array"} if is_device_code(path) else ALLOCATORS
        if path.name not in ("buffers.py", "downloads.py", "struct_tables.py", "assets.py"):
            offenders += [(module_name(path), call, line) for call, line in calls(path) if call in allocators]
    assert not offenders


def undocumented(path: Path) -> Iterator[str]:
    """Yields the public names of a file without a docstring."""
    module = tree(path)
    if module.body and not ast.get_docstring(module):
        yield f"{path}: the module"
    classes = (node for node in module.body if isinstance(node, ast.ClassDef))
    bodies = [module, *(node for node in classes if not node.name.startswith("_"))]
    for node in (node for body in bodies for node in body.body):
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            is_overload = any(ast.unparse(one) == "overload" for one in node.decorator_list)
            if not is_overload and not ast.get_docstring(node):
                yield f"{path}: {node.name}"


def test_every_public_name_of_the_source_has_a_docstring() -> None:
    """Names are modules, classes, functions, methods and properties."""
    assert not [name for path in FILES for name in undocumented(path)]


def test_every_source_folder_has_a_docstring() -> None:
    """The ``__init__`` of every folder describes its content."""
    folders = {path.parent for path in FILES}
    assert not [str(folder) for folder in folders if not ast.get_docstring(tree(folder / "__init__.py"))]


def test_every_setting_has_a_docstring_below_its_name() -> None:
    """Settings are the fields of the classes in ``config/``."""
    for node in (node for path in PACKAGE.glob("config/*.py") for node in ast.walk(tree(path))):
        if isinstance(node, ast.ClassDef):
            for field, after in zip(node.body, [*node.body[1:], None], strict=True):
                if isinstance(field, ast.AnnAssign):
                    documented = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
                    assert documented, f"{node.name}.{ast.unparse(field.target)} has no docstring"


def test_readers_of_source_code_find_imports_and_calls_inside_functions_and_blocks(tmp_path: Path) -> None:
    """Imports for type checkers are skipped by default."""
    path = tmp_path / "sample.py"
    path.write_text(
        "from typing import TYPE_CHECKING\nimport warp as wp\n"
        "if TYPE_CHECKING:\n    from lumisplat.frame.frame import Frame\n"
        "from lumisplat.renderer.raster import splat_kernels\n"
        "def f():\n    from lumisplat.io.images import exr\n    wp.launch(k, 1)\n"
    )
    at_run_time = ["renderer.raster.splat_kernels", "io.images.exr"]
    assert list(imported_modules(path)) == at_run_time
    assert list(imported_modules(path, typing=True)) == ["frame.frame", *at_run_time]
    assert ("wp.launch", 8) in list(calls(path))


@pytest.mark.parametrize(
    ("place", "source", "offence"),
    [
        ("math/sample.py", "def f():\n    from lumisplat.scene.camera import Camera\n", "imports scene.camera"),
        ("scene/sample.py", "from lumisplat.runtime.buffers import Buffers\n", "imports runtime.buffers"),
        ("renderer/scene/sample.py", "from lumisplat.renderer.film.film import Film\n", "imports renderer.film.film"),
        ("renderer/film/a_kernels.py", "from lumisplat.config import Pipeline\n", "imports config"),
        ("renderer/sample.py", "import warp as wp\nwp.launch(k, 1)\n", "calls wp.launch"),
        ("renderer/sample.py", "@wp.kernel\ndef k():\n    pass\n", "k is a kernel"),
        ("scene/sample.py", "@wp.func\ndef f():\n    pass\n", "f is a wp.func"),
        ("scene/sample.py", '"""Module."""\ndef f():\n    pass\n', "sample.py: f"),
    ],
)
def test_each_broken_architecture_rule_is_reported_with_the_offending_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str, source: str, offence: str
) -> None:
    """Rules on imports, launches, device code and docstrings are each broken once."""
    package = tmp_path / "lumisplat"
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
    (package / place).write_text(source)
    monkeypatch.setattr(sys.modules[__name__], "PACKAGE", package)
    found = [*broken_imports(package / place), *misplaced_device_code(package / place), *undocumented(package / place)]
    assert any(offence in line for line in found), found
