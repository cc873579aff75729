"""Tests the length of commit subjects in the history."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SUBJECT_MAX = 72
FIRST = "3b2d25ac"
"""Last commit before the limit was enforced."""


def test_commit_subjects_have_at_most_72_characters() -> None:
    """Commits before the limit was enforced are exempt."""
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
    log = subprocess.run(
        ["git", "log", "--format=%s", f"{FIRST}.."], cwd=ROOT, check=False, capture_output=True, text=True
    )
    if log.returncode:
        pytest.skip("the history is not here: an export, or a shallow clone")
    assert [subject for subject in log.stdout.splitlines() if len(subject) > SUBJECT_MAX] == []
