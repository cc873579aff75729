"""Reading and writing files: scenes, captures, meshes, cameras, images, rigs, animations and settings.

`formats` has the tables of formats, whose modules are imported when they are first used.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeVar

from lumisplat.io import formats
from lumisplat.io.files.source import PathLike, readable, references_outside

if TYPE_CHECKING:
    import numpy.typing as npt

    from lumisplat.config import RenderConfig
    from lumisplat.math.arrays import FloatArray
    from lumisplat.scene.animation.actors import Animation
    from lumisplat.scene.animation.camera_path import CameraPath
    from lumisplat.scene.animation.rig import Rig
    from lumisplat.scene.animation.sequence import GaussianSequence
    from lumisplat.scene.camera import Camera
    from lumisplat.scene.gaussians import Gaussians
    from lumisplat.scene.mesh import Mesh
    from lumisplat.scene.scene import Scene

__all__ = [
    "change_config",
    "check_format",
    "load",
    "load_animation",
    "load_camera_path",
    "load_cameras",
    "load_config",
    "load_image",
    "load_radiance",
    "load_rig",
    "load_sequence",
    "save",
    "save_animation",
    "save_cameras",
    "save_config",
]

_Config = TypeVar("_Config")
Progress = Callable[[float], None]


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
            options = formats.LoadOptions(drop_invalid, crease_angle, up, progress, incident, lod, budget)
            load_asset = partial(load, drop_invalid=drop_invalid, crease_angle=crease_angle, lod=lod, budget=budget)
            loaded = formats.read(Path(path), load_asset, options)
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
    formats.write(path, asset, cameras, columns)


def check_format(path: PathLike, *, scene: bool = False) -> None:
    """Refuses the name of a file that `save` could not write, before there is anything to save.

    Args:
        path: The file; its extension counts.
        scene: Whether it shall hold a mesh or a scene; else Gaussians.

    Raises:
        FormatError: The extension is unknown, or the format cannot hold that.
    """
    formats.check_written(path, scene=scene)


def load_cameras(path: PathLike, *, width: int | None = None, height: int | None = None) -> list[Camera]:
    """Loads the cameras of a capture or a scene, in the file's order; each has a unique ``name``, that of its image.

    Args:
        path: ``transforms.json`` (OpenGL camera-to-world; intrinsics of the file or of each frame, in pixels or as
            ``camera_angle_x``; image sizes are read from the images if the file has none; pinhole, equidistant fisheye
            and orthophoto, with lens distortion), INRIA's ``cameras.json`` (OpenCV; the principal point is the
            centre), nerfstudio's ``camera_path.json``, or a sparse model of COLMAP: its folder, or one of its
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
    from lumisplat.io.load_save import read_cameras

    return read_cameras(path, width, height)


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
    from lumisplat.io.load_save import read_camera_way

    return read_camera_way(path, width, height)


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
    from lumisplat.io.images.radiance import read_picture

    return read_picture(path)


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
        return formats.read_animation(Path(path), load_asset, load_cameras, drop_invalid=drop_invalid)


def save_cameras(path: PathLike, cameras: Sequence[Camera]) -> None:
    """Saves cameras as a `transforms.json` that `load_cameras` and nerfstudio read.

    Args:
        path: The file to write. It appears complete or not at all.
        cameras: At least one camera, all of one model; names become the frames' file paths.

    Raises:
        SceneError: There is no camera, models differ, or a camera has an aperture or a rolling shutter, which the
            format cannot store.
        FormatError: The file cannot be written.
    """
    from lumisplat.io.cameras.json_cameras import write_transforms

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
