"""Diagnostics of this machine: devices on which a kernel is tried, the kernel cache, packages and extras."""

from __future__ import annotations

import contextlib
import os
import platform
import re
import shutil
import sys
import tempfile
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from lumisplat.errors import DeviceError, LumisplatError
from lumisplat.memory import usable_memory
from lumisplat.runtime import trial_kernels
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.kernel_cache import OTHER_CACHE, cache_error
from lumisplat.runtime.launcher import Launcher, usable_cores
from lumisplat.runtime.shipped_objects import shipped_state
from lumisplat.runtime.start import start_warp

_DISTRIBUTION = "lumisplat"
_FOR_DEVELOPERS = ("dev", "docs", "bench")
"""Extras (optional dependencies) for development alone, which the diagnosis leaves out."""

_TRIAL_SIZE = 1_000
_FREE_BYTES_MIN = 2**29
"""Free disk space in bytes below which compiled kernels may not fit. The kernels of one version took 186 MB after all
tests had run."""

_SIGNS_OF_A_GPU = ("/dev/nvidia0", "/dev/dxg", "/proc/driver/nvidia/version")
"""Files that exist where an NVIDIA driver is installed; ``/dev/dxg`` is that of WSL."""


@dataclass(frozen=True)
class DeviceFacts:
    """A compute device of this machine, and whether it runs kernels."""

    name: str
    """Name to give as ``device``: ``cpu``, ``cuda:0``."""
    description: str
    """Model name, such as ``NVIDIA H100 80GB HBM3``."""
    memory_bytes: int
    """Memory in bytes; 0 if unknown."""
    problem: str | None
    """Reason why a small test kernel failed; None if it ran and its results were right."""


@dataclass(frozen=True)
class CacheFacts:
    """Folder of compiled kernels, its size, and the free disk space."""

    folder: Path
    used_bytes: int
    free_bytes: int
    problem: str | None
    """Reason why compiled kernels cannot be stored in the folder; None if they can."""


@dataclass(frozen=True)
class PackageFacts:
    """A package that Lumisplat or one of its extras requires, and its installed version."""

    name: str
    needed: str
    """Required versions, such as ``>=1.19``; empty if any version will do."""
    installed: str | None
    """Installed version; None if the package is missing."""
    is_right: bool
    """True if the installed version is one of the required versions."""


@dataclass(frozen=True)
class ExtraFacts:
    """An optional feature set (pip extra) and the packages that it needs."""

    name: str
    packages: tuple[PackageFacts, ...]

    @property
    def is_installed(self) -> bool:
        """True if all packages of the extra are installed in a right version."""
        return all(package.is_right for package in self.packages)

    @property
    def install(self) -> str:
        """The pip command that installs the extra."""
        return f"pip install 'lumisplat[{self.name}]'"


@dataclass(frozen=True)
class Diagnosis:
    """Findings of `lumisplat.diagnostics.diagnose`: versions, devices, kernel cache, packages and extras."""

    version: str
    """Version of Lumisplat."""
    python: str
    """Version and path of the Python interpreter."""
    system: str
    """Operating system and architecture."""
    cores: int
    """Number of CPU cores that this process may use."""
    packages: tuple[PackageFacts, ...]
    """Packages that Lumisplat itself requires, without those of extras."""
    devices: tuple[DeviceFacts, ...]
    cache: CacheFacts
    shipped_kernels: str
    """Number of kernel modules that were compiled for CPUs when Lumisplat was built, and whether they are used here."""
    extras: tuple[ExtraFacts, ...]
    remarks: tuple[str, ...]
    """Observations that need no fix but may surprise, such as a GPU that cannot be used, one line each."""

    @property
    def problems(self) -> tuple[str, ...]:
        """Problems to fix before everything works, one line each; empty if there are none."""
        lines = [
            f"{package.name} is {package.installed or 'not installed'}, expected {package.needed or 'any version'}: "
            f"pip install '{package.name}{package.needed}'"
            for package in self.packages
            if not package.is_right
        ]
        lines += [f"{device.name}: {device.problem}" for device in self.devices if device.problem]
        return (*lines, *([self.cache.problem] if self.cache.problem else []))


def diagnose() -> Diagnosis:
    """Inspects this machine for Lumisplat, and runs a small kernel on each device.

    Takes a few seconds if the kernel is not in the kernel cache yet. Apart from adding the kernel to the cache, the
    function changes and installs nothing.

    Returns:
        The findings. They include all problems; the function never raises an error for a problem.
    """
    cache = _cache()
    with _writable_cache(cache):
        devices = tuple(_tested_device(device) for device in wp.get_devices())
        shipped = shipped_state()
    return Diagnosis(
        version=metadata.version(_DISTRIBUTION),
        python=f"{platform.python_version()}, {sys.executable}",
        system=f"{platform.system()} {platform.release()}, {platform.machine()}",
        cores=usable_cores(),
        packages=_packages(extra=""),
        devices=devices,
        cache=cache,
        shipped_kernels=shipped,
        extras=tuple(ExtraFacts(name, _packages(name)) for name in _extras() if name not in _FOR_DEVELOPERS),
        remarks=tuple(_remarks(devices)),
    )


