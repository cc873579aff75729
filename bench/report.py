"""Writes the results of `bench.run` as tables, in detail to the terminal and as rows to docs/benchmarks.md."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from bench.page import CPU_PAGE, Origin, Row, table as page_table, times_as_fast, write_region
from bench.presets import KINDS, LIGHT, RASTER, TRACE, Preset

RASTER_STAGES = ("sync", "mesh", "project", "sort", "bin", "composite", "download")
TRACE_STAGES = ("sync", "rays", "mesh", "gaussians", "bounce", "store", "download")
PIPELINES = ("raster", "trace", "hybrid")

BARS = {
    "light-raster-lit": ("deferred shading with 4 unshadowed lights", 1.4),
    "light-hybrid-hard": ("a hybrid frame with one hard shadow", 8.0),
}
"""Largest ratio of a frame's time to that of an unlit raster frame."""
DECIBELS_MIN, FASTER_MIN = 35.0, 2.0
"""Targets of stochastic shadows against exact ones: PSNR of 64 samples, and speed-up of one sample."""


def tables(rows: list[dict]) -> list[str]:
    """Returns the Markdown tables of the rasteriser and of the ray tracer."""
    raster = [row for row in rows if not row["preset"].startswith("trace")]
    traced = [row for row in rows if row["preset"].startswith("trace")]
    lines = table(raster, RASTER_STAGES) if raster else []
    return [*lines, "", *table(traced, TRACE_STAGES)] if traced else lines


