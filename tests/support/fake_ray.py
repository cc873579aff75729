"""Replaces Ray for the farm's driver: workers behave as a test prescribes, one after another in the calling thread."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

from lumisplat.cli.farm.worker import Answer

Does = Callable[[int, int | None], Answer | Exception | None]
"""Maps the numbers of a worker and a frame (None for loading the scene) to an answer, an exception, or None for
silence."""


class RayError(Exception):
    """Replaces Ray's error for a dead worker."""


def died(how: str = "its process has ended") -> RayError:
    """Returns the error of a dead worker."""
    return RayError(how)


def answer(**values: Any) -> Answer:
    """Returns an answer of a worker on this machine."""
    return Answer(**({"lines": [], "host": "here"} | values))


@dataclass
class FakeRay:
    """A simulated Ray cluster.

    While the driver waits, ``does`` answers the oldest pending question that has an answer.
    """

    does: Does
    cpus: int = 2
    gpus: int = 0
    now: float = 0.0
    """Current time in seconds; it advances by the timeout of ``wait`` when no worker answers."""
    given: list[tuple[int, int]] = field(default_factory=list[tuple[int, int]])
    """Pairs of worker and frame in the order in which frames were assigned."""
    living: set[int] = field(default_factory=set[int])
    started: int = 0
    needs: dict[str, Any] = field(default_factory=dict[str, Any])
    exceptions = SimpleNamespace(RayError=RayError)

    def cluster_resources(self) -> dict[str, float]:
        """Returns the resources of the cluster."""
        return {"CPU": float(self.cpus)} | ({"GPU": float(self.gpus)} if self.gpus else {})

    def remote(self, **needs: Any) -> Callable[[type], Any]:
        """Returns a decorator that makes the actor class."""
        self.needs = needs
        return lambda _: SimpleNamespace(remote=self._start)

    def wait(self, refs: list[Any], *, num_returns: int, timeout: float) -> tuple[list[Any], list[Any]]:
        """Returns a list with the oldest question that has an answer, and a list of all other questions."""
        for ref in refs:
            if ref.answer is None:
                ref.answer = self.does(ref.worker, ref.frame)
            if ref.answer is not None:
                return [ref], [other for other in refs if other is not ref]
        self.now += timeout
        return [], refs

    def get(self, ref: Any) -> Answer:
        """Returns the answer to a question, or raises the answer if it is an exception."""
        if isinstance(ref.answer, Exception):
            raise ref.answer
        return ref.answer

    def kill(self, worker: Any) -> None:
        """Kills a worker."""
        self.living.discard(worker.number)

    def _start(self, *_: object) -> Any:
        number, self.started = self.started, self.started + 1
        self.living.add(number)

        def make(frame: int) -> _Ref:
            self.given.append((number, frame))
            return _Ref(number, frame)

        methods = SimpleNamespace(remote=make)
        return SimpleNamespace(number=number, open=SimpleNamespace(remote=lambda: _Ref(number, None)), make=methods)


@dataclass(eq=False)
class _Ref:
    worker: int
    frame: int | None
    answer: Answer | Exception | None = None