@contextlib.contextmanager
def _writable_cache(cache: CacheFacts) -> Generator[None]:
    """Switches to a temporary kernel cache if the real one cannot be written, so that devices can still be tested."""
    if cache.problem is None:
        yield
        return
    before = wp.config.kernel_cache_dir
    with tempfile.TemporaryDirectory() as folder:
        wp.config.kernel_cache_dir = folder
        try:
            start_warp()
            yield
        finally:
            wp.config.kernel_cache_dir = before


def _tested_device(device: Any) -> DeviceFacts:
    """Tests a device by running a kernel on it, and describes it."""
    try:
        problem = _kernel_problem(device)
    except (LumisplatError, OSError) as error:
        problem = " ".join(str(error).split())
    except Exception as error:  # Warp raises bare exceptions for errors of drivers and compilers
        problem = f"a kernel cannot be compiled or run ({' '.join(str(error).split())})"
    if device.is_cpu:
        return DeviceFacts(device.alias, _processor(), usable_memory() or 0, problem)
    return DeviceFacts(device.alias, device.name, int(device.total_memory), problem)


def _processor() -> str:
    """Returns the CPU's model name, or its architecture where the system does not report a model."""
    with contextlib.suppress(OSError):
        found = re.search(r"^model name\s*: (.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
        if found:
            return found[1]
    return platform.processor() or platform.machine()


def _kernel_problem(device: Any) -> str | None:
    """Runs a kernel that squares numbers on a device; returns what went wrong, or None if the results are right."""
    launcher = Launcher(device.alias)
    launcher.load([trial_kernels])
    squares = Buffers(device.alias).upload("squares", wp.float32, np.full(_TRIAL_SIZE, np.nan, dtype=np.float32))
    launcher.run(trial_kernels.trial_kernel, _TRIAL_SIZE, squares)
    expected = np.arange(_TRIAL_SIZE, dtype=np.float32) ** 2
    return None if np.array_equal(squares.numpy(), expected) else "a kernel that squares numbers gives wrong results"


def _cache() -> CacheFacts:
    """Inspects the kernel cache: its folder, its size, and whether it can be written."""
    problem, free = None, 0
    try:
        start_warp()
        folder = Path(wp.config.kernel_cache_dir or "")
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        free = shutil.disk_usage(folder).free
        if free < _FREE_BYTES_MIN:
            problem = f"{folder}: {free / 2**20:.0f} MiB are free for compiled kernels, expected 512: {OTHER_CACHE}"
    except OSError as error:
        problem = str(cache_error(error))
    except DeviceError as error:
        problem = str(error)
    folder = Path(wp.config.kernel_cache_dir or "")
    used = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) if folder.is_dir() else 0
    return CacheFacts(folder, used, free, problem)


def _remarks(devices: tuple[DeviceFacts, ...]) -> Iterator[str]:
    has_cuda = any(device.name != "cpu" for device in devices)
    sign = next(filter(os.path.exists, _SIGNS_OF_A_GPU), None) or shutil.which("nvidia-smi")
    if sign is not None and not has_cuda:
        needed = ".".join(map(str, wp.get_cuda_toolkit_version() or ()))
        yield (
            f"there is a GPU ({sign}), which cannot be used: Warp {wp.config.version} needs a driver for CUDA {needed} "
            "or its minor versions, and nvidia-smi shows which one the driver has"
        )


def _extras() -> list[str]:
    return sorted(metadata.metadata(_DISTRIBUTION).get_all("Provides-Extra") or [])


def _packages(extra: str) -> tuple[PackageFacts, ...]:
    """Compares installed packages with the requirements of an extra, or of Lumisplat itself if ``extra`` is empty."""
    from packaging.requirements import Requirement

    found: list[PackageFacts] = []
    for requirement in metadata.requires(_DISTRIBUTION) or []:
        needed = Requirement(requirement)
        is_general = needed.marker is None or needed.marker.evaluate({"extra": ""})
        is_required = needed.marker is None or needed.marker.evaluate({"extra": extra})
        if needed.name == _DISTRIBUTION or not is_required or (extra and is_general):
            continue
        try:
            installed = metadata.version(needed.name)
        except metadata.PackageNotFoundError:
            installed = None
        is_right = installed is not None and needed.specifier.contains(installed, prereleases=True)
        found.append(PackageFacts(needed.name, str(needed.specifier), installed, is_right))
    return tuple(found)


__all__ = ["Diagnosis", "diagnose"]