def table(rows: list[dict], stages: tuple[str, ...]) -> list[str]:
    """Returns a Markdown table with times in milliseconds."""
    head = ["preset", "Gaussians", "load", "first frame", "**frame**", *stages, "peak MiB", "Mitsuba", "times faster"]
    lines = ["| " + " | ".join(head) + " |", "| --- |" + " ---: |" * (len(head) - 1)]
    for row in rows:
        peer = row.get("peer")
        cells = [
            row["preset"],
            f"{row['gaussians']:,}",
            f"{row['load_ms']:.0f}",
            f"{row['first_ms']:.0f}",
            f"**{row['frame_ms']:.1f}** ({row['frame_min_ms']:.1f}-{row['frame_max_ms']:.1f})",
            *(f"{row['stage_ms'].get(stage, 0.0):.1f}" for stage in stages),
            f"{row['peak_mib']:.0f}",
            f"{peer['frame_ms']:.0f}" if peer else "",
            f"**{peer['frame_ms'] / row['frame_ms']:.0f}**" if peer else "",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def light_lines(rows: list[dict], shadows: dict) -> list[str]:
    """Returns Markdown lines: the table of lit frames, the targets, and the convergence of stochastic shadows."""
    lines = [*light_table(rows), "", bars_line(rows)]
    for name, row in shadows.items():
        lines += ["", shadow_line(name, row)]
    return lines


def light_table(rows: list[dict]) -> list[str]:
    """Returns a Markdown table of milliseconds with, in brackets, the ratio to an unlit raster frame."""
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
    """Returns the figures that have a target, as ratios to an unlit raster frame."""
    ratios = {row["preset"]: row["ratio"] for row in rows}
    figures = [
        f"{label} {ratios[name]:.2f} ({'below' if ratios[name] < most else 'NOT below'} the target of {most:g})"
        for name, (label, most) in BARS.items()
        if name in ratios
    ]
    return "Frame times as multiples of an unlit raster frame's: " + ", ".join(figures) + "."


def shadow_line(name: str, row: dict) -> str:
    """Returns PSNR by number of samples, and the speed-up of one sample."""
    steps = ", ".join(f"{samples} samples {value:.1f} dB" for samples, value in row["psnr_db"].items())
    times = row["sample_ms"]
    faster = times["exact"] / times["stochastic"]
    return (
        f"Stochastic shadows against exact ones, {name}, PSNR of the shadow factor: {steps}; "
        f"one sample takes {times['stochastic']:.0f} ms, {faster:.1f} times faster than {times['exact']:.0f} ms. "
        f"Targets: {DECIBELS_MIN:g} dB with 64 samples, {FASTER_MIN:g} times faster."
    )


@dataclass(frozen=True)
class Results:
    """Results of a run of the command."""

    rows: list[dict] = field(default_factory=list)
    """Raster and trace presets."""
    lit: list[dict] = field(default_factory=list)
    shadows: dict = field(default_factory=dict)
    """Convergence of stochastic shadows by scene."""
    quality: dict = field(default_factory=dict)
    """Convergence of stochastic frames, and the times of BVHs."""
    command_ms: dict = field(default_factory=dict)


def write_page(results: Results, page: Path = CPU_PAGE) -> list[str]:
    """Replaces the page's tables of the groups that ran completely, and returns the names of these tables.

    The tables of raster and trace also need the peer: without its figures, the page keeps the tables it has.
    """
    by_name = {row["preset"]: row for row in [*results.rows, *results.lit]}
    raster, traced = ([(one, by_name.get(one.name)) for one in group] for group in (RASTER, TRACE))
    written = {}
    if is_complete(raster):
        written["raster"] = frame_rows(raster), "bench.run raster --write"
        written["start"] = start_rows(by_name, results.command_ms), "bench.run raster --write"
    if is_complete(traced) and results.quality:
        written["trace"] = frame_rows(traced) + quality_rows(results.quality), "bench.run trace --write"
    if all(one.name in by_name for one in LIGHT) and results.shadows:
        written["light"] = light_rows(by_name, results.shadows), "bench.run light --write"
    for region, (rows, command) in written.items():
        write_region(page, region, page_table(rows, Origin.here("cpu", command)))
    return list(written)


def is_complete(group: list[tuple[Preset, dict | None]]) -> bool:
    """Returns whether all presets of a group ran, those with a peer beside it."""
    return all(row is not None and (not preset.peer or "peer" in row) for preset, row in group)


def frame_rows(group: list[tuple[Preset, dict | None]]) -> list[Row]:
    """Returns the frame times of presets beside the peer's, those without a peer, and how alike the images are."""
    ran = [(preset, row) for preset, row in group if row]
    beside = [(preset, row, row["peer"]) for preset, row in ran if "peer" in row]
    alone = [(preset, row) for preset, row in ran if "peer" not in row]
    rows = []
    for preset, row, peer in beside:
        cells = f"**{row['frame_ms']:,.1f} ms**", f"Mitsuba {peer['frame_ms']:,.0f} ms"
        rows.append(Row(preset.title, *cells, times_as_fast(row["frame_ms"], peer["frame_ms"])))
    if alone:
        counts = "; ".join(f"{row['gaussians']:,}" for _, row in alone)
        times = "; ".join(f"{row['frame_ms']:,.1f}" for _, row in alone)
        first = alone[0][0]
        what = f"{counts} synthetic Gaussians, {first.width} x {first.height}{first.settings}"
        rows.append(Row(what, f"{times} ms"))
    seen = {preset.view: (preset, peer) for preset, _, peer in beside if not preset.trace}.values()
    if seen:
        views = "; ".join(preset.subject for preset, _ in seen)
        traced, rasterised = (
            ", ".join(f"{peer[name]:.1f}" for _, peer in seen) for name in ("trace_psnr_db", "psnr_db")
        )
        what = f"PSNR against Mitsuba's frames of 16 samples: {views}"
        rows.append(Row(what, f"rasterised {rasterised} dB; traced {traced} dB"))
    return rows


def quality_rows(quality: dict) -> list[Row]:
    """Returns the PSNR of the mean of stochastic frames, and the times to build and refit a BVH."""
    rows = [convergence_row(f"`{name}` frames", row) for name, row in quality["psnr_db"].items()]
    times = f"{quality['build_s']:.2f} s, {quality['refit_s']:.2f} s"
    return [*rows, Row("BVH of 1,000,000 Gaussians: build, refit", times)]


def light_rows(by_name: dict[str, dict], shadows: dict) -> list[Row]:
    """Returns the times of lit frames by kind of lighting, and the convergence of stochastic shadows."""
    rows = []
    for kind, label in KINDS.items():
        found = [(name, by_name.get(f"light-{name}-{kind}")) for name in PIPELINES]
        ran = [(name, row) for name, row in found if row]
        times = ", ".join(f"{name} {row['frame_ms']:.0f}" for name, row in ran)
        ratios = ", ".join(f"{row['ratio']:.2f}" for _, row in ran)
        rows.append(Row(f"demo, {label}", f"{times} ms", "", f"{ratios} times unlit raster"))
    times = [row["sample_ms"] for row in shadows.values()]
    ours, exact, ratios = (
        "; ".join(cells)
        for cells in (
            [f"{one['stochastic']:.0f}" for one in times],
            [f"{one['exact']:.0f}" for one in times],
            [times_as_fast(one["stochastic"], one["exact"]).removesuffix(" times as fast") for one in times],
        )
    )
    names = "; ".join(shadows)
    rows.append(Row(f"shadows, 1 sample: {names}", f"{ours} ms", f"own exact {exact} ms", f"{ratios} times as fast"))
    return [*rows, *(convergence_row(f"stochastic shadows, {name}", row["psnr_db"]) for name, row in shadows.items())]


def convergence_row(what: str, psnr_db: dict) -> Row:
    """Returns the PSNR of the mean of some samples against the exact result, by number of samples."""
    decibels = ", ".join(f"{value:.1f}" for value in psnr_db.values())
    return Row(f"PSNR of {what}, mean of {', '.join(map(str, psnr_db))} samples, against exact", f"{decibels} dB")


def start_rows(by_name: dict[str, dict], command_ms: dict[str, float]) -> list[Row]:
    """Returns the times of whole processes, and the loading time and peak memory of synthetic captures."""
    rows = [
        Row(f"whole process: {', '.join(command_ms)}", ", ".join(f"{ms:.0f}" for ms in command_ms.values()) + " ms")
    ]
    large = [preset for preset in RASTER if preset.count >= 1_000_000]
    counts = "; ".join(f"{preset.count:,}" for preset in large)
    loads = "; ".join(f"{by_name[preset.name]['load_ms']:,.0f}" for preset in large)
    peaks = "; ".join(f"{by_name[preset.name]['peak_mib']:,.0f}" for preset in large)
    what = f"{counts} Gaussians of a PLY, SH degree 3: load, package import included; peak memory with a frame"
    return [*rows, Row(what, f"{loads} ms; {peaks} MiB")]
