"""What `estimate_materials` has found, and how sure it is."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat.constants.delight import RESIDUAL_LARGE, SKY_IMAGE_ROWS, SURE, TOO_LIGHT
from lumisplat.io.images.radiance import write_radiance
from lumisplat.math.arrays import Doubles, Flags, FloatArray, Rows
from lumisplat.math.directions import panorama_directions
from lumisplat.math.transforms import rotation_matrix
from lumisplat.relighting.delight.sky_cells import SkyCells
from lumisplat.scene.gaussians import Gaussians


@dataclass(frozen=True, slots=True, eq=False)
class MaterialEstimate:
    """Materials of a capture of N Gaussians, and the light in which it was taken."""

    gaussians: Gaussians
    """The capture, Gaussian by Gaussian, with ``albedo`` (linear), ``roughness`` and ``normals``."""
    cells: SkyCells
    """Of the sky, K of them; none if the capture was taken from inside of it."""
    sky: Doubles
    """Radiance of each, linear, in units of display white, shape (K, 3)."""
    lamps: Doubles
    """Radiances of groups of Gaussians that were as bright as could be captured, likewise, shape (L, 3)."""
    lamp_of: Rows
    """The group of each Gaussian, -1: none, shape (N,)."""
    residual: FloatArray
    """What materials and light leave unexplained of each Gaussian's captured radiance, as a share of it, 0.., (N,)."""
    confidence: FloatArray
    """How much of the light at a Gaussian was seen in the capture rather than found, 0..1, shape (N,)."""
    sureness: FloatArray
    """By how much highlights narrow down the roughness of each Gaussian, 0..1, shape (N,). At 0 it is 0.8, which is not
    found but taken: nothing tells, as in a capture whose colours do not change with the direction of view."""
    is_inside: bool
    """Whether the capture was taken from inside of it, as that of a room is."""
    out_of_range: Flags
    """Gaussians whose albedo would be above 1 in a channel: more light reached them than was found. They are darkened
    in all channels by one factor, to 1 in the lightest, so that they keep their hue; shape (N,)."""
    is_white: Flags
    """Gaussians, but for lamps, that may have been brighter than could be captured: their albedo is a guess; (N,)."""
    is_too_dark: Flags
    """Gaussians that are darker in a channel than what a surface as they have mirrors: relit, they come out lighter
    there, and saturated colours paler; shape (N,)."""

    def sky_image(self, rotation_wxyz: npt.ArrayLike = (1.0, 0.0, 0.0, 0.0)) -> FloatArray:
        """The sky as a latitude-longitude image for `LightEnvironment`, shape (H, 2 H, 3); black if there is none.

        Args:
            rotation_wxyz: World from image, such as ``scene.upright_wxyz``; a `LightEnvironment` that is turned by it
                shines as the sky did.
        """
        directions = panorama_directions(SKY_IMAGE_ROWS, 2 * SKY_IMAGE_ROWS) @ rotation_matrix(rotation_wxyz).T
        if not len(self.cells):
            return np.zeros(directions.shape, np.float32)
        cosines = directions @ self.cells.directions.T
        within = np.cos(np.sqrt(self.cells.solid_angles / np.pi))
        # The cell in whose disc a direction lies deepest; cells of all sizes count by their own.
        nearest = np.argmax((cosines - 1.0) / (1.0 - within), axis=-1)
        return self.sky[nearest].astype(np.float32)

    def save_sky(self, path: str | os.PathLike[str], rotation_wxyz: npt.ArrayLike = (1.0, 0.0, 0.0, 0.0)) -> None:
        """Writes `sky_image` as an EXR.

        Args:
            path: File to write, .exr.
            rotation_wxyz: As for `sky_image`.

        Raises:
            FormatError: The file cannot be written.
        """
        write_radiance(path, self.sky_image(rotation_wxyz))

    @property
    def remarks(self) -> tuple[str, ...]:
        """What to know about the result, a sentence each."""
        shown = float(self.confidence.mean())
        lines = [
            "a closed room, for much of it sees no sky (if not: --inside no, inside=False): light is what it shows"
            if self.is_inside
            else f"open: {1.0 - shown:.0%} of the light comes from where the capture shows nothing, and is found as a "
            "sky, whose brightness is a guess (a closed room: --inside yes, inside=True)"
        ]
        if len(self.lamps):
            brightness = ", ".join(f"{lamp.mean():.3g}" for lamp in self.lamps)
            lines.append(f"lamps, times as bright as display white: {brightness}")
        if self.sureness.any():
            share = float((self.sureness > SURE).mean())
            lines.append(
                f"views from all sides tell the roughness of {share:.0%} of the Gaussians; else it is nearer to 0.8"
            )
        else:
            lines.append("roughness is 0.8 everywhere: colours do not change with the view, or lamps are in it")
        if (share := float(self.out_of_range.mean())) > TOO_LIGHT:
            lines.append(
                f"{share:.1%} of the Gaussians would reflect more than all light: albedo ends at 1, in the same hue"
            )
        if (share := float(self.is_white.mean())) > TOO_LIGHT:
            lines.append(f"{share:.1%} of the Gaussians are as bright as display white: their albedo is a guess")
        if (share := float(self.is_too_dark.mean())) > TOO_LIGHT:
            lines.append(
                f"{share:.1%} of the Gaussians are darker, in a channel at least, than what they would mirror, and "
                "come out lighter and paler: --matt, or matt=True, is for what mirrors nothing"
            )
        if (share := float((self.residual > RESIDUAL_LARGE).mean())) > TOO_LIGHT:
            lines.append(f"the captured colour of {share:.1%} of the Gaussians is not explained")
        return tuple(lines)
