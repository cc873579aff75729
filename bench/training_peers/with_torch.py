"""A trainer of 3D Gaussians in PyTorch alone, as people write who have no GPU: autograd differentiates all of it.

Projection and spherical harmonics are gsplat's functions in PyTorch; each pixel blends all Gaussians. The loss, the
rates and the start are those of Kerbl et al. 2023; the number of Gaussians stays.
"""

from __future__ import annotations

import numpy as np
import torch  # noqa: TID253  # pyright: ignore[reportMissingImports]
from gsplat.cuda._torch_impl import (  # pyright: ignore[reportMissingImports]
    _fully_fused_projection,
    _quat_scale_to_covar_preci,
    _spherical_harmonics,
)

from bench.training_peers.task import Floats, Task, Trained, nearest_distances, run_peer

SH_C0, DEGREE, EPS2D, ALPHA_MIN, ALPHA_MAX, SSIM_SHARE = 0.2820947917738781, 1, 0.3, 1.0 / 255.0, 0.99, 0.2
RATES = {"means": 1.6e-4, "rotations": 1e-3, "log_scales": 5e-3, "logits": 5e-2, "sh": 2.5e-3, "sh_rest": 1.25e-4}


def train(task: Task, trained: Trained) -> Floats:
    """Learns until the time is over, and shows the views."""
    torch.manual_seed(0)
    parameters = first_parameters(task)
    rates = RATES | {"means": RATES["means"] * float(task.extent)}
    groups = [{"params": [value], "lr": rates[name], "name": name} for name, value in parameters.items()]
    optimizer = torch.optim.Adam(groups, eps=1e-15)
    photographs, weights = torch.tensor(task.photographs), torch.tensor(task.weights)[..., None]
    order: list[int] = []
    while (done := trained.done) < 1.0:
        order = order or torch.randperm(len(photographs)).tolist()
        number = order.pop()
        image = frame(parameters, task.poses[number], task.intrinsics[number], task.size)
        seen, wanted = image * weights[number], photographs[number] * weights[number]
        loss = (1.0 - SSIM_SHARE) * (seen - wanted).abs().mean() + SSIM_SHARE * (1.0 - ssim(seen, wanted))
        optimizer.zero_grad()
        loss.backward()
        optimizer.param_groups[0]["lr"] = rates["means"] * 0.01**done
        optimizer.step()
        trained.steps += 1
    with torch.no_grad():
        views = zip(task.shown_poses, task.shown_intrinsics, strict=True)
        return np.stack([frame(parameters, *view, task.size).numpy() for view in views])


def first_parameters(task: Task) -> dict[str, torch.Tensor]:
    """Round Gaussians as wide as their neighbours are away, an opacity of 0.1."""
    count, terms = len(task.points), (DEGREE + 1) ** 2
    rotations = np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (count, 1))
    values = {
        "means": task.points,
        "rotations": rotations,
        "log_scales": np.log(np.repeat(nearest_distances(task.points)[:, None], 3, axis=1)),
        "logits": np.full(count, np.log(0.1 / 0.9), np.float32),
        "sh": ((task.colors - 0.5) / SH_C0)[:, None],
        "sh_rest": np.zeros((count, terms - 1, 3), np.float32),
    }
    return {name: torch.tensor(value, requires_grad=True) for name, value in values.items()}


def frame(values: dict[str, torch.Tensor], pose: Floats, intrinsics: Floats, size: tuple[int, int]) -> torch.Tensor:
    """The colours of all pixels over black, (H, W, 3)."""
    width, height = size
    view = torch.tensor(pose)
    fx, fy, cx, cy = intrinsics.tolist()
    matrix = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    covariances, _ = _quat_scale_to_covar_preci(
        torch.nn.functional.normalize(values["rotations"], dim=1), values["log_scales"].exp(), compute_preci=False
    )
    radii, means, depths, conics, _ = _fully_fused_projection(
        values["means"], covariances, view[None], matrix[None], width, height, EPS2D
    )
    drawn = torch.nonzero((radii[0] > 0).reshape(len(depths[0]), -1).all(dim=1))[:, 0]
    drawn = drawn[torch.argsort(depths[0, drawn].detach())]
    eye = -view[:3, :3].T @ view[:3, 3]
    harmonics = torch.cat([values["sh"], values["sh_rest"]], dim=1)[drawn]
    colors = torch.clamp_min(_spherical_harmonics(DEGREE, values["means"][drawn] - eye, harmonics) + 0.5, 0.0)
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    dx, dy = (places.reshape(-1, 1) - means[0, drawn, axis] for axis, places in ((0, x), (1, y)))
    a, b, c = conics[0, drawn].unbind(dim=1)
    power = -0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy
    alpha = torch.clamp_max(torch.sigmoid(values["logits"][drawn]) * power.exp(), ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0.0)
    before = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1.0 - alpha[:, :-1]], dim=1), dim=1)
    return ((alpha * before) @ colors).reshape(height, width, 3)


def ssim(image: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """Mean structural similarity, 11 taps, sigma 1.5, borders reflected."""
    taps = torch.exp(-0.5 * (torch.arange(-5.0, 6.0) / 1.5) ** 2)
    window = torch.outer(taps, taps) / taps.sum() ** 2
    window = window.expand(3, 1, 11, 11)
    a, b = (values.permute(2, 0, 1)[None] for values in (image, other))

    def blurred(values: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.conv2d(
            torch.nn.functional.pad(values, (5, 5, 5, 5), mode="reflect"), window, groups=3
        )

    mean_a, mean_b = blurred(a), blurred(b)
    var_a, var_b, both = blurred(a * a) - mean_a**2, blurred(b * b) - mean_b**2, blurred(a * b) - mean_a * mean_b
    top = (2.0 * mean_a * mean_b + 1e-4) * (2.0 * both + 9e-4)
    return (top / ((mean_a**2 + mean_b**2 + 1e-4) * (var_a + var_b + 9e-4))).mean()


if __name__ == "__main__":
    run_peer(train)
