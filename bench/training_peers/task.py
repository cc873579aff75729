"""What all trainers are given, and what they give back. Needs NumPy alone: peers run in environments of their own."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Task:
    """Photographs to learn from, views to show, and where Gaussians begin."""

    photographs: Floats
    """Display-referred sRGB, 0..1, shape (V, H, W, 3)."""
    weights: Floats
    """What counts of them, 0..1, shape (V, H, W)."""
    poses: Floats
    """``camera_from_world`` of each, OpenCV axes, shape (V, 4, 4)."""
    intrinsics: Floats
    """fx, fy, cx, cy, pixels, shape (V, 4)."""
    shown_poses: Floats
    """Of the views that are held out, likewise."""
    shown_intrinsics: Floats
    points: Floats
    """World space, shape (N, 3)."""
    colors: Floats
    """Display-referred sRGB of these, shape (N, 3)."""
    extent: Floats
    """Of the cameras, scene units; one number."""
    seconds: Floats
    """How long to train, from the first step; one number."""

    def save(self, path: Path) -> None:
        """Writes it."""
        np.savez(path, **asdict(self))

    @classmethod
    def load(cls, path: Path) -> Task:
        """Reads it."""
        with np.load(path) as stored:
            return cls(**{field.name: stored[field.name] for field in fields(cls)})

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.photographs.shape[2], self.photographs.shape[1]


class Trained:
    """Counts steps while there is time, and remembers what came of them.

    Args:
        task: What to do.
    """

    def __init__(self, task: Task) -> None:
        self._seconds = float(task.seconds)
        self._begun: float | None = None
        self.steps = 0
        self.lasted = 0.0

    @property
    def done(self) -> float:
        """Share of the time that is over; the first step begins it."""
        if self._begun is None:
            self._begun = time.monotonic()
        self.lasted = time.monotonic() - self._begun
        return self.lasted / self._seconds

    def save(self, path: Path, frames: Floats) -> None:
        """Writes how many steps there were, and what the views look like."""
        np.savez(path, frames=frames, steps=self.steps, seconds=self.lasted)


def run_peer(train: Callable[[Task, Trained], Floats]) -> None:
    """Runs a peer by the two paths on its command line: the task, and what it writes."""
    task = Task.load(Path(sys.argv[1]))
    trained = Trained(task)
    trained.save(Path(sys.argv[2]), train(task, trained))
    print(f"{trained.steps:,} steps, load {os.getloadavg()[0]:.1f}")


def nearest_distances(points: Floats, neighbours: int = 3) -> Floats:
    """Root mean square distance of each point to its nearest neighbours, shape (N,)."""
    squares = ((points[:, None] - points[None]) ** 2).sum(axis=2)
    return np.sqrt(np.sort(squares, axis=1)[:, 1 : neighbours + 1].mean(axis=1)).astype(np.float32)
