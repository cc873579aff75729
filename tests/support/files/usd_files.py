"""Writes OpenUSD files as text, and validates files with usd-core."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

EXTENSIONS = (".usda", ".usdc", ".usdz", ".usd")


def usd_core(module: str = "Usd") -> Any:
    """Returns a module of usd-core, or skips the test if usd-core is missing."""
    pytest.importorskip("pxr", reason="needs usd-core: pip install 'lumisplat[usd]'")
    return pytest.importorskip(f"pxr.{module}")


def write_usda(path: Path, body: str, head: str = 'upAxis = "Y"') -> Path:
    """Writes a text layer with the given body. Returns its path."""
    usd_core()
    path.write_text(f"#usda 1.0\n(\n{head}\n)\n{body}\n")
    return path


def field(
    values: Mapping[str, str] | None = None,
    *,
    count: int = 2,
    properties: str = "",
    kind: str = "ParticleField3DGaussianSplat",
    name: str = "splats",
    schemas: str = "",
) -> str:
    """Returns a particle field as text; by default, ``count`` particles 1 apart along x."""
    positions = ", ".join(f"({k}, 0, 0)" for k in range(count))
    given = {"point3f[] positions": f"[{positions}]", **(values or {})}
    lines = "\n".join(f"    {key} = {held}" for key, held in given.items() if held)
    applied = f"( prepend apiSchemas = [{schemas}] )\n" if schemas else ""
    return f'def {kind} "{name}" {applied}{{\n{lines}\n    {properties}\n}}'


def validation_messages(path: Path) -> list[str]:
    """Returns the messages of usd-core's validators about a file."""
    usd, validation = usd_core(), usd_core("UsdValidation")
    validators = validation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) >= 20
    errors = validation.ValidationContext(validators).Validate(usd.Stage.Open(str(path)))
    return [str(error.GetMessage()) for error in errors]
