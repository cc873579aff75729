"""Kernels that wheels contain are loaded where they fit the machine; otherwise kernels are compiled as ever."""

from __future__ import annotations

import ast
import importlib
import inspect
import logging
import os
import pkgutil
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest
import warp as wp
from tools.compile_kernels import compile_into, cpu_modules

import lumisplat
from lumisplat.runtime import shipped_objects
from lumisplat.runtime.kernel_cache import load_module
from lumisplat.runtime.launcher import Launcher
from lumisplat.runtime.shipped_objects import missing_features, shipped_state, target_of_kernels
from lumisplat.runtime.start import start_warp


@wp.kernel(module="unique", enable_backward=False)
def thrice(values_inout: wp.array(dtype=float)):  # pyright: ignore[reportInvalidTypeForm]
    """Multiplies each element by three."""
    i = wp.tid()
    values_inout[i] = 3.0 * values_inout[i]


MODULE: Any = cast(Any, thrice).module


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a folder with the shipped kernel."""
    start_warp()
    if missing_features():
        pytest.skip("kernels are shipped for x86-64 CPUs with AVX2")
    folder = tmp_path_factory.mktemp("compiled") / "kernels"
    compile_into(folder, [MODULE])
    return folder


@pytest.fixture
def shipped(compiled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Returns the object file of a kernel that is shipped and not loaded yet, on a machine with an empty cache."""
    MODULE.unload()
    shutil.copytree(compiled, tmp_path / "shipped")
    (tmp_path / "cache").mkdir()
    monkeypatch.setattr(shipped_objects, "SHIPPED_FOLDER", tmp_path / "shipped")
    monkeypatch.setattr(wp.config, "kernel_cache_dir", os.fspath(tmp_path / "cache"))
    (path,) = (tmp_path / "shipped").rglob("*.o")
    return path


@pytest.fixture
def left_to_warp(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Returns the growing list of the modules that are left to Warp, which would compile them."""
    names: list[str] = []
    monkeypatch.setattr(wp, "load_module", lambda module, **_: names.append(module.name))
    return names


def test_shipped_kernels_run_without_compilation_and_nothing_is_written(shipped: Path, tmp_path: Path) -> None:
    """The cache stays empty, and the files of the installation, which may be another user's, stay as they are."""
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    load_module(MODULE, "cpu", 1)
    values = wp.array([1.0, 2.0], dtype=float, device="cpu")
    wp.launch(cast(Any, thrice), 2, inputs=[values], device="cpu", block_dim=1)
    assert values.numpy().tolist() == [3.0, 6.0]
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
    assert shipped_state() == "1 modules for CPUs, used"


def test_launch_of_a_module_that_no_pass_has_loaded_uses_the_shipped_object(shipped: Path, tmp_path: Path) -> None:
    """Warp loads such a module itself, without knowing of shipped objects."""
    values = wp.array([1.0, 2.0], dtype=float, device="cpu")
    Launcher("cpu").run(thrice, 2, values)
    assert values.numpy().tolist() == [3.0, 6.0]
    assert not any((tmp_path / "cache").rglob("*.o"))


def test_threads_load_one_shipped_kernel_at_the_same_time(shipped: Path, left_to_warp: list[str]) -> None:
    """Launchers of several threads and processes share the files, because they only read them."""
    errors: list[BaseException] = []

    def load() -> None:
        try:
            load_module(MODULE, "cpu", 1)
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=load) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors and not left_to_warp


