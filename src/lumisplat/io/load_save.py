"""Reads and writes files by their formats: scenes, captures, meshes, cameras, images, rigs, animations and settings.

Tables say what reads and writes each extension. Functions are named, ``splats.spz.read_spz``, and their modules
imported when a format is first used. Headers tell whether a PLY is a capture, compressed or not, or a mesh.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeVar, cast

from lumisplat.errors import ConfigError, FormatError, SceneError
from lumisplat.io.files.source import BLOCKS, STREAMED_SOG, PathLike, format_of, readable, references_outside

if TYPE_CHECKING:
    import numpy.typing as npt

    from lumisplat.config import RenderConfig
    from lumisplat.io.ply import PlyHeader
    from lumisplat.io.splats.columns import SplatColumns
    from lumisplat.math.arrays import FloatArray
    from lumisplat.scene.animation.actors import Animation, GaussianSequence
    from lumisplat.scene.animation.camera_path import CameraPath
    from lumisplat.scene.animation.rig import Rig
    from lumisplat.scene.camera import Camera
    from lumisplat.scene.gaussians import Gaussians
    from lumisplat.scene.mesh import Mesh
    from lumisplat.scene.scene import Scene

    _Loaded = SplatColumns | Gaussians | Mesh | Scene


_Config = TypeVar("_Config")
Progress = Callable[[float], None]


class _LoadOptions(NamedTuple):
    """Options of `load` that some readers take."""

    drop_invalid: bool
    """Of glTF and OpenUSD files; `SplatColumns` are not checked yet."""
    crease_angle: float | None
    """Of OBJs."""
    up: str | npt.ArrayLike | None
    """Of scene files."""
    progress: Callable[[float], None] | None
    """Of PLYs."""
    incident: bool
    """Of PLYs."""
    lod: int | None
    """Of streamed SOGs and captures in blocks."""
    budget: int | None
    """Likewise: Gaussians."""


USD = (".usd", ".usda", ".usdc", ".usdz")
"""Extensions of OpenUSD."""

_READERS = {
    ".spz": "splats.spz.read_spz",
    ".splat": "splats.ksplat.read_splat",
    ".ksplat": "splats.ksplat.read_ksplat",
    ".sog": "splats.sog.read_sog",
    ".obj": "meshes.obj.read_obj",
    ".stl": "meshes.stl.read_stl",
    ".glb": "gltf.scene.read_gltf",
    ".gltf": "gltf.scene.read_gltf",
    **dict.fromkeys(USD, "usd.scene.read_usd"),
}
"""Besides these, .ply is read by its header, .toml by what it names, and streamed SOGs and blocks at a level."""

_LOD_READERS = {STREAMED_SOG: "splats.streamed_sog.read_streamed_sog", BLOCKS: "blocks.views.read_blocks"}
"""Readers of captures in levels of detail."""

_ANIMATION_READERS = {
    **dict.fromkeys((".glb", ".gltf"), "gltf.animation.read_gltf_animation"),
    **dict.fromkeys(USD, "usd.animation.read_usd_animation"),
}
"""Readers of animations, besides those of scene files."""

_LUMISPLAT = "lumisplat"

_PLY_WRITERS = {_LUMISPLAT: "splats.splat_ply.write_splat_ply", "r3dg": "splats.splat_ply.write_r3dg_ply"}
"""By whose columns they write."""

_WRITERS = {
    ".compressed.ply": "splats.compressed_ply.write_compressed_ply",
    ".ply": _PLY_WRITERS[_LUMISPLAT],
    ".spz": "splats.spz.write_spz",
    ".sog": "splats.sog.write_sog",
    "/meta.json": "splats.sog.write_sog",
    f"/{STREAMED_SOG}": "splats.streamed_sog.write_streamed_sog",
}
"""Writers of captures; the first one that a path ends with is used."""

_SCENE_WRITERS = {
    ".glb": "gltf.scene.write_gltf",
    ".gltf": "gltf.scene.write_gltf",
    **dict.fromkeys(USD, "usd.writing.write_usd"),
}
"""Writers of scenes with their cameras, to which captures and meshes are scenes, too."""

_READABLE = (
    ".ply, .compressed.ply, .spz, .splat, .ksplat, .sog, a SOG folder or its meta.json or lod-meta.json, a folder of "
    "blocks, .obj, .stl, .glb, .gltf, .usda, .usdc, .usdz, .usd, .toml"
)

_WRITABLE = (
    ".ply, .compressed.ply, .spz, .sog, .glb, .gltf, .usda, .usdc, .usdz, .usd, or, in a "
    "folder, meta.json (SOG) or lod-meta.json (SOG in levels of detail)"
)


def load(
    path: PathLike,
    *,
    drop_invalid: bool = False,
    crease_angle: float | None = None,
    allow_outside: bool = False,
    up: str | npt.ArrayLike | None = None,
    incident: bool = False,
    lod: int | None = None,
    budget: int | None = None,
    progress: Progress | None = None,
) -> Gaussians | Mesh | Scene:
    """Loads a capture, a mesh or a scene; extension and content select the reader.

    Args:
        path: A Gaussian capture (PLY, compressed PLY, SPZ, .splat, .ksplat, SOG bundle, SOG folder or its
            ``meta.json``, streamed SOG or its ``lod-meta.json``), a mesh (OBJ, STL, PLY with faces) or a scene (glTF,
            GLB, OpenUSD, a ``scene.toml`` that names other files).
        drop_invalid: Leave out Gaussians with NaN or infinite values or a rotation of zero length, and log their
            number, instead of refusing the file.
        crease_angle: Of OBJs without normals, also of those that a ``scene.toml`` names: faces that meet at less are
            shaded smoothly, radians, 0 to pi, see `smooth_normals`; 0: flat; None: 0.9, which is 51.6 degrees.
        allow_outside: Whether a file may name buffers, layers, materials and textures outside of its own folder, as
            files that you trust do. A ``scene.toml`` may always name any file.
        up: Of a ``scene.toml`` that does not say it, for what stands upright in it: an axis (``"y-down"``) or a
            direction; None: y down with a capture, y up for meshes alone. Other files are read as they are.
        incident: Whether to read the incident light of a .ply that has some (R3DG's ``incidents_*``): it is that of the
            photographs, and lights nothing here.
        lod: Of streamed SOGs, also of those in a ``scene.toml``: their level, 0 the finest; None: 0, or by ``budget``.
        budget: Of the same: the finest level of no more Gaussians than this; None: no limit.
        progress: Called with the fraction done, 0..1; the last call is with 1.

    Returns:
        ``Gaussians`` for a capture, with the materials of R3DG, GS-IR and our own files, 2D Gaussians as flat ones;
        ``Mesh`` for a mesh, or ``Scene`` if it has several materials; ``Scene`` for scenes. Arrays are read-only.
        Captures have the axes of the usual Gaussian PLY (SPZ is mirrored), meshes have the axes of their files.

    Raises:
        FormatError: The file is unknown, damaged or truncated, holds no Gaussians or invalid values, or needs more
            memory than there is. The message names it.
        SceneError: ``up`` is no direction.
        MissingFileError: There is no such file: a `FormatError` that is a FileNotFoundError, too.
        MissingExtraError: OpenUSD needs usd-core.
    """
    from lumisplat.io.splats.columns import SplatColumns, gaussians_from_columns

    with readable(path):
        with references_outside(allow_outside):
            options = _LoadOptions(drop_invalid, crease_angle, up, progress, incident, lod, budget)
            load_asset = partial(load, drop_invalid=drop_invalid, crease_angle=crease_angle, lod=lod, budget=budget)
            loaded = _read(Path(path), load_asset, options)
        if isinstance(loaded, SplatColumns):
            loaded = gaussians_from_columns(path, loaded, drop_invalid=drop_invalid)
    if progress:
        progress(1.0)
    return loaded


def save(
    path: PathLike,
    asset: Gaussians | Mesh | Scene | Animation,
    *,
    cameras: Sequence[Camera] = (),
    columns: Literal["lumisplat", "r3dg"] = "lumisplat",
) -> None:
    """Saves a capture, or a scene; the extension selects the format. The file appears complete or not at all.

    The lossy formats clamp values that they cannot store. SPZ: scales to e^-10..e^5.94 (4.5e-5 to 379 scene units; the
    thin axis of Gaussians from a mesh may be smaller, which is logged), SH above degree 0 to -1..1. Compressed PLY:
    scales to e^-20..e^20, SH above degree 0 to -4..4; a Gaussian far from the others makes the positions of its whole
    chunk coarse, which is logged if it is visible. SOG: nothing is clamped, but numbers share 256 values.

    glTF holds scenes: captures (KHR_gaussian_splatting, exact), meshes with materials and textures, punctual lights,
    cameras. Its files are y up: captures are turned by half a turn about x, as in SPZ, and what stands upright in the
    scene stands upright there. What glTF cannot hold is logged in one line, such as area lamps and environments.

    OpenUSD (``pip install 'lumisplat[usd]'``) holds the same, and area lights, environments and what moves: captures as
    ParticleField3DGaussianSplat, exact, materials as UsdPreviewSurface, UsdLux lights, cameras, time samples.

    Args:
        path: Of captures ``.ply`` (lossless), ``.compressed.ply`` (16 bytes per Gaussian and 9, 24 or 45 for SH;
            changes the order), ``.spz`` (version 4), ``.sog`` (version 2; changes the order; the harmonics of all
            Gaussians become a palette), or ``meta.json``, which writes the files of a SOG beside it. Of all that there
            is ``.glb`` (lossless, 60 bytes per Gaussian without view-dependent colours), or ``.gltf``, the same as
            text; or ``.usda`` (text), ``.usdc``, ``.usd`` or ``.usdz`` (a package with its textures; those of the
            others are in a folder beside them).
        asset: The capture, mesh, scene or, for OpenUSD, animation. Only ``.ply``, glTF and OpenUSD store normals and
            materials of Gaussians, and ``.spz`` and ``.sog`` do not store the kernel degree; values that are left out
            are logged.
        cameras: Cameras of the scene, which glTF and OpenUSD hold, too.
        columns: Of a ``.ply``: ours, or those of Relightable 3D Gaussians (``"r3dg"``), for their programs: SH of
            degree 3, albedo within 0.03..0.8, roughness 0.09..0.99, no metals; what that changes is logged.

    Raises:
        ConfigError: ``columns`` is neither, or R3DG's are asked for of another format.
        FormatError: The extension is unknown, the format cannot store a value, the file cannot be written, or R3DG's
            columns are asked for of a capture without materials.
        MissingExtraError: OpenUSD needs usd-core.
    """
    from lumisplat.scene.animation.actors import Animation
    from lumisplat.scene.gaussians import Gaussians
    from lumisplat.scene.mesh import Mesh
    from lumisplat.scene.scene import Scene

    _check_path_first("save(path, asset)", path)
    if not isinstance(cast("object", asset), Gaussians | Mesh | Scene | Animation):
        raise FormatError(
            path, f"only Gaussians, meshes, scenes and animations can be saved, got {type(asset).__name__}"
        )
    if isinstance(asset, Animation) and Path(path).suffix.lower() not in USD:
        raise FormatError(path, f"cannot hold what moves: animations can be saved as {', '.join(USD)}")
    writer = _writer_of(path, scene=bool(cameras) or not isinstance(asset, Gaussians))
    if columns not in _PLY_WRITERS:
        raise ConfigError(f"columns is {columns!r}, expected {' or '.join(map(repr, _PLY_WRITERS))}")
    if columns != _LUMISPLAT:
        if writer != _PLY_WRITERS[_LUMISPLAT]:
            raise ConfigError(f"columns {columns!r} are those of a .ply, got {os.fspath(path)}")
        writer = _PLY_WRITERS[columns]
    if writer not in _SCENE_WRITERS.values():
        _import(writer)(path, asset)
        return
    if isinstance(asset, Gaussians | Mesh):
        asset = Scene(splats=[asset]) if isinstance(asset, Gaussians) else Scene(meshes=[asset])
    _import(writer)(path, asset, cameras)


def check_format(path: PathLike, *, scene: bool = False) -> None:
    """Refuses the name of a file that `save` could not write, before there is anything to save.

    Args:
        path: The file; its extension counts.
        scene: Whether it shall hold a mesh or a scene; else Gaussians.

    Raises:
        FormatError: The extension is unknown, or the format cannot hold that.
    """
    _writer_of(path, scene=scene)


def load_cameras(path: PathLike, *, width: int | None = None, height: int | None = None) -> list[Camera]:
    """Loads the cameras of a capture or a scene, in the file's order; each has a unique ``name``, that of its image.

    Args:
        path: ``transforms.json`` (OpenGL camera-to-world; intrinsics of the file or of each frame, in pixels or as
            ``camera_angle_x``; image sizes are read from the images if the file has none; pinhole, equidistant fisheye
            and orthophoto, with lens distortion), INRIA's ``cameras.json`` (OpenCV; the principal point is the
            centre), nerfstudio's ``camera_path.json``, or a COLMAP sparse model: its folder, or one of its
            ``cameras`` and ``images``, .bin or .txt; or a folder that holds one of these. Or a glTF scene (.glb,
            .gltf), whose cameras only have an aspect ratio: without ``width`` and ``height`` they get the largest size
            within 1280 x 720; or an OpenUSD stage (.usda, .usdc, .usdz, .usd), whose sizes may be those of pictures
            that it orders. Or a ``scene.toml``.
        width: Image width, pixels, of frames for which neither the file nor an image gives a size; only together with
            ``height``, except for glTF and OpenUSD.
        height: Image height, pixels, of such frames.

    Returns:
        At least one camera; for a scene file, there may be none.

    Raises:
        FormatError: The file is not a camera file, has no frames, or has a frame whose pose or intrinsics are invalid;
            names the frame.
        MissingFileError: There is no such file: a `FormatError` that is a FileNotFoundError, too.
    """
    from lumisplat.io.cameras.colmap import is_colmap, read_colmap
    from lumisplat.io.cameras.common import unique_names
    from lumisplat.io.cameras.json_cameras import read_camera_json

    path = _in_folder(Path(path))
    suffix = path.suffix.lower()
    if suffix in (".glb", ".gltf"):
        from lumisplat.io.gltf.cameras import read_gltf_cameras

        return unique_names(read_gltf_cameras(path, width, height))
    if suffix in USD:
        from lumisplat.io.usd.cameras import read_usd_cameras

        return unique_names(read_usd_cameras(path, width, height))
    if suffix == ".toml":
        from lumisplat.io.scene_toml.cameras import read_scene_cameras
        from lumisplat.io.scene_toml.scene_file import read_document

        return read_scene_cameras(read_document(path), load_cameras, width, height)
    if is_colmap(path):
        return unique_names(read_colmap(path))
    return read_camera_json(path, width, height)


def load_camera_path(path: PathLike, *, width: int | None = None, height: int | None = None) -> CameraPath:
    """Loads cameras as the way of a camera that moves through them.

    Args:
        path: nerfstudio's ``camera_path.json``, whose frames are at its own rate; a ``scene.toml``, of which the first
            camera with keyframes moves as they say; or any other file that `load_cameras` reads, with a second from
            each of its cameras to the next.
        width: As of `load_cameras`.
        height: As of `load_cameras`.

    Raises:
        FormatError: The file cannot be read, has no cameras, or has cameras of different sizes or models.
        MissingFileError: There is no such file: a `FormatError` that is a FileNotFoundError, too.
    """
    from lumisplat.io.cameras.json_cameras import read_path_rate
    from lumisplat.scene.animation.camera_path import CameraPath

    suffix, rate = Path(path).suffix.lower(), None
    if suffix == ".toml":
        from lumisplat.io.scene_toml.cameras import read_camera_path
        from lumisplat.io.scene_toml.scene_file import read_document

        moving = read_camera_path(read_document(path))
        if moving is not None:
            return moving
    elif suffix == ".json":
        rate = read_path_rate(path)
    cameras = load_cameras(path, width=width, height=height)
    if not cameras:
        raise FormatError(path, "has no cameras")
    try:
        return CameraPath(cameras, None if rate is None else [k / rate for k in range(len(cameras))])
    except SceneError as error:
        raise FormatError(path, str(error)) from None


def load_config(path: PathLike) -> RenderConfig:
    """Loads the settings of a ``scene.toml`` from its ``[render]`` table; other settings have their defaults.

    Args:
        path: A scene file, or a file from `save_config`.

    Raises:
        FormatError: The file cannot be read, or a setting is unknown or invalid; names the line and the setting.
        MissingFileError: There is no such file: a `FormatError` that is a FileNotFoundError, too.
    """
    from lumisplat.io.scene_toml.config_file import read_config
    from lumisplat.io.scene_toml.scene_file import read_document

    return read_config(read_document(path))


def change_config(config: _Config, name: str, value: str) -> _Config:
    """Returns settings with one of them changed, which is named and written as in a scene file.

    Args:
        config: A `RenderConfig`, or other settings with groups below them.
        name: The setting's key in the table of a scene file, behind those of its groups: ``trace.hits_per_pass``.
        value: Its value in TOML; the quotation marks of a string may be left out: ``8``, ``peak``, ``off``.

    Raises:
        ConfigError: There is no such setting, or its value is of the wrong type or out of range.
    """
    from lumisplat.io.scene_toml.config_file import changed_setting

    return changed_setting(config, name, value)


def save_config(path: PathLike, config: RenderConfig) -> None:
    """Saves all settings as the ``[render]`` table of a TOML file, which appears complete or not at all.

    Args:
        path: The file to write; `load_config` reads it back to equal settings.
        config: The settings.

    Raises:
        ConfigError: ``config`` is not a `RenderConfig`.
        FormatError: The file cannot be written.
    """
    from lumisplat.io.scene_toml.config_file import write_config

    write_config(path, config)


def load_image(path: PathLike) -> FloatArray:
    """Loads a picture in display colours, such as one to compare by `psnr`, `ssim` or `flip`.

    Args:
        path: PNG, JPEG, WebP or another format that Pillow reads, in sRGB; transparent pixels are blended over black.
            Or OpenEXR or Radiance HDR, whose linear light is encoded as sRGB and clipped at white.

    Returns:
        Display-referred sRGB, 0..1, shape (H, W, 3), row 0 at the top.

    Raises:
        FormatError: The file is damaged, or not a picture.
        MissingFileError: There is no such file: a `FormatError` that is a FileNotFoundError, too.
    """
    from lumisplat.io.images.radiance import read_display_image

    return read_display_image(path)


def load_radiance(path: PathLike) -> FloatArray:
    """Loads an image of radiance, such as a latitude-longitude environment for a `LightEnvironment`.

    Args:
        path: Radiance HDR (``.hdr``, ``.pic``: RGBE, any of its encodings) or OpenEXR (channels R, G and B, half or
            float; of a file with several parts, the first). The format is recognised by the content.

    Returns:
        Linear Rec.709, finite and at least 0, shape (H, W, 3), row 0 at the top, read-only. Negative and non-finite
        values become 0, and one log line counts them.

    Raises:
        FormatError: The file is damaged or truncated, or holds 8-bit display colours.
        MissingFileError: There is no such file: a `FormatError` that is a FileNotFoundError, too.
    """
    from lumisplat.io.images.radiance import read_radiance

    return read_radiance(path)


def load_rig(path: PathLike, *, vertex_colors: bool = True, allow_outside: bool = False) -> Rig:
    """Loads a rigged glTF: its meshes, the joints that move them, and its animations.

    Translation, rotation, scale and weights of morph targets are animated, linearly, in steps or by cubic splines;
    meshes that are moved by their node alone are included. Meshes with the same material become one.

    Args:
        path: A ``.glb`` or ``.gltf`` file.
        vertex_colors: Multiply the base colour by COLOR_0, as the format demands. False for files that store something
            else there, such as masks, which would make meshes nearly black (a log line warns).
        allow_outside: As in `load`.

    Raises:
        FormatError: The file is malformed, has neither a skin nor an animation, is skinned without weights or with
            weights that sum to 0, or has keys that are not finite or not in order.
        MissingFileError: There is no such file: a `FormatError` that is a FileNotFoundError, too.
    """
    from lumisplat.io.gltf.animation import read_rig

    with references_outside(allow_outside):
        return read_rig(path, vertex_colors)


def load_sequence(folder: PathLike, fps: float, *, drop_invalid: bool = False) -> GaussianSequence:
    """Finds the frames of a Gaussian sequence; each is loaded when it is shown.

    Args:
        folder: A folder with one capture per frame, all with the same extension (.ply, .compressed.ply, .spz, .sog),
            in the natural order of their names: ``frame_2`` before ``frame_10``. Other files are ignored.
        fps: Frames per second, above 0.
        drop_invalid: As in `load`, for each frame.

    Raises:
        FormatError: The folder holds no frame or frames of two kinds, or the first frame cannot be read.
        SceneError: ``fps`` is out of range.
        MissingFileError: There is no such folder: a `FormatError` that is a FileNotFoundError, too.
    """
    from lumisplat.io.splats.sequence import read_sequence

    return read_sequence(folder, fps, partial(load, drop_invalid=drop_invalid))


def load_animation(
    path: PathLike, *, drop_invalid: bool = False, crease_angle: float | None = None, allow_outside: bool = False
) -> Animation:
    """Loads an animated ``scene.toml``: its scene, cameras, ``[[actors]]`` and ``[animation]``; or an OpenUSD or glTF.

    Args:
        path: The scene file. Or ``.glb`` or ``.gltf``, of which the first animation is played: nodes, skins and morph
            targets, at 25 frames a second; or ``.usda``, ``.usdc``, ``.usdz`` or ``.usd``, of which what moves without
            deforming becomes an actor with keyframes. The first camera that moves becomes a path.
        drop_invalid: As in `load`, for each capture.
        crease_angle: As in `load`, for each OBJ.
        allow_outside: As in `load`, for each mesh and rig.

    Raises:
        FormatError: The file, or a file that it names, cannot be read, or an entry is invalid; names the line and the
            key.
        MissingFileError: There is no such file: a `FormatError` that is a FileNotFoundError, too.
        MissingExtraError: OpenUSD needs usd-core.
    """
    with references_outside(allow_outside):
        load_asset = partial(load, drop_invalid=drop_invalid, crease_angle=crease_angle)
        reader = _ANIMATION_READERS.get(Path(path).suffix.lower())
        if reader is not None:
            return _import(reader)(Path(path), drop_invalid)
        return _import("scene_toml.scene_file.read_animation")(Path(path), load_asset, load_cameras)


def save_cameras(path: PathLike, cameras: Sequence[Camera]) -> None:
    """Saves cameras as a `transforms.json` that `load_cameras` and nerfstudio read.

    Args:
        path: The file to write. It appears complete or not at all.
        cameras: At least one camera, all of one model; names become the frames' file paths.

    Raises:
        ConfigError: ``path`` is no path.
        SceneError: There is no camera, models differ, or a camera has an aperture or a rolling shutter, which the
            format cannot store.
        FormatError: The file cannot be written.
    """
    from lumisplat.io.cameras.json_cameras import write_transforms

    _check_path_first("save_cameras(path, cameras)", path)
    write_transforms(path, cameras)


def save_animation(path: PathLike, frames: Iterable[npt.ArrayLike], fps: float = 25.0) -> None:
    """Saves pictures as an animation; the extension selects the format. All but videos repeat for ever.

    ``.gif``: 256 colours for all frames, dithered by a fixed pattern, so that static parts do not flicker. ``.webp``:
    lossy, small. ``.png``, ``.apng``: lossless, large. ``.mp4``: H.264 in BT.709, by PyAV (``pip install
    'lumisplat[video]'``); an odd width or height is made even by repeating the last column or row.

    Args:
        path: The file to write. It appears complete or not at all.
        frames: Display-referred values, 0..1, each of the same shape (H, W, 3), as ``Frame.pixels_srgb`` gives them
            over a background.
        fps: Frames per second, above 0, at most 50, or 240 for a video.

    Raises:
        ConfigError: ``fps`` is out of range.
        SceneError: There is no frame, a frame has the wrong shape, or sizes differ.
        FormatError: The extension is unknown, or the file cannot be written.
        MissingExtraError: A video needs PyAV.
    """
    from lumisplat.io.images.video import write_animation

    write_animation(path, frames, fps)


def _read(path: Path, load: Callable[..., Gaussians | Mesh | Scene], options: _LoadOptions) -> _Loaded:
    """What is in a file; ``load`` reads the files that a scene file names."""
    extension = format_of(path)
    if extension == ".ply":
        return _read_ply(path, options.progress, incident=options.incident)
    if extension == ".toml":
        return _import("scene_toml.scene_file.read_scene_file")(path, load, options.up)
    if extension in _LOD_READERS:
        return _import(_LOD_READERS[extension])(path, options.lod, options.budget)
    if extension not in _READERS:
        raise FormatError(path, f"unknown extension {path.suffix!r}, expected {_READABLE}")
    reader: Callable[..., _Loaded] = _import(_READERS[extension])
    if extension in (".glb", ".gltf", *USD):
        return reader(path, drop_invalid=options.drop_invalid)
    if extension == ".obj" and options.crease_angle is not None:
        return reader(path, options.crease_angle)
    return reader(path)


def _writer_of(path: PathLike, *, scene: bool) -> str:
    """The function that writes a file, by its extension; arguments as of `check_format`."""
    name = f"/{Path(path).name.lower()}"
    if writer := next((_SCENE_WRITERS[end] for end in _SCENE_WRITERS if name.endswith(end)), None):
        return writer
    writer = next((_WRITERS[end] for end in _WRITERS if name.endswith(end)), None)
    if writer is None:
        expected = ", ".join(_SCENE_WRITERS) if scene else _WRITABLE
        raise FormatError(path, f"unknown extension {Path(path).suffix!r}, expected {expected}")
    if scene:
        raise FormatError(path, f"holds Gaussians alone: scenes and meshes can be saved as {', '.join(_SCENE_WRITERS)}")
    return writer


def _import(function: str) -> Any:
    """A function of this package, imported on first use."""
    module, _, name = function.rpartition(".")
    return getattr(import_module(f"{__package__}.{module}"), name)


def _read_ply(path: Path, progress: Callable[[float], None] | None, *, incident: bool) -> SplatColumns | Mesh:
    """Reads a capture or a mesh; ``progress`` and ``incident`` as of `load`."""
    from lumisplat.io.ply import read_ply_header
    from lumisplat.io.splats.compressed_ply import is_compressed_header, read_compressed_ply
    from lumisplat.io.splats.splat_ply import read_splat_ply

    header = read_ply_header(path)
    if is_compressed_header(header):
        return read_compressed_ply(header)
    if _has_faces(header):
        from lumisplat.io.meshes.mesh_ply import read_ply_mesh

        return read_ply_mesh(header)
    return read_splat_ply(header, progress, incident=incident)


def holds_mesh(path: Path) -> bool:
    """Whether a file is a mesh, not a capture; False if it cannot be read.

    Args:
        path: A ``.ply`` file.
    """
    from lumisplat.io.ply import read_ply_header
    from lumisplat.io.splats.compressed_ply import is_compressed_header

    try:
        header = read_ply_header(path)
    except (OSError, FormatError):
        return False
    return not is_compressed_header(header) and _has_faces(header)


def _has_faces(header: PlyHeader) -> bool:
    """Whether there are faces or triangle strips, and no Gaussians."""
    from lumisplat.io.splats.splat_ply import is_gaussian_element

    vertex, surfaces = header.element("vertex"), map(header.element, ("face", "tristrips"))
    return any(one and one.count for one in surfaces) and not (vertex and is_gaussian_element(vertex))


def _in_folder(path: Path) -> Path:
    """Returns the camera file that a folder of images holds; the path itself if it is a file, or holds none."""
    if not os.path.isdir(path):  # False, also of names that are too long
        return path
    from lumisplat.io.training_images.loading import find_model

    file = next((file for file in (path / "transforms.json", path / "cameras.json") if file.is_file()), None)
    return file or find_model(path) or path


def _check_path_first(call: str, path: object) -> None:
    """Refuses the arguments of a function that saves if they are swapped."""
    if not isinstance(path, str | os.PathLike):
        raise ConfigError(f"{call}: the path comes first, got {type(path).__name__}")
