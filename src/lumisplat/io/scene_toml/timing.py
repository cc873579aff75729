"""The ``[animation]`` table of a scene file, as far as it can be checked without its actors."""

from __future__ import annotations

import numpy as np

from lumisplat.config import AvatarLightingConfig
from lumisplat.io.scene_toml.config_file import read_settings
from lumisplat.io.scene_toml.toml_table import NUMBER, TABLE, WHOLE, TomlTable

ANIMATION_KEYS = {"fps": NUMBER, "duration": NUMBER, "frames": WHOLE, "lighting": TABLE}
_FPS = 25.0


def read_timing(document: TomlTable) -> tuple[float, AvatarLightingConfig]:
    """Frames a second of a scene file's animation, and how its actors are lit; defaults if it has no such table.

    Raises:
        FormatError: A key of ``[animation]`` is unknown, or a value is invalid.
    """
    table = document.table("animation")
    given = table.take(ANIMATION_KEYS)
    lighting = read_settings(table.table("lighting"), AvatarLightingConfig)
    fps = given.get("fps", _FPS)
    if not 0.0 < fps < np.inf:
        raise table.wrong("fps", "a positive number of frames a second")
    if "duration" in given and "frames" in given:
        raise table.error("has both duration and frames: expected one of them", "frames")
    if not 0.0 < given.get("duration", 1.0) < np.inf:
        raise table.wrong("duration", "a positive number of seconds")
    if given.get("frames", 1) < 1:
        raise table.wrong("frames", "at least 1")
    return fps, lighting
