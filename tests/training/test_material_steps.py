"""Single steps of the material fit follow the gradients and the smoothness terms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.math.sh import even_directions
from lumisplat.training.lit_gaussians import IncidentRadiance, Materials
from lumisplat.training.material_fit import MaterialFit
from lumisplat.training.views import TrainingView
from support.scenes.lit_sphere import ball, matte, write_training_images

COUNT, DIRECTIONS = 60, 12
SHAPES = {"albedo": (COUNT, 3), "roughness": (COUNT,), "environment": (DIRECTIONS, 3)}


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a folder with two images of a grey ball."""
    folder = tmp_path_factory.mktemp("set")
    return write_training_images(folder, matte(ball(COUNT), np.full(3, 0.5), np.ones_like), count=2, size=8)


@pytest.fixture
def fit(images: Path) -> MaterialFit:
    """Returns a material fit of the ball, with constant initial albedo, roughness and environment."""
    capture, directions = matte(ball(COUNT), np.full(3, 0.5), np.ones_like), even_directions(DIRECTIONS)
    light = np.ones((COUNT, DIRECTIONS), np.float32), np.zeros((COUNT, DIRECTIONS, 3), np.float32)
    normals = capture.means / np.linalg.norm(capture.means, axis=1, keepdims=True)
    start = Materials(np.full((COUNT, 3), 0.5), np.full(COUNT, 0.5), normals.astype(np.float64), np.ones((12, 3)))
    views = [TrainingView.of(one) for one in ls.io.load_training_images(images).training]
    config, incident = ls.config.MaterialsConfig(iterations=10), IncidentRadiance(directions, *light)
    return MaterialFit(capture, views, incident, start, config, device="cpu", threads=1, progress=None)


def moved(fit: MaterialFit, **gradient: np.ndarray) -> Materials:
    """Returns the materials after a step with the given gradients; all other gradients are 0."""
    given = {name: np.zeros(shape) for name, shape in SHAPES.items()} | gradient
    fit._update(Materials(normals=np.zeros((COUNT, 3)), **given))  # pyright: ignore[reportPrivateUsage]
    return fit.materials


@pytest.mark.parametrize("name", SHAPES)
def test_material_fit_moves_parameters_against_their_gradients(fit: MaterialFit, name: str) -> None:
    """Only parameters with a gradient move."""
    sign = np.where(np.random.default_rng(0).random(SHAPES[name]) < 0.5, -1.0, 1.0)
    before = fit.materials
    after = moved(fit, **{name: sign})
    assert (np.sign(getattr(before, name) - getattr(after, name)) == sign).all()
    for other in set(SHAPES) - {name}:
        np.testing.assert_allclose(getattr(after, other), getattr(before, other), atol=1e-12)


@pytest.mark.parametrize("name", SHAPES)
def test_smoothness_terms_of_the_material_fit_pull_neighbours_together(fit: MaterialFit, name: str) -> None:
    """An outlier moves back towards its neighbours, and some of the neighbours move towards the outlier."""
    state = {key: values.copy() for key, values in fit.state.items()}
    state["sky" if name == "environment" else name][3] += 1.0
    fit.restore(state, 0)
    before, after = getattr(fit.materials, name), getattr(moved(fit), name)
    assert (after[3] < before[3]).all()
    others = np.delete(after - before, 3, axis=0)
    assert others.min() >= -1e-12 and others.max() > 1e-4
