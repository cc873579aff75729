"""Finds the light of a photograph of a known scene, and puts an object into it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

import lumisplat as ls


def taken(scene: ls.Scene, camera: ls.Camera, samples: int) -> np.ndarray:
    """A picture of light that bounces, as bytes."""
    frame = ls.render(scene, camera, ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=samples))
    return np.asarray(frame, np.uint8)


def main(width: int = 320, samples: int = 64, size: int = 96, degree: int = 2) -> None:
    """Writes out/lights_of_a_photograph.png: photograph, scene as it was thought to be, as fitted, with an object."""
    truth = ls.demo_scene_lit(ls.demo_scene())
    camera = ls.demo_cameras(width, round(0.5625 * width), 1)[0]
    grain = np.random.default_rng(0).normal(0.0, 2.0, (camera.height, camera.width, 3))
    photograph = np.clip(taken(truth, camera, samples) + grain, 0, 255).astype(np.uint8)

    # Where the lamps stand is known, how bright they are and what sky is outside is not.
    lamps = [replace(light, color=(1, 1, 1), intensity=2.0) for light in truth.lights[:2]]
    thought = replace(truth, lights=lamps)
    config = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=samples)
    fit = ls.fit_lights(thought, camera, photograph, environment_degree=degree, size=size, config=config)
    for light, error in zip(fit.lights, fit.standard_errors, strict=True):
        print(light.name, np.round(np.multiply(light.color, light.intensity), 3), "+-", np.round(error, 3))
    print(*fit.remarks, sep="\n")

    clay = ls.MaterialPbr(base_color=(0.85, 0.82, 0.78), roughness=0.6)
    ball = ls.MeshInstance(ls.sphere(0.17, material=clay), position=(-0.28, 0.17, 0.55))
    scenes = (thought, fit.scene, replace(fit.scene, meshes=(*fit.scene.meshes, ball)))
    pictures = [photograph, *(taken(scene, camera, samples) for scene in scenes)]
    sheet = np.vstack([np.hstack(pictures[:2]), np.hstack(pictures[2:])])
    Path("out").mkdir(exist_ok=True)
    Image.fromarray(sheet).save("out/lights_of_a_photograph.png")


if __name__ == "__main__":
    main()
