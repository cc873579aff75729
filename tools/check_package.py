"""Builds the sdist and the wheel, and tests the wheel in a fresh environment of each given Python.

    python tools/check_package.py python3.11 python3.12 python3.13 python3.14
    python tools/check_package.py python3.12 --extras view,video

Needs the package registry. Prints one line per interpreter; the exit status is 1 if one fails. The test runs
``lumisplat doctor``, renders the demo, for which nothing may be compiled, converts its capture to each compressed
format, and imports all modules.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
import zipfile
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[1]
_IMPORT_ALL = """
import importlib, lumisplat, pathlib, pkgutil
root = pathlib.Path(lumisplat.__file__).parent
assert (root / "py.typed").is_file(), "py.typed is missing"
names = [name for _, name, _ in pkgutil.walk_packages([str(root)], "lumisplat.")]
assert len(names) > 300, f"only {len(names)} modules"
for name in names:
    if name != "lumisplat.__main__" and not name.startswith("lumisplat.viewer"):
        importlib.import_module(name)
"""
_COMPILED = "lumisplat/runtime/compiled/"
_FORMATS = ("spz", "sog", "compressed.ply")


def main() -> int:
    """Builds the wheel, and tests it with each interpreter."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pythons", nargs="*", default=[sys.executable], help="interpreters; default: this one")
    parser.add_argument("--extras", default="", help="extras to install, such as view,video")
    args = parser.parse_args()
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        wheel = build_wheel(Path(folder))
        for number, python in enumerate(args.pythons):
            started = time.monotonic()
            try:
                version = try_wheel(python, wheel, args.extras, Path(folder) / f"try-{number}")
                print(f"{python}: {version}, passed, {time.monotonic() - started:.0f} s", flush=True)
            except FileNotFoundError as error:
                failed += 1
                print(f"{python}: no such interpreter: {error.filename}", flush=True)
            except subprocess.CalledProcessError as error:
                failed += 1
                last = (error.stderr or error.stdout or "no output").strip().splitlines()[-1]
                print(f"{python}: `{' '.join(map(str, error.cmd[:6]))}` failed: {last}", flush=True)
    return min(failed, 1)


def build_wheel(folder: Path) -> Path:
    """Builds sdist and wheel, checks that the sdist builds the same wheel, and returns the wheel."""
    run(sys.executable, "-m", "venv", folder / "build")
    python = interpreter(folder / "build")
    run(python, "-m", "pip", "install", "--quiet", "build")
    run(python, "-m", "build", "-o", folder / "dist", _ROOT)  # the wheel from the sdist
    (wheel,), (sdist,) = (folder / "dist").glob("*.whl"), (folder / "dist").glob("*.tar.gz")
    run(python, "-m", "build", "--wheel", "-o", folder / "again", _ROOT, HATCH_BUILD_NO_HOOKS="true")
    (again,) = (folder / "again").glob("*.whl")
    compiled = {name for name in names_in(wheel) if name.startswith(_COMPILED)}
    if names_in(wheel) - compiled != names_in(again):
        raise SystemExit(f"the sdist lacks {sorted(names_in(wheel) - compiled ^ names_in(again))[:5]}")
    if not compiled:
        raise SystemExit("the wheel has no compiled kernels")
    sizes = ", ".join(f"{path.name} {path.stat().st_size / 1e6:.1f} MB" for path in (wheel, sdist))
    print(f"{sizes}: {len(names_in(wheel))} files, {len(compiled)} of compiled kernels", flush=True)
    return wheel


def try_wheel(python: str, wheel: Path, extras: str, folder: Path) -> str:
    """Installs and uses the wheel in a new environment; returns the version of Python."""
    run(python, "-m", "venv", folder / "venv")
    inside = interpreter(folder / "venv")
    run(inside, "-m", "pip", "install", "--quiet", f"{wheel}[{extras}]" if extras else wheel)
    run(inside, "-m", "lumisplat", "doctor", cwd=folder)
    run(inside, "-c", _IMPORT_ALL, cwd=folder)
    cache = folder / "kernels"
    demo = ("demo", "-o", "out", "--width", "160", "--save-assets", "--device", "cpu")
    run(inside, "-m", "lumisplat", *demo, cwd=folder, WARP_CACHE_PATH=str(cache))
    if compiled := list(cache.rglob("*.o")):
        raise SystemExit(f"kernels had to be compiled: {compiled[0].name}")
    for name in _FORMATS:
        run(inside, "-m", "lumisplat", "convert", "out/demo.ply", f"out/demo.{name}", cwd=folder)
        run(
            inside,
            "-m",
            "lumisplat",
            "render",
            f"out/demo.{name}",
            "-o",
            f"out/{name}.png",
            "--width",
            "160",
            cwd=folder,
        )
    return run(inside, "-c", "import platform; print(platform.python_version(), platform.machine())").strip()


def interpreter(environment: Path) -> Path:
    """Returns the Python of a virtual environment."""
    return environment / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")


def names_in(wheel: Path) -> set[str]:
    """Returns the names of the files in a wheel."""
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


def run(*command: object, cwd: Path | None = None, **environment: str) -> str:
    """Runs a command, with more variables in its environment if given, and returns its output."""
    return subprocess.run(
        list(map(str, command)), cwd=cwd, env=os.environ | environment, check=True, capture_output=True, text=True
    ).stdout


if __name__ == "__main__":
    raise SystemExit(main())
