"""``lumisplat train``: trains a capture from images with poses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.input.loading import holds_all_columns
from lumisplat.cli.input.numbers import seconds_of
from lumisplat.cli.options.command import DeviceCommand, Flag, given_settings_of, own_options_first, setting
from lumisplat.cli.output.comparisons import plain, write_image, write_json
from lumisplat.cli.output.console import Report, counted, duration_text, print_columns, progress_bars
from lumisplat.cli.output.images import file_stems, make_folder, refuse_standard_output

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

_CAPTURES = (".ply", ".spz")
_POSES = ("transforms.json", "transforms_train.json", "sparse", "cameras.bin", "cameras.txt")
"""Names of files and folders with camera poses; if the image folder has one, ``--poses`` estimates no poses."""
_WORST = 5
"""Number of held-out views with the lowest PSNR that the printed table lists."""
_RELIGHTABLE_WEIGHTS = (0.3, 0.05, 0.3)
"""Default weights of the losses ``flatness``, ``normals`` and ``depth_spread`` if ``--relightable`` is given."""
_CLIPPED_MAX = 0.02
"""Fraction of visible Gaussians whose albedo is clipped at 1, above which a printed line warns about them."""


@own_options_first
@dataclass(frozen=True, kw_only=True)
class Train(DeviceCommand):
    """Train a capture from images with poses.

    Writes FILE, and beside it a .training folder with checkpoints, settings, training curve and held-out images.
    The same command continues after an interruption.
    Guide: docs/guide/training.md, relightable.md.
    First try: lumisplat train fox/ -o fox.ply --stop-after 10m
    """

    folder: Positional[Annotated[Path, arg(metavar="FOLDER")]]
    """Read images with transforms.json, transforms_train.json or a COLMAP model."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="FILE")]
    """Write the capture, .ply or .spz."""
    iterations: Annotated[int | None, setting("N", "7000")] = None
    """Take N training steps, each with one image."""
    cap: Annotated[int | None, setting("N", "100000")] = None
    """Limit the number of Gaussians."""
    hold_out: Annotated[int, arg(metavar="N")] = 8
    """Hold out every N-th image, or the test images that FOLDER names; 0: none."""
    scale: Annotated[float, arg(metavar="0..1", help_behavior_hint="(default: 1)")] = 1.0
    """Scale the images by this factor, above 0 and at most 1."""
    poses: Annotated[Literal["colmap", "colmap-film"] | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """Find missing poses by colmap, or colmap-film for video frames; needs pip install 'lumisplat[poses]'."""
    background: Annotated[str, arg(metavar="COLOR")] = "black"
    """Fill transparent parts of images: a name, #rrggbb, r,g,b, or random in each step."""
    densification: Annotated[Literal["mcmc", "adaptive"] | None, setting("NAME", "mcmc")] = None
    """Add Gaussians until --cap (mcmc), or only where gradients are large (adaptive)."""
    sh_degree: Annotated[int | None, setting("0..3", "3")] = None
    """Set the SH degree of view-dependent colour."""
    pipeline: Annotated[Literal["raster", "trace"] | None, setting("raster|trace", "raster")] = None
    """Train by raster, or by trace: slower, and exact for any lens."""
    projection: Annotated[Literal["ewa", "unscented"] | None, setting("NAME", "ewa")] = None
    """Rasterise as ellipses (ewa), or along the rays of any lens (unscented)."""
    kernel_degree: Annotated[int | None, setting("0..5", "2")] = None
    """Set exponent p of falloff exp(-c d^p), 0: linear; others than 2 need --pipeline trace."""
    antialiased: Flag = False
    """Compensate opacities for the width of pixels (Mip-Splatting)."""
    exposures: Flag = False
    """Optimise an exposure for each image."""
    refine_poses: Flag = False
    """Optimise the camera poses too."""
    relightable: Flag = False
    """Find albedo, roughness, normals and environment after training; sets loss weights unless one is given."""
    material_steps: Annotated[int | None, setting("N", "300")] = None
    """Refine the materials of --relightable in N steps."""
    metal: Flag = False
    """Take all surfaces for bare metal in --relightable, instead of plastic, stone or paint."""
    flatness: Annotated[float | None, arg(metavar="WEIGHT", help_behavior_hint="")] = None
    """Set the weight of the loss that flattens Gaussians; --relightable sets 0.3."""
    normals: Annotated[float | None, arg(metavar="WEIGHT", help_behavior_hint="")] = None
    """Set the weight of the loss that aligns Gaussians with surfaces; --relightable sets 0.05."""
    depth_spread: Annotated[float | None, arg(metavar="WEIGHT", help_behavior_hint="")] = None
    """Set the weight of the loss that thins surfaces; --relightable sets 0.3."""
    prune_below: Annotated[float | None, setting("WEIGHT", "0.01")] = None
    """Remove Gaussians with less blending weight than this in every image, at the end."""
    seed: Annotated[int | None, setting("N", "0")] = None
    """Set the random seed; equal seeds give equal results."""
    stop_after: Annotated[str | None, arg(metavar="TIME", help_behavior_hint="")] = None
    """Stop after this time: 90s, 10m or 1.5h; the same command continues."""
    preview: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Write an image of the first held-out view every N steps."""
    allow_outside: Flag = False
    """Let a transforms.json name images outside of its folder."""
    overwrite: Flag = False
    """Delete an earlier training and begin again."""

    def run(self) -> None:
        """Trains and writes the capture."""
        self.check()
        self.quiet_warp()
        with progress_bars() as report:
            made = self.make(report)
        self.print_results(*made)

    def check(self) -> None:
        """Checks the options before images are read.

        Raises:
            ConfigError: An option is out of range, or two exclude each other.
        """
        refuse_standard_output(self.output)
        if self.output.suffix.lower() not in _CAPTURES:
            raise ls.ConfigError(f"-o is {self.output}, expected a file that ends in {' or '.join(_CAPTURES)}")
        if self.relightable and not holds_all_columns(self.output):
            raise ls.ConfigError(f"-o is {self.output}, expected a .ply: others have no columns for --relightable")
        if self.relightable and (self.pipeline == "trace" or self.projection == "unscented"):
            raise ls.ConfigError("--relightable needs --pipeline raster and --projection ewa")
        if self.relightable and self.exposures:
            raise ls.ConfigError("--relightable needs images of equal exposure: leave out --exposures")
        if self.metal and not self.relightable:
            raise ls.ConfigError("--metal needs --relightable: other captures have no materials")
        if self.material_steps is not None and self.material_steps < 0:
            raise ls.ConfigError(f"--material-steps is {self.material_steps}, expected 0 or more")
        for made in (self._config, self._materials_config, self._seconds, self._checked_background):
            made()

    def make(self, report: Report) -> tuple[ls.training.TrainResult, ls.inverse.FoundMaterials | None]:
        """Trains and writes the capture.

        Args:
            report: Receives the progress.

        Returns:
            Result of the training, and the materials of ``--relightable``; None without materials.

        Raises:
            KeyboardInterrupt: The training was interrupted; the message says how to continue.
            LumisplatError: Raised by `lumisplat.train`.
        """
        if self.poses is not None and not any((self.folder / name).exists() for name in _POSES):
            ls.io.find_poses(self.folder, ordered=self.poses == "colmap-film", progress=report)
        config = self._config()
        try:
            images = ls.io.load_training_images(
                self.folder,
                scale=self.scale,
                hold_out=self.hold_out,
                background=self._checked_background(),
                straighten=not config.keeps_lenses,
                allow_outside=self.allow_outside,
            )
            result = ls.train(
                images,
                config,
                output=self.output,
                stop_after=self._seconds(),
                overwrite=self.overwrite,
                preview=self.preview,
                device=self.device,
                progress=report,
            )
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"{self._same_command} continues; with --stop-after 1s, it writes the capture"
            ) from None
        return result, self._materials(result, images, self._materials_config(), report)

    def print_results(self, result: ls.training.TrainResult, found: ls.inverse.FoundMaterials | None) -> None:
        """Prints the results of a training, and the files of its materials.

        Args:
            result: Result of the training.
            found: Materials of ``--relightable``; None without them.
        """
        self._print_results(result)
        if found is not None:
            self._print_materials(found)

    def _materials(
        self,
        result: ls.training.TrainResult,
        images: ls.io.TrainingImages,
        config: ls.config.MaterialsConfig,
        report: Report,
    ) -> ls.inverse.FoundMaterials | None:
        """Estimates and writes the materials after a finished training; returns None without ``--relightable``."""
        if not self.relightable or not result.is_finished:
            return None
        if result.cameras is not None:  # training has refined the poses
            moved = zip(images.training, result.cameras, strict=True)
            images = replace(images, training=tuple(replace(one, camera=camera) for one, camera in moved))
        try:
            found = ls.inverse.find_materials(
                result.gaussians, images, config, output=self.output, device=self.device, progress=report
            )
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"{self._same_command} continues; {self.output} has no materials yet") from None
        _write_materials(self.output.with_suffix(".training") / "materials", found, images, self.device)
        return found

    def _print_materials(self, found: ls.inverse.FoundMaterials) -> None:
        """Prints the files of the materials, and a warning if more than `_CLIPPED_MAX` of the albedos are clipped."""
        environment = self.output.with_name(self.output.stem + ".environment.exr")
        print(
            f"{environment}: the environment; {self.output.with_suffix('.training')}/materials has images of "
            "environment and materials"
        )
        if found.too_light > _CLIPPED_MAX:
            print(
                f"{found.too_light:.0%} of the surface is brighter than the estimated environment can make it: "
                "highlights, or light that no image shows"
            )

    def _seconds(self) -> float | None:
        """Returns the time limit of ``--stop-after`` in seconds; None without the option."""
        return None if self.stop_after is None else seconds_of("--stop-after", self.stop_after)

    def _materials_config(self) -> ls.config.MaterialsConfig:
        steps = {} if self.material_steps is None else {"iterations": self.material_steps}
        return ls.config.MaterialsConfig(
            metal=self.metal, **steps, **({} if self.seed is None else {"seed": self.seed})
        )

    def _config(self) -> ls.TrainConfig:
        given = given_settings_of(self, ls.TrainConfig)
        names = ("flatness", "normals", "depth_spread")
        if self.relightable and given.keys().isdisjoint(names):
            given |= dict(zip(names, _RELIGHTABLE_WEIGHTS, strict=True))
        return ls.TrainConfig(**given, random_background=self._is_random)

    @property
    def _is_random(self) -> bool:
        """True if ``--background`` is ``random``: each training step has a different background."""
        return self.background.strip().lower() == "random"

    def _checked_background(self) -> str:
        """Returns the background of ``--background`` for transparent training images, checked; black for ``random``."""
        if self._is_random:
            return "black"
        try:
            ls.RenderConfig(background=self.background)  # pyright: ignore[reportArgumentType]
        except ls.ConfigError as error:
            raise ls.ConfigError(f"{error}, or random: another one in each step") from None
        return self.background

    def _print_results(self, result: ls.training.TrainResult) -> None:
        """Prints PSNR of held-out views, number of Gaussians, steps and time of the training."""
        score = result.score
        if score is not None:
            worst = sorted(score.of_views.items(), key=lambda item: item[1])[:_WORST]
            print_columns(
                ["held out", "PSNR, dB"], [["mean", f"{score.psnr:.2f}"], *([n, f"{v:.2f}"] for n, v in worst)]
            )
        steps = f"{result.iterations:,} of {self._config().iterations:,} steps"
        print(f"{self.output}: {counted(result.gaussians.count, 'Gaussian')}, {steps}, {duration_text(result.seconds)}")
        if result.pruned:
            print(
                f"pruned {counted(result.pruned, 'Gaussian')} whose blending weight is below "
                f"{self._config().prune_below:g} in every image (--prune-below)"
            )
        if not result.is_finished:
            print(f"{self._same_command} continues the training")

    @property
    def _same_command(self) -> str:
        """How messages call the command that continues the training: the same, but without ``--overwrite``."""
        return "the same command without --overwrite" if self.overwrite else "the same command"


_MATERIAL_VIEWS = 4
"""Number of views for which a PNG shows the training image, albedo, roughness and normals side by side."""
_ENVIRONMENT_PX = 16
"""Factor by which the PNG of the estimated environment enlarges its few pixels."""
_ENVIRONMENT_MEAN = 0.3
"""Mean linear radiance to which the environment is scaled in its PNG. The environment's absolute brightness is
arbitrary, and values above 1 are shown white."""
_SH_C0 = 0.28209479177387814


def _write_materials(folder: Path, found: ls.inverse.FoundMaterials, images: ls.io.TrainingImages, device: str) -> None:
    """Writes what was estimated for ``--relightable``: PNGs of views and of the environment, and materials.json.

    Args:
        folder: Folder to write into; created if missing.
        found: The estimated materials and environment.
        images: Training images; the views are held-out ones if there are any.
        device: Device that renders.
    """
    import numpy as np

    make_folder(folder)
    views = (images.held_out or images.training)[:_MATERIAL_VIEWS]
    renderer = ls.create_renderer(ls.RenderConfig(lighting=False), device)
    layers = [ls.Scene([layer]) for layer in _layers(found.gaussians)]
    for view, stem in zip(views, file_stems([view.name for view in views]), strict=True):
        shown = [view.pixels(), *(renderer.render(layer, view.camera).color for layer in layers)]
        write_image(folder / f"{stem}.png", np.concatenate(shown, axis=1))
    image = found.environment.image
    if image is not None:
        exposed = image * (_ENVIRONMENT_MEAN / max(float(image.mean()), 1e-9))
        write_image(
            folder / "environment.png", np.kron(_encoded(exposed), np.ones((_ENVIRONMENT_PX, _ENVIRONMENT_PX, 1)))
        )
    figures = plain({"error": found.error, "too_light": found.too_light}) | {"gaussians": found.gaussians.count}
    write_json(folder / "materials.json", figures)


def _layers(gaussians: ls.Gaussians) -> list[ls.Gaussians]:
    """Returns three unlit copies of a capture whose Gaussians show their albedo, roughness and normals as colours."""
    import numpy as np

    assert gaussians.albedo is not None and gaussians.roughness is not None and gaussians.normals is not None
    grey = np.repeat(gaussians.roughness[:, None], 3, axis=1)
    return [_colored(gaussians, color) for color in (_encoded(gaussians.albedo), grey, 0.5 + 0.5 * gaussians.normals)]


def _colored(gaussians: ls.Gaussians, color: npt.NDArray[np.floating]) -> ls.Gaussians:
    import numpy as np

    return replace(gaussians, sh=((color - 0.5) / _SH_C0).astype(np.float32)[:, None])


def _encoded(linear: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Converts linear values to sRGB-encoded values, without clipping."""
    import numpy as np

    bright = 1.055 * np.maximum(linear, 1e-9) ** (1.0 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, bright)
