"""Fixtures shared by all tests, and what is done once before several processes run them."""

from __future__ import annotations

import os
import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hypothesis
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.io.files.atomic import atomic_write
from support import twins
from support.twins import TWINS

# The same examples everywhere in CI, new ones on a developer's machine; nothing is timed.
hypothesis.settings.register_profile("ci", derandomize=True, deadline=None)
hypothesis.settings.register_profile("local", deadline=None)
hypothesis.settings.load_profile("ci" if os.environ.get("CI") else "local")

IS_WORKER = "PYTEST_XDIST_WORKER" in os.environ


def pytest_addoption(parser: pytest.Parser) -> None:
    """Options of this suite."""
    parser.addoption("--recompute-twins", action="store_true", help="compute all stored twins anew, and compare")


def pytest_configure(config: pytest.Config) -> None:
    """Before anything is collected."""
    TWINS.recompute_all = bool(config.getoption("recompute_twins"))


def pytest_report_header() -> str:
    """Which stored twins this run checks."""
    return f"twins: {'all' if TWINS.recompute_all else f'those of tenth {twins.TENTH}'} computed anew"


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_setupnodes(config: pytest.Config) -> None:
    """Before the workers start: compiles all kernels on all cores, and leaves each worker one thread for NumPy."""
    from support.kernels import compile_all

    config.get_terminal_writer().line("compiling kernels that the cache lacks")
    compile_all()
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, "1")


def pytest_sessionfinish(session: pytest.Session) -> None:
    """A worker tells the main process how many twins it had to compute."""
    if IS_WORKER:
        session.config.workeroutput["missing_twins"] = TWINS.missing  # pyright: ignore[reportAttributeAccessIssue]


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Adds what a worker has told."""
    TWINS.missing += getattr(node, "workeroutput", {}).get("missing_twins", 0)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Says what would make the next run quicker."""
    if TWINS.missing:
        terminalreporter.line(f"{TWINS.missing} twins were not stored and had to be computed: {twins.COMMAND}")


@pytest.fixture(scope="session", autouse=IS_WORKER)
def one_thread_a_worker() -> Iterator[None]:
    """Workers share the cores: kernels run on one thread, unless a test asks for more."""
    from lumisplat.runtime import launcher

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(launcher, "usable_cores", lambda: 1)
        yield


@pytest.fixture(scope="session", autouse=True)
def arrays_of_the_host() -> None:
    """Arrays that tests make by hand are the CPU's, also where Warp would take a GPU; the package names its device."""
    wp.set_device("cpu")


@pytest.fixture(scope="session")
def demo_and_progress(tmp_path_factory: pytest.TempPathFactory) -> tuple[ls.Scene, list[float]]:
    """The demo scene, built by a worker that finds it missing, and what its progress callback heard."""
    folder = tmp_path_factory.getbasetemp()
    path = (folder.parent if IS_WORKER else folder) / "demo.pickle"
    if not path.exists():
        shares: list[float] = []
        built = ls.demo_scene(progress=lambda _, share: shares.append(share)), shares
        with atomic_write(path) as written:
            written.write_bytes(pickle.dumps(built))
    return pickle.loads(path.read_bytes())


@pytest.fixture(scope="session")
def demo(demo_and_progress: tuple[ls.Scene, list[float]]) -> ls.Scene:
    """The demo scene."""
    return demo_and_progress[0]


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Real captures and meshes, where the machine has them."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    path = Path(os.environ.get("LUMISPLAT_DATA", default))
    if not path.is_dir():
        pytest.skip(f"no test data at {path} (set LUMISPLAT_DATA)")
    return path
