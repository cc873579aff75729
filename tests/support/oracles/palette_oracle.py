"""Computes palettes in float64 by comparing each vector with every entry."""

from __future__ import annotations

import numpy as np


def nearest(values: np.ndarray, entries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the entry closest to each vector, the first of ties, and the squared distance."""
    squares = ((values[:, None].astype(np.float64) - entries[None].astype(np.float64)) ** 2).sum(axis=2)
    return squares.argmin(axis=1), squares.min(axis=1)


def one_level(values: np.ndarray, count: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns entries and labels of brute-force k-means; unused entries move to the vectors with the largest errors."""
    values = values.astype(np.float64)
    entries = values[np.arange(count) * len(values) // count].copy()
    for _ in range(steps):
        labels, distances = nearest(values, entries)
        worst = iter(np.argsort(-distances, kind="stable"))
        for k in range(count):
            members = values[labels == k]
            entries[k] = members.mean(axis=0) if len(members) else values[next(worst)]
    return entries, nearest(values, entries)[0]
