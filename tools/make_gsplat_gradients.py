"""Writes tests/reference/gsplat_gradients.npz: gradients of frames for Gaussians, as an independent reference.

Projection, opacity compensation and SH are gsplat's own PyTorch functions (``gsplat/cuda/_torch_impl.py``), blending is
written in PyTorch below, and PyTorch differentiates everything, in double precision. The scene avoids all rules in
which gsplat and Lumisplat differ:

- gsplat 1.5.3 limits alpha to 0.999, we to 0.99: no opacity is above 0.9.
- Its CUDA kernels cut splats at 3.33 standard deviations. Both skip alpha below 1/255, and an opaque splat is below
  that at 3.33 standard deviations.
- Compensations below 0.005 are constant in our gradient, as in gsplat's since 1.5.3: none is that small.
- gsplat takes the eye from the inverse of the pose matrix, we from its transpose. They agree for rigid poses, but have
  different derivatives with respect to single elements. ``blend`` uses the transpose.

The scene covers rules that both share: means beyond 1.3 times the field of view, where the Jacobian is clamped, and
colour channels clamped at 0. No alpha is so close to 1/255 that float32 could decide otherwise, and no pixel stops.

Needs its own environment::

    python3 -m venv reference && reference/bin/pip install torch==2.13.0 -e .
    reference/bin/pip install --no-deps gsplat==1.5.3
    reference/bin/python tools/make_gsplat_gradients.py
"""

from __future__ import annotations

import importlib.metadata
from pathlib import Path

import numpy as np
import torch  # noqa: TID253  # pyright: ignore[reportMissingImports]
from gsplat.cuda._torch_impl import (  # pyright: ignore[reportMissingImports]
    _fully_fused_projection,
    _quat_scale_to_covar_preci,
    _spherical_harmonics,
)

from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians

PATH = Path(__file__).resolve().parents[1] / "tests" / "reference" / "gsplat_gradients.npz"
WIDTH, HEIGHT, COUNT, DEGREE = 44, 34, 48, 3
EPS2D, ALPHA_MIN, COMPENSATION_MIN, MARGIN = 0.3, 1.0 / 255.0, 0.005, 3e-6
PARAMETERS = ("means", "rotations_wxyz", "scales", "opacities", "sh", "camera_from_world", "background")


def scene(rng: np.random.Generator) -> tuple[Gaussians, Camera]:
    """Returns Gaussians of all shapes, the last six beside the image and reaching into it, and a camera."""
    means = rng.uniform(-1.0, 1.0, (COUNT, 3)) * (1.2, 0.9, 0.7)
    scales = np.exp(rng.uniform(-3.0, -1.2, (COUNT, 3)))
    means[-6:, 0] = np.where(np.arange(6) % 2, 2.4, -2.4)
    scales[-6:] = rng.uniform(0.5, 0.7, (6, 3))
    gaussians = Gaussians(
        means=means,
        rotations_wxyz=rng.normal(size=(COUNT, 4)),
        scales=scales,
        opacities=rng.uniform(0.1, 0.9, COUNT),
        sh=rng.normal(size=(COUNT, (DEGREE + 1) ** 2, 3)) * 0.3,
    )
    camera = Camera.look_at((0.3, -0.2, -3.0), (0.0, 0.0, 0.0), (0.1, -1.0, 0.0), width=WIDTH, height=HEIGHT, fov_y=0.8)
    return gaussians, camera


def blend(values: dict[str, torch.Tensor], camera: Camera, *, antialiased: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the colour over the background, (H, W, 3), and alpha, (H, W)."""
    view = values["camera_from_world"]
    intrinsics = view.new_tensor([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    covariances, _ = _quat_scale_to_covar_preci(values["rotations_wxyz"], values["scales"], compute_preci=False)
    _, means2d, depths, conics, compensations = _fully_fused_projection(
        values["means"], covariances, view[None], intrinsics[None], WIDTH, HEIGHT, EPS2D,
        calc_compensations=antialiased,
    )  # fmt: skip
    opacities = values["opacities"]
    if antialiased:
        assert compensations.min() > COMPENSATION_MIN
        opacities = opacities * compensations[0]
    eye = -view[:3, :3].T @ view[:3, 3]
    colors = torch.clamp_min(_spherical_harmonics(DEGREE, values["means"] - eye, values["sh"]) + 0.5, 0.0)
    assert (colors == 0.0).any(), "no channel is cut off"
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    image, transmittance = torch.zeros((HEIGHT, WIDTH, 3)).to(view), torch.ones((HEIGHT, WIDTH)).to(view)
    for i in torch.argsort(depths[0].detach()).tolist():
        dx, dy = means2d[0, i, 0] - x, means2d[0, i, 1] - y
        a, b, c = conics[0, i]
        alpha = opacities[i] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
        assert (alpha / ALPHA_MIN - 1.0).abs().min() > MARGIN, "float32 may decide otherwise: take another seed"
        alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0.0)
        image = image + (transmittance * alpha)[..., None] * colors[i]
        transmittance = transmittance * (1.0 - alpha)
    assert transmittance.min() > 2e-4, "a pixel might stop"
    return image + transmittance[..., None] * values["background"], 1.0 - transmittance


def main() -> None:
    """Differentiates a random linear function of both frames, and stores all."""
    rng = np.random.default_rng(9)
    gaussians, camera = scene(rng)
    by_color = rng.normal(size=(HEIGHT, WIDTH, 3)).astype(np.float32)
    by_alpha = rng.normal(size=(HEIGHT, WIDTH)).astype(np.float32)
    inputs = {name: getattr(gaussians, name) for name in PARAMETERS[:5]}
    inputs |= {"camera_from_world": camera.camera_from_world, "background": np.array([0.3, 0.5, 0.2])}
    stored = {**inputs, "by_color": by_color, "by_alpha": by_alpha}
    for name in ("classic", "antialiased"):
        values = {key: torch.tensor(value, dtype=torch.float64, requires_grad=True) for key, value in inputs.items()}
        color, alpha = blend(values, camera, antialiased=name == "antialiased")
        total = (color * torch.tensor(by_color)).sum() + (alpha * torch.tensor(by_alpha)).sum()
        total.backward()
        stored[f"{name}_value"] = total.detach().numpy()
        stored |= {f"{name}_{key}": value.grad.numpy().astype(np.float32) for key, value in values.items()}
        print(f"{name}: {stored[f'{name}_value']:.4f}, mean alpha {alpha.detach().mean():.3f}")
    made_with = f"gsplat {importlib.metadata.version('gsplat')}, torch {torch.__version__}"
    intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy]
    np.savez_compressed(PATH, **stored, intrinsics=intrinsics, made_with=made_with)
    print(f"{PATH.name}: {PATH.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
