"""What finding materials has come to, as files beside a capture, from which it goes on as if it had never ended."""

from __future__ import annotations

import hashlib
import json
import logging
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lumisplat.config import MaterialsConfig
from lumisplat.errors import FormatError, MissingFileError
from lumisplat.io.files.arrays import checked_array, read_arrays
from lumisplat.io.files.atomic import atomic_write
from lumisplat.math.arrays import Doubles
from lumisplat.scene.gaussians import Gaussians
from lumisplat.training.materials.lit_gaussians import IncidentRadiance, Materials

_log = logging.getLogger("lumisplat")

VERSION = 1
_OF_START, _OF_FIT = "start.", "fit."


@dataclass(frozen=True, slots=True, eq=False)
class FoundSoFar:
    """Everything that the next step depends on, but for settings, photographs, the capture and traced light."""

    start: Materials
    """Where steps begin."""
    too_light: float
    """Of the start, as of `FoundMaterials`."""
    iteration: int = 0
    """Steps that were made."""
    fit: dict[str, Doubles] = field(default_factory=dict[str, Doubles])
    """What moves, and its moments; empty before the first step."""
    errors: tuple[float, ...] = ()
    """Of the last steps, at most as many as there are photographs."""


@dataclass(frozen=True, slots=True)
class MaterialFiles:
    """The files of one search.

    A file of another search, or a damaged one, is as good as none: then the search begins anew, and a log line says so.
    """

    folder: Path
    mark: str
    """What tells the search from others."""
    count: int
    """Gaussians of the capture."""
    directions: int
    """Directions in which light is traced."""

    @classmethod
    def of(cls, folder: Path, gaussians: Gaussians, photographs: str, config: MaterialsConfig) -> MaterialFiles:
        """Those of a capture, photographs with this fingerprint, and settings."""
        told = hashlib.sha256(json.dumps([VERSION, photographs, asdict(config), gaussians.antialiased]).encode())
        for name in ("means", "rotations_wxyz", "scales", "opacities", "sh"):
            told.update(getattr(gaussians, name).tobytes())
        return cls(folder, told.hexdigest(), gaussians.count, config.directions)

    @property
    def _found(self) -> Path:
        return self.folder / "materials.npz"

    @property
    def _light(self) -> Path:
        return self.folder / "light.npz"

    def write(self, found: FoundSoFar) -> None:
        """Writes what was found so far.

        Raises:
            FormatError: It cannot be written.
        """
        arrays = {f"{_OF_START}{name}": getattr(found.start, name) for name in Materials.__slots__}
        arrays |= {f"{_OF_FIT}{name}": values for name, values in found.fit.items()}
        arrays["errors"] = np.array(found.errors, np.float64)
        self._write(self._found, arrays, {"iteration": found.iteration, "too_light": found.too_light})

    def read(self) -> FoundSoFar | None:
        """What was found so far, if anything."""
        held = self._read(self._found)
        if held is None:
            return None
        told, arrays = held
        moved = {"albedo": (self.count, 3), "roughness": (self.count,), "sky": (self.directions, 3)}
        shapes = moved | {"normals": (self.count, 3)}
        try:
            start = Materials(
                *(checked_array(arrays, f"{_OF_START}{name}", shapes[name], np.float64) for name in Materials.__slots__)
            )
            names = {name.removeprefix(_OF_FIT) for name in arrays if name.startswith(_OF_FIT)}
            expected = {f"{name}{part}": shape for name, shape in moved.items() for part in ("", ".first", ".second")}
            if names and names != expected.keys():
                raise ValueError("no state of a fit")
            fit = {name: checked_array(arrays, f"{_OF_FIT}{name}", expected[name], np.float64) for name in names}
            errors = tuple(checked_array(arrays, "errors", (None,), np.float64).tolist())
            iteration = int(told["iteration"])
            if iteration < 0 or (iteration > 0) != bool(names):
                raise ValueError("steps that do not fit the state")
            return FoundSoFar(start, float(told["too_light"]), iteration, fit, errors)
        except (KeyError, TypeError, ValueError, OverflowError):
            self._tell_anew(self._found)
            return None

    def write_light(self, incident: IncidentRadiance) -> None:
        """Writes what was traced: large, and only needed until the end.

        Raises:
            FormatError: It cannot be written.
        """
        self._write(self._light, {name: getattr(incident, name) for name in IncidentRadiance.__slots__}, {})

    def read_light(self) -> IncidentRadiance | None:
        """What was traced, if it is still there."""
        held = self._read(self._light)
        if held is None:
            return None
        pairs = self.count, self.directions
        try:
            return IncidentRadiance(
                directions=checked_array(held[1], "directions", (self.directions, 3), np.float64),
                open=checked_array(held[1], "open", pairs, np.float32),
                seen=checked_array(held[1], "seen", (*pairs, 3), np.float32),
            )
        except ValueError:
            self._tell_anew(self._light)
            return None

    def forget_light(self) -> None:
        """Removes what was traced."""
        self._light.unlink(missing_ok=True)

    def _write(self, path: Path, arrays: dict[str, Any], told: dict[str, float]) -> None:
        about = np.array(json.dumps({"mark": self.mark, **told}))
        with atomic_write(path) as temporary, temporary.open("wb") as file:
            np.savez(file, about=about, **arrays)

    def _read(self, path: Path) -> tuple[dict[str, Any], dict[str, Any]] | None:
        """What a file tells and holds; None: it is not there, or not of this search."""
        try:
            arrays = read_arrays(path, "what was found so far")
            told: dict[str, Any] = json.loads(str(arrays.pop("about")))
            if told["mark"] == self.mark:
                return told, arrays
        except MissingFileError:
            return None
        except FormatError as error:
            if "is damaged" not in error.problem:
                raise
        except (ValueError, LookupError, TypeError, RecursionError):
            pass
        self._tell_anew(path)
        return None

    @staticmethod
    def _tell_anew(path: Path) -> None:
        _log.warning(
            "%s: is damaged, or of another capture, other photographs or settings: materials are found anew", path
        )
