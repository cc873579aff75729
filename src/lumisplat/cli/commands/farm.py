"""``lumisplat farm``: the frames of animate, orbit, render and dataset, and trainings, made by workers."""

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
from lumisplat.cli.options.command import Flag


@dataclass(frozen=True, kw_only=True)
class FarmAnimate(Animate):
    """Render an animated scene by workers.

    lumisplat farm animate scene.toml --workers 2 -o frames --video walk.mp4
    """

    farm: FarmGroup = field(default_factory=FarmOptions)
    """Frames are the same to the bit as those of one process."""

    def run(self) -> None:
        """Renders the frames that are missing, then the video."""
        run_farm(self, overwrite=self.overwrite, video=self.video)


@dataclass(frozen=True, kw_only=True)
class FarmOrbit(Orbit):
    """Go once round a scene, by workers.

    lumisplat farm orbit garden.ply --workers 2 --video orbit.mp4
    """

    farm: FarmGroup = field(default_factory=FarmOptions)
    """Frames are the same to the bit as those of one process."""

    def run(self) -> None:
        """Renders the frames that are missing, then the video."""
        run_farm(self, overwrite=self.overwrite, video=self.video)


@dataclass(frozen=True, kw_only=True)
class FarmRender(Render):
    """Render a picture for each camera, by workers. Pictures that are there stay, as with --resume.

    lumisplat farm render garden.ply --cameras transforms.json --workers 2 -o out
    """

    overwrite: Flag = False
    """Render images that are there anew."""
    farm: FarmGroup = field(default_factory=FarmOptions)
    """Pictures are the same to the bit as those of one process."""

    def run(self) -> None:
        """Renders the pictures that are missing."""
        run_farm(self, overwrite=self.overwrite, video=None)


@dataclass(frozen=True, kw_only=True)
class FarmDataset(Dataset):
    """Make training data by workers.

    lumisplat farm dataset scene.toml --workers 2 --views 1000 -o set
    """

    farm: FarmGroup = field(default_factory=FarmOptions)
    """Files are the same to the bit as those of one process."""

    def run(self) -> None:
        """Renders the views that are missing, then what follows from all of them."""
        self.settings()  # its mistakes are found before workers start
        run_farm(self, overwrite=self.overwrite, video=None)
        self.finish()


@dataclass(frozen=True, kw_only=True)
class Farm:
    """Render frames or train by several workers: GPUs, CPU cores or a Ray cluster.

    After an interruption, the same command continues: frames that are there stay. Workers that die are replaced.
    Exit status: 0: all frames are there. 2: a mistake. 3: some frames could not be made. 130: interrupted.
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
    """What is made."""
