"""Reads and writes files of all formats: scenes, captures, meshes, cameras, images, rigs, animations and settings.

Tables map each extension to its reader and writer by name, such as ``splats.spz.read_spz``. The module of a format is
imported when the format is first used. The header of a PLY file shows whether it is a capture, a compressed capture or
a mesh.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
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
    from lumisplat.math.arrays import FloatArray, IntArray
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
    """Options of `load` that apply to some formats only; the readers of other formats ignore them."""

    drop_invalid: bool
    """Whether the glTF and OpenUSD readers drop Gaussians with NaN or infinite values instead of refusing the file.
    For other formats, `load` applies the option itself after reading.
    """
    crease_angle: float | None
    """Angle in radians below which faces of an OBJ without normals are shaded smoothly; None: 0.9, `CREASE_ANGLE`."""
    up: str | npt.ArrayLike | None
    """Up direction for a ``scene.toml`` that states none: an axis (``"y-down"``) or a vector; None: see `load`."""
    progress: Callable[[float], None] | None
    """Called by the PLY reader with the fraction read, 0..1; None reports nothing."""
    incident: bool
    """Whether to read the SH of incident light that R3DG stores in a PLY for each Gaussian (``incidents_*``)."""
    lod: int | None
    """Level of detail to load from a streamed SOG or a capture in blocks; 0 is the finest. None selects the level by
    ``budget``, or 0 without a budget."""
    budget: int | None
    """Largest number of Gaussians to load from a streamed SOG or a capture in blocks: the finest level within this
    limit is loaded. None has no limit."""


USD = (".usd", ".usda", ".usdc", ".usdz")
"""File extensions of OpenUSD."""

_READERS = {
    ".spz": "splats.spz.read_spz",
    ".splat": "splats.ksplat.read_splat",
    ".ksplat": "splats.ksplat.read_ksplat",
    ".sog": "splats.sog.read_sog",
    ".obj": "meshes.obj.read_obj",
    ".stl": "meshes.stl.read_stl",
    ".glb": "gltf.scene.read_gltf",
    ".gltf": "gltf.scene.read_gltf",
    ".vrm": "gltf.scene.read_gltf",
    **dict.fromkeys(USD, "usd.scene.read_usd"),
}
"""Reader of each extension, as module and function name. `_read` handles PLY, scene files and levels of detail itself.
"""

_LOD_READERS = {STREAMED_SOG: "splats.streamed_sog.read_streamed_sog", BLOCKS: "blocks.views.read_blocks"}
"""Readers of the two formats with levels of detail, streamed SOG and blocks, as module and function names."""

_ANIMATION_READERS = {
    **dict.fromkeys((".glb", ".gltf"), "gltf.animation.read_gltf_animation"),
    **dict.fromkeys(USD, "usd.animation.read_usd_animation"),
}
"""Animation reader of each extension, except scene files."""

_LUMISPLAT = "lumisplat"

_PLY_WRITERS = {_LUMISPLAT: "splats.splat_ply.write_splat_ply", "r3dg": "splats.splat_ply.write_r3dg_ply"}
"""PLY writer for each value of the argument ``columns`` of `save`. The value names the program whose columns are
written."""

_WRITERS = {
    ".compressed.ply": "splats.compressed_ply.write_compressed_ply",
    ".ply": _PLY_WRITERS[_LUMISPLAT],
    ".spz": "splats.spz.write_spz",
    ".sog": "splats.sog.write_sog",
    "/meta.json": "splats.sog.write_sog",
    f"/{STREAMED_SOG}": "splats.streamed_sog.write_streamed_sog",
}
"""Writers of captures; the first entry that matches the end of the path is used."""

_SCENE_WRITERS = {
    ".glb": "gltf.scene.write_gltf",
    ".gltf": "gltf.scene.write_gltf",
    **dict.fromkeys(USD, "usd.writing.write_usd"),
}
"""Writers of scenes with cameras, by extension. These formats store a capture or a mesh as a scene."""

_READABLE = (
    ".ply, .compressed.ply, .spz, .splat, .ksplat, .sog, a SOG folder or its meta.json or lod-meta.json, a folder of "
    "blocks, .obj, .stl, .glb, .gltf, .vrm, .usda, .usdc, .usdz, .usd, .toml"
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
        drop_invalid: Drop Gaussians with NaN or infinite values or a rotation of zero length, and log their number,
            instead of refusing the file.
        crease_angle: Smoothing angle for OBJs without normals, also those that a ``scene.toml`` names, in radians, 0 to
            pi: faces that meet at a smaller angle are shaded smoothly, see `smooth_normals`. 0 is flat; None is 0.9,
            which is 51.6 degrees.
        allow_outside: Whether a file may refer to buffers, layers, materials and textures outside of its own folder.
            Set it only for files that you trust. A ``scene.toml`` may always refer to any file.
        up: Up direction for a ``scene.toml`` that does not state it: an axis (``"y-down"``) or a direction. None uses
            the up direction of the first capture that states one. If none does, it is y down for a scene with a
            capture, and y up for a scene with only meshes. Other formats ignore the argument.
        incident: Whether to read the incident light that a .ply may store (R3DG's ``incidents_*``). It is the light of
            the training images, and does not light the scene.
        lod: Level of detail for streamed SOGs and captures in blocks, also those in a ``scene.toml``: 0 is the finest;
            None is 0, or selected by ``budget``.
        budget: Load the finest level of detail with at most this many Gaussians, for streamed SOGs and captures in
            blocks; a log line names the level. None has no limit.
        progress: Called with the fraction done, 0..1; the last call is with 1.

    Returns:
        ``Gaussians`` for a capture, with the materials of R3DG, GS-IR and Lumisplat files; 2D Gaussians become flat
        3D ones. ``Mesh`` for a mesh, or ``Scene`` if it has several materials; ``Scene`` for scenes. Arrays are
        read-only. Captures have the axes of the usual Gaussian PLY (SPZ is mirrored), meshes the axes of their files.

    Raises:
        FormatError: The file is unknown, damaged or truncated, holds no Gaussians or invalid values, or needs more
            memory than there is. The message names the file.
        SceneError: ``up`` is not a direction.
        MissingFileError: There is no such file; both a `FormatError` and a FileNotFoundError.
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
    """Saves a capture, mesh, scene or animation in the format of the extension, completely or not at all.

    Lossy formats clamp values that they cannot store. SPZ: scales to e^-10..e^5.94 (4.5e-5 to 379 scene units; the thin
    axis of Gaussians made from a mesh may be smaller, which is logged), SH above degree 0 to -1..1. Compressed PLY:
    scales to e^-20..e^20, SH above degree 0 to -4..4; a Gaussian far from the others makes the positions of its whole
    chunk coarse, which is logged if it is visible. SOG clamps nothing, but quantizes numbers to 256 values.

    glTF stores scenes: captures (KHR_gaussian_splatting, lossless), meshes with materials and textures, punctual lights
    and cameras. glTF files are y up: captures are rotated by a half turn about x, as in SPZ, and the scene is rotated
    so that its up becomes y. One log line lists what glTF cannot store, such as area lights and environments.

    OpenUSD (``pip install 'lumisplat[usd]'``) stores everything that glTF stores, and area lights, environments and
    animation: captures as ParticleField3DGaussianSplat (lossless), materials as UsdPreviewSurface, UsdLux lights,
    cameras and time samples.

    Args:
        path: For captures ``.ply`` (lossless), ``.compressed.ply`` (16 bytes per Gaussian, and 9, 24 or 45 bytes for
            SH), ``.spz`` (version 4), ``.sog`` (version 2; the SH of all Gaussians become a palette), or ``meta.json``,
            which writes the files of a SOG beside it. Compressed PLY and SOG change the order of the Gaussians. For
            captures, meshes and scenes ``.glb`` (lossless, 60 bytes per Gaussian without view-dependent colours),
            ``.gltf`` (``.glb`` as text), ``.usda`` (text), ``.usdc``, ``.usd``, or ``.usdz`` (a package with its
            textures; the other OpenUSD files put their textures in a folder beside them).
        asset: The capture, mesh, scene or, for OpenUSD, animation. Only ``.ply``, glTF and OpenUSD store normals and
            materials of Gaussians; ``.spz`` and ``.sog`` do not store the kernel degree. Lost values are logged.
        cameras: Cameras of the scene, for glTF and OpenUSD.
        columns: Columns of a ``.ply``: Lumisplat's, or those of Relightable 3D Gaussians (``"r3dg"``) for that program:
            SH of degree 3, albedo within 0.03..0.8, roughness 0.09..0.99, no metals; values that change are logged.

    Raises:
        ConfigError: ``columns`` is unknown, or ``"r3dg"`` is requested for another format than ``.ply``.
        FormatError: The extension is unknown, the format cannot store a value, the file cannot be written, or
            ``"r3dg"`` is requested for a capture without materials.
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
        raise FormatError(path, f"cannot store animations: save them as {', '.join(USD)}")
    writer = _writer_of(path, scene=bool(cameras) or not isinstance(asset, Gaussians))
    if columns not in _PLY_WRITERS:
        raise ConfigError(f"columns is {columns!r}, expected {' or '.join(map(repr, _PLY_WRITERS))}")
    if columns != _LUMISPLAT:
        if writer != _PLY_WRITERS[_LUMISPLAT]:
            raise ConfigError(f"columns {columns!r} need a .ply, got {os.fspath(path)}")
        writer = _PLY_WRITERS[columns]
    if writer not in _SCENE_WRITERS.values():
        _import(writer)(path, asset)
        return
    if isinstance(asset, Gaussians | Mesh):
        asset = Scene(splats=[asset]) if isinstance(asset, Gaussians) else Scene(meshes=[asset])
    _import(writer)(path, asset, cameras)


