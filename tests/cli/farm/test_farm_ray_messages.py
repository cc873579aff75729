"""Tests messages about Ray actors that end or refuse; Ray itself is not needed."""

from __future__ import annotations

import pytest

from lumisplat.cli.farm.cluster import actor_failure


class RayTaskError(Exception):
    """Stands in for Ray's error, which has the cause."""

    cause = ValueError("shapes\ndiffer")


class OutOfMemoryError(Exception):
    """Stands in for Ray's error."""


HEAD = "The actor died unexpectedly before finishing this task.\n\tclass_name: RayWorker\n\tpid: 7\n\tip: 10.0.0.3\n"


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (Exception(HEAD + "The actor died because its node has died. Node Id: 69ca"), "its node on 10.0.0.3 has died"),
        (
            Exception(
                HEAD
                + "The actor is dead because its worker process has died. Worker exit type: SYSTEM_ERROR Worker exit "
                "detail: Some common causes include: (1) the process was killed by the OOM killer"
            ),
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
        (OutOfMemoryError("Task was killed"), "killed by Ray because memory ran out"),
        (Exception("something\nelse"), "something else"),
    ],
)
def test_long_errors_of_ray_become_short_descriptions(error: Exception, words: str) -> None:
    """Ray 2.60 prints pages for each error."""
    assert actor_failure(error) == words
