"""Benchmarks of speed and of accuracy: ``python -m bench`` lists the commands."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path += [str(ROOT / "tests"), str(ROOT / "tools")]  # test scenes, and data set generators