def check_format(path: PathLike, *, scene: bool = False) -> None:
    """Refuses a file name that `save` could not write, before there is anything to save.

    Args:
        path: The file; only its extension matters.
        scene: Whether a mesh or a scene will be saved; otherwise Gaussians.

    Raises:
        FormatError: The extension is unknown, or the format stores only captures and ``scene`` is True.
    """
    _writer_of(path, scene=scene)


def load_cameras(path: PathLike, *, width: int | None = None, height: int | None = None) -> list[Camera]:
    """Loads the cameras of a capture or a scene in file order; each gets a unique ``name`` from its image.

    Args:
        path: ``transforms.json`` (OpenGL camera-to-world; intrinsics of the file or of each frame, in pixels or as
            ``camera_angle_x``; image sizes are read from the images if the file has none; pinhole, equidistant fisheye
            and orthophoto, with lens distortion), INRIA's ``cameras.json`` (OpenCV; the principal point is the centre),
            nerfstudio's ``camera_path.json``, or a COLMAP sparse model: its folder, or one of its ``cameras`` and
            ``images``, .bin or .txt; or a folder that holds one of these. Or a glTF scene (.glb, .gltf), whose cameras
            have only an aspect ratio: without ``width`` and ``height`` they get the largest size within 1280 x 720. Or
            an OpenUSD stage (.usda, .usdc, .usdz, .usd), whose image sizes may come from render products. Or a
            ``scene.toml``.
        width: Image width in pixels for frames whose size neither the file nor an image gives; only together with
            ``height``, except for glTF and OpenUSD.
        height: Image height in pixels for frames whose size neither the file nor an image gives.

    Returns:
        At least one camera; a scene file may have none.

    Raises:
        FormatError: The file is not a camera file, has no frames, or has a frame with an invalid pose or intrinsics;
            the message names the frame.
        MissingFileError: There is no such file; both a `FormatError` and a FileNotFoundError.
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
    """Loads cameras as the keyframes of one moving camera.

    Args:
        path: nerfstudio's ``camera_path.json``, with its frame rate; a ``scene.toml``, from which the first camera with
            keyframes is used; or any other file that `load_cameras` reads, with one second between consecutive cameras.
        width: As in `load_cameras`.
        height: As in `load_cameras`.

    Raises:
        FormatError: The file cannot be read, has no cameras, or has cameras of different sizes or models.
        MissingFileError: There is no such file; both a `FormatError` and a FileNotFoundError.
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
    """Loads render settings from the ``[render]`` table of a ``scene.toml``; missing settings have their defaults.

    Args:
        path: A scene file, or a file that `save_config` wrote.

    Raises:
        FormatError: The file cannot be read, or a setting is unknown or invalid; the message names the line and
            setting.
        MissingFileError: There is no such file; both a `FormatError` and a FileNotFoundError.
    """
    from lumisplat.io.scene_toml.config_file import read_config
    from lumisplat.io.scene_toml.scene_file import read_document

    return read_config(read_document(path))


