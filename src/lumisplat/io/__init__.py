"""Files to scenes and back: `load`, `save`, and their like for cameras and radiance.

Modules are imported when needed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lumisplat.errors import FormatError
from lumisplat.io.files.source import PathLike

if TYPE_CHECKING:
    import numpy.typing as npt

    from lumisplat.config import RenderConfig
    from lumisplat.io.splats.columns import SplatColumns
    from lumisplat.math.arrays import FloatArray
    from lumisplat.scene.animation.actors import Animation
    from lumisplat.scene.animation.rig import Rig
    from lumisplat.scene.animation.sequence import GaussianSequence
    from lumisplat.scene.camera import Camera
    from lumisplat.scene.gaussians import Gaussians
    from lumisplat.scene.mesh import Mesh
    from lumisplat.scene.scene import Scene

__all__ = [
    "load",
    "load_animation",
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

Progress = Callable[[float], None]

READABLE = ".ply, .compressed.ply, .spz, .sog, a SOG folder or its meta.json, .obj, .stl, .glb, .gltf, .toml"
WRITABLE = ".ply, .compressed.ply, .spz"


def load(path: PathLike, *, drop_invalid: bool = False, progress: Progress | None = None) -> Gaussians | Mesh | Scene:
    """Loads a capture, a mesh or a scene; extension and content choose the reader.

    Args:
        path: A Gaussian capture (PLY, compressed PLY, SPZ, SOG bundle, SOG folder or its ``meta.json``), a mesh (OBJ,
            STL, PLY with faces) or a scene (glTF, GLB, a ``scene.toml`` that names other files).
        drop_invalid: Leave out Gaussians with NaN or infinite values or a rotation of zero length, and log how many,
            instead of refusing the file.
        progress: Called with the fraction done, 0..1; the last call has 1.

    Returns:
        ``Gaussians`` for a capture; ``Mesh`` for a mesh, or ``Scene`` where it has several materials; ``Scene`` for the
        others. Arrays are read-only. Axes are those of the usual Gaussian PLY for captures (SPZ is mirrored to them),
        those of the file for meshes.

    Raises:
        FormatError: The file is missing, unknown, damaged, truncated, empty of Gaussians, holds invalid values, or
            claims more than memory holds. The message names it.
    """
    from lumisplat.io.splats.columns import SplatColumns, gaussians_from_columns

    try:
        loaded = _read(Path(path), drop_invalid, progress)
        if isinstance(loaded, SplatColumns):
            loaded = gaussians_from_columns(path, loaded, drop_invalid=drop_invalid)
    except OSError as error:
        raise FormatError(path, f"cannot be read: {error.strerror or error}") from None
    except MemoryError:
        raise FormatError(path, "does not fit into memory") from None
    if progress:
        progress(1.0)
    return loaded


def _read(path: Path, drop_invalid: bool, progress: Progress | None) -> SplatColumns | Mesh | Scene:
    match _extension(path):
        case ".ply":
            return _read_ply(path, progress)
        case ".toml":
            from lumisplat.io.scene_toml.scene_file import read_scene_file

            return read_scene_file(path, lambda file: load(file, drop_invalid=drop_invalid))
        case ".spz":
            from lumisplat.io.splats.spz import read_spz as read
        case ".sog":
            from lumisplat.io.splats.sog import read_sog as read
        case ".obj":
            from lumisplat.io.meshes.obj import read_obj as read
        case ".stl":
            from lumisplat.io.meshes.stl import read_stl as read
        case ".glb" | ".gltf":
            from lumisplat.io.gltf.scene import read_gltf as read
        case _:
            raise FormatError(path, f"unknown extension {path.suffix!r}, expected {READABLE}")
    return read(path)


def _extension(path: Path) -> str:
    """The extension of an existing file, ``.sog`` for a SOG folder or its meta.json."""
    if path.is_dir():
        if (path / "meta.json").is_file():
            return ".sog"
        raise FormatError(path, "is a folder without a meta.json, expected a SOG folder or a file")
    if not path.exists():
        raise FormatError(path, "no such file")
    if path.stat().st_size == 0:
        raise FormatError(path, "is empty: zero bytes")
    return ".sog" if path.name == "meta.json" else path.suffix.lower()


def _read_ply(path: Path, progress: Progress | None) -> SplatColumns | Mesh:
    from lumisplat.io.ply.ply_rows import read_ply_header
    from lumisplat.io.splats.compressed_ply import is_compressed_header, read_compressed_ply
    from lumisplat.io.splats.splat_ply import is_gaussian_element, read_splat_ply

    header = read_ply_header(path)
    if is_compressed_header(header):
        return read_compressed_ply(header)
    vertex, face = header.element("vertex"), header.element("face")
    if face is not None and face.count and not (vertex and is_gaussian_element(vertex)):
        from lumisplat.io.meshes.mesh_ply import read_ply_mesh

        return read_ply_mesh(header)
    return read_splat_ply(header, progress)


def save(path: PathLike, gaussians: Gaussians) -> None:
    """Saves a capture; the extension chooses the format. The file appears complete or not at all.

    The lossy formats clamp what they cannot hold. SPZ: scales to e^-10..e^5.94 (4.5e-5 to 379 scene units; the thin
    axis of Gaussians made from a mesh may be below, which is logged), SH above degree 0 to -1..1. Compressed PLY:
    scales to e^-20..e^20, SH above degree 0 to -4..4; one Gaussian far from the others makes the positions of its
    whole chunk coarse, which is logged where it shows.

    Args:
        path: ``.ply`` (lossless), ``.compressed.ply`` (16 bytes a Gaussian and 9, 24 or 45 for SH; reordered) or
            ``.spz`` (version 4).
        gaussians: What to save. Only ``.ply`` keeps normals and materials, and ``.spz`` no kernel degree; what is
                left out is logged.

    Raises:
        FormatError: An unknown extension, values that the format cannot hold, or the file cannot be written.
    """
    from lumisplat.scene.gaussians import Gaussians

    name = Path(path).name.lower()
    if not isinstance(gaussians, Gaussians):
        raise FormatError(path, f"only Gaussians can be saved, got {type(gaussians).__name__}")
    if name.endswith(".compressed.ply"):
        from lumisplat.io.splats.compressed_ply import write_compressed_ply as write
    elif name.endswith(".ply"):
        from lumisplat.io.splats.splat_ply import write_splat_ply as write
    elif name.endswith(".spz"):
        from lumisplat.io.splats.spz import write_spz as write
    else:
        raise FormatError(path, f"unknown extension {Path(path).suffix!r}, expected {WRITABLE}")
    write(path, gaussians)


def load_cameras(path: PathLike, *, width: int | None = None, height: int | None = None) -> list[Camera]:
    """Loads the cameras of a capture or a scene, in the file's order; each has a unique ``name``, its image's.

    Args:
        path: ``transforms.json`` (OpenGL camera-to-world; intrinsics of the file or of each frame, in pixels or as
            ``camera_angle_x``; image sizes are looked up where the file gives none; pinhole, equidistant fisheye and
            orthophoto) or INRIA's ``cameras.json`` (OpenCV; the principal point is the centre). Lens distortion is
            ignored with a log line. Or a glTF scene (.glb, .gltf), whose cameras know their aspect ratio only: without
            ``width`` and ``height`` they get the largest size within 1280 x 720. Or a ``scene.toml``.
        width: Image width, pixels, of frames whose size neither the file nor an image tells; only with ``height``,
            except for glTF.
        height: Image height, pixels, of such frames.

    Returns:
        At least one; of a scene, perhaps none.

    Raises:
        FormatError: No camera file, no frames, or a frame whose pose or intrinsics are unusable; names the frame.
    """
    from lumisplat.io.cameras import camera_json

    if Path(path).suffix.lower() in (".glb", ".gltf"):
        from lumisplat.io.gltf.cameras import read_gltf_cameras

        return camera_json.unique_names(read_gltf_cameras(path, width, height))
    if Path(path).suffix.lower() == ".toml":
        from lumisplat.io.scene_toml.cameras import read_scene_cameras
        from lumisplat.io.scene_toml.scene_file import read_document

        def load_sized(file: Path, width: int | None, height: int | None) -> list[Camera]:
            return load_cameras(file, width=width, height=height)

        return read_scene_cameras(read_document(path), load_sized, width, height)
    return camera_json.load_cameras(path, width, height)


def load_config(path: PathLike) -> RenderConfig:
    """Loads the settings of a ``scene.toml``: its ``[render]`` table, the defaults where it says nothing.

    Args:
        path: A scene file, or what `save_config` has written.

    Raises:
        FormatError: The file cannot be read, or a setting is unknown or bad; names the line and the setting.
    """
    from lumisplat.io.scene_toml.config_file import read_config
    from lumisplat.io.scene_toml.scene_file import read_document

    return read_config(read_document(path))


def save_config(path: PathLike, config: RenderConfig) -> None:
    """Saves every setting as the ``[render]`` table of a TOML file, which appears complete or not at all.

    Args:
        path: Where to; `load_config` gives back equal settings.
        config: What to save.

    Raises:
        ConfigError: These are no settings.
        FormatError: The file cannot be written.
    """
    from lumisplat.io.scene_toml.config_file import write_config

    write_config(path, config)


def load_image(path: PathLike) -> FloatArray:
    """Loads a picture as it is shown, such as one to compare by `psnr`, `ssim` or `flip`.

    Args:
        path: PNG, JPEG, WebP and what else Pillow reads, in sRGB; transparent pixels are taken over black. Or OpenEXR
            and Radiance HDR, whose linear light is encoded as sRGB, and clipped at white.

    Returns:
        Display-referred sRGB, 0..1, shape (H, W, 3), row 0 on top.

    Raises:
        FormatError: The file is missing, damaged, or no picture.
    """
    from lumisplat.io.images.picture import read_picture

    return read_picture(path)


def load_radiance(path: PathLike) -> FloatArray:
    """Loads an image of radiance, such as a latitude-longitude environment for a `LightEnvironment`.

    Args:
        path: Radiance HDR (``.hdr``, ``.pic``: RGBE, any of its encodings) or OpenEXR (channels R, G and B, half or
            float; of a file with several parts, the first). The content decides which.

    Returns:
        Linear Rec.709, finite and at least 0, shape (H, W, 3), row 0 on top, read-only. Values that were negative or
        not finite are 0, and one log line counts them.

    Raises:
        FormatError: The file is missing, damaged, truncated, or holds display colours of 8 bit.
    """
    from lumisplat.io.images.environment import read_radiance

    return read_radiance(path)


def load_rig(path: PathLike, *, vertex_colors: bool = True) -> Rig:
    """Loads a rigged glTF: its meshes, the joints that move them, and its animations.

    Translation, rotation, scale and weights of morph targets are animated, linearly, in steps or by cubic splines;
    meshes that are moved by their node alone count as well. Meshes of one material become one.

    Args:
        path: A ``.glb`` or ``.gltf`` file.
        vertex_colors: Multiply the base colour by COLOR_0, as the format says; False for files that keep something
            else there, such as masks, which make them nearly black (a log line tells).

    Raises:
        FormatError: The file is malformed, has neither skin nor animation, is skinned without weights or with weights
            that sum to 0, or has keys that are not finite or not in order.
    """
    from lumisplat.io.gltf.rigs import read_rig

    return read_rig(path, vertex_colors)


def load_sequence(folder: PathLike, fps: float, *, drop_invalid: bool = False) -> GaussianSequence:
    """Finds the frames of a Gaussian sequence; each is loaded when it is shown.

    Args:
        folder: Holds a capture a frame, all with the same extension (.ply, .compressed.ply, .spz, .sog), in the
            natural order of their names: ``frame_2`` before ``frame_10``. Files of other kinds are ignored.
        fps: Frames a second, above 0.
        drop_invalid: As of `load`, for each frame.

    Raises:
        FormatError: There is no such folder, no frame in it, frames of two kinds, or the first one cannot be read.
        SceneError: ``fps`` is out of range.
    """
    from lumisplat.io.splats.sequence import read_sequence

    return read_sequence(folder, fps, lambda frame: load(frame, drop_invalid=drop_invalid))


def load_animation(path: PathLike, *, drop_invalid: bool = False) -> Animation:
    """Loads an animated ``scene.toml``: its scene, cameras, ``[[actors]]`` and ``[animation]``.

    Args:
        path: The scene file.
        drop_invalid: As of `load`, for each capture.

    Raises:
        FormatError: The file or one that it names cannot be read, or an entry is bad; names the line and the key.
    """
    from lumisplat.io.scene_toml.animation import read_animation

    def load_sized(file: Path, width: int | None, height: int | None) -> list[Camera]:
        return load_cameras(file, width=width, height=height)

    return read_animation(path, lambda file: load(file, drop_invalid=drop_invalid), load_sized)


def save_cameras(path: PathLike, cameras: Sequence[Camera]) -> None:
    """Saves cameras as a `transforms.json` that `load_cameras` and nerfstudio read.

    Args:
        path: Where to. The file appears complete or not at all.
        cameras: At least one, all of one model; names become the frames' file paths.

    Raises:
        SceneError: There is no camera, models are mixed, or a camera has an aperture or a rolling shutter, for which
            the format has no place.
        FormatError: The file cannot be written.
    """
    from lumisplat.io.cameras import camera_json

    camera_json.save_cameras(path, cameras)


def save_animation(path: PathLike, frames: Iterable[npt.ArrayLike], fps: float = 25.0) -> None:
    """Saves pictures as an animation; the extension chooses how. All but videos repeat for ever.

    ``.gif``: 256 colours for all frames together, dithered by a pattern that stands still, so that what does not move
    does not flicker. ``.webp``: lossy, small. ``.png``, ``.apng``: exact, large. ``.mp4``: H.264 in BT.709, by PyAV
    (``pip install 'lumisplat[video]'``); an odd width or height is made even by repeating the last column or row.

    Args:
        path: Where to. The file appears complete or not at all.
        frames: Display-referred values, 0..1, each of the same shape (H, W, 3), as ``Frame.pixels_srgb`` gives them
            over a background.
        fps: Frames a second, above 0, at most 50; of a video 240.

    Raises:
        ConfigError: ``fps`` is out of range.
        SceneError: There is no frame, one is no such image, or sizes differ.
        FormatError: The extension is none of these, or the file cannot be written.
        MissingExtraError: A video needs PyAV.
    """
    from lumisplat.io.images import animation

    animation.write_animation(path, frames, fps)
