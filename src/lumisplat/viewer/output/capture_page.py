"""Captures as one HTML file: viser's own page with the Gaussians in it, which needs neither a server nor a network."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.viewer.frames.first_view import ASPECT, FirstView
from lumisplat.viewer.server.page_server import PageServer
from lumisplat.viewer.state.extent import Extent


def capture_page(scene: ls.Scene) -> str:
    """The captures of a scene as a page, unlit, each Gaussian in its mean colour: viser's page has no harmonics.

    Args:
        scene: With at least one capture; all else is left out.

    Raises:
        MissingExtraError: viser is not installed.
    """
    captures = ls.Scene(scene.splats, up=scene.up_direction)
    units = Extent.of(captures).page_from_scene
    server = PageServer("127.0.0.1", 0)  # nobody has its token
    try:
        api = server.viser.scene
        api.set_up_direction(captures.up_direction)
        view = FirstView.of(captures)
        camera = server.viser.initial_camera
        camera.fov, camera.up = view.fov_y, captures.up_direction
        camera.position, camera.look_at = view.at(ASPECT)
        for number, instance in enumerate(captures.splats):
            means, covariances = _world_gaussians(instance, units)
            gaussians = instance.gaussians
            api.add_gaussian_splats(
                f"/capture {number}",
                means,
                covariances,
                np.clip(_SH_C0 * gaussians.sh[:, 0] + 0.5, 0.0, 1.0),
                gaussians.opacities[:, None],
            )
        return api.as_html(dark_mode=True).replace("<title>Viser</title>", "<title>Lumisplat</title>", 1)
    finally:
        server.close()


_SH_C0 = 0.28209479177387814
"""Value of the constant spherical harmonic."""


def _world_gaussians(instance: ls.SplatInstance, units: float) -> tuple[npt.NDArray[np.float32], ...]:
    """Means, shape (N, 3), and covariances, shape (N, 3, 3), of an instance, in units of a page."""
    from viser import transforms

    matrix = units * instance.transform[:3, :4]
    gaussians = instance.gaussians
    axes = transforms.SO3(np.asarray(gaussians.rotations_wxyz, np.float64)).normalize().as_matrix()
    axes = matrix[:, :3] @ (axes * np.asarray(gaussians.scales, np.float64)[:, None, :])
    means = np.asarray(gaussians.means, np.float64) @ matrix[:, :3].T + matrix[:, 3]
    return means.astype(np.float32), (axes @ axes.transpose(0, 2, 1)).astype(np.float32)