def change_config(config: _Config, name: str, value: str) -> _Config:
    """Returns settings with one setting changed, given by its key and value as in a scene file.

    Args:
        config: A `RenderConfig`, or other settings with nested groups.
        name: Key of the setting, with the names of its groups: ``trace.hits_per_pass``.
        value: Its value in TOML; quotation marks of strings are optional: ``8``, ``peak``, ``off``.

    Raises:
        ConfigError: There is no such setting, or its value has the wrong type or is out of range.
    """
    from lumisplat.io.scene_toml.config_file import changed_setting

    return changed_setting(config, name, value)


def save_config(path: PathLike, config: RenderConfig) -> None:
    """Saves all settings as the ``[render]`` table of a TOML file, which appears complete or not at all.

    Args:
        path: The file to write; `load_config` reads equal settings from it.
        config: The settings.

    Raises:
        ConfigError: ``config`` is not a `RenderConfig`.
        FormatError: The file cannot be written.
    """
    from lumisplat.io.scene_toml.config_file import write_config

    write_config(path, config)


def load_image(path: PathLike) -> FloatArray:
    """Loads an image in display colours, for example to compare it by `psnr`, `ssim` or `flip`.

    Args:
        path: PNG, JPEG, WebP or another format that Pillow reads, in sRGB; transparent pixels are blended over black.
            Or OpenEXR or Radiance HDR, whose linear values are encoded as sRGB and clipped at white.

    Returns:
        Display-referred sRGB, 0..1, shape (H, W, 3), row 0 at the top.

    Raises:
        FormatError: The file is damaged, or not an image.
        MissingFileError: There is no such file; both a `FormatError` and a FileNotFoundError.
    """
    from lumisplat.io.images.radiance import read_display_image

    return read_display_image(path)


