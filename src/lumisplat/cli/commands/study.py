"""``lumisplat study``: a page that asks people which of two images or videos they prefer, and the analysis of it."""

from __future__ import annotations

import base64
import csv
import json
import mimetypes
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, UseAppendAction, arg

import lumisplat as ls
from lumisplat.cli.options.command import Command, Flag, own_options_first
from lumisplat.cli.output.console import counted, print_columns
from lumisplat.cli.output.images import check_folder, make_folder

_INLINE_BYTES = 20_000_000
"""Files that have more bytes in all lie in a folder beside the page: browsers open larger pages slowly."""
_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".gif", ".apng", ".mp4", ".webm")
_QUESTIONS = ("Realism=Which looks more realistic?", "Lighting=Which better matches the lighting of the scene?")
_COLUMNS = ("rater", "question", "pair", "method", "left", "right", "choice", "winner", "again")


@own_options_first
@dataclass(frozen=True, kw_only=True)
class Study(Command):
    """Ask people which of two images or videos they prefer.

    Guide: docs/guide/metrics.md.
    First try: lumisplat study ours baseline -o study.html
    """

    files: Positional[Annotated[tuple[Path, ...], arg(metavar="A B | ANSWERS.csv...", help_behavior_hint="")]] = ()
    """Compare two files or two folders; with --analyse, read saved answers."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="OUT")] = Path("study.html")
    """Write the page here; large files go into a folder beside it."""
    question: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME=TEXT", help_behavior_hint="")] = ()
    """Ask this about each pair, in place of realism and lighting; repeat for several."""
    repeats: Annotated[int, arg(metavar="N")] = 0
    """Show N pairs again, sides swapped, to measure how consistent answers are."""
    seed: Annotated[int, arg(metavar="N")] = 0
    """Choose orders and sides by this seed and the rater's name."""
    analyse: Flag = False
    """Print win rates with 95 % intervals from files of answers."""

    def run(self) -> None:
        """Writes the page, or prints the analysis of answers."""
        if self.analyse:
            _print_analysis(_read_answers(self.files))
            return
        if len(self.files) != 2:
            raise ls.ConfigError(f"{counted(len(self.files), 'file')} given, expected two images, videos or folders")
        if self.output.suffix.lower() != ".html":
            raise ls.ConfigError(f"{self.output}: expected a page, .html")
        check_folder(self.output.parent, self.output)
        first, second = self.files
        pairs = _pairs(first, second)
        if not 0 <= self.repeats <= len(pairs):
            raise ls.ConfigError(f"--repeats is {self.repeats}, expected 0 to {len(pairs)}, the number of pairs")
        print(self._write(pairs, [first.name or str(first), second.name or str(second)]))

    def _write(self, pairs: list[tuple[str, tuple[Path, Path]]], methods: list[str]) -> str:
        """Writes the page, and files that are too large for it beside it; returns a summary line."""
        if methods[0] == methods[1]:
            methods = [str(path) for path in self.files]
        total = sum(path.stat().st_size for _, both in pairs for path in both)
        folder = None if total <= _INLINE_BYTES else self.output.with_name(f"{self.output.stem}_files")
        if folder is not None:
            make_folder(folder)
        shown: list[dict[str, Any]] = []
        for number, (name, both) in enumerate(pairs):
            sources = [_source(path, folder, f"{number:04d}{'ab'[side]}") for side, path in enumerate(both)]
            files = [
                {"source": source, "video": _type_of(path).startswith("video/")}
                for source, path in zip(sources, both, strict=True)
            ]
            shown.append({"name": name, "files": files})
        content = {
            "seed": self.seed,
            "repeats": self.repeats,
            "methods": methods,
            "questions": [_question(text) for text in self.question or _QUESTIONS],
            "pairs": shown,
        }
        template = resources.files("lumisplat.cli.output").joinpath("study.html").read_text(encoding="utf-8")
        text = json.dumps(content).replace("<", "\\u003c")  # nothing in the data ends the script
        self.output.write_text(template.replace("/*STUDY*/null", text), encoding="utf-8")
        beside = "" if folder is None else f", with its files in {folder}"
        return f"{self.output}: {counted(len(pairs), 'pair')} of {methods[0]} and {methods[1]}{beside}"


def _question(text: str) -> dict[str, str]:
    """Returns the name and the text of a question, from ``NAME=TEXT``."""
    name, equals, asked = (part.strip() for part in text.partition("="))
    if not (name and equals and asked):
        raise ls.ConfigError(f"--question is '{text}', expected NAME=TEXT, such as 'Shadows=Which shadow is better?'")
    return {"name": name, "text": asked}


def _type_of(path: Path) -> str:
    return mimetypes.guess_type(path.name)[0] or "image/png"


