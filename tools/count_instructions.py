"""Counts the GPU resources of kernels from their compiled code; no GPU is needed.

Prints registers, bytes of stack, instructions, and memory accesses by kind, and for each loop the smallest and largest
number of instructions per iteration. Needs ``cuobjdump``, of the CUDA toolkit or of its wheels::

    python3 -m venv cuda && cuda/bin/pip install nvidia-cuda-cuobjdump nvidia-cuda-nvdisasm
    export PATH=$PATH:$(echo $PWD/cuda/lib/python3*/site-packages/nvidia/cu13/bin)
    .venv/bin/python tools/count_instructions.py lumisplat.renderer.raster.splat_kernels:BLOCKS

The part of a name after a colon is one of the file's Warp modules, or a function that makes a kernel, called for one
ray per packet as on CUDA. Numbers after further colons are the function's other arguments, such as a stack size.
"""

from __future__ import annotations

import argparse
import functools
import importlib
import re
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import warp as wp

ACCESSES = ("LDG", "STG", "LDS", "STS", "LDL", "STL", "LD.", "ST.")
"""Instructions for global, shared, local and generic memory."""
LOOP_MIN = 8
"""Smallest length of a listed loop; shorter loops are copies and sums."""


def main() -> None:
    """Prints the resources of the given modules."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("modules", nargs="+")
    parser.add_argument("--arch", type=int, nargs="+", default=[90, 86])
    given = parser.parse_args()
    for name in given.modules:
        for arch in given.arch:
            with tempfile.TemporaryDirectory() as folder:
                found = wp.compile_aot_module(module_of(name), arch=[arch], module_dir=folder, use_ptx=False)
                cubin = next(Path(path) for path in found if str(path).endswith(".cubin"))
                print(f"{name}, sm_{arch}")
                resources = dict(re.findall(r"Function (\S+):\s*\n\s*(REG:\d+ STACK:\d+)", dumped("-res-usage", cubin)))
                for function in dumped("-sass", cubin).split("Function : ")[1:]:
                    kernel = function.split()[0]
                    print(f"  {kernel}: {resources[kernel]}")
                    for line in counts(function):
                        print(f"    {line}")


def module_of(name: str) -> Any:
    """Returns a module of kernels, or the module of the kernel that a function makes."""
    file, *names = name.split(":")
    found = importlib.import_module(file)
    if not names:
        return found
    named = getattr(found, names[0])
    return named if isinstance(named, wp.Module) else named(1, *map(int, names[1:])).module


def dumped(what: str, cubin: Path) -> str:
    """Returns the output of cuobjdump."""
    try:
        return subprocess.run(["cuobjdump", what, cubin], capture_output=True, text=True, check=True).stdout
    except FileNotFoundError:
        sys.exit("cuobjdump is not on the PATH: see the head of this file")


def counts(function: str) -> Iterator[str]:
    """Yields lines with instructions and accesses of a function, and of each of its loops."""
    code = [(int(at, 16), text.strip()) for at, text in re.findall(r"/\*([0-9a-f]{4,})\*/\s+([^;]*);", function)]
    yield f"{sum(operation(text) != 'NOP' for _, text in code)} instructions, {accesses(code)}"
    position = {at: number for number, (at, _) in enumerate(code)}
    for end, (at, text) in enumerate(code):
        target = branch_of(text)
        if target is not None and target <= at and end - position[target] >= LOOP_MIN:
            fewest, most = round_lengths(code, position, position[target], end)
            loop = code[position[target] : end + 1]
            yield f"loop at {target:#06x}: {fewest} to {most} instructions a round, {accesses(loop)}"


def operation(text: str) -> str:
    """Returns the name of an instruction without its predicate."""
    words = text.split()
    return words[1] if words[0].startswith("@") else words[0]


def accesses(code: list[tuple[int, str]]) -> str:
    """Returns the memory accesses by kind."""
    found = Counter(operation(text) for _, text in code if operation(text).startswith(ACCESSES))
    return ", ".join(f"{count} {name}" for name, count in sorted(found.items())) or "no memory"


def branch_of(text: str) -> int | None:
    """Returns the target of a branch instruction."""
    found = re.search(r"\bBRA\b.*?(0x[0-9a-f]+)", text)
    return int(found[1], 16) if found else None


def round_lengths(code: list[tuple[int, str]], position: dict[int, int], begin: int, end: int) -> tuple[int, int]:
    """Returns the smallest and largest number of instructions from the begin of a loop to its end.

    An inner loop counts as one iteration.
    """
    sys.setrecursionlimit(100_000)

    @functools.cache
    def lengths(number: int) -> tuple[float, float]:
        if number == end:
            return 1.0, 1.0
        text = code[number][1]
        target = branch_of(text)
        always = target is not None and not text.startswith("@") and not re.search(r"BRA !?U?P\d", text)
        following = [] if always or (operation(text) == "EXIT" and not text.startswith("@")) else [number + 1]
        following += [position[target]] if target is not None else []
        lengths_after = [lengths(other) for other in following if number < other <= end]
        return 1.0 + min((one[0] for one in lengths_after), default=1e9), 1.0 + max(
            (one[1] for one in lengths_after), default=-1e9
        )

    fewest, most = lengths(begin)
    return int(fewest), int(most)


if __name__ == "__main__":
    main()