def load_radiance(path: PathLike) -> FloatArray:
    """Loads an image of radiance, such as a latitude-longitude environment for a `LightEnvironment`.

    Args:
        path: Radiance HDR (``.hdr``, ``.pic``: RGBE in any encoding) or OpenEXR (channels R, G and B, half or float;
            the first part of a multi-part file). The content determines the format.

    Returns:
        Linear Rec.709, finite and at least 0, shape (H, W, 3), row 0 at the top, read-only. Negative and non-finite
        values become 0; one log line counts them, unless they are only negative and negligible.

    Raises:
        FormatError: The file is damaged or truncated, or holds 8-bit display colours.
        MissingFileError: There is no such file; both a `FormatError` and a FileNotFoundError.
    """
    from lumisplat.io.images.radiance import read_radiance

    return read_radiance(path)


def load_rig(
    path: PathLike,
    *,
    motion: PathLike | None = None,
    joints: Mapping[str, str] | None = None,
    betas: npt.ArrayLike | None = None,
    expression: npt.ArrayLike | None = None,
    vertex_colors: bool = True,
    allow_outside: bool = False,
) -> Rig:
    """Loads a rig, a figure with joints and clips: a glTF, or a body model of SMPL, SMPL-H, SMPL-X or FLAME.

    Of a glTF, translation, rotation, scale and morph target weights are animated with linear, step or cubic spline
    interpolation. Meshes that are moved by their node alone are included. Meshes with the same material are joined.

    A body model has shape and pose blend shapes (Loper et al. 2015), y up, in metres. At rest its arms are spread.

    Args:
        path: A ``.glb``, ``.gltf`` or ``.vrm`` file, a body model as ``.npz``, or a ``.bvh``: a skeleton without
            meshes, to which `bind_gaussians` binds given Gaussians. A ``.pkl`` or ``.fbx`` is refused with the command
            that converts it.
        motion: File whose clips come first: AMASS poses (``.npz``) for body models, or ``.bvh``, ``.glb``, ``.gltf`` or
            ``.vrma`` for body models and humans in glTF. The latter are matched by the names of joints, and fitted to
            the rest pose and the leg length; a log line names joints that are not matched.
        joints: Names in SMPL of joints, as in `load_motion`.
        betas: Shape of a body model, up to as many numbers as the model has. None: those of ``motion``, which is
            logged, or the mean shape.
        expression: Facial expression of a SMPL-X or FLAME model, the same at all times; None: neutral.
        vertex_colors: Whether to multiply the base colour by COLOR_0, as glTF demands. Use False for files that
            store something else there, such as masks, which would make meshes nearly black (a log line warns).
        allow_outside: As in `load`.

    Raises:
        FormatError: A file is malformed, has neither a skin nor an animation, is skinned without weights or with
            weights that sum to 0, has keys that are not finite or not in order, or is no human that can be matched.
        MissingFileError: There is no such file; both a `FormatError` and a FileNotFoundError.
    """
    from lumisplat.io.rigs.loading import load_rig as load_any_rig

    with references_outside(allow_outside):
        return load_any_rig(
            path, motion=motion, joints=joints, betas=betas, expression=expression, vertex_colors=vertex_colors
        )


