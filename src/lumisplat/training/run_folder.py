"""The folder beside a capture: what a training needs to go on, and what came of it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from lumisplat.config import TrainConfig
from lumisplat.errors import FormatError
from lumisplat.io import save_cameras
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike
from lumisplat.io.scene_toml.toml_table import toml_text
from lumisplat.io.training_images.loading import ReadFrom
from lumisplat.math.arrays import Doubles
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.training.curve import Curve
from lumisplat.training.held_out import HeldOut, HeldOutScore

_LEFT = (
    *("checkpoint.npz", "curve.*", "metrics.json", "exposures.json", "poses*.json", "held out", "previews"),
    *("light.npz", "materials"),
)
"""What a training leaves, and finding materials, beside what tells that they have."""
_TELLS = ("settings.toml", "materials.npz")
"""What is removed last of all."""


@dataclass(frozen=True, slots=True)
class RunFolder:
    """Files of a training."""

    path: Path

    @classmethod
    def of(cls, output: Path) -> RunFolder:
        """That of a capture: ``fox.ply`` has ``fox.training``."""
        return cls(output.with_suffix(".training"))

    @property
    def checkpoint(self) -> Path:
        """From which training goes on."""
        return self.path / "checkpoint.npz"

    @property
    def is_begun(self) -> bool:
        """Whether there is a training that can go on."""
        return self.checkpoint.exists() or (self.path / "settings.toml").exists()

    def preview(self, step: int) -> Path:
        """The picture of a step."""
        return self.path / "previews" / f"{step:07d}.png"

    def prepare(self, *, overwrite: bool) -> None:
        """Makes the folder, or empties it.

        Raises:
            FormatError: It cannot be made, or is none of a training.
        """
        try:
            if overwrite and self.path.exists():
                self._empty()
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FormatError(self.path, f"cannot be made: {error.strerror or error}") from None

    def _empty(self) -> None:
        """Removes what an earlier training has left, and nothing else; last of all what tells that it has."""
        told = [self.path / name for name in _TELLS]
        if any(self.path.iterdir()) and not any(path.exists() for path in told):
            raise FormatError(self.path, "is no folder of a training: it is not removed")
        for path in (found for pattern in _LEFT for found in self.path.glob(pattern)):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        for path in told:
            path.unlink(missing_ok=True)

    def write_settings(self, config: TrainConfig, read_from: ReadFrom | None) -> None:
        """Writes all that makes the same training again: from where photographs were read, and how, and settings."""
        tables = {"train": asdict(config)}
        if read_from is not None:
            background = read_from.background or "transparent"
            tables = {"photographs": asdict(read_from) | {"background": background}} | tables
        _write(self.path / "settings.toml", toml_text(tables))

    def write_curve(self, curve: Curve) -> None:
        """Writes the numbers of a curve."""
        _write(self.path / "curve.json", json.dumps(curve.told))

    def write_exposures(self, exposures: dict[str, Doubles]) -> None:
        """Writes how photographs were exposed: three rows of four numbers each, by name."""
        told = {name: exposure.tolist() for name, exposure in exposures.items()}
        _write(self.path / "exposures.json", json.dumps(told, indent=2) + "\n")

    def write_poses(self, cameras: Sequence[Camera]) -> None:
        """Writes cameras that have moved; those of more than one model in a file each, as a file holds one model."""
        models = {camera.model for camera in cameras}
        for model in models:
            name = "poses.json" if len(models) == 1 else f"poses-{model.value}.json"
            save_cameras(self.path / name, [camera for camera in cameras if camera.model is model])

    def write_report(self, curve: Curve, score: HeldOutScore | None, held_out: HeldOut, gaussians: Gaussians) -> None:
        """Writes the curve, also as a picture, and figures and pictures of what was held out."""
        self.write_curve(curve)
        with atomic_write(self.path / "curve.png") as temporary:
            curve.picture().save(temporary, format="PNG")
        if score is not None:
            told = {"psnr": score.psnr, "views": score.of_views, "gaussians": gaussians.count}
            _write(self.path / "metrics.json", json.dumps(told, indent=2) + "\n")
            held_out.write_pairs(gaussians, self.path / "held out")


def forget_training(output: PathLike) -> None:
    """Removes what a training has left beside a capture, and the capture, so that the next one begins anew.

    Args:
        output: The capture; what `lumisplat.train` has not written stays.

    Raises:
        FormatError: The folder beside it is none of a training, or cannot be emptied.
    """
    folder = RunFolder.of(Path(output))
    if folder.path.exists():
        folder.prepare(overwrite=True)
        with suppress(OSError):  # it holds something else, too
            folder.path.rmdir()
    try:
        Path(output).unlink(missing_ok=True)
    except OSError as error:
        raise FormatError(output, f"cannot be removed: {error.strerror or error}") from None


def _write(path: Path, text: str) -> None:
    with atomic_write(path) as temporary:
        temporary.write_text(text)
