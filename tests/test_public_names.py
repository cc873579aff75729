"""The names of the package are what they say, whatever was imported before."""

from __future__ import annotations

import subprocess
import sys

import pytest


@pytest.mark.parametrize("first", ["ls.render", "ls.create_renderer", "__import__('lumisplat.render.frame')"])
def test_render_stays_callable(first):
    """`lumisplat.render` is a function, also once the package of the same name has been imported."""
    program = f"import lumisplat as ls; {first}; ls.create_renderer; assert callable(ls.render), ls.render"
    subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)