def load_bound_gaussians(path: PathLike) -> tuple[Gaussians, IntArray | None]:
    """Loads Gaussians that belong to a rig, with the triangle of each if the file is one of GaussianAvatars.

    Their arguments of `bind_gaussians` are ``gaussians`` and ``triangles``.

    Args:
        path: A capture.

    Returns:
        The Gaussians; and the index of each Gaussian's triangle, shape (N,), None for all other captures.

    Raises:
        FormatError: The file cannot be read, or is no capture.
        MissingFileError: There is no such file.
    """
    from lumisplat.io.rigs.bound_gaussians import read_triangles
    from lumisplat.scene.gaussians import Gaussians

    gaussians = load(path)
    if not isinstance(gaussians, Gaussians):
        raise FormatError(path, "is no capture, expected Gaussians")
    return gaussians, read_triangles(path)


def load_motion(
    path: PathLike, rig: Rig, *, joints: Mapping[str, str] | None = None, allow_outside: bool = False
) -> Rig:
    """Returns a rig with the clips of a motion file first, as ``motion`` of `load_rig` does; its own clips follow.

    Args:
        path: AMASS poses (``.npz``) for body models of SMPL, or ``.bvh``, ``.glb``, ``.gltf`` or ``.vrma`` for humans.
        rig: A rig of `load_rig`, or one that a program made.
        joints: Names in SMPL of joints whose names in the motion or the rig are not known, by those names:
            ``{"Shin.L": "left_knee"}``. A name that both have applies to the motion alone if the rig has another such
            joint.
        allow_outside: As in `load`.

    Raises:
        FormatError: The file is malformed, or its joints cannot be matched with those of the rig.
        SceneError: ``rig`` is not a rig, or ``joints`` has an unknown name.
        MissingFileError: There is no such file; both a `FormatError` and a FileNotFoundError.
    """
    from lumisplat.io.rigs.loading import load_motion as load_any_motion
    from lumisplat.scene.animation.rig import Rig
    from lumisplat.scene.checks import check_argument

    check_argument("load_motion", rig, Rig, "a Rig of load_rig")
    with references_outside(allow_outside):
        return load_any_motion(path, rig, joints=joints)


