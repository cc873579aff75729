"""``lumisplat convert``: converts captures to another format, and crops, moves, joins or thins them."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

import lumisplat as ls
from lumisplat.cli.input.loading import holds_all_columns, size_on_disk
from lumisplat.cli.input.numbers import numbers, vector
from lumisplat.cli.options.command import Flag, LevelsCommand, own_options_first
from lumisplat.cli.output.console import Report, byte_size, counted, progress_bars, up_name
from lumisplat.cli.output.images import STANDARD_OUTPUT, standard_output

_Range = tuple[float | None, float | None]
_Edit = Callable[["ls.Gaussians"], "ls.Gaussians"]


@own_options_first
@dataclass(frozen=True, kw_only=True)
class Convert(LevelsCommand):
    """Convert, cut, clean, thin and join captures.

    Extract the middle, without floaters: lumisplat convert garden.ply --sphere 0 0 3 5 --floaters 4 -o middle.ply

    Edits apply in the order of this list: join, --box and --sphere, --keep, --floaters,
    --sh-degree, --decimate, --level, --scale, --rotate, --translate, --morton.
    Guide: docs/guide/edit.md, convert_captures.md.
    First try: lumisplat convert garden.ply garden.spz
    """

    files: Positional[Annotated[tuple[Path, ...], arg(metavar="IN... [OUT]", help_behavior_hint="")]] = ()
    """Read captures, glTF or OpenUSD; without -o, two files are input and output."""
    output: Annotated[Path | None, arg(aliases=("-o",), metavar="OUT", help_behavior_hint="")] = None
    """Write .ply, .compressed.ply, .spz, .sog, glTF or OpenUSD; - is standard output."""
    box: Annotated[str | None, arg(metavar="X,Y,Z,X,Y,Z", help_behavior_hint="")] = None
    """Keep Gaussians whose mean lies in the box between two corners."""
    sphere: Annotated[str | None, arg(metavar="X,Y,Z,R", help_behavior_hint="")] = None
    """Keep Gaussians whose mean lies within radius R of a point."""
    outside: Flag = False
    """Keep the other Gaussians instead of those in --box and --sphere."""
    keep: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME=MIN..MAX", help_behavior_hint="")] = ()
    """Keep Gaussians with a value in a range: opacity=0.1.., scale_max=..0.5."""
    floaters: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Remove Gaussians with fewer than N others within three scales; 4 suits most captures."""
    sh_degree: Annotated[int | None, arg(metavar="0..3", help_behavior_hint="")] = None
    """Write SH of this degree, shortened or padded with zeros."""
    decimate: Annotated[str | None, arg(metavar="COUNT|N%", help_behavior_hint="")] = None
    """Merge neighbouring Gaussians until COUNT, or N%, are left."""
    level: Flag = False
    """Rotate the capture so that its up direction becomes a coordinate axis."""
    scale: Annotated[float, arg(metavar="FACTOR", help_behavior_hint="(default: 1)")] = 1.0
    """Scale the capture about the origin."""
    rotate: Annotated[str | None, arg(metavar="X,Y,Z", help_behavior_hint="")] = None
    """Rotate about the x axis, then y, then z, in degrees."""
    translate: Annotated[str | None, arg(metavar="X,Y,Z", help_behavior_hint="")] = None
    """Translate by this vector, after --scale and --rotate."""
    columns: Annotated[Literal["lumisplat", "r3dg"], arg(metavar="NAME")] = "lumisplat"
    """Name the material columns of a .ply as Lumisplat, or Relightable 3D Gaussians (r3dg), does."""
    incident: Flag = False
    """Keep the incident light that a .ply of Relightable 3D Gaussians stores."""
    morton: Flag = False
    """Sort along a Morton curve, so that neighbours are stored together."""

    def run(self) -> None:
        """Loads, edits and writes captures, and prints what each edit did."""
        if STANDARD_OUTPUT in (self.output, *self.files[1:]):
            sources = self.files if self.output == STANDARD_OUTPUT else self.files[:-1]
            with standard_output(".ply") as file:
                replace(self, files=sources, output=file).run()
            return
        sources, target = self._sources_and_target()
        self.check_levels(sources)
        with progress_bars() as report:
            captures = [self._loaded(source, report) for source in sources]
            gaussians = captures[0] if len(captures) == 1 else ls.merge(captures)
            done: list[str] = []
            for option, edit in self._edits(report, done):
                gaussians, before = _edited(option, edit, gaussians), gaussians.count
                if gaussians.count != before:
                    done.append(f"{option}: {before:,} -> {counted(gaussians.count, 'Gaussian')}")
            report("writing", 0.0)
            ls.save(target, gaussians, columns=self.columns)
        before, after = sum(map(size_on_disk, sources)), size_on_disk(target)
        sizes = f"{byte_size(before)} -> {byte_size(after)}"
        done.append(f"{target}: {counted(gaussians.count, 'Gaussian')}, SH degree {gaussians.sh_degree}, {sizes}")
        print("\n".join(done))

    def _sources_and_target(self) -> tuple[tuple[Path, ...], Path]:
        """Returns the files to read and the file to write: ``-o``, else the second of two files."""
        sources, target = self.files, self.output
        if target is None and len(sources) == 2:
            sources, target = sources[:1], sources[1]
        if target is None and len(sources) > 2:
            raise ls.ConfigError("joining several captures needs -o: lumisplat convert A B -o OUT")
        if target is None or not sources:
            raise ls.ConfigError("convert needs a file to read and a file to write: lumisplat convert IN OUT")
        ls.io.check_format(target)  # fails before the slow work
        for option, given in (
            (f"--columns {self.columns}", self.columns != "lumisplat"),
            ("--incident", self.incident),
        ):
            if given and not holds_all_columns(target):
                raise ls.ConfigError(f"{option} needs a .ply, got {target}")
        return sources, target

    @property
    def keeps_incident(self) -> bool:
        """True if ``--incident`` is given: the incident light of a Relightable 3D Gaussians file is kept."""
        return self.incident

    def _loaded(self, source: Path, report: Report) -> ls.Gaussians:
        """Loads a capture; of a glTF or OpenUSD scene, all captures as one."""
        loaded = self.load_asset(source, report)
        if isinstance(loaded, ls.Scene) and loaded.splats and not loaded.meshes:
            rotation = (180.0, 0.0, 0.0) if loaded.up == (0.0, 1.0, 0.0) else (0.0, 0.0, 0.0)  # captures have y down
            placed = (ls.transform(one.gaussians, one.transform, rotation_degrees=rotation) for one in loaded.splats)
            return ls.merge(list(placed))
        if not isinstance(loaded, ls.Gaussians):
            raise ls.FormatError(
                source, "is not a capture: convert takes Gaussians only (Python: ls.gaussians_from_mesh)"
            )
        if self.incident and loaded.incident is None:
            raise ls.FormatError(source, "has no incident light: leave out --incident")
        return loaded

    def _edits(self, report: Report, done: list[str]) -> Iterator[tuple[str, _Edit]]:
        """Yields (options, edit) for each edit that the user asked for, in order; an edit maps Gaussians to Gaussians.

        Args:
            report: Receives the progress of slow edits.
            done: Edits append lines about what they did, for the user.
        """
        if self.box is not None or self.sphere is not None:
            box = None if self.box is None else _split_at(numbers("--box", self.box, 6, "-1,-1,-1,1,1,1"), 3)
            sphere = None
            if self.sphere is not None:
                center, (radius,) = _split_at(numbers("--sphere", self.sphere, 4, "0,0,0,2"), 3)
                sphere = (center, radius)
            given = [name for name, value in (("--box", box), ("--sphere", sphere)) if value is not None]
            yield ", ".join(given), lambda g: ls.editing.crop(g, box, sphere, outside=self.outside)
        elif self.outside:
            raise ls.ConfigError("--outside needs --box or --sphere")
        if self.keep:
            ranges = _value_ranges(self.keep)
            yield "--keep", lambda g: ls.editing.select(g, **ranges)
        if (neighbours := self.floaters) is not None:
            bar = partial(report, "looking for floaters")
            yield "--floaters", lambda g: ls.editing.remove_floaters(g, neighbours, progress=bar)
        if (degree := self.sh_degree) is not None:
            yield "--sh-degree", lambda g: ls.editing.limit_sh_degree(g, degree, pad=True)
        if (target := self.decimate) is not None:
            merging = partial(report, "merging neighbours")
            yield "--decimate", lambda g: ls.editing.decimate(g, _target_count(target, g.count), progress=merging)
        if self.level:
            yield "--level", lambda g: _levelled(g, done)
        if self.scale != 1.0 or self.rotate is not None or self.translate is not None:
            yield "--scale, --rotate, --translate", self._placed
        if self.morton:
            yield "--morton", ls.editing.sort_morton

    def _placed(self, gaussians: ls.Gaussians) -> ls.Gaussians:
        rotation = (0.0, 0.0, 0.0) if self.rotate is None else vector("--rotate", self.rotate, "180,0,0")
        translation = (0.0, 0.0, 0.0) if self.translate is None else vector("--translate", self.translate)
        return ls.transform(gaussians, scale=self.scale, rotation_degrees=rotation, translation=translation)


