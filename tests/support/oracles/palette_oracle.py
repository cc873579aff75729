"""Palettes in float64, from the definition: each vector is compared with each entry."""

from __future__ import annotations

import numpy as np


def nearest(values: np.ndarray, entries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest entry to each vector, the first of equal ones, and its squared distance."""
    squares = ((values[:, None].astype(np.float64) - entries[None].astype(np.float64)) ** 2).sum(axis=2)
    return squares.argmin(axis=1), squares.min(axis=1)


def one_level(values: np.ndarray, count: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Entries and labels by k-means that compares each vector with all entries; unused ones move to what is worst."""
    values = values.astype(np.float64)
    entries = values[np.arange(count) * len(values) // count].copy()
    for _ in range(steps):
        labels, distances = nearest(values, entries)
        worst = iter(np.argsort(-distances, kind="stable"))
        for k in range(count):
            members = values[labels == k]
            entries[k] = members.mean(axis=0) if len(members) else values[next(worst)]
    return entries, nearest(values, entries)[0]
