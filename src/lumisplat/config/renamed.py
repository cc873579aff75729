"""Settings that were renamed or moved since 0.1: the old names are refused with the new ones, until 1.0."""

from __future__ import annotations

import functools
from typing import Any, TypeVar

from lumisplat.errors import ConfigError

_Settings = TypeVar("_Settings")

RENAMED: dict[str, dict[str, str]] = {
    "RenderConfig": {"shadow": "RenderConfig.shadow_rays"},
    "TraceConfig": {
        "jitter": "RenderConfig.jitter",
        "kernel_degree": "RenderConfig.response.kernel_degree",
        "min_response": "RenderConfig.response.min_response",
        "adaptive_clamping": "RenderConfig.response.adaptive_clamping",
    },
    "AvatarLightingConfig": {"shadow": "AvatarLightingConfig.shadow_map"},
    "SplatInstance": {"shadow_only": "SplatInstance.shadow_catcher"},
}
"""Class -> old field -> where the setting is now, as a path from the settings of a frame, of avatars or an instance."""


_RENAMED_KEYS = {"shadow_only": "shadow_catcher"}
"""Old key of files -> its name now."""


def with_present_keys(values: dict[str, Any]) -> dict[str, Any]:
    """Returns the values that a file gives, those under old keys by their present names."""
    return {_RENAMED_KEYS.get(key, key): value for key, value in values.items()}


def refuse_renamed(kind: type[_Settings]) -> type[_Settings]:
    """Class decorator, above ``@dataclass``: old names raise ConfigError instead of dataclass's TypeError."""
    renamed = RENAMED[kind.__name__]
    initialise = kind.__init__

    @functools.wraps(initialise)
    def checked(self: _Settings, *values: object, **settings: object) -> None:
        for name in settings:
            if name in renamed:
                raise ConfigError(f"{kind.__name__}.{name} is now {renamed[name]}")
        initialise(self, *values, **settings)

    type.__setattr__(kind, "__init__", checked)
    return kind
