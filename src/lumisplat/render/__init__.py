"""Stages of a frame: ``<stage>.py`` is the host pass, ``<stage>_kernels.py`` its thin kernels.

The package shares its name with the public function ``lumisplat.render``, and importing any of its modules puts the
package in the function's place. So the package can be called, and is that function.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any


class _CallablePackage(ModuleType):
    def __call__(self, *args: Any, **options: Any) -> Any:
        from lumisplat.render.calls import render

        return render(*args, **options)


sys.modules[__name__].__class__ = _CallablePackage
