"""``lumisplat info``: what is in a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.console import byte_size, print_table, progress_bars
from lumisplat.cli.options import Command, Flag, size_on_disk
from lumisplat.cli.outputs import file_stems

if TYPE_CHECKING:
    import numpy.typing as npt

_BAR = 24
"""Length of the longest histogram bar, characters."""

Rows = list[tuple[str, str]]


@dataclass(frozen=True, kw_only=True)
class Info(Command):
    """Show what is in captures, meshes, scenes and camera files."""

    files: Positional[Annotated[tuple[Path, ...], arg(metavar="FILE...", help_behavior_hint="")]] = ()
    """Any file that render takes, cameras too."""
    drop_invalid: Flag = False
    """Leave out Gaussians with NaN or infinite values instead of refusing the file."""

    def run(self) -> None:
        """Prints a table for each asset."""
        if not self.files:
            raise ls.ConfigError("no file given")
        for path in self.files:
            if path.suffix.lower() == ".json" and path.name != "meta.json":
                print_table(str(path), _camera_rows(ls.load_cameras(path)))
                continue
            with progress_bars() as report:
                asset = ls.load(path, drop_invalid=self.drop_invalid, progress=partial(report, f"loading {path.name}"))
            size = ("file", byte_size(size_on_disk(path)))
            if isinstance(asset, ls.Gaussians):
                print_table(str(path), [("kind", "capture"), size, *_gaussian_rows(asset)])
            elif isinstance(asset, ls.Mesh):
                print_table(str(path), [("kind", "mesh"), size, *_mesh_rows(asset)])
            else:
                _print_scene(path, size, asset)


def _print_scene(path: Path, size: tuple[str, str], scene: ls.Scene) -> None:
    counts = ("holds", f"{len(scene.splats)} captures, {len(scene.meshes)} meshes")
    low, high = scene.bounds()
    print_table(str(path), [("kind", "scene"), size, counts, ("bounds", _box(low, high))])
    for index, splat in enumerate(scene.splats):
        print_table(f"  capture {index}   {splat.name}", _gaussian_rows(splat.gaussians))
    for index, mesh in enumerate(scene.meshes):
        names = dict.fromkeys(name for name in (mesh.name, mesh.mesh.name, mesh.mesh.material.name) if name)
        print_table(f"  mesh {index}   {' / '.join(names)}", _mesh_rows(mesh.mesh))


def _gaussian_rows(gaussians: ls.Gaussians) -> Rows:
    import numpy as np

    arrays = gaussians.arrays()
    percentiles = np.percentile(gaussians.scales, (1, 50, 99))
    rows = [
        ("Gaussians", f"{gaussians.count:,}"),
        ("SH degree", f"{gaussians.sh_degree}"),
        ("bounds", _box(*gaussians.bounds())),
        (
            "scale",
            "1 % {:.4g}   median {:.4g}   99 % {:.4g}   largest {:.4g}".format(*percentiles, gaussians.scales.max()),
        ),
        ("opacity", _histogram(gaussians.opacities)),
        ("memory", byte_size(sum(array.nbytes for array in arrays.values()))),
        ("antialiased", "yes (Mip-Splatting)" if gaussians.antialiased else "no"),
    ]
    if gaussians.kernel_degree != 2:  # all but a few captures
        rows.append(("kernel degree", f"{gaussians.kernel_degree}"))
    extras = [name for name in ("normals", "albedo", "roughness", "metallic") if name in arrays]
    if extras:
        rows.append(("also has", ", ".join(extras)))
    rows += [("comment", comment) for comment in gaussians.comments]
    return rows


def _mesh_rows(mesh: ls.Mesh) -> Rows:
    material = mesh.material
    texture = material.base_color_texture
    has = [name for name in ("normals", "uvs", "colors") if getattr(mesh, name) is not None]
    rows = [
        ("vertices", f"{mesh.vertex_count:,}"),
        ("faces", f"{mesh.face_count:,}"),
        ("bounds", _box(*mesh.bounds())),
        ("has", ", ".join(has) or "positions only"),
        ("material", "{} base colour {:.3g} {:.3g} {:.3g}".format(material.name or "unnamed", *material.base_color)),
        ("surface", _surface(material)),
    ]
    if texture is not None:
        rows.append(("texture", f"{texture.shape[1]} x {texture.shape[0]}"))
    return rows


def _surface(material: ls.MaterialPbr | ls.MaterialSimple) -> str:
    if isinstance(material, ls.MaterialPbr):
        names = ("metallic", "roughness", "specular", "ior", "transmission")
        return "   ".join(f"{name} {getattr(material, name):.3g}" for name in names)
    factors = "   ".join(
        "{} {:.3g} {:.3g} {:.3g}".format(name, *getattr(material, name))
        for name in ("emissive", "ambient", "diffuse", "specular")
    )
    return f"{factors}   shininess {material.shininess:.3g}"


def _camera_rows(cameras: Sequence[ls.Camera]) -> Rows:
    import numpy as np

    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    eyes = np.array([camera.eye for camera in cameras])
    names = file_stems([camera.name for camera in cameras])
    return [
        ("kind", "cameras"),
        ("frames", f"{len(cameras):,}"),
        (
            "sizes",
            ", ".join(f"{width} x {height}" for width, height in sizes[:4]) + (", ..." if len(sizes) > 4 else ""),
        ),
        ("positions", _box(eyes.min(axis=0), eyes.max(axis=0))),
        ("names", ", ".join(names[:4]) + (", ..." if len(names) > 4 else "")),
    ]


def _box(low: npt.NDArray, high: npt.NDArray) -> str:
    return "({:.4g}, {:.4g}, {:.4g}) to ({:.4g}, {:.4g}, {:.4g})".format(*low, *high)


def _histogram(opacities: npt.NDArray) -> str:
    import numpy as np

    counts, edges = np.histogram(opacities, bins=10, range=(0.0, 1.0))
    bars = ["━" * round(_BAR * count / counts.max()) for count in counts]
    return "\n".join(
        f"{low:.1f} {bar:<{_BAR}} {count:,}" for low, bar, count in zip(edges[:-1], bars, counts, strict=True)
    )
