"""Light of a captured scene on what is put into it: lights found, probes, transfer to avatars (seeds/001).

The package shares its name with the public function ``lumisplat.relight``, and importing any of its modules puts the
package in the function's place. So the package can be called, and is that function.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any


class _CallablePackage(ModuleType):
    def __call__(self, *args: Any, **options: Any) -> Any:
        from lumisplat.relight.transfer import relight

        return relight(*args, **options)


sys.modules[__name__].__class__ = _CallablePackage
