"""Rows of lit frames as a table, by kind of light and pipeline, and whether they reach their targets."""

from __future__ import annotations

from bench.light_presets import KINDS

PIPELINES = ("raster", "trace", "hybrid")

BARS = {
    "light-raster-lit": ("deferred shading with 4 unshadowed lights", 1.4),
    "light-hybrid-hard": ("a hybrid frame with one hard shadow", 8.0),
}
"""Largest ratio of a frame's time to that of an unlit raster frame."""
DECIBELS_MIN, FASTER_MIN = 35.0, 2.0
"""Of 64 stochastic shadow samples against the exact shadow, and of one of them."""


def light_lines(rows: list[dict], shadows: dict) -> list[str]:
    """Markdown lines: the table, the targets, and how stochastic shadows converge."""
    lines = [*table(rows), "", bars_line(rows)]
    for name, row in shadows.items():
        lines += ["", shadow_line(name, row)]
    return lines


def table(rows: list[dict]) -> list[str]:
    """Markdown lines; a cell has milliseconds, and in brackets the ratio to an unlit raster frame."""
    found = {row["preset"]: row for row in rows}
    lines = ["| lit frames, ms | " + " | ".join(PIPELINES) + " |", "| --- |" + " ---: |" * len(PIPELINES)]
    for kind, label in KINDS.items():
        cells = []
        for pipeline in PIPELINES:
            row = found.get(f"light-{pipeline}-{kind}")
            cells.append(f"**{row['frame_ms']:.0f}** ({row['ratio']:.2f}x)" if row else "")
        if any(cells):
            lines.append(f"| {label} | " + " | ".join(cells) + " |")
    return lines


def bars_line(rows: list[dict]) -> str:
    """The figures that have a target, as ratios to an unlit raster frame."""
    ratios = {row["preset"]: row["ratio"] for row in rows}
    figures = [
        f"{label} {ratios[name]:.2f} ({'below' if ratios[name] < most else 'NOT below'} the target of {most:g})"
        for name, (label, most) in BARS.items()
        if name in ratios
    ]
    return "Frame times as multiples of an unlit raster frame's: " + ", ".join(figures) + "."


def shadow_line(name: str, row: dict) -> str:
    """Decibels by samples, and how much faster one sample is."""
    steps = ", ".join(f"{samples} samples {value:.1f} dB" for samples, value in row["psnr_db"].items())
    times = row["sample_ms"]
    faster = times["exact"] / times["stochastic"]
    return (
        f"Stochastic shadows against exact ones, {name}, PSNR of the share of light that arrives: {steps}; "
        f"one sample takes {times['stochastic']:.0f} ms, {faster:.1f} times faster than {times['exact']:.0f} ms. "
        f"Targets: {DECIBELS_MIN:g} dB with 64 samples, {FASTER_MIN:g} times faster."
    )


def print_light_table(rows: list[dict], shadows: dict) -> None:
    """The same as text."""
    print("\n".join(light_lines(rows, shadows)))