def _source(path: Path, folder: Path | None, name: str) -> str:
    """Returns how the page refers to a file: as data, or by a copy's name, which does not tell the method."""
    if folder is None:
        return f"data:{_type_of(path)};base64,{base64.b64encode(path.read_bytes()).decode()}"
    shutil.copyfile(path, folder / f"{name}{path.suffix.lower()}")
    return f"{folder.name}/{name}{path.suffix.lower()}"


def _by_name(folder: Path) -> dict[str, Path]:
    """Returns the pictures and videos of a folder by their names without extension.

    Raises:
        FormatError: Two files have the same name.
    """
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in _SUFFIXES:
            if path.stem in found:
                raise ls.FormatError(folder, f"has {found[path.stem].name} and {path.name}: give each its own name")
            found[path.stem] = path
    return found


def _pairs(first: Path, second: Path) -> list[tuple[str, tuple[Path, Path]]]:
    """Returns (name, files) of each pair: two files, or files of two folders that have the same name.

    Raises:
        FormatError: A path is missing or of another kind, or no names agree.
    """
    for path in (first, second):
        if not path.exists():
            raise ls.FormatError(path, "no such file or folder")
    if first.is_dir() != second.is_dir():
        folder, file = (first, second) if first.is_dir() else (second, first)
        raise ls.FormatError(folder, f"is a folder and {file} is not: compare two files, or two folders")
    if not first.is_dir():
        for path in (first, second):
            if path.suffix.lower() not in _SUFFIXES:
                raise ls.FormatError(path, f"browsers do not show it, expected one of {', '.join(_SUFFIXES)}")
        return [(first.stem, (first, second))]
    ours, theirs = (_by_name(folder) for folder in (first, second))
    if {*ours} != {*theirs} or not ours:
        alone = sorted({*ours} ^ {*theirs})
        problem = f"only one of the folders has '{alone[0]}'" if alone else f"no files ({', '.join(_SUFFIXES)})"
        raise ls.FormatError(first, f"does not pair with {second}: {problem}")
    return [(name, (ours[name], theirs[name])) for name in ours]


def _read_answers(paths: Sequence[Path]) -> list[dict[str, str]]:
    """Reads the rows of files that raters saved.

    Raises:
        ConfigError: No file is given.
        FormatError: A file is missing, or is not such a file.
    """
    if not paths:
        raise ls.ConfigError("--analyse needs files of answers, such as answers/*.csv")
    rows: list[dict[str, str]] = []
    for path in paths:
        try:
            with path.open(newline="", encoding="utf-8-sig") as file:
                read = list(csv.DictReader(file))
        except FileNotFoundError:
            raise ls.FormatError(path, "no such file") from None
        except (UnicodeDecodeError, csv.Error):
            raise ls.FormatError(path, "is not a file of answers, which a page of lumisplat study saves") from None
        for row in read:
            sides = (row.get("left"), row.get("right"))
            if {*row} != {*_COLUMNS} or row["winner"] not in sides:
                raise ls.FormatError(path, f"is not a file of answers: expected the columns {', '.join(_COLUMNS)}")
        rows += read
    if not rows:
        raise ls.FormatError(paths[0], "has no answers")
    return rows


def _print_analysis(rows: list[dict[str, str]]) -> None:
    """Prints, for each question, how often the first method won: of each pair, and of all pairs and raters."""
    methods = {row["method"] for row in rows}
    others = [*{row[side] for row in rows for side in ("left", "right")} - methods]
    if len(methods) != 1 or len(others) != 1:
        named = ", ".join(sorted({*methods, *others}))
        raise ls.ConfigError(f"answers are about {named}, expected those of one study of two methods")
    (method,) = methods
    votes = [row for row in rows if row["again"] == "0"]
    table: list[list[str]] = []
    for question in dict.fromkeys(row["question"] for row in votes):
        asked = [row for row in votes if row["question"] == question]
        for pair in [*sorted({row["pair"] for row in asked}), ""]:
            counted_votes = [row["winner"] == method for row in asked if pair in ("", row["pair"])]
            wins, total = sum(counted_votes), len(counted_votes)
            found = ls.metrics.win_rate(wins, total)
            figures = [f"{100 * found.rate:.1f}", f"{100 * found.low:.1f} to {100 * found.high:.1f}"]
            table.append([f"{question}, {pair or 'all pairs'}", str(wins), str(total), *figures])
    print_columns([f"wins of {method} over {others[0]}", "wins", "votes", "%", "95 % interval"], table)
    raters = len({row["rater"] for row in votes})
    print(f"{counted(raters, 'rater')}; Wilson's interval over all votes, as if each were independent")
    first = {(row["rater"], row["question"], row["pair"]): row["winner"] for row in votes}
    again = [row for row in rows if row["again"] == "1"]
    if again:
        same = sum(first.get((row["rater"], row["question"], row["pair"])) == row["winner"] for row in again)
        print(f"{same} of {counted(len(again), 'repeated answer')} are as before")
