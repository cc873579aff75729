"""Measures how fast Lumisplat is and how near to the truth: ``python -m bench`` lists the commands."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path += [str(ROOT / "tests"), str(ROOT / "tools")]  # scenes of the tests, and makers of data sets
