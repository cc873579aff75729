"""Fixtures for all tests, and steps that run once before several worker processes start."""

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

# CI draws the same examples each time, developers' machines draw new ones; no test has a deadline.
hypothesis.settings.register_profile("ci", derandomize=True, deadline=None)
hypothesis.settings.register_profile("local", deadline=None)
hypothesis.settings.load_profile("ci" if os.environ.get("CI") else "local")

IS_WORKER = "PYTEST_XDIST_WORKER" in os.environ


def pytest_addoption(parser: pytest.Parser) -> None:
    """Adds the options of this suite."""
    parser.addoption("--recompute-twins", action="store_true", help="recompute all stored twins and compare them")


def pytest_configure(config: pytest.Config) -> None:
    """Reads the options before tests are collected."""
    TWINS.recompute_all = bool(config.getoption("recompute_twins"))


def pytest_report_header() -> str:
    """Reports which stored twins this run recomputes."""
    return f"twins: {'all' if TWINS.recompute_all else f'tenth number {twins.TENTH}'} recomputed"


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_setupnodes(config: pytest.Config) -> None:
    """Compiles all kernels on all cores before the workers start, and limits each worker to one thread for NumPy."""
    from support.kernels import compile_all

    config.get_terminal_writer().line("compiling kernels that are not in the cache")
    compile_all()
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, "1")


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Sends a worker's number of missing twins to the main process."""
    if IS_WORKER:
        session.config.workeroutput["missing_twins"] = TWINS.missing  # pyright: ignore[reportAttributeAccessIssue]


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Adds up the numbers of missing twins that workers sent."""
    TWINS.missing += getattr(node, "workeroutput", {}).get("missing_twins", 0)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Reports how to store missing twins, which makes the next run faster."""
    if TWINS.missing:
        terminalreporter.line(f"{TWINS.missing} twins were not stored and had to be computed: {twins.COMMAND}")


@pytest.fixture(scope="session", autouse=IS_WORKER)
def one_thread_a_worker() -> Iterator[None]:
    """Runs kernels on one thread in workers, which share the cores, unless a test asks for more."""
    from lumisplat.runtime import launcher

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(launcher, "usable_cores", lambda: 1)
        yield


@pytest.fixture(scope="session", autouse=True)
def arrays_of_the_host() -> None:
    """Makes the CPU the default device for arrays of tests, also with a GPU; the package always names its device."""
    wp.set_device("cpu")


@pytest.fixture(scope="session")
def demo_and_progress(tmp_path_factory: pytest.TempPathFactory) -> tuple[ls.Scene, list[float]]:
    """Returns the demo scene, built by the first worker that needs it, and the fractions its callback received."""
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
    """Returns the demo scene."""
    return demo_and_progress[0]


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Returns the folder of real captures and meshes, or skips the test if there is none."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    path = Path(os.environ.get("LUMISPLAT_DATA", default))
    if not path.is_dir():
        pytest.skip(f"no test data at {path} (set LUMISPLAT_DATA)")
    return path
