"""The table of ``--stats``: times, counts and memory of a frame."""

from __future__ import annotations

import lumisplat as ls
from lumisplat.cli.output.console import byte_size, print_table


def print_stats(frame: ls.Frame, pipeline: ls.Pipeline) -> None:
    """Prints times, counts and memory of a frame of ``pipeline``."""
    print_table("last frame", [*stage_rows(stage_times(frame)), *count_rows(frame, pipeline)])


def stage_times(frame: ls.Frame) -> dict[str, float]:
    """Milliseconds of each stage of a frame, a copy; empty on CUDA unless profiling."""
    return dict(frame.stats.stage_ms) if frame.stats else {}


def stage_rows(stage_ms: dict[str, float]) -> list[tuple[str, str]]:
    """Milliseconds of each stage, then their sum; no rows if stages were not timed.

    Of a frame that is made by passes, those of each pass, and below it those of the stages in it.
    """
    if not stage_ms:
        return []
    passes: dict[str, dict[str, float]] = {}
    for name, milliseconds in stage_ms.items():
        pass_name, _, stage = name.partition(": ")
        passes.setdefault(pass_name, {})[stage] = milliseconds
    rows: list[tuple[str, float]] = []
    for name, stages in passes.items():
        rows.append((name, sum(stages.values())))
        rows += [(f"  {stage}", milliseconds) for stage, milliseconds in stages.items() if stage]
    rows.append(("all stages", sum(stage_ms.values())))
    return [(name, f"{milliseconds:8.2f} ms") for name, milliseconds in rows]


def count_rows(frame: ls.Frame, pipeline: ls.Pipeline) -> list[tuple[str, str]]:
    """Gaussians and triangles; for the rasteriser those that were visible, and their tile pairs; device memory."""
    stats = frame.stats
    assert stats is not None
    rows = [("Gaussians", f"{stats.gaussian_count:,}"), ("triangles", f"{stats.triangle_count:,}")]
    if pipeline.rasterises:
        rows += [("visible", f"{stats.visible_count:,}"), ("tile pairs", f"{stats.pair_count:,}")]
    if frame.samples:
        rows += [("samples", f"{frame.samples:,}")]
    if stats.noise is not None:
        rows += [("noise", f"{stats.noise:.4f}")]
    return [*rows, ("not finite", f"{stats.nonfinite_count:,}"), ("memory", byte_size(stats.memory_bytes))]
