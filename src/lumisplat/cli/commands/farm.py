"""``lumisplat farm``: runs animate, orbit, render, dataset or train with several worker processes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, subcommand

from lumisplat.cli.commands.animate import Animate
from lumisplat.cli.commands.dataset import Dataset
from lumisplat.cli.commands.farm_train import FarmTrain
from lumisplat.cli.commands.orbit import Orbit
from lumisplat.cli.commands.render import Render
from lumisplat.cli.farm.driver import FarmGroup, FarmOptions, run_farm
from lumisplat.cli.options.command import Flag, own_options_first


@own_options_first
@dataclass(frozen=True, kw_only=True)
class FarmAnimate(Animate):
    """Render an animated scene by several workers.

    Guide: docs/guide/farm.md, animate.md.
    First try: lumisplat farm animate scene.toml --workers 2 -o frames --video walk.mp4
    """

    farm: FarmGroup = field(default_factory=FarmOptions)
    """Set the workers; frames are bit-identical to those of a single process."""

    def run(self) -> None:
        """Renders the missing frames, then the video."""
        run_farm(self, overwrite=self.overwrite, video=self.video)


@own_options_first
@dataclass(frozen=True, kw_only=True)
class FarmOrbit(Orbit):
    """Render a turntable or a camera path by several workers.

    Guide: docs/guide/farm.md.
    First try: lumisplat farm orbit garden.ply --workers 2 --video orbit.mp4
    """

    farm: FarmGroup = field(default_factory=FarmOptions)
    """Set the workers; frames are bit-identical to those of a single process."""

    def run(self) -> None:
        """Renders the missing frames, then the video."""
        run_farm(self, overwrite=self.overwrite, video=self.video)


@own_options_first
@dataclass(frozen=True, kw_only=True)
class FarmRender(Render):
    """Render an image for each camera by several workers; existing images stay.

    Guide: docs/guide/farm.md, tiles.md.
    First try: lumisplat farm render garden.ply --cameras transforms.json --workers 2 -o out
    """

    overwrite: Flag = False
    """Render existing images anew."""
    farm: FarmGroup = field(default_factory=FarmOptions)
    """Set the workers; images are bit-identical to those of a single process."""

    def run(self) -> None:
        """Renders the missing images."""
        run_farm(self, overwrite=self.overwrite, video=None)


@own_options_first
@dataclass(frozen=True, kw_only=True)
class FarmDataset(Dataset):
    """Render training data by several workers.

    Guide: docs/guide/farm.md, dataset.md.
    First try: lumisplat farm dataset scene.toml --workers 2 --views 1000 -o set
    """

    farm: FarmGroup = field(default_factory=FarmOptions)
    """Set the workers; files are bit-identical to those of a single process."""

    def run(self) -> None:
        """Renders the missing views, then writes transforms.json and the other files that list all views."""
        self.settings()  # mistakes in settings are found before workers start
        run_farm(self, overwrite=self.overwrite, video=None)
        self.finish()


@dataclass(frozen=True, kw_only=True)
class Farm:
    """Render or train by several workers, on GPUs, cores or Ray.

    The same command continues after an interruption, and keeps existing frames. Lost workers are replaced.
    Exit status: 0 all frames exist, 2 a mistake, 3 some frames failed, 130 interrupted.
    Guide: docs/guide/farm.md.
    First try: lumisplat farm orbit garden.ply --workers 2 --video orbit.mp4
    """

    what: Annotated[
        Annotated[FarmAnimate, subcommand("animate")]
        | Annotated[FarmOrbit, subcommand("orbit")]
        | Annotated[FarmRender, subcommand("render")]
        | Annotated[FarmDataset, subcommand("dataset")]
        | Annotated[FarmTrain, subcommand("train")],
        OmitArgPrefixes,
        OmitSubcommandPrefixes,
    ]
    """Choose what the workers make: animate, orbit, render, dataset or train."""