_UP_SOURCES = {
    "axes": "from the axes of the capture, as no ground was found: check the result",
    "stated": "from the file, as no ground was found",
}
"""Words for how `find_up` found the up direction of a capture in which it found no ground, by the source that it
reports."""


def _levelled(gaussians: ls.Gaussians, done: list[str]) -> ls.Gaussians:
    """Returns a capture rotated so that its up direction, found from its ground, is a coordinate axis.

    Args:
        gaussians: The capture.
        done: Receives a line about the rotation, for the user.
    """
    found = ls.editing.find_up(ls.Scene([gaussians]))
    level = ls.editing.level(gaussians, found.up)
    assert level.up is not None
    cosine = sum(before * after for before, after in zip(found.up, level.up, strict=True))
    how = _UP_SOURCES.get(found.source)
    if found.height is not None and found.share is not None:
        how = f"from the ground at height {found.height:.4g}, {found.share:.0%} of the visible surface"
    rotation = f"rotated by {math.degrees(math.acos(min(max(cosine, -1.0), 1.0))):.1f} degrees"
    done.append(f"--level: up was {up_name(found.up)}, {how}; {rotation}, it is {up_name(level.up)}")
    return level


def _split_at(values: tuple[float, ...], first: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Splits a tuple into its first ``first`` values and the others."""
    return values[:first], values[first:]


def _edited(option: str, edit: _Edit, gaussians: ls.Gaussians) -> ls.Gaussians:
    """Applies an edit to a capture; an error of the edit gets a message that names the option."""
    try:
        return edit(gaussians)
    except ls.SceneError as error:
        raise ls.ConfigError(f"{option}: {error}") from error


def _value_ranges(texts: Sequence[str]) -> dict[str, _Range]:
    """Parses the values of ``--keep``, such as ``opacity=0.1..`` or ``x=-1..1``, for `lumisplat.editing.select`."""
    known = [name for name, p in inspect.signature(ls.editing.select).parameters.items() if p.kind is p.KEYWORD_ONLY]
    ranges: dict[str, _Range] = {}
    for text in texts:
        name, equals, limits = text.partition("=")
        low, dots, high = limits.partition("..")
        if name not in known:
            raise ls.ConfigError(f"--keep {text}: unknown value {name!r}, expected one of {', '.join(known)}")
        if name in ranges:
            raise ls.ConfigError(f"--keep names {name} twice: give both limits at once, {name}=MIN..MAX")
        try:
            ranges[name] = (float(low) if low else None, float(high) if high else None)
        except ValueError:
            dots = ""
        if not equals or not dots or not (low or high):
            raise ls.ConfigError(f"--keep {text}: expected {name}=MIN..MAX, {name}=MIN.. or {name}=..MAX")
    return ranges


def _target_count(text: str, whole: int) -> int:
    """Returns the number of Gaussians that ``--decimate`` asks for, as a count or as a percentage of ``whole``."""
    try:
        count = round(whole * float(text[:-1]) / 100.0) if text.endswith("%") else int(text)
        positive = float(text.removesuffix("%")) > 0.0
    except (ValueError, OverflowError):
        count, positive = 0, False
    if not positive or not math.isfinite(count):
        raise ls.ConfigError(f"--decimate: {text}, expected the number of Gaussians to keep, such as 100000 or 25%")
    return max(count, 1)
