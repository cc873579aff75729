"""Gives true normals and true light to the search for materials, one after another (100 images, 200 x 200: 10 minutes).

``python -m bench.material_causes CAPTURE OBJECT LIGHT`` takes a capture, the object of `tools/make_published_set.py
--layout tensoir` on whose images it was trained, and the panorama of those images. It prints a JSON object for each of
four searches: with nothing true, with true normals, with the true environment, and with both. True normals of Gaussians
are those of the test views, blended as the Gaussians are.

``albedo_db_start`` and ``albedo_db_refined`` are the PSNR of albedo before and after the refinement, over the object's
pixels in the test views, with a gamma of 2.2, after one factor per channel. ``albedo_db_at_right_normals_`` counts only
pixels whose estimated normal is within 45 degrees of the truth. ``roughness`` is the mean of the result.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import lumisplat as ls
from bench.presets import load_capture
from bench.timing import parser, quiet_warp
from lumisplat.io.images.radiance import read_radiance
from lumisplat.math.arrays import Doubles, Flags, FloatArray
from lumisplat.math.color import albedo_in_range
from lumisplat.math.directions import panorama_lookup
from lumisplat.math.sh import even_directions
from lumisplat.metrics.materials import normal_errors
from lumisplat.relighting.evaluation import LayerRenderer
from lumisplat.relighting.irradiance import mean_outgoing
from lumisplat.relighting.published_sets import Z_UP, TestView, open_tensoir, unit_texels
from lumisplat.relighting.seen_normals import rendered_normals
from lumisplat.renderer.gradients.differentiable_renderer import DifferentiableRenderer
from lumisplat.training.lit_gaussians import Materials, traced_incident
from lumisplat.training.material_fit import MaterialFit, fit_environment, white_radiance
from lumisplat.training.views import TrainingView

UNLIT = ls.RenderConfig(pipeline=ls.Pipeline.RASTER, lighting=False)
RIGHT = 45.0
"""Error of a normal, degrees, up to which it counts as right."""
GAMMA = 2.2
SEEN_MIN = 0.05
"""Blending weight in all test views, pixels, from which a Gaussian has a true normal."""


def main() -> None:
    """Runs the four searches."""
    given = parser("material_causes", __doc__)
    given.add_argument("capture", type=Path, help="trained capture, .ply")
    given.add_argument("object", type=Path, help="folder with train_000 and test_000")
    given.add_argument("light", type=Path, help="panorama of the training images")
    given.add_argument("--steps", type=int, default=300, help="steps of the refinement")
    options = given.parse_args()
    quiet_warp()
    capture, tests = load_capture(options.capture), open_tensoir(options.object, None).views
    capture = replace(capture, albedo=None, roughness=None, normals=None, albedo_error=None, roughness_error=None)
    images = [TrainingView.of(image) for image in ls.io.load_training_images(options.object, hold_out=0).training]
    config = ls.config.MaterialsConfig(iterations=options.steps)
    differentiable = DifferentiableRenderer(UNLIT, options.device)
    found, weights, _ = rendered_normals(capture, [view.camera for view in images], differentiable, silent)
    normals = {False: found, True: true_normals(capture, tests, found, differentiable)}
    light = true_environment(options.light, even_directions(config.directions))
    truth = Truth(tests, options.device)
    truth.mark_right(replace(capture, normals=found.astype(np.float32)))
    for with_normals, with_light in ((False, False), (True, False), (False, True), (True, True)):
        search = Search(capture, images, weights, config, options.device)
        start, end = search.run(normals[with_normals], light if with_light else None)
        printed = {"true_normals": with_normals, "true_light": with_light}
        for name, materials in (("start", start), ("refined", end)):
            everywhere, at_right = truth.compare(capture, materials)
            printed |= {f"albedo_db_{name}": everywhere, f"albedo_db_at_right_normals_{name}": at_right}
        print(json.dumps(printed | {"roughness": round(float(np.average(end.roughness, weights=weights)), 3)}))


def silent(label: str, fraction: float) -> None:
    """Ignores progress."""


def true_normals(
    capture: ls.Gaussians, tests: tuple[TestView, ...], found: Doubles, renderer: DifferentiableRenderer
) -> Doubles:
    """Returns the true normals of N Gaussians, (N, 3); of those that no test view shows, the found ones."""
    sums, weights = np.zeros((capture.count, 3)), np.zeros(capture.count)
    for view in tests:
        frame = renderer.render(ls.Scene([capture]), view.camera)
        renderer.render_features(np.zeros((capture.count, 3), np.float32))
        texels = unit_texels(view.layers["normal"])
        shown = np.where(texels[..., 3:] > 0.99, 2.0 * texels[..., :3] - 1.0, 0.0)
        gradients = renderer.gradients(np.zeros_like(frame.color), dL_dfeatures=shown.astype(np.float32))
        assert gradients.features is not None
        sums += gradients.features
        weights += gradients.weights
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    is_known = (weights[:, None] > SEEN_MIN) & (length > 0.0)
    return np.where(is_known, sums / np.maximum(length, 1e-12), found)


def true_environment(path: Path, directions: Doubles) -> Doubles:
    """Returns the mean radiance of a panorama around each of K directions, (K, 3)."""
    rays = np.random.default_rng(0).normal(size=(400_000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    nearest = np.argmax(rays @ directions.T, axis=1)
    radiance = panorama_lookup(read_radiance(path), rays @ Z_UP)
    count = np.bincount(nearest, minlength=len(directions))
    return np.stack([np.bincount(nearest, radiance[:, c], len(directions)) / count for c in range(3)], axis=1)


@dataclass(frozen=True)
class Search:
    """The search of `lumisplat.inverse.find_materials` for a capture, to which truth can be given."""

    capture: ls.Gaussians
    images: list[TrainingView]
    weights: Doubles
    config: ls.config.MaterialsConfig
    device: str

    def run(self, normals: Doubles, light: Doubles | None) -> tuple[Materials, Materials]:
        """Returns the materials before and after the refinement."""
        config, directions = self.config, even_directions(self.config.directions)
        rays = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.TRACE, lighting=False), self.device)
        incident = traced_incident(self.capture, normals, directions, rays, seed=config.seed, report=silent)
        white, outgoing = incident.irradiance(normals), mean_outgoing(self.capture, normals)
        if light is None:
            rng = np.random.default_rng([config.seed, 8])
            steps = config.environment_steps
            light = fit_environment(outgoing, white, self.weights, directions, steps=steps, rng=rng, report=silent)
        albedo = albedo_in_range(outgoing / white_radiance(white, light))
        start = Materials(albedo, np.full(self.capture.count, config.roughness), normals, light)
        device = {"device": self.device, "threads": None, "progress": None}
        fit = MaterialFit(self.capture, self.images, incident, start, config, **device)
        while fit.iteration < config.iterations:
            fit.step()
        return start, fit.materials


class Truth:
    """Albedo and normals of the test views."""

    def __init__(self, tests: tuple[TestView, ...], device: str) -> None:
        self._tests, self._device = tests, device
        self._albedo = [unit_texels(view.layers["albedo"]) for view in tests]
        self._normals = [2.0 * unit_texels(view.layers["normal"])[..., :3] - 1.0 for view in tests]
        self._inside: list[Flags] = [texels[..., 3] > 0.99 for texels in self._albedo]
        self._right: list[Flags] = self._inside

    def mark_right(self, capture: ls.Gaussians) -> None:
        """Finds the pixels in which the normals of a capture are right."""
        white = replace(capture, albedo=np.ones((capture.count, 3), np.float32))
        layers = LayerRenderer.of(white, self._device)
        self._right = [
            inside & (normal_errors(layers.draw(view.camera)["normal"], normals) < RIGHT)
            for view, normals, inside in zip(self._tests, self._normals, self._inside, strict=True)
        ]

    def compare(self, capture: ls.Gaussians, materials: Materials) -> tuple[float, float]:
        """Returns the PSNR of albedo over all pixels of the object, and over those whose normals are right, dB."""
        given = replace(
            capture, albedo=materials.albedo.astype(np.float32), normals=materials.normals.astype(np.float32)
        )
        layers = LayerRenderer.of(given, self._device)
        shown = [layers.draw(view.camera)["albedo"] for view in self._tests]
        found, truth = (
            np.concatenate([image[..., :3][inside] for image, inside in zip(images, self._inside, strict=True)])
            for images in (shown, self._albedo)
        )
        right = np.concatenate([at[inside] for at, inside in zip(self._right, self._inside, strict=True)])
        scale = np.median(truth / np.maximum(found, 1e-6), axis=0)
        errors = encoded(found * scale) - encoded(truth)
        return decibels(errors), decibels(errors[right])


def encoded(linear: Doubles | FloatArray) -> Doubles | FloatArray:
    """Returns linear values, clipped to 0..1, with a gamma of 2.2."""
    return np.clip(linear, 0.0, 1.0) ** (1.0 / GAMMA)


def decibels(errors: Doubles | FloatArray) -> float:
    """Returns the PSNR of errors, rounded."""
    return round(-10.0 * float(np.log10(np.mean(np.square(errors)))), 2)


if __name__ == "__main__":
    main()
