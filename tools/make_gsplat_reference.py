"""Writes tests/reference/gsplat_*.npz: frames of gsplat, as an independent reference.

Projection, SH and opacity compensation run in gsplat itself, in the float32 PyTorch functions that its authors test
their CUDA kernels against (``gsplat/cuda/_torch_impl.py``). Its blending exists only as a CUDA kernel. So that no GPU
is needed, ``blend`` below restates it in NumPy from the constants and rules of version 1.5.3: an extent of 3.33
standard deviations or the opacity's own, whole tiles of 16 pixels, alpha of at least 1/255 and at most 0.999, and a
stop at a transmittance of 1e-4. It shares no code with Lumisplat or its float64 twin.

Needs its own environment::

    python3 -m venv reference && reference/bin/pip install torch==2.13.0 -e .
    reference/bin/pip install --no-deps gsplat==1.5.3
    reference/bin/python tools/make_gsplat_reference.py --data ../shared/data
"""

from __future__ import annotations

import argparse
import importlib.metadata
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch  # noqa: TID253  # pyright: ignore[reportMissingImports]
from gsplat.cuda._torch_impl import (  # pyright: ignore[reportMissingImports]
    _fully_fused_projection,
    _quat_scale_to_covar_preci,
    _spherical_harmonics,
)

from lumisplat.io import load
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY / "tests"))

from support.scenes import raster_scenes as scenes  # noqa: E402

NEAR, EPS2D, TILE = 0.01, 0.3, 16
ALPHA_THRESHOLD, ALPHA_LIMIT, TRANSMITTANCE_STOP, EXTENT_LIMIT = 1.0 / 255.0, 0.999, 1e-4, 3.33
STEPS = 4096
"""Quantisation: stored values are multiples of 1/4096, far finer than the comparison, and compress well."""


class Projected(NamedTuple):
    """Gaussians projected to the image plane, float32."""

    means2d: np.ndarray
    conics: np.ndarray
    colors: np.ndarray
    opacities: np.ndarray
    depths: np.ndarray


def project(gaussians: Gaussians, camera: Camera) -> Projected:
    """Projects and shades every Gaussian by gsplat's own functions."""
    means, quats, scales, opacities, sh = (
        torch.tensor(values)
        for values in (gaussians.means, gaussians.rotations_wxyz, gaussians.scales, gaussians.opacities, gaussians.sh)
    )
    view = torch.tensor(camera.camera_from_world, dtype=torch.float32)
    intrinsics = torch.tensor([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    covariances, _ = _quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    _, means2d, depths, conics, compensations = _fully_fused_projection(
        means, covariances, view[None], intrinsics[None], camera.width, camera.height, EPS2D, NEAR,
        calc_compensations=gaussians.antialiased,
    )  # fmt: skip
    if compensations is not None:
        opacities = opacities * compensations[0]
    directions = means - torch.linalg.inv(view)[:3, 3]
    colors = torch.clamp_min(_spherical_harmonics(gaussians.sh_degree, directions, sh) + 0.5, 0.0)
    return Projected(*(t.numpy() for t in (means2d[0], conics[0], colors, opacities, depths[0])))


def blend(projected: Projected, camera: Camera) -> np.ndarray:
    """Returns the image of gsplat's rasterize_to_pixels over black: red, green, blue, alpha, shape (H, W, 4)."""
    means2d, conics, colors, opacities, depths = projected
    determinant = conics[:, 0] * conics[:, 2] - conics[:, 1] ** 2
    visible = (depths >= NEAR) & (opacities >= ALPHA_THRESHOLD) & (determinant > 0.0)
    order = np.flatnonzero(visible)[np.argsort(depths[visible], kind="stable")]
    extent = np.minimum(EXTENT_LIMIT, np.sqrt(2.0 * np.log(np.maximum(opacities / ALPHA_THRESHOLD, 1.0))))
    variances = conics[:, [2, 0]] / np.maximum(determinant, 1e-30)[:, None]
    radii = np.ceil(extent[:, None] * np.sqrt(variances))

    image = np.zeros((camera.height, camera.width, 4), np.float32)
    transmittance = np.ones((camera.height, camera.width), np.float32)
    done = np.zeros((camera.height, camera.width), bool)
    size = np.array([camera.width, camera.height])
    low = (np.clip(np.floor((means2d - radii) / TILE), 0, 1 << 16) * TILE).clip(0, size).astype(int)
    high = (np.clip(np.ceil((means2d + radii) / TILE), 0, 1 << 16) * TILE).clip(0, size).astype(int)
    for i in order:
        at = slice(low[i, 1], high[i, 1]), slice(low[i, 0], high[i, 0])
        dx = means2d[i, 0] - (np.arange(low[i, 0], high[i, 0], dtype=np.float32) + 0.5)
        dy = means2d[i, 1] - (np.arange(low[i, 1], high[i, 1], dtype=np.float32) + 0.5)[:, None]
        sigma = 0.5 * (conics[i, 0] * dx * dx + conics[i, 2] * dy * dy) + conics[i, 1] * dx * dy
        alpha = np.minimum(ALPHA_LIMIT, opacities[i] * np.exp(-sigma))
        counts = (sigma >= 0.0) & (alpha >= ALPHA_THRESHOLD) & ~done[at]
        after = transmittance[at] * (1.0 - alpha)
        done[at] |= counts & (after <= TRANSMITTANCE_STOP)
        counts &= ~done[at]
        image[at][..., :3] += np.where(counts, alpha * transmittance[at], 0.0)[..., None] * colors[i]
        transmittance[at] = np.where(counts, after, transmittance[at])
    image[..., 3] = 1.0 - transmittance
    return image


def write(name: str, gaussians: Gaussians, camera: Camera) -> None:
    """Renders one reference, and stores it with its camera and the versions that made it."""
    image = blend(project(gaussians, camera), camera)
    path = REPOSITORY / "tests" / "reference" / f"gsplat_{name}.npz"
    np.savez_compressed(
        path,
        image=np.round(image * STEPS).clip(0, 65535).astype(np.uint16),
        steps=STEPS,
        intrinsics=[camera.fx, camera.fy, camera.cx, camera.cy],
        camera_from_world=camera.camera_from_world,
        made_with=f"gsplat {importlib.metadata.version('gsplat')}, torch {torch.__version__}",
    )
    print(f"{path.relative_to(REPOSITORY)}: {path.stat().st_size:,} bytes, mean alpha {image[..., 3].mean():.3f}")


def main() -> None:
    """Writes every reference; those of the capture only if its file exists."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=REPOSITORY.parent / "shared" / "data", help="folder with splats/")
    capture = parser.parse_args().data / "splats" / "biker.compressed.ply"

    for name, (gaussians, camera) in scenes.gsplat_frames().items():
        write(name, gaussians, camera)
    if not capture.exists():
        print(f"{capture} does not exist: its references are unchanged")
        return
    biker = load(capture)
    assert isinstance(biker, Gaussians)
    up = (0.0, -1.0, 0.0)
    for name, eye, target in (
        ("biker_front", (-1.9, -1.9, 0.6), (-0.06, -1.75, 0.0)),
        ("biker_close", (0.7, -2.7, -0.55), (-0.1, -2.45, 0.05)),
    ):
        write(name, biker, Camera.look_at(eye, target, up, width=320, height=180, fov_y=0.9))


if __name__ == "__main__":
    main()
