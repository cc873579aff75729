"""What is said of actors of Ray that end or refuse, in the words of their place. Ray itself is not needed."""

from __future__ import annotations

import pytest

import lumisplat as ls
from lumisplat.cli.farm.executor import Failed, Refused, Said
from lumisplat.cli.farm.ray_actors import Answer, end_of_actor
from lumisplat.cli.output.console import one_line


class RayTaskError(Exception):
    """As Ray's: the cause is at hand."""

    cause = ValueError("shapes\ndiffer")


class OutOfMemoryError(Exception):
    """As Ray's."""


HEAD = "The actor died unexpectedly before finishing this task.\n\tclass_name: RayWorker\n\tpid: 7\n\tip: 10.0.0.3\n"


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (Exception(HEAD + "The actor died because its node has died. Node Id: 69ca"), "its node on 10.0.0.3 has died"),
        (
            Exception(HEAD + "The actor is dead because its worker process has died. Worker exit type: SYSTEM_ERROR"),
            "its process on 10.0.0.3 has ended",
        ),
        (
            Exception(
                "The actor died because of an error raised in its creation task, ray::RayWorker() (pid=7, ip=10.0.0.3)"
                "\nTraceback (most recent call last):\nModuleNotFoundError: No module named 'lumisplat'"
            ),
            "it could not start: ModuleNotFoundError: No module named 'lumisplat'",
        ),
        (RayTaskError("ray::RayWorker.make() pages of it"), "ValueError: shapes differ"),
        (OutOfMemoryError("Task was killed"), "killed by Ray for want of memory"),
        (Exception("something\nelse"), "something else"),
    ],
)
def test_ends_of_actors(error: Exception, words: str) -> None:
    """In a few words, of what Ray 2.60 says in pages."""
    assert end_of_actor(error) == words


def test_errors_say_on_which_machine_they_were(monkeypatch: pytest.MonkeyPatch) -> None:
    """On another one than that of the command; here, the words are those of one process."""
    monkeypatch.setattr("socket.gethostname", lambda: "desk")
    error = ls.MissingFileError("garden.ply", "no such file")
    (said, event) = Answer(["grainy"], Refused(1, error), "node-3").events()
    assert said == Said(1, "grainy") and isinstance(event, Refused)
    assert one_line(event.error) == "garden.ply: no such file (on node-3)"
    (event,) = Answer([], Failed(1, 4, OSError(13, "Permission denied", "walk.exr"), False), "node-3").events()
    assert isinstance(event, Failed)
    assert one_line(event.error) == "walk.exr: cannot be read or written: Permission denied (on node-3)"
    (event,) = Answer([], Refused(1, ls.MissingFileError("garden.ply", "no such file")), "desk").events()
    assert isinstance(event, Refused) and one_line(event.error) == "garden.ply: no such file"