def test_shipped_kernels_are_compiled_for_the_instruction_set_that_is_checked(
    shipped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The compiler gets x86-64-v3 in place of this CPU, whose AVX-512 would end other machines' programs (SIGILL).

    The module's other flags are kept, since they change the bits of its results.
    """
    used: list[str] = []
    build = wp._src.build  # pyright: ignore[reportAttributeAccessIssue]
    real = cast(Callable[..., None], build.build_cpu)  # pyright: ignore[reportUnknownMemberType]

    def recorded(*args: object, **kwargs: object) -> None:
        used.append(str(kwargs["extra_flags"]))
        real(*args, **kwargs)

    monkeypatch.setattr(build, "build_cpu", recorded)
    flags = {"cpu_compiler_flags": "-march=native -ffp-contract=fast"}
    wp.set_module_options(flags, MODULE)
    try:
        compile_into(tmp_path / "kernels", [MODULE])
        assert used == ["-target-cpu x86-64-v3 -ffp-contract=fast"]
        assert MODULE.options.items() >= flags.items(), "the module would be compiled for x86-64-v3 ever after"
    finally:
        wp.set_module_options({"cpu_compiler_flags": None}, MODULE)


@pytest.mark.parametrize("feature", ["avx2", "fma", "bmi2"])
def test_cpu_without_the_instruction_set_compiles_its_own_kernels(
    feature: str, shipped: Path, left_to_warp: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Shipped kernels would end the program with SIGILL; the line of `lumisplat doctor` names what is missing."""
    context: Any = wp._src.context  # pyright: ignore[reportAttributeAccessIssue, reportUnknownMemberType]
    features = context._get_cpu_feature_set() - {feature}
    monkeypatch.setattr(context, "_get_cpu_feature_set", lambda: features)
    load_module(MODULE, "cpu", 1)
    assert left_to_warp == [MODULE.name]
    assert shipped_state() == f"1 modules, not used: the CPU lacks {feature}"


def test_other_version_of_warp_compiles_its_own_kernels(shipped: Path, left_to_warp: list[str]) -> None:
    """Structs and functions of Warp may have changed; the line of `lumisplat doctor` names both versions."""
    shipped.parent.rename(shipped.parent.with_name("1.18.0-Linux-x86_64-0123abcd-x86-64-v3"))
    load_module(MODULE, "cpu", 1)
    assert left_to_warp == [MODULE.name]
    assert "not used: made for 1.18.0-Linux-x86_64-0123abcd-x86-64-v3, but this is " in shipped_state()
    assert shipped_state().endswith(f"{target_of_kernels()}: install Lumisplat again")


def test_kernels_whose_source_or_options_differ_are_compiled(shipped: Path, left_to_warp: list[str]) -> None:
    """A kernel edited after the installation, or other settings of Warp such as debug mode, never meets old code."""
    wp.set_module_options({"max_unroll": 3}, MODULE)
    try:
        load_module(MODULE, "cpu", 1)
        assert left_to_warp == [MODULE.name]
    finally:
        wp.set_module_options({"max_unroll": 16}, MODULE)


@pytest.mark.parametrize("suffix", [".o", ".meta"])
def test_damaged_shipped_kernels_are_compiled_with_a_warning(
    suffix: str, shipped: Path, compiled: Path, left_to_warp: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    """A disk that was full during the installation costs time, and no frame; the files of another one replace these."""
    file = shipped.with_suffix(suffix)
    os.truncate(file, file.stat().st_size // 2)
    with caplog.at_level(logging.WARNING, "lumisplat"):
        load_module(MODULE, "cpu", 1)
    assert left_to_warp == [MODULE.name]
    assert [record.getMessage() for record in caplog.records] == [
        f"{shipped}: shipped kernels are damaged and are compiled here; install Lumisplat again to replace them"
    ]
    shutil.copytree(compiled, shipped.parents[1], dirs_exist_ok=True)
    load_module(MODULE, "cpu", 1)
    assert left_to_warp == [MODULE.name]


def test_installation_without_shipped_kernels_compiles_them(
    shipped: Path, left_to_warp: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Editable installs have none."""
    monkeypatch.setattr(shipped_objects, "SHIPPED_FOLDER", tmp_path / "nothing")
    load_module(MODULE, "cpu", 1)
    assert left_to_warp == [MODULE.name]
    assert shipped_state() == "none: kernels are compiled on first use"


def test_kernels_of_all_pipelines_of_the_cpu_are_shipped_and_none_of_cuda() -> None:
    """Modules that only CUDA's schedule launches would cost time and space for nothing."""
    names = {module.name.rpartition(".")[2].partition("__")[0] for module in cpu_modules()}
    assert {"path_kernels", "secondary_ray_kernels", "gaussian_trace_kernel", "shadow_kernel", "trial_kernels"} <= names
    assert not names & {"blocks", "pairs"}


def test_no_local_name_in_kernel_code_hides_a_function_of_its_module() -> None:
    """Warp hashes such a function as a reference until it generates the code, and after that no more.

    The module would have two hashes: users would compile it in their first process and again in the second, and a
    shipped object would not have the kernels that its name promises.
    """
    hidden: list[str] = []
    for info in pkgutil.walk_packages(lumisplat.__path__, "lumisplat."):
        if info.ispkg or not (info.name.endswith("_kernels") or ".device." in info.name):
            continue
        module = importlib.import_module(info.name)
        for function in ast.walk(ast.parse(inspect.getsource(module))):
            if isinstance(function, ast.FunctionDef):
                stored = {node.id for node in ast.walk(function) if isinstance(node, ast.Name) and is_stored(node)}
                names = (stored | {arg.arg for arg in function.args.args}) - {"_"}
                hidden += [f"{info.name}.{function.name}: {name}" for name in names & vars(module).keys()]
    assert not hidden


def is_stored(name: ast.Name) -> bool:
    """Returns whether an expression assigns to a name."""
    return isinstance(name.ctx, ast.Store)