def load_sequence(folder: PathLike, fps: float, *, drop_invalid: bool = False) -> GaussianSequence:
    """Finds the frames of a Gaussian sequence; each frame is loaded when it is rendered.

    Args:
        folder: A folder with one capture per frame, all with the same extension (.ply, .compressed.ply, .spz, .sog), in
            the natural order of their names: ``frame_2`` before ``frame_10``. Other files are ignored.
        fps: Frames per second, above 0.
        drop_invalid: As in `load`, for each frame.

    Raises:
        FormatError: The folder has no frames or frames of two formats, or the first frame cannot be read.
        SceneError: ``fps`` is out of range.
        MissingFileError: There is no such folder; both a `FormatError` and a FileNotFoundError.
    """
    from lumisplat.io.splats.sequence import read_sequence

    return read_sequence(folder, fps, partial(load, drop_invalid=drop_invalid))


def load_animation(
    path: PathLike, *, drop_invalid: bool = False, crease_angle: float | None = None, allow_outside: bool = False
) -> Animation:
    """Loads an animation from a ``scene.toml`` (with ``[[actors]]`` and ``[animation]``), an OpenUSD or a glTF.

    Args:
        path: The scene file. Or ``.glb`` or ``.gltf``: its first animation (nodes, skins and morph targets) at 25
            frames per second. Or ``.usda``, ``.usdc``, ``.usdz`` or ``.usd``: rigid prims with time samples become
            actors with keyframes, and deforming prims become actors that are read again at each frame. The first moving
            camera becomes the camera path.
        drop_invalid: As in `load`, for each capture.
        crease_angle: As in `load`, for each OBJ.
        allow_outside: As in `load`, for each mesh and rig.

    Raises:
        FormatError: The file, or a file that it names, cannot be read, or an entry is invalid; the message names the
            line and the key.
        MissingFileError: There is no such file; both a `FormatError` and a FileNotFoundError.
        MissingExtraError: OpenUSD needs usd-core.
    """
    with references_outside(allow_outside):
        load_asset = partial(load, drop_invalid=drop_invalid, crease_angle=crease_angle)
        extension = Path(path).suffix.lower()
        if extension in _ANIMATION_READERS:
            return _import(_ANIMATION_READERS[extension])(Path(path), drop_invalid)
        _refuse_rig(Path(path), extension)
        return _import("scene_toml.scene_file.read_animation")(Path(path), load_asset, load_cameras)


def save_cameras(path: PathLike, cameras: Sequence[Camera]) -> None:
    """Saves cameras as a `transforms.json` that `load_cameras` and nerfstudio read.

    Args:
        path: The file to write. It appears complete or not at all.
        cameras: At least one camera, all of one model; names become the frames' file paths.

    Raises:
        ConfigError: ``path`` is not a path.
        SceneError: There is no camera, models differ, or a camera has an aperture or a rolling shutter, which the
            format cannot store.
        FormatError: The file cannot be written.
    """
    from lumisplat.io.cameras.json_cameras import write_transforms

    _check_path_first("save_cameras(path, cameras)", path)
    write_transforms(path, cameras)


