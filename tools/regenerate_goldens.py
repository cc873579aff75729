"""Renders the golden frames again: ``python tools/regenerate_goldens.py``.

Writes tests/golden/*.npz, and out/goldens.png with old frame, new frame and ten times their difference side by side.
Look at it before committing, because the new frames become the reference.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import lumisplat as ls  # noqa: E402
from lumisplat.io.images.texture import write_png  # noqa: E402
from support.compare.goldens import CASES, FOLDER  # noqa: E402


def main() -> None:
    """Renders, compares and stores every case."""
    scene = ls.demo_scene()
    FOLDER.mkdir(exist_ok=True)
    sheet = []
    for case in CASES:
        new = case.render(scene)
        old = new["color"]
        if case.path.is_file():
            with np.load(case.path) as stored:
                old = stored["color"].astype(np.float32)
        difference = np.abs(new["color"] - old)
        sheet.append(np.concatenate([old, new["color"], 10.0 * difference], axis=1))
        stored = {name: image.astype(np.float16) for name, image in new.items()}
        np.savez_compressed(case.path, **stored)  # pyright: ignore[reportArgumentType]
        print(
            f"{case.view}: mean difference {255 * difference.mean():.3f}/255, largest {255 * difference.max():.1f}/255"
        )
    write_png(ROOT / "out" / "goldens.png", np.concatenate(sheet, axis=0))


if __name__ == "__main__":
    main()
