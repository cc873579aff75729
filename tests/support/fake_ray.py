"""Ray as the driver of a farm sees it, whose workers do as a test says, one after the other, in this thread."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

from lumisplat.cli.farm.worker import Answer

Does = Callable[[int, int | None], Answer | Exception | None]
"""What a worker answers, by its number and that of a frame (None: it loads the scene), raises, or never answers."""


class RayError(Exception):
    """As Ray's: a worker is gone."""


def died(how: str = "its process has ended") -> RayError:
    """The end of a worker."""
    return RayError(how)


def answer(**values: Any) -> Answer:
    """An answer of a worker of this machine."""
    return Answer(**({"lines": [], "host": "here"} | values))


@dataclass
class FakeRay:
    """A cluster; ``does`` is asked when the driver waits, for the oldest question that has an answer."""

    does: Does
    cpus: int = 2
    gpus: int = 0
    now: float = 0.0
    """The time: a second passes where nobody answers."""
    given: list[tuple[int, int]] = field(default_factory=list[tuple[int, int]])
    """Workers and frames, in the order in which they were given out."""
    living: set[int] = field(default_factory=set[int])
    started: int = 0
    needs: dict[str, Any] = field(default_factory=dict[str, Any])
    exceptions = SimpleNamespace(RayError=RayError)

    def cluster_resources(self) -> dict[str, float]:
        """What the cluster has."""
        return {"CPU": float(self.cpus)} | ({"GPU": float(self.gpus)} if self.gpus else {})

    def remote(self, **needs: Any) -> Callable[[type], Any]:
        """The class of actors."""
        self.needs = needs
        return lambda _: SimpleNamespace(remote=self._start)

    def wait(self, refs: list[Any], *, num_returns: int, timeout: float) -> tuple[list[Any], list[Any]]:
        """The first question that has an answer."""
        for ref in refs:
            if ref.answer is None:
                ref.answer = self.does(ref.worker, ref.frame)
            if ref.answer is not None:
                return [ref], [other for other in refs if other is not ref]
        self.now += timeout
        return [], refs

    def get(self, ref: Any) -> Answer:
        """The answer."""
        if isinstance(ref.answer, Exception):
            raise ref.answer
        return ref.answer

    def kill(self, worker: Any) -> None:
        """Ends a worker."""
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
