"""Settings of data sets in TOML: keys are the names of settings, groups are tables.

views = 1000
layers = ["depth", "instance"]

[poses]
where = "inside"

[objects]
files = ["chair.glb"]                   # relative to the settings file
"""

from __future__ import annotations

import os
from dataclasses import replace

from lumisplat.config.dataset import DatasetConfig
from lumisplat.io.files.source import PathLike
from lumisplat.io.scene_toml.config_file import read_settings
from lumisplat.io.scene_toml.toml_table import TomlTable


def load_dataset_config(path: PathLike) -> DatasetConfig:
    """Loads the settings of a data set.

    Args:
        path: A TOML file, whose keys are the settings of `DatasetConfig`, with tables ``[poses]``, ``[lights]`` and
            ``[objects]``; what it does not name has its default. Paths in it begin at its folder.

    Raises:
        FormatError: The file cannot be read, has an unknown or invalid setting, or names a file that is not there.
    """
    document = TomlTable.read(path, "settings of a data set")
    config = read_settings(document, DatasetConfig)
    lights, objects = config.lights, config.objects
    return replace(
        config,
        lights=replace(lights, environments=_files(document.table("lights"), "environments", lights.environments)),
        objects=replace(objects, files=_files(document.table("objects"), "files", objects.files)),
    )


def _files(table: TomlTable, key: str, names: tuple[str, ...]) -> tuple[str, ...]:
    """Paths from the folder of the settings file.

    Raises:
        FormatError: One of them is not there.
    """
    paths = [table.path.parent / name for name in names]
    for name, path in zip(names, paths, strict=True):
        if not path.exists():
            raise table.error(f"{key} has {name!r}, no such file", key)
    return tuple(map(os.fspath, paths))
