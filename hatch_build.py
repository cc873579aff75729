"""Puts compiled kernels into wheels, so that the first frame after an installation compiles nothing.

Editable installs get none, because their kernels change. ``HATCH_BUILD_NO_HOOKS=true`` builds a wheel without them.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class CompiledKernels(BuildHookInterface):
    """Compiles the kernels in a process of its own; a wheel without them works too, so no failure ends the build."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compiles the kernels, unless the install is editable, and adds them to the wheel."""
        if version == "editable":
            return
        self._folder = tempfile.mkdtemp(prefix="lumisplat-kernels-")
        paths = [os.path.join(self.root, "src"), self.root, os.environ.get("PYTHONPATH", "")]
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(filter(None, paths)),
            "WARP_CACHE_PATH": self._folder,
        }
        out = Path(self._folder, "compiled")
        self.app.display_info("compiling kernels: a minute or two")
        done = subprocess.run(
            [sys.executable, "-m", "tools.compile_kernels", out], cwd=self.root, env=environment, check=False
        )
        if done.returncode == 0:
            build_data["force_include"][str(out)] = "lumisplat/runtime/compiled"
        else:
            self.app.display_warning("kernels could not be compiled here: the first frames will compile them")

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Removes what was compiled, which the wheel now contains."""
        if version != "editable":
            shutil.rmtree(self._folder, ignore_errors=True)