def save_animation(path: PathLike, frames: Iterable[npt.ArrayLike], fps: float = 25.0) -> None:
    """Saves frames as an animated image or a video; the extension selects the format. Animated images loop forever.

    ``.gif``: 256 colours for all frames, dithered with a fixed pattern so that static parts do not flicker. ``.webp``:
    lossy, small. ``.png``, ``.apng``: lossless, large. ``.mp4``: H.264 in BT.709, by PyAV (``pip install
    'lumisplat[video]'``); an odd width or height is made even by repeating the last column or row.

    Args:
        path: The file to write. It appears complete or not at all.
        frames: Display-referred values, 0..1, each of the same shape (H, W, 3), such as ``Frame.pixels_srgb`` returns
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
    """Reads a capture, a mesh or a scene.

    Args:
        path: The file.
        load: Reads the captures and meshes that a scene file names.
        options: Options of `lumisplat.io.load`.
    """
    extension = format_of(path)
    if extension == ".ply":
        return _read_ply(path, options.progress, incident=options.incident)
    if extension == ".toml":
        return _import("scene_toml.scene_file.read_scene_file")(path, load, options.up)
    if extension in _LOD_READERS:
        return _import(_LOD_READERS[extension])(path, options.lod, options.budget)
    if extension in (".exr", ".hdr"):
        raise FormatError(path, "is an image, not a scene: --environment (ls.LightEnvironment) lights a scene with it")
    if extension not in _READERS:
        _refuse_rig(path, extension)
        raise FormatError(path, f"unknown extension {path.suffix!r}, expected {_READABLE}")
    reader: Callable[..., _Loaded] = _import(_READERS[extension])
    if extension in (".glb", ".gltf", ".vrm", *USD):
        return reader(path, drop_invalid=options.drop_invalid)
    if extension == ".obj" and options.crease_angle is not None:
        return reader(path, options.crease_angle)
    return reader(path)


def _refuse_rig(path: Path, extension: str) -> None:
    """Raises `FormatError` for rigs and motions that are no scenes; the message says how they are loaded."""
    from lumisplat.io.rigs.loading import refuse_foreign

    refuse_foreign(path)
    if what := {".npz": "a body model or poses", ".bvh": "a motion", ".vrma": "a motion"}.get(extension):
        use = "use it in [[actors]] of a scene file, or by ls.avatars.load_rig(path, motion=)"
        raise FormatError(path, f"may be {what}: {use}")


def _writer_of(path: PathLike, *, scene: bool) -> str:
    """Returns the writer for the extension of ``path``, such as ``splats.spz.write_spz``.

    Args:
        path: The file.
        scene: Whether a mesh or a scene will be saved; otherwise Gaussians.

    Raises:
        FormatError: The extension is unknown, or the format stores only captures and ``scene`` is True.
    """
    name = f"/{Path(path).name.lower()}"
    if writer := next((_SCENE_WRITERS[end] for end in _SCENE_WRITERS if name.endswith(end)), None):
        return writer
    writer = next((_WRITERS[end] for end in _WRITERS if name.endswith(end)), None)
    if writer is None:
        expected = ", ".join(_SCENE_WRITERS) if scene else _WRITABLE
        raise FormatError(path, f"unknown extension {Path(path).suffix!r}, expected {expected}")
    if scene:
        raise FormatError(path, f"stores only Gaussians: save scenes and meshes as {', '.join(_SCENE_WRITERS)}")
    return writer


def _import(function: str) -> Any:
    """Imports and returns a function of `lumisplat.io`, named by module and function: ``splats.spz.read_spz``."""
    module, _, name = function.rpartition(".")
    return getattr(import_module(f"{__package__}.{module}"), name)


def _read_ply(path: Path, progress: Callable[[float], None] | None, *, incident: bool) -> SplatColumns | Mesh:
    """Reads a PLY file as a mesh if it has faces, else as a capture; ``progress`` and ``incident`` as in `load`."""
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
    """Returns whether a file is a mesh rather than a capture; False if the file cannot be read.

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
    """Returns whether a PLY header declares a mesh: faces or triangle strips, and no Gaussian properties."""
    from lumisplat.io.splats.splat_ply import is_gaussian_element

    vertex, surfaces = header.element("vertex"), map(header.element, ("face", "tristrips"))
    return any(one and one.count for one in surfaces) and not (vertex and is_gaussian_element(vertex))


def _in_folder(path: Path) -> Path:
    """Returns the file with the cameras of a folder of images, such as its ``transforms.json`` or COLMAP model.

    ``path`` itself is returned if it is a file, or a folder without such a file.
    """
    if not os.path.isdir(path):  # a name that is too long also gives False
        return path
    from lumisplat.io.training_images.loading import find_model

    file = next((file for file in (path / "transforms.json", path / "cameras.json") if file.is_file()), None)
    return file or find_model(path) or path


def _check_path_first(call: str, path: object) -> None:
    """Raises `ConfigError` if the first argument of the save function ``call`` is no path: arguments may be swapped."""
    if not isinstance(path, str | os.PathLike):
        raise ConfigError(f"{call}: the path comes first, got {type(path).__name__}")
