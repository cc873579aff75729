"""Writes the images of a command: a file per camera, with layers beside the colour, or a false-colour view instead."""

from __future__ import annotations

import contextlib
import difflib
import io
import mimetypes
import re
import shutil
import sys
import tempfile
from collections.abc import Generator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import lumisplat as ls

FORMATS = ("png", "exr", "npz")
_UNSAFE = re.compile(r"[^\w.-]+")
_STEM_BYTES = 150
"""Largest length of a file name without extension, UTF-8 bytes; suffixes then fit below the usual limit of 255."""


@dataclass(frozen=True)
class Shot:
    """A camera to render, and the path of the image to write."""

    camera: ls.Camera
    path: Path


def plan_shots(cameras: Sequence[ls.Camera], wanted: Sequence[str], output: Path, format_name: str) -> list[Shot]:
    """Returns a camera and an image path for each image to render.

    Args:
        cameras: All cameras.
        wanted: Names of the cameras to render; empty means all.
        output: A folder, or for one image a file ``.png``, ``.exr`` or ``.npz``.
        format_name: One of `FORMATS`, or ``auto``: the format of the file's name, else PNG.

    Raises:
        ConfigError: A name is unknown, the output is another kind of image, or its name contradicts the format.
    """
    stems = file_stems([camera.name for camera in cameras])
    chosen = [index for index in range(len(cameras)) if not wanted or {cameras[index].name, stems[index]} & {*wanted}]
    for name in wanted:
        if not any(name in (cameras[index].name, stems[index]) for index in chosen):
            listed = ", ".join(stems[:5]) + (", ..." if len(stems) > 5 else "")
            raise ls.ConfigError(f"no camera is named '{name}': there are {len(stems)} ({listed})")
    suffix = output.suffix.lower().removeprefix(".")
    if suffix not in FORMATS:
        if (mimetypes.guess_type(output)[0] or "").startswith(("image/", "video/")):
            raise ls.ConfigError(
                f"{output}: unknown image extension '.{suffix}', expected .png, .exr or .npz, or a folder"
            )
        extension = "png" if format_name == "auto" else format_name
        return [Shot(cameras[index], output / f"{stems[index]}.{extension}") for index in chosen]
    if format_name not in ("auto", suffix):
        raise ls.ConfigError(f"{output}: the name means {suffix}, but --format is {format_name}")
    if len(chosen) > 1:
        raise ls.ConfigError(
            f"{output}: {len(chosen)} frames do not fit into one file: give a folder, or choose one by --frames"
        )
    return [Shot(cameras[index], output) for index in chosen]


def file_stems(names: Sequence[str]) -> list[str]:
    """Returns a file name without extension for each frame name: safe characters, numbered if equal ignoring case."""
    taken: set[str] = set()
    copies: dict[str, int] = {}
    stems: list[str] = []
    for index, name in enumerate(names):
        safe = _UNSAFE.sub("_", name).strip("._").encode()[:_STEM_BYTES].decode(errors="ignore")
        safe = safe or f"frame_{index:04d}"
        stem = safe
        while stem.casefold() in taken:
            copies[safe] = copies.get(safe, 1) + 1
            stem = f"{safe}_{copies[safe]}"
        taken.add(stem.casefold())
        stems.append(stem)
    return stems


def check_writable(output: Path) -> None:
    """Checks that images can be written to ``-o``, before anything slow is done; leaves no file behind.

    Args:
        output: Argument of `plan_shots`.

    Raises:
        FormatError: A file blocks the folder, or the folder cannot be written.
    """
    check_folder(output.parent if output.suffix.lower().removeprefix(".") in FORMATS else output, output)


def check_folder(folder: Path, output: Path | None = None) -> None:
    """Checks that files can be written into an existing or new folder; leaves no file behind.

    Args:
        folder: The folder.
        output: Path that messages name; None is the folder.

    Raises:
        FormatError: A file blocks the folder, or the folder cannot be written.
    """
    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not existing.is_dir():
        raise ls.FormatError(existing, "is a file, expected a folder")
    try:
        tempfile.TemporaryFile(dir=existing).close()
    except OSError as error:
        raise ls.FormatError(
            output or folder, f"cannot be written, as {existing} is not writable: {error.strerror}"
        ) from None


