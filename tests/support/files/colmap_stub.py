"""Replaces pycolmap in tests by a stub with prescribed results."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any


@dataclass
class ColmapStub:
    """Provides the names of pycolmap that Lumisplat uses; its database is a JSON file of the recorded calls."""

    models: Sequence[Sequence[int]] = ((0, 1, 2),)
    """Image indices of each model; empty if COLMAP finds no poses."""
    interrupt_in: str = ""
    """Name of the step that raises KeyboardInterrupt."""
    features: int = 500
    """Number of features per image."""
    verified: int = 100
    """Number of verified image pairs among 100."""
    lenses: list[tuple[str, str, bool]] = field(default_factory=list)
    """Camera model, camera mode, and whether an existing camera was used, for each call that extracts features."""
    compared: list[tuple[str, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.logging = SimpleNamespace(minloglevel=0)
        self.CameraMode = SimpleNamespace(SINGLE="single", PER_IMAGE="per image")
        self.CancellationToken = lambda: SimpleNamespace(cancel=lambda: None)
        self.FeatureExtractionOptions = lambda **given: SimpleNamespace(sift=SimpleNamespace(), **given)
        self.ImageReaderOptions = lambda **given: SimpleNamespace(existing_camera_id=-1, **given)
        self.ImportedPairingOptions = SimpleNamespace
        self.IncrementalPipelineOptions = SimpleNamespace
        self.Database = SimpleNamespace(open=self._open)

    def extract_features(self, database: Path, images: Path, **options: Any) -> None:
        """Records the image names."""
        reader = options["reader_options"]
        self.lenses.append((reader.camera_model, options["camera_mode"], reader.existing_camera_id == 1))
        assert all((images / name).is_file() for name in options["image_names"])
        self._add(database, "images", options["image_names"])
        self._interrupt("extract")

    def match_image_pairs(self, database: Path, **options: Any) -> None:
        """Records the pairs."""
        pairs = options["pairing_options"].match_list_path.read_text().split()
        self.compared += [(a, b) for a, b in zip(pairs[::2], pairs[1::2], strict=True)]
        self._add(database, "pairs", [" ".join(pair) for pair in self.compared])
        self._interrupt("match")

    def incremental_mapping(
        self,
        database: Path,
        images: Path,
        output: Path,
        options: Any,
        initial_image_pair_callback: Callable[[], None],
        next_image_callback: Callable[[], None],
        **_: Any,
    ) -> dict[int, _Model]:
        """Returns the prescribed models."""
        self._interrupt("estimate_poses")
        names = self._read(database)["images"]
        for model in self.models:
            initial_image_pair_callback()
            for _k in model[2:]:
                next_image_callback()
        return {k: _Model([names[index] for index in model]) for k, model in enumerate(self.models)}

    def _interrupt(self, step: str) -> None:
        if self.interrupt_in == step:
            raise KeyboardInterrupt

    @staticmethod
    def _read(database: Path) -> dict[str, list[str]]:
        return json.loads(database.read_text()) if database.is_file() else {"images": [], "pairs": []}

    def _add(self, database: Path, kind: str, names: Sequence[str]) -> None:
        content = self._read(database)
        content[kind] = sorted({*content[kind], *names})
        database.write_text(json.dumps(content))

    @contextmanager
    def _open(self, database: Path) -> Any:
        content = self._read(database)
        yield SimpleNamespace(
            num_images=lambda: len(content["images"]),
            num_matched_image_pairs=lambda: len(content["pairs"]),
            read_two_view_geometry_num_inliers=lambda: (range(100), [20] * self.verified + [0] * (100 - self.verified)),
            num_keypoints=lambda: self.features * len(content["images"]),
        )


class _Model:
    """A model of images of 640 x 480 pixels."""

    def __init__(self, names: Sequence[str]) -> None:
        self.images = {k: SimpleNamespace(name=name) for k, name in enumerate(names)}
        self.cameras = {1: SimpleNamespace(width=640, height=480, mean_focal_length=lambda: 500.0)}
        self.image = self.images.__getitem__
        self.reg_image_ids = lambda: list(self.images)
        self.num_reg_images = lambda: len(self.images)
        self.num_points3D = lambda: 1000
        self.compute_mean_observations_per_reg_image = lambda: 400.0
        self.compute_mean_reprojection_error = lambda: 0.5

    def write(self, folder: Path) -> None:
        """Writes only the names of the images, not COLMAP's files."""
        (folder / "names.txt").write_text("\n".join(image.name for image in self.images.values()))
