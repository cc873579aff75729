"""The table of `bench.relighting_table`, next to the figures of Mir et al. 2026."""

from __future__ import annotations

import statistics

PAPER = {
    "S1": (0.580, 0.320, 0.072, 0.046, 7.90, 5.60),
    "S2": (0.630, 0.340, 0.081, 0.050, 8.60, 5.80),
    "S3": (0.490, 0.280, 0.068, 0.043, 7.20, 5.10),
}
"""PAA-Y, APF-Y and NCM-ab, each as captured and relit, of Mir et al. 2026, table 1."""
KEYS = ("paa", "apf", "ncm")
DIGITS = (3, 3, 2)


def lines(facts: dict, rows: dict[str, dict]) -> list[str]:
    """Markdown lines."""
    seconds = sum(row["seconds"] for row in rows.values())
    head = ["Clip"] + [
        f"{name} {kind}" for name in ("PAA-Y ↓", "APF-Y ↓", "NCM-ab ↓") for kind in ("orig", "relit", "Δ ↑")
    ]
    ours = {
        name: tuple(row[f"{key}_{kind}"] for key in KEYS for kind in ("orig", "relit")) for name, row in rows.items()
    }
    return [
        f"Measured on {facts['date']} at revision `{facts['revision']}`: {facts['cpu']}, {facts['cores']} cores, "
        f"Warp {facts['warp']}; {facts['frames']} moments of the walk, {facts['figure']:,} Gaussians of the figure, "
        f"{seconds:.0f} s. Command: `python -m bench.relighting_table`.",
        "",
        "| " + " | ".join(head) + " |",
        "| --- |" + " ---: |" * (len(head) - 1),
        *(row_line(name, values) for name, values in ours.items()),
        *([row_line("mean", mean(list(ours.values())))] if len(ours) > 1 else []),
        *(row_line(f"paper: {name}", values) for name, values in PAPER.items()),
        row_line("paper: mean", mean(list(PAPER.values()))),
        "",
        "Mean luminance of the figure, as captured and relit: "
        + ", ".join(f"{name} {row['y_orig']:.3f} and {row['y_relit']:.3f}" for name, row in rows.items())
        + ".",
    ]


def row_line(name: str, values: tuple[float, ...]) -> str:
    """A row: each metric as captured, relit, and by how much it fell, in bold."""
    cells: list[str] = []
    for metric, digits in enumerate(DIGITS):
        before, after = values[2 * metric : 2 * metric + 2]
        cells += [f"{before:.{digits}f}", f"{after:.{digits}f}", f"**{before - after:.{digits}f}**"]
    return "| " + " | ".join([name, *cells]) + " |"


def mean(rows: list[tuple[float, ...]]) -> tuple[float, ...]:
    """Column means."""
    return tuple(statistics.mean(column) for column in zip(*rows, strict=True))
