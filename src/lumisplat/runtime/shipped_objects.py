"""Kernels compiled when Lumisplat was built, for CPUs: with them the first frame on a machine compiles nothing.

Wheels contain them, made by `tools/compile_kernels.py`: an object file for each Warp module, in a folder named after
the versions of Warp and its compiler, the operating system and the instruction set. File names contain Warp's hash of
the module's source and options. So a shipped kernel is loaded only if it is the one that would be compiled; otherwise,
kernels are compiled on first use. The files are read where they are installed, and nothing is written.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import warp as wp

SHIPPED_FOLDER = Path(__file__).with_name("compiled")
"""Folder of the shipped kernels; editable installs have none."""

INSTRUCTION_SET = "x86-64-v3"
"""Instruction set of the shipped kernels, which are no slower than those for CPUs with more features (ADR 0112)."""

_NEEDED = ("avx2", "bmi", "bmi2", "cx16", "f16c", "fma", "lzcnt", "movbe", "popcnt", "sahf", "sse4.2")
"""Features of x86-64-v3 by LLVM's names: those of servers since 2013, and of PCs since about 2015."""


def target_of_kernels() -> str:
    """Returns the name of the folder with kernels for this system and version of Warp; initialises Warp."""
    return f"{wp.get_cpu_kernel_cache_key(cpu_compiler_flags='')}-{INSTRUCTION_SET}"


def shipped_object(module: wp.Module, block_threads: int) -> Path | None:
    """Returns the shipped object file of a Warp module for this machine, or None; its metadata are beside it."""
    if not SHIPPED_FOLDER.is_dir() or missing_features():
        return None
    path = SHIPPED_FOLDER / target_of_kernels() / f"{module.get_module_identifier(block_threads)}.o"
    return path if path.is_file() else None


def missing_features() -> list[str]:
    """Returns the features of `INSTRUCTION_SET` that this machine's CPU lacks; Warp must be initialised."""
    context: Any = getattr(getattr(wp, "_src", None), "context", None)
    found: frozenset[str] = getattr(context, "_get_cpu_feature_set", frozenset[str])()
    return [name for name in _NEEDED if name not in found]


def shipped_state() -> str:
    """Returns in a line how many kernel modules are shipped, and why, if they are not used on this machine."""
    if not SHIPPED_FOLDER.is_dir():
        return "none: kernels are compiled on first use"
    target = target_of_kernels()
    count = sum(1 for _ in SHIPPED_FOLDER.rglob("*.o"))
    if missing := missing_features():
        return f"{count} modules, not used: the CPU lacks {', '.join(missing)}"
    if not (SHIPPED_FOLDER / target).is_dir():
        made_for = ", ".join(sorted(folder.name for folder in SHIPPED_FOLDER.iterdir()))
        return f"{count} modules, not used: made for {made_for}, but this is {target}: install Lumisplat again"
    return f"{count} modules for CPUs, used"