def make_folder(folder: Path) -> None:
    """Makes ``folder`` and its parents.

    Raises:
        FormatError: The folder cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise ls.FormatError(folder, "is a file, expected a folder for the images") from None
    except OSError as error:
        raise ls.FormatError(folder, f"the output folder cannot be made: {error.strerror}") from None


_LEGENDS = {
    "depth": "depth in scene units from {:.4g} (red) to {:.4g} (blue)",
    "motion": "pixels per frame, {:.0f} (white) to {:.0f} (full), red to the right, yellow-green up; unknown: black",
    "history": "number of frames averaged in direct light, from {:.0f} (violet) to {:.0f} (yellow); no surface: black",
    "probes": "refreshes of screen probes from {:.0f} (violet) to {:.0f} (yellow), logarithmic",
    "hits": "Gaussians per ray from {:.0f} (violet) to {:.0f} (yellow), logarithmic; none: black",
}
"""Text that explains the colours of a false-colour view; its two gaps take the lower and upper end of the colour
scale."""


@dataclass(frozen=True)
class Layers:
    """Layers that ``--aov`` asks to write besides the colour: image layers, Cryptomatte mattes and deep samples."""

    names: tuple[str, ...]
    """Image layers that are written from AOVs of the frame, such as ``depth``; without ``cryptomatte`` and ``deep``."""
    cryptomatte: bool
    deep: bool

    @classmethod
    def of(cls, text: str) -> Layers:
        """Parses the value of ``--aov``: layer names separated by commas.

        Raises:
            ConfigError: A name is not that of a layer.
        """
        known = (*ls.Frame.LAYERS, "cryptomatte", "deep")
        given = [name.strip() for name in text.split(",") if name.strip()]
        for name in given:
            if name not in known:
                near = difflib.get_close_matches(name, known, 1)
                hint = f", did you mean {near[0]}?" if near else ""
                raise ls.ConfigError(f"--aov has '{name}'{hint or ','} expected some of {', '.join(known)}")
        names = tuple(name for name in given if name in ls.Frame.LAYERS)
        return cls(names, "cryptomatte" in given, "deep" in given)


@dataclass(frozen=True)
class Views:
    """Names the views of ``--view``: a false-colour view in place of the image, or insets on the image."""

    main: str | None = None
    """View that replaces the image; None: the image itself."""
    insets: tuple[str, ...] = ()
    """Views that are drawn small, in the lower right corner of the image."""

    @classmethod
    def of(cls, text: str) -> Views:
        """Parses the value of ``--view``: a view, or ``color`` and insets, such as ``color,depth,normal``.

        Raises:
            ConfigError: A name is not that of a view, or insets follow another view than ``color``.
        """
        main, *insets = [name.strip() for name in text.split(",") if name.strip()] or [""]
        for name in (main, *insets):
            if name not in ls.Frame.VIEWS and (name != main or name not in ("color", "")):
                near = difflib.get_close_matches(name, ls.Frame.VIEWS, 1)
                hint = f", did you mean {near[0]}?" if near else ""
                raise ls.ConfigError(f"--view has '{name}'{hint or ','} expected one of {', '.join(ls.Frame.VIEWS)}")
        if insets and main != "color":
            raise ls.ConfigError(
                f"--view {text}: insets are drawn on the image: --view color,{main},{','.join(insets)}"
            )
        return cls(None if main in ("color", "") else main, tuple(insets))

    @property
    def aovs(self) -> tuple[str, ...]:
        """AOVs that `RenderConfig.aovs` must list so that frames contain the views."""
        return tuple(ls.Frame.NEEDS[name] for name in (self.main or "", *self.insets) if name in ls.Frame.NEEDS)


@dataclass
class FrameWriter:
    """Writes image files: each frame with its layers and insets, or one false-colour view of each frame.

    The colour scale of a view is set by the first frame, so that colours mean the same in all frames of a run. Insets
    have the scale of their own frame, so that frames of a run can be made apart.

    Raises:
        ConfigError: Both a view and layers are given.
    """

    layers: tuple[str, ...]
    """Names of the layers to write besides the colour."""
    views: Views = Views()
    legend: str | None = field(default=None, init=False)
    """Text that explains the colours of the view, or the values of a 16-bit depth PNG; None before a frame has been
    written, or if nothing needs explaining."""
    _limits: tuple[float, float] | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        if self.views.main and self.layers:
            raise ls.ConfigError("--view and --aov exclude each other: a view replaces the image")

    @property
    def aovs(self) -> tuple[str, ...]:
        """AOVs that `RenderConfig.aovs` must list so that frames contain the layers or the view."""
        return (*(ls.Frame.NEEDS[name] for name in self.layers if name in ls.Frame.NEEDS), *self.views.aovs)

    def write(self, frame: ls.Frame, path: Path, mattes: ls.layers.Mattes | None = None) -> None:
        """Writes one frame to a file, with its layers, or the false-colour view instead.

        Args:
            frame: The frame.
            path: Path of the file; its extension selects the format.
            mattes: Cryptomatte mattes to write with the layers; None for none.

        Raises:
            ConfigError: The frame lacks a layer, or data that the view needs.
            FormatError: The file cannot be written.
        """
        view = self.views.main
        if view is None:
            frame.save(path, self.layers, mattes, insets=self.views.insets)
            if "depth" in self.layers and path.suffix.lower() == ".png":
                self.legend = _depth_legend(path.with_suffix(".depth16.png"), frame, first=self.legend is None)
            return
        self._limits = self._limits or frame.view_limits(view)
        if view in _LEGENDS:
            self.legend = _LEGENDS[view].format(*self._limits)
        frame.save_view(path, view, self._limits)


def _depth_legend(path: Path, frame: ls.Frame, *, first: bool) -> str:
    """Returns how the values of a 16-bit depth PNG map to scene units.

    Args:
        path: Path of the PNG.
        frame: Frame whose depth it stores.
        first: True for the first file of a run, whose range is given as numbers; for later ones, the text says that
            each file stores its own range.
    """
    if not first:
        return (
            ".depth16.png: depth in scene units, from depth_near (1) to depth_far (65535) of each file's text; 0: none"
        )
    if frame.depth_range is None:
        return f"{path}: no surface is seen, all values are 0"
    near, far = frame.depth_range
    return f"{path}: depth in scene units from {near:.6g} (1) to {far:.6g} (65535); 0: no surface"


STANDARD_OUTPUT = Path("-")


def refuse_standard_output(output: Path | None) -> None:
    """Raises an error if ``-o`` is ``-``; for commands that write several files.

    Raises:
        ConfigError: ``-o -`` is given.
    """
    if output == STANDARD_OUTPUT:
        raise ls.ConfigError("-o - is one file, but there are several frames: give a folder")


@contextlib.contextmanager
def standard_output(suffix: str) -> Generator[Path]:
    """Context that yields a temporary file, which is copied to standard output if the block succeeds.

    Text that the block prints appears on standard error.

    Args:
        suffix: Extension of the file, which selects its format.

    Raises:
        ConfigError: Standard output is a terminal, or closed.
        LumisplatError: Raised by the block; messages name standard output in place of the temporary file.
    """
    out = sys.stdout
    if sys.__stdout__ is None or out.isatty():
        raise ls.ConfigError("-o - is standard output: redirect it to a file or a program, such as -o - > image.png")
    messages = io.StringIO()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"out{suffix}"
        try:
            with contextlib.redirect_stdout(messages):
                yield file
        except ls.LumisplatError as error:
            if str(file) not in str(error):
                raise
            raise ls.SceneError(str(error).replace(str(file), "standard output")) from error
        print(messages.getvalue().replace(str(file), "standard output"), end="", file=sys.stderr)
        out.flush()
        with file.open("rb") as stream:
            shutil.copyfileobj(stream, out.buffer)
        out.flush()
