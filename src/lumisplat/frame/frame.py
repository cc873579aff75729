"""The finished frame of one camera: its images as NumPy arrays, how it is displayed, and the files it is saved to."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Collection, Mapping
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from lumisplat.config import RenderConfig, ToneMap
from lumisplat.config.render import AOVS, EVERY_FRAME
from lumisplat.errors import ConfigError, FormatError, SceneError
from lumisplat.frame.denoise import check_denoiser, denoised_light
from lumisplat.frame.encoding import MimeBundle, depth_range, encoded, mime_bundle, mime_type, write_depth_png
from lumisplat.frame.frame_data import FrameData, unpremultiplied
from lumisplat.frame.insets import with_insets
from lumisplat.frame.layers import (
    COUNTS,
    LAYERS,
    RADIANCE,
    VIEWS,
    Image,
    exr_channels,
    layer_names,
    layer_pictures,
    present_layers,
    view_limits,
    view_names,
    view_picture,
)
from lumisplat.frame.mattes import Mattes
from lumisplat.io.files.arrays import write_npz
from lumisplat.io.images.exr import write_exr
from lumisplat.io.images.texture import to_bytes, write_png
from lumisplat.math.arrays import FloatArray
from lumisplat.math.color import decode_srgb
from lumisplat.math.tone_map import captured_radiance, lit_picture
from lumisplat.scene.camera import Camera

_log = logging.getLogger("lumisplat")

_PICTURE = "picture"
"""Key in ``_unread`` of the function that fetches the frame's encoded bytes; the other keys are names of image fields.
"""
_LIT_PARTS = ("captured", "captured_weight", "light")

ReadPicture = Callable[[], npt.NDArray[np.uint8] | None]
"""Function that fetches a frame's sRGB bytes from the device. It returns None if some pixels are not finite; the frame
then encodes its pixels on the host."""


class Frame(FrameData):
    """Rendered images of one camera, all of shape (H, W, ...).

    Depth, normals and indices are those of the first sample; colours, alpha and radiance are means over samples.
    """

    __slots__ = ("_unread",)

    _unread: dict[str, Callable[[], Any]]
    """Functions that download images from the device, by field name; a function runs when its image is first read."""

    LAYERS: ClassVar[tuple[str, ...]] = LAYERS
    """Names of images that can be saved in addition to the colour, such as depth."""
    VIEWS: ClassVar[tuple[str, ...]] = VIEWS
    """Names of false-colour images that explain the frame, such as hits; see `view`."""
    NEEDS: ClassVar[Mapping[str, str]] = {name: name for name in AOVS} | {
        "shadow": "lights",
        "shadow_matte": "shadow_ratio",
    }
    """Name that ``RenderConfig.aovs`` must contain for each layer or view; layers that are not listed are always
    available."""

    @classmethod
    def of(
        cls,
        images: Mapping[str, Any],
        picture: ReadPicture | None = None,
        **others: Any,
    ) -> Frame:
        """Makes a frame from arrays, or from functions that are called when their image is first read.

        Args:
            images: Arrays, or functions that fetch them, by image field.
            picture: Fetches the encoded bytes of `pixels_srgb` from the device; None: they are encoded on the host.
            others: Values of the fields that are not images.
        """
        frame = cls(**images, **others)
        unread = {name: image for name, image in images.items() if callable(image)}
        object.__setattr__(frame, "_unread", unread)
        for name in unread:
            object.__delattr__(frame, name)
        if picture is not None:
            unread[_PICTURE] = picture
        return frame

    def developed(self, camera: Camera, config: RenderConfig | None, picture: ReadPicture | None) -> Frame:
        """Returns a frame that shares this frame's images, with another exposure or tone map.

        Args:
            camera: This frame's camera, with another exposure.
            config: This frame's settings, with another tone map.
            picture: Fetches the encoded bytes of `pixels_srgb` from the device; None: they are encoded on the host.
        """
        unread = self._fetches()
        images = {name: partial(getattr, self, name) for name in unread if name != _PICTURE}
        shared = {field.name: getattr(self, field.name) for field in fields(self) if field.name not in images}
        return Frame.of(images, picture, **shared | {"camera": camera, "config": config})

    if not TYPE_CHECKING:  # otherwise type checkers accept every attribute

        def __getattr__(self, name: str) -> Any:
            """Fetches an image at its first access. Python calls this method only for fields without a value."""
            fetch = self._fetches().get(name)
            if fetch is None:
                return object.__getattribute__(self, name)  # raises, unless another thread has fetched it
            image = fetch()
            object.__setattr__(self, name, image)
            unread = self._fetches()
            unread.pop(name, None)
            if name in ("color", "alpha", *_LIT_PARTS):
                unread.pop(_PICTURE, None)  # the caller may change the array
            if unread.keys() == {_PICTURE}:
                unread.clear()  # all images are on the host: release the device memory
            return image

    def has(self, field: str) -> bool:
        """Returns whether the frame has an image under a field name, without fetching the image."""
        return field in self._fetches() or super().has(field)

    def save(
        self,
        path: str | os.PathLike[str],
        layers: Collection[str] | str | None = None,
        mattes: Mattes | None = None,
        *,
        insets: Collection[str] | str = (),
    ) -> None:
        """Writes the frame in the format of the file's extension.

        ``.png``: 8-bit sRGB over the background, RGBA with straight alpha if there is none; a lit frame is exposed and
        tone-mapped, see `pixels_srgb`. ``.exr``: 32-bit linear Rec.709 ``R G B A`` without the background, alpha
        premultiplied, neither exposed nor tone-mapped, and layers such as ``depth.Z``, ``normal.X/Y/Z``,
        ``index.gaussian``, ``albedo.R/G/B`` or ``light.NAME.shadow.R/G/B`` in one part; an index is a 32-bit unsigned
        integer, and 4294967295 means "none". ``.npz``: every array of the frame unchanged.

        PNG and EXR hold 0 where radiance is not finite, and a warning counts those pixels.

        Args:
            path: File to write.
            layers: Names from `LAYERS`, as a list or a comma-separated text. An EXR gets the layers as channels (None:
                all layers that the frame has). Beside a PNG, each layer becomes a file ``NAME.LAYER.png`` (None: no
                files), and depth also a 16-bit grey file ``NAME.depth16.png`` with `depth_range` in its metadata. An
                NPZ has all layers but ``shadow_matte``, whatever is given.
            mattes: Object and material mattes (Cryptomatte) to add to an EXR, one EXR part each, see
                `lumisplat.layers.render_mattes`.
            insets: Names from `VIEWS`, as a list or a comma-separated text, that a PNG shows small, side by side, in
                its lower right corner.

        Raises:
            ConfigError: A name is not a layer or view, the frame was rendered without the layer, mattes are given for
                a format other than EXR, or insets for one other than PNG.
            SceneError: The mattes and the frame differ in size.
            FormatError: The extension is not .png, .exr or .npz, or the file cannot be written.
        """
        suffix = Path(path).suffix.lower()
        if mattes is not None:
            if suffix != ".exr":
                raise ConfigError(f"{os.fspath(path)}: mattes can only be written to EXR files")
            if mattes.size != self.color.shape[:2]:
                raise SceneError(
                    f"the mattes have {mattes.size} rows and columns, expected the frame's {self.color.shape[:2]}"
                )
        if insets and suffix != ".png":
            raise ConfigError(f"{os.fspath(path)}: insets can only be drawn on PNG files")
        layers = None if layers is None else layer_names(layers)
        if suffix == ".png":
            pictures: dict[str, FloatArray] = {}
            for layer in layers or ():
                pictures |= layer_pictures(self, layer)
            for name, picture in pictures.items():
                write_png(Path(path).with_suffix(f".{name}.png"), picture)
            if "depth" in pictures:
                write_depth_png(Path(path).with_suffix(".depth16.png"), self.depth)
            image = self._picture()
            if insets:
                image = self.with_insets(insets, to_bytes(image, path))
            write_png(path, image)  # last: if this file exists, all do
        elif suffix == ".exr":
            write_exr(path, self.layers(layers), further=() if mattes is None else mattes.parts())
        elif suffix == ".npz":
            write_npz(path, self.arrays())
        else:
            raise FormatError(path, f"unknown image extension '{suffix}', expected .png, .exr or .npz")
        shown = () if suffix == ".png" and layers is None else layers
        self._warn_of_nonfinite(path, LAYERS if shown is None or suffix == ".npz" else shown)

    def save_view(self, path: str | os.PathLike[str], view: str, limits: tuple[float, float] | None = None) -> None:
        """Writes a false-colour view of the frame as a PNG; arguments as for `view`.

        Raises:
            ConfigError: There is no view of this name, or the frame was rendered without the layer that the view needs.
            FormatError: The extension is not .png, or the file cannot be written.
        """
        if Path(path).suffix.lower() != ".png":
            raise FormatError(path, f"unknown extension '{Path(path).suffix}' for the view of a frame, expected .png")
        write_png(path, self.view(view, limits))
        self._warn_of_nonfinite(path, (self.NEEDS.get(view, ""),))

    @property
    def depth_range(self) -> tuple[float, float] | None:
        """Distances of the nearest and the farthest surface, scene units along the ray; None if there is no surface."""
        return depth_range(self.depth)

    def view(self, name: str, limits: tuple[float, float] | None = None) -> FloatArray:
        """Returns a false-colour image that explains the frame, display-referred, (H, W, 3), 0..1.

        Args:
            name: One of `VIEWS`. ``normal``: world-space normals mapped from -1..1, black without a hit. ``depth``: red
                (near) to blue (far), black without a surface. ``index``: a colour for each Gaussian and each mesh.
                ``shadow``: fraction of the direct light of all lights that arrives, from black (none) to white (all);
                blue where none would arrive without shadows either. ``hits``: Gaussians blended per ray, from violet
                over red to yellow on a logarithmic scale, black for none. ``transmittance``: visible fraction of the
                background, from violet (none) to yellow (all). ``direct_diffuse``, ``indirect_diffuse``,
                ``direct_glossy``, ``indirect_glossy`` and ``emission``: the image field of that name, exposed. In
                real-time frames, ``motion``: hue by direction in the image, red to the right, yellow-green up, paler
                where slower, black where unknown; ``history``: number of frames averaged into the direct light, from
                violet to yellow; ``probes``: screen probes over the frame in grey, by their number of updates, from
                violet over red to yellow on a logarithmic scale; ``cache``: radiance stored in the radiance cache,
                exposed; ``cache_cells``: a colour for each cell of the radiance cache, black where the surface has no
                cell.
            limits: Values at the ends of the colour map of ``depth``, ``hits``, ``motion``, ``history`` and ``probes``;
                None: ``view_limits(name)``.

        Raises:
            ConfigError: There is no view of this name, or the frame was rendered without the layer that the view needs,
                see `NEEDS`.
        """
        return view_picture(self, name, limits)

    def with_insets(
        self, views: Collection[str] | str, picture: npt.NDArray[np.uint8] | None = None
    ) -> npt.NDArray[np.uint8]:
        """Returns the frame's image with views drawn small, side by side, in its lower right corner.

        Args:
            views: Names from `VIEWS`, as a list or a comma-separated text.
            picture: sRGB image to draw on, shape (H, W, 3 or 4), of any size; None: that of the PNG.

        Raises:
            ConfigError: There is no view of one of the names, or the frame was rendered without the layer that it
                needs.
        """
        image = to_bytes(self._picture(), "a frame") if picture is None else picture
        return with_insets(image, self, view_names(views))

    def view_limits(self, name: str) -> tuple[float, float]:
        """Returns the default values at the two ends of a view's colour map. Compare frames with equal limits.

        Depth: the 1st and the 99th percentile of this frame's depths. ``hits``: 0 and 255 Gaussians; ``motion``: 0 and
        16 pixels; ``probes``: 0 and 64 updates; ``history``: 0 and the largest number of frames that the settings
        allow. Other views have no limits, and give 0 and 1.

        Raises:
            ConfigError: There is no view of this name.
        """
        return view_limits(self, name)

    def denoised(self) -> Frame:
        """Returns the frame with its light denoised by Open Image Denoise (extra ``denoise``).

        Captured radiance is not denoised, and pixels that show only captured radiance keep their exact values. Albedo
        and normals guide the denoiser if they are free of noise; ``RenderConfig.aovs`` must then contain ``albedo``.
        They are noisy with an aperture and, where Gaussians are visible, with a stochastic strategy or in the ``PATH``
        pipeline unless ``path.primary`` is ``ISO``. All images other than the light and the colour, including alpha,
        are unchanged.

        Returns:
            A new frame, to which no samples can be added; this frame itself if it is already denoised.

        Raises:
            ConfigError: The frame is unlit, or lacks the albedo as a guide.
            MissingExtraError: The denoiser is not installed; the message says how to install it.
        """
        if self.is_denoised:
            return self
        light = denoised_light(self)
        assert self.captured is not None and self.captured_weight is not None
        sums = np.maximum(captured_radiance(self.captured, self.captured_weight) + light, 0.0)
        changed = (light != self.light).any(axis=2, keepdims=True)
        return replace(self, light=light, color=np.where(changed, sums, self.color), is_denoised=True)

    @staticmethod
    def check_denoiser() -> None:
        """Checks that the denoiser is installed; call this before frames are rendered to be denoised.

        Raises:
            MissingExtraError: The denoiser is not installed.
        """
        check_denoiser()

    def pixels_srgb(self) -> FloatArray:
        """Returns sRGB pixels as in the PNG, 0..1, (H, W, 3), or (H, W, 4) with straight alpha without a background.

        An unlit frame is shown as trained. A lit frame is exposed by its camera's ``exposure`` and tone-mapped by its
        ``config``; pixels that show only captures equal the pixels of an unlit frame. Pixels that are not finite are
        black. Captures may be brighter than display white: this array is clipped, ``color`` is not.
        """
        frame, transparent = self._without_nonfinite(), self.background is None
        parts = frame._lit_parts()
        if parts is None:
            pixels = frame.straight() if transparent else frame.color
        else:
            captured, weight, light = (unpremultiplied(part, frame.alpha) for part in parts) if transparent else parts
            tone_map = self.config.tone_map if self.config else ToneMap.NONE
            pixels = lit_picture(captured, weight, light, self.camera.exposure, tone_map)
        pixels = np.concatenate([pixels, frame.alpha[..., None]], axis=2) if transparent else pixels
        return np.clip(pixels, 0.0, 1.0)

    def __array__(self, dtype: npt.DTypeLike | None = None, copy: bool | None = None) -> npt.NDArray[Any]:
        """Returns `pixels_srgb`, so that NumPy and libraries built on it accept a frame as an image.

        Args:
            dtype: Type of the array; None: float32, 0..1. ``uint8`` gives the bytes of the PNG.
            copy: False is refused, because the array is always new.

        Raises:
            ValueError: ``copy`` is False; NumPy's protocol requires this type of error.
        """
        if copy is False:
            raise ValueError("the image of a frame is computed, so that copy=False is impossible: use copy=None")
        if dtype is not None and np.dtype(dtype) == np.uint8:
            return to_bytes(self._picture(), "a frame")
        pixels = self.pixels_srgb()
        return pixels if dtype is None else pixels.astype(dtype)

    def _repr_mimebundle_(
        self, include: Collection[str] | None = None, exclude: Collection[str] | None = None
    ) -> MimeBundle:
        """Shows the frame in a notebook as an image and a line of text; only the text if the image cannot be made."""
        try:
            return mime_bundle(self._picture(), repr(self), include, exclude)
        except Exception as error:  # an exception would replace the cell's result by a traceback
            return {"text/plain": f"{self!r} (no image: {error})"}, {}

    def _repr_png_(self) -> bytes | None:
        """Returns a PNG for notebooks that ignore MIME bundles; None if the image becomes a JPEG or cannot be made."""
        try:
            pixels = self._picture()
            return encoded(pixels, "image/png") if mime_type(pixels) == "image/png" else None
        except Exception:
            return None

    def layers(self, names: Collection[str] | str | None = None) -> dict[str, Image]:
        """Returns EXR channels by name: linear ``R G B A``, and the channels of the chosen layers.

        Args:
            names: Names from `LAYERS`, as a list or a comma-separated text; None: all layers that the frame has.

        Raises:
            ConfigError: A name is not a layer, or the frame was rendered without it.
        """
        frame = self._without_nonfinite()
        linear = frame.premultiplied()
        if frame._lit_parts() is None:
            linear = decode_srgb(frame.straight()) * frame.alpha[..., None]
        channels: dict[str, Image] = {name: linear[..., i] for i, name in enumerate("RGB")} | {"A": frame.alpha}
        return channels | exr_channels(self, present_layers(self) if names is None else layer_names(names))

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Returns every image that the frame has, by its field name, and ``light_names`` if it has layers of lights."""
        present = [name for name in (*_LIT_PARTS, *RADIANCE, *COUNTS) if self.has(name)]
        arrays: dict[str, npt.NDArray[Any]] = {name: getattr(self, name) for name in (*EVERY_FRAME, *present)}
        return arrays | ({"light_names": np.array(self.light_names)} if self.light_names else {})

    def _picture(self) -> npt.NDArray[Any]:
        """Returns the frame's sRGB pixels: bytes if the device has encoded them, otherwise `pixels_srgb` as floats."""
        unread = self._fetches()
        fetch = unread.get(_PICTURE)
        picture = None if fetch is None else fetch()
        if picture is None:
            return self.pixels_srgb()
        unread[_PICTURE] = lambda: picture
        return picture

    def _fetches(self) -> dict[str, Callable[[], Any]]:
        """Returns the functions that fetch images not read yet, by field name; empty for a frame made from arrays."""
        try:
            return object.__getattribute__(self, "_unread")
        except AttributeError:
            return {}

    def _finite(self) -> npt.NDArray[np.bool_]:
        """Returns the mask of the pixels where all radiance is finite, shape (H, W)."""
        finite = np.isfinite(self.alpha)
        for radiance in (self.color, *(self._lit_parts() or ())):
            finite &= np.isfinite(radiance).reshape(*finite.shape, -1).all(axis=2)
        return finite

    def _without_nonfinite(self) -> Frame:
        """Returns the frame with black and alpha 0 at pixels whose radiance is not finite."""
        finite = self._finite()
        if finite.all():
            return self
        blackened: dict[str, Any] = {}
        for name in ("color", "alpha", *(() if self._lit_parts() is None else _LIT_PARTS)):
            values: FloatArray = getattr(self, name)
            blackened[name] = np.where(finite if values.ndim == 2 else finite[..., None], values, np.float32(0.0))
        return replace(self, **blackened)

    def _warn_of_nonfinite(self, path: str | os.PathLike[str], layers: Collection[str]) -> None:
        """Warns how many saved pixels are not finite, and how many samples the renderer left out for that reason."""
        encoded_finite = _PICTURE in self._fetches() and self._picture().dtype == np.uint8
        nonfinite = np.zeros(self.camera.image_size[::-1], bool) if encoded_finite else ~self._finite()
        fields = [name for name in RADIANCE if name in layers or ("lights" in layers and name.startswith("light_"))]
        for name in fields:
            values: FloatArray | None = getattr(self, name)
            if values is not None:
                per_light = values.reshape(-1, *nonfinite.shape, 1 if name in ("hits", "history") else 3)
                nonfinite |= ~np.isfinite(per_light).all(axis=(0, 3))
        if count := np.count_nonzero(nonfinite):
            stored_as = "stored as they are" if Path(path).suffix.lower() == ".npz" else "black"
            _log.warning("%s: %d pixels are not finite and are %s in the file", os.fspath(path), count, stored_as)
        if self.stats and self.stats.nonfinite_count:
            count = self.stats.nonfinite_count
            _log.warning(
                "%s: %d Gaussians or samples were left out, because a value was NaN or too large for float32",
                os.fspath(path),
                count,
            )
