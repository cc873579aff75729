"""Options that have another name: one line says which."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

_SETTINGS = {
    "--acceptance-scale": ("trace.acceptance_scale",),
    "--adaptive": ("adaptive",),
    "--antialiasing": ("raster.antialiasing", "trace.antialiasing"),
    "--crease-angle": ("meshes.crease_angle_degrees",),
    "--depth-iso": ("raster.depth_iso_transmittance", "trace.depth_iso_transmittance"),
    "--direct": ("animation.lighting.direct",),
    "--gamma": ("animation.lighting.transfer.gamma",),
    "--glossy-reflections": ("glossy_reflections=true",),
    "--hit-distance": ("trace.hit_distance", "shadow_rays.hit_distance"),
    "--hits-per-pass": ("trace.hits_per_pass",),
    "--kernel-degree": ("response.kernel_degree",),
    "--max-bounces": ("max_bounces",),
    "--min-response": ("response.min_response",),
    "--no-adaptive-clamping": ("response.adaptive_clamping=false",),
    "--no-glossy-reflections": ("glossy_reflections=false",),
    "--no-jitter": ("jitter=false",),
    "--no-relight": ("animation.lighting.relight=false",),
    "--no-shadows": ("animation.lighting.shadows=false",),
    "--no-sun-on-actors": ("animation.lighting.sun_on_actors=false",),
    "--noise": ("noise",),
    "--normals": ("trace.normal_method",),
    "--primary": ("path.primary",),
    "--projection": ("raster.projection",),
    "--quality": ("realtime.quality",),
    "--raster-strategy": ("raster.strategy",),
    "--seed": ("seed",),
    "--sh-degree": ("raster.sh_degree", "trace.sh_degree"),
    "--shadow-color": ("shadow_rays.color_strength",),
    "--shadow-hits": ("shadow_rays.hits",),
    "--shadow-method": ("shadow_rays.method",),
    "--shadow-offset": ("shadow_rays.offset",),
    "--shadow-offset-absolute": ("shadow_rays.offset_absolute",),
    "--shadow-threshold": ("shadow_rays.transmittance_threshold",),
    "--strategy": ("trace.strategy",),
    "--time": ("time_limit",),
    "--transmittance-min": ("raster.transmittance_min", "trace.transmittance_min", "shadow_rays.transmittance_min"),
}
"""Option -> the settings that it gave."""

_OPTIONS = {
    "--cryptomatte": "--aov cryptomatte",
    "--deep": "--aov deep",
    "--frame": "--frames {}",
    "--lod-budget": "--lod budget={}",
    "--lod-pixels": "--lod pixels={}",
    "--path": "--camera-path {}",
    "--split-samples": "--tiles samples",
    "--warm-up": "--samples {}",
}
"""Option -> what is typed in its place."""


def moved_option(args: Sequence[str], options: Iterable[str]) -> str | None:
    """Returns the line about the first option that has another name; None: there is none.

    Args:
        args: What follows the name of a command.
        options: The options that the command has.
    """
    known = {*options}
    for index, typed in enumerate(args):
        option, _, value = typed.replace("_", "-").partition("=")
        given = typed.partition("=")[2] if value else "".join(args[index + 1 : index + 2])
        value = "VALUE" if not given or given.startswith("--") else given
        if option in known:
            continue
        if option in _SETTINGS and "--set" in known:
            texts = (name if "=" in name else f"{name}={value}" for name in _SETTINGS[option])
            return f"{option} is a setting: {' '.join(f'--set {text}' for text in texts)}"
        if option in _OPTIONS and _OPTIONS[option].split()[0] in known:
            return f"{option} is now {_OPTIONS[option].format(value)}"
    return None
