"""Encodes files of GaussianSplats3D (.ksplat), number by number."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

import numpy as np

import lumisplat as ls

SH_C0 = 0.28209479177387814
DEGREE_MAX = 2


def ksplat(
    sections: Sequence[ls.Gaussians],
    level: int,
    *,
    block: float = 0.5,
    bucket: int = 4,
    steps: int = 32767,
    limits: tuple[float, float] = (-1.5, 1.5),
) -> bytes:
    """Encodes a file with one section per capture, SH degree at most 2; `in_buckets` defines the order of Gaussians.

    Args:
        sections: Captures.
        level: Compression level of the file.
        block: Edge length of a bucket's cube.
        bucket: Number of Gaussians in a full bucket.
        steps: Quantisation steps from the centre of a bucket to its side.
        limits: Smallest and largest SH coefficient that a file of compression level 2 can store.
    """
    heads, bodies = bytearray(), bytearray()
    for one in sections:
        degree = min(one.sh_degree, DEGREE_MAX)
        body = bytearray()
        buckets = in_buckets(one, block, bucket) if level else []
        full = [entry for entry in buckets if len(entry[1]) == bucket]
        partial = [entry for entry in buckets if len(entry[1]) < bucket]
        for _, members in partial:
            body += struct.pack("<I", len(members))
        for center, _ in buckets:
            body += struct.pack("<3f", *center)
        rows = [(center, i) for center, members in buckets for i in members] or [(None, i) for i in range(one.count)]
        for center, i in rows:
            body += _row(one, i, level, degree, center, steps / (0.5 * block), steps, limits)
        head = bytearray(1024)
        struct.pack_into("<4I", head, 0, one.count, one.count, bucket if level else 0, len(buckets))
        struct.pack_into("<fH", head, 16, block if level else 0.0, 12 if level else 0)
        struct.pack_into("<4I", head, 24, steps if level else 0, len(body), len(full), len(partial))
        struct.pack_into("<H", head, 40, degree)
        heads += head
        bodies += body
    top = bytearray(4096)
    count = sum(one.count for one in sections)
    struct.pack_into("<4B4IH", top, 0, 0, 1, 0, 0, len(sections), len(sections), count, count, level)
    struct.pack_into("<5f", top, 24, 0.0, 0.0, 0.0, *limits)
    return bytes(top + heads + bodies)


def in_buckets(one: ls.Gaussians, block: float, bucket: int) -> list[tuple[tuple[float, ...], list[int]]]:
    """Groups Gaussians into cubes of at most ``bucket`` Gaussians. Returns centres and members, full cubes first."""
    low = one.means.min(axis=0)
    full: list[tuple[tuple[float, ...], list[int]]] = []
    filling: dict[tuple[int, ...], list[int]] = {}
    for i in range(one.count):
        cell = tuple(math.floor((float(v) - float(least)) / block) for v, least in zip(one.means[i], low, strict=True))
        filling.setdefault(cell, []).append(i)
        if len(filling[cell]) == bucket:
            full.append((_center(cell, low, block), filling.pop(cell)))
    return full + [(_center(cell, low, block), members) for cell, members in filling.items()]


def order_of(one: ls.Gaussians, level: int, block: float = 0.5, bucket: int = 4) -> list[int]:
    """Returns the indices of the Gaussians in the order of the file."""
    return [i for _, members in in_buckets(one, block, bucket) for i in members] if level else list(range(one.count))


def _center(cell: tuple[int, ...], low: np.ndarray, block: float) -> tuple[float, ...]:
    return tuple(c * block + float(least) + 0.5 * block for c, least in zip(cell, low, strict=True))


def _row(
    one: ls.Gaussians,
    i: int,
    level: int,
    degree: int,
    center: tuple[float, ...] | None,
    factor: float,
    steps: int,
    limits: tuple[float, float],
) -> bytes:
    number = "f" if level == 0 else "e"
    if center is None:
        row = struct.pack("<3f", *one.means[i])
    else:
        offsets = [round((float(v) - c) * factor) + steps for v, c in zip(one.means[i], center, strict=True)]
        row = struct.pack("<3H", *(min(max(offset, 0), 2 * steps + 1) for offset in offsets))
    row += struct.pack(f"<7{number}", *one.scales[i], *one.rotations_wxyz[i])
    colors = [255.0 * (0.5 + SH_C0 * float(v)) for v in one.sh[i, 0]] + [255.0 * float(one.opacities[i])]
    row += bytes(min(255, max(0, round(v))) for v in colors)
    for ell in range(1, degree + 1):
        for channel in range(3):
            for k in range(ell * ell, (ell + 1) ** 2):
                value = float(one.sh[i, k, channel])
                if level == 2:
                    share = (min(max(value, limits[0]), limits[1]) - limits[0]) / (limits[1] - limits[0])
                    row += struct.pack("<B", math.floor(255.0 * share))
                else:
                    row += struct.pack(f"<{number}", value)
    return row
