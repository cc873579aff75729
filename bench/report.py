"""Writes the rows of `bench.run` as tables, to the terminal and to docs/benchmarks.md."""

from __future__ import annotations

from pathlib import Path

from bench.presets import KINDS

RASTER_STAGES = ("sync", "mesh", "project", "sort", "bin", "composite", "download")
TRACE_STAGES = ("sync", "rays", "mesh", "gaussians", "bounce", "store", "download")
MARK = "<!-- table: written by make bench -->"
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


def write_document(
    path: Path, machine: dict, rows: list[dict], *, lit: list[dict], shadows: dict, quality: dict
) -> None:
    """Replaces the text between the two marks of the document by the tables and the facts of the measurement."""
    before, _, after = path.read_text().split(MARK)
    views = {(row["gaussians"], row["width"]): row for row in rows if "peer" in row}.values()
    psnr = ", ".join(
        f"{row['gaussians']:,} Gaussians at {row['width']}x{row['height']} {row['peer']['psnr_db']:.1f} dB rasterised, "
        f"{row['peer']['trace_psnr_db']:.1f} dB traced"
        for row in views
    )
    peer = next((row["peer"]["peer"] for row in rows if "peer" in row), "no peer")
    facts = [
        f"Measured on {machine['date']} at revision `{machine['revision']}`: {machine['cpu']}, "
        f"{machine['cores']} cores, Python {machine['python']}, Warp {machine['warp']}; peer {peer}. "
        "Command: `make bench`.",
        "",
        *tables(rows),
        "",
        *light_lines(lit, shadows),
        "",
        "Whole processes, interpreter included: "
        + ", ".join(f"`{name}` {value:.0f} ms" for name, value in machine["command_ms"].items())
        + ".",
        "",
        f"Agreement with the peer's 16-sample image, PSNR: {psnr}.",
        "",
        *quality_lines(quality),
    ]
    path.write_text(before + MARK + "\n" + "\n".join(facts) + "\n" + MARK + after)


def quality_lines(quality: dict) -> list[str]:
    """Returns the convergence of stochastic frames, and the times to build and refit BVHs."""
    lines = []
    for strategy, row in quality["psnr_db"].items():
        steps = ", ".join(f"{samples} samples {value:.1f} dB" for samples, value in row.items())
        lines += [f"Mean of `{strategy}` frames against the sorted one, biker 640x360, PSNR: {steps}.", ""]
    # A rebuild includes the refit that found the BVH too loose.
    rebuilt = quality["strew_s"] > quality["build_s"]
    lines.append(
        f"BVH of 1,000,000 Gaussians: built in {quality['build_s']:.2f} s, refitted in {quality['refit_s']:.2f} s "
        f"if all move alike; if each moves at random by half its size, {'rebuilt' if rebuilt else 'refitted'} "
        f"in {quality['strew_s']:.2f} s."
    )
    return lines
