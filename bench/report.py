"""Rows as a table, on the terminal and in docs/benchmarks.md."""

from __future__ import annotations

from pathlib import Path

STAGES = ("sync", "mesh", "project", "sort", "bin", "composite", "download")
MARK = "<!-- table: written by make bench -->"


def table(rows: list[dict]) -> list[str]:
    """Markdown lines; times in milliseconds."""
    head = ["preset", "Gaussians", "load", "first frame", "**frame**", *STAGES, "peak MiB", "Mitsuba", "times faster"]
    lines = ["| " + " | ".join(head) + " |", "| --- |" + " ---: |" * (len(head) - 1)]
    for row in rows:
        peer = row.get("peer")
        cells = [
            row["preset"],
            f"{row['gaussians']:,}",
            f"{row['load_ms']:.0f}",
            f"{row['first_ms']:.0f}",
            f"**{row['frame_ms']:.1f}** ({row['frame_min_ms']:.1f}-{row['frame_max_ms']:.1f})",
            *(f"{row['stage_ms'].get(stage, 0.0):.1f}" for stage in STAGES),
            f"{row['peak_mib']:.0f}",
            f"{peer['frame_ms']:.0f}" if peer else "",
            f"**{peer['frame_ms'] / row['frame_ms']:.0f}**" if peer else "",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def print_table(rows: list[dict]) -> None:
    """The table as text."""
    print("\n".join(table(rows)))


def write_document(path: Path, machine: dict, rows: list[dict]) -> None:
    """Replaces what lies between the two marks of the document by the table and what it was measured with."""
    before, _, after = path.read_text().split(MARK)
    psnr = ", ".join(f"{row['preset']} {row['peer']['psnr_db']:.1f} dB" for row in rows if "peer" in row)
    peer = next((row["peer"]["peer"] for row in rows if "peer" in row), "no peer")
    facts = [
        f"Measured on {machine['date']} at revision `{machine['revision']}`: {machine['cpu']}, "
        f"{machine['cores']} cores, Python {machine['python']}, Warp {machine['warp']}; peer {peer}. "
        "Command: `make bench`.",
        "",
        *table(rows),
        "",
        "Whole processes, interpreter included: "
        + ", ".join(f"`{name}` {value:.0f} ms" for name, value in machine["command_ms"].items())
        + ".",
        "",
        f"Agreement with the peer's 16-sample image (another method: rays, not EWA), PSNR: {psnr}.",
    ]
    path.write_text(before + MARK + "\n" + "\n".join(facts) + "\n" + MARK + after)
