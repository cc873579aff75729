"""Runs ``lumisplat train`` and kills it: ``python -m support.killed_training MOMENT NUMBER ARGUMENTS...``.

The process writes a checkpoint after each step, and sends itself SIGKILL the NUMBER-th time it reaches MOMENT; with the
moment ``never``, it runs to its end.
"""

from __future__ import annotations

import io
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from lumisplat.cli import main
from lumisplat.training import find_materials, run_folder, train
from lumisplat.training.material_fit import MaterialFit
from lumisplat.training.trainer import Trainer


def die() -> None:
    """Kills the process like `kill -9`, without cleanup."""
    os.kill(os.getpid(), signal.SIGKILL)


def dying(function: Callable[..., Any], number: int, *, after: bool) -> Callable[..., Any]:
    """Returns a function that kills the process at its ``number``-th call, before or after its work."""
    calls = 0

    def called(*arguments: Any, **options: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == number and not after:
            die()
        result = function(*arguments, **options)
        if calls == number:
            die()
        return result

    return called


def dying_in_writing(number: int) -> Callable[..., None]:
    """Returns a ``numpy.savez`` that kills the process at its ``number``-th call, with half of the file written."""
    calls, savez = 0, np.savez

    def called(file: BinaryIO, **arrays: Any) -> None:
        nonlocal calls
        calls += 1
        whole = io.BytesIO()
        savez(whole, **arrays)
        data = whole.getvalue()
        file.write(data if calls != number else data[: len(data) // 2])
        file.flush()
        if calls == number:
            die()

    return called


def arm(moment: str, number: int) -> None:
    """Patches the function that MOMENT names, so that the process dies at its NUMBER-th call."""
    match moment:
        case "in a step of materials":
            MaterialFit.step = dying(MaterialFit.step, number, after=True)
        case "before the capture has materials":
            find_materials.save = dying(find_materials.save, number, after=False)
        case "in a step":
            Trainer._update = dying(Trainer._update, number, after=True)
        case "as a checkpoint is written":
            np.savez = dying_in_writing(number)
        case "before a checkpoint has its name":
            os.replace = dying(os.replace, number, after=False)
        case "after a checkpoint has its name":
            train.write_checkpoint = dying(train.write_checkpoint, number, after=True)
        case "before the capture is written":
            train.save = dying(train.save, number, after=False)
        case "after the capture is written":
            train.save = dying(train.save, number, after=True)
        case "as metrics are written":
            run_folder._write = dying(run_folder._write, number, after=False)
        case "as pictures are written":
            run_folder.write_pair = dying(run_folder.write_pair, number, after=True)
        case _:
            assert moment == "never", moment


if __name__ == "__main__":
    train.CHECKPOINT_EVERY_S = find_materials.CHECKPOINT_EVERY_S = 0.0
    arm(sys.argv[1], int(sys.argv[2]))
    assert Path(sys.argv[4]).is_dir()
    sys.exit(main(sys.argv[3:]))
