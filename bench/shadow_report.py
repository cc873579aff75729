"""The tables of `bench.ablations`, next to the figures of Mir et al. 2026."""

from __future__ import annotations

from pathlib import Path

MARK = "<!-- {name}: written by python -m {command} -->"

PAPER = {
    "sampling": {
        "center": (0.203, 0.622, 0.585),
        "stencil": (0.167, 0.712, 0.662),
        "monte-carlo": (0.058, 0.830, 0.796),
    },
    "absorption": {
        "simple": (0.182, 0.694, 0.642),
        "avg": (0.058, 0.830, 0.796),
        "mass": (0.171, 0.708, 0.660),
        "diag": (0.177, 0.701, 0.651),
    },
    "layout": {"cubemap": (0.136, 0.811, 0.761), "octahedral": (0.058, 0.830, 0.796)},
}
"""SAE, SM-IoU and BF of Mir et al. 2026, tables 3 to 5."""
PAPER_BUILD_S = {"both": 0.13, "no region": 29.1, "no culling": 17.1}
"""Seconds a frame on an A100, section 4.4 D."""
TITLES = {
    "sampling": "Where receivers sample the map (table 3)",
    "picture": "Pipeline of the picture",
    "absorption": "Opacity to absorption (table 4)",
    "layout": "Atlas (table 5)",
    "settings": "Settings",
}


def lines(facts: dict, found: dict) -> list[str]:
    """Markdown lines."""
    measured = (
        f"Measured on {facts['date']} at revision `{facts['revision']}`: {facts['cpu']}, {facts['cores']} cores, "
        f"Warp {facts['warp']}"
    )
    if set(found) != {"timings"}:
        measured += (
            f"; pictures of {facts['size']}, {facts['frames']} moments of the walk, {facts['casters']:,} Gaussians of "
            f"the figure, {facts['receivers']:,} of floor and wall"
        )
    out = [f"{measured}. Command: `python -m bench.ablations {' '.join(found)}`."]
    for name, rows in found.items():
        out += ["", *(timing_lines(rows) if name == "timings" else score_lines(name, rows))]
    return out


def score_lines(name: str, rows: dict[str, dict]) -> list[str]:
    """Means of the three scores, with those of the paper if it has them, and the map's times and memory."""
    head = [TITLES[name], "SAE ↓", "SM-IoU ↑", "BF 2 px ↑", "paper: SAE", "SM-IoU", "BF", "build", "sample", "memory"]
    out = ["| " + " | ".join(head) + " |", "| --- |" + " ---: |" * (len(head) - 1)]
    for variant, row in rows.items():
        theirs = PAPER.get(name, {}).get(variant)
        cells = [f"**{row[key]:.3f}**" for key in ("sae", "iou", "bf")]
        cells += [f"{value:.3f}" for value in theirs] if theirs else ["", "", ""]
        cells += [f"{row['build_ms']:.0f} ms", f"{row['sample_ms']:.0f} ms", f"{row['mib']:.0f} MiB"]
        out.append("| " + " | ".join([variant, *cells]) + " |")
    return out


def timing_lines(rows: dict[str, dict]) -> list[str]:
    """Build times with and without the region and culling."""
    head = ["Build (4.4 D)", "seconds", "times both", "paper: seconds", "times both"]
    out = ["| " + " | ".join(head) + " |", "| --- |" + " ---: |" * (len(head) - 1)]
    for variant, row in rows["build"].items():
        cells = [variant, f"{row:.2f}", f"{row / rows['build']['both']:.1f}"]
        theirs = PAPER_BUILD_S.get(variant)
        cells += [f"{theirs:.2f}", f"{theirs / PAPER_BUILD_S['both']:.0f}"] if theirs else ["", ""]
        out.append("| " + " | ".join(cells) + " |")
    return [
        *out,
        "",
        f"The build of the table has {rows['casters']:,} casters, {rows['receivers']:,} receivers, "
        f"{rows['resolution']}x{rows['resolution']} texels and {rows['bins']} bins. With both, `rebuild` takes "
        f"{rows['rebuild_s']:.2f} s; sampling 8 points of each receiver takes {rows['sample_s']:.2f} s. "
        f"With the default settings, a build takes {rows['default_build_s']:.2f} s, `rebuild` "
        f"{rows['default_rebuild_s']:.2f} s and sampling {rows['default_sample_s']:.2f} s.",
    ]


def write_section(path: Path, name: str, section: list[str], *, command: str = "bench.ablations") -> None:
    """Replaces the text between the two marks of a table in the document."""
    mark = MARK.format(name=name, command=command)
    parts = path.read_text().split(mark)
    if len(parts) != 3:
        raise SystemExit(f"{path}: expected two lines '{mark}', between which the table goes, found {len(parts) - 1}")
    path.write_text(parts[0] + mark + "\n" + "\n".join(section) + "\n" + mark + parts[2])
