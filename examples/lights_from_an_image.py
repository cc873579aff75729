"""Finds the lights of a known room from an image, and puts an object into it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

import lumisplat as ls


def matt(*color: float) -> ls.MaterialPbr:
    """Returns a matt material."""
    return ls.MaterialPbr(base_color=color, roughness=0.9)


def room() -> list[ls.MeshInstance]:
    """Returns a room that is open to the front, with a ball and a box."""
    white, red, green = matt(0.75, 0.73, 0.7), matt(0.6, 0.14, 0.1), matt(0.15, 0.5, 0.2)
    floor, side = ls.plane(4.0, 4.0, material=matt(0.6, 0.5, 0.4)), ls.plane(2.6, 4.0, material=white)
    return [
        ls.MeshInstance(floor),
        ls.MeshInstance(replace(floor, material=white), position=(0, 2.6, 0), rotation_degrees=(180, 0, 0)),
        ls.MeshInstance(ls.plane(4.0, 2.6, material=white), position=(0, 1.3, -2), rotation_degrees=(90, 0, 0)),
        ls.MeshInstance(replace(side, material=red), position=(-2, 1.3, 0), rotation_degrees=(0, 0, -90)),
        ls.MeshInstance(replace(side, material=green), position=(2, 1.3, 0), rotation_degrees=(0, 0, 90)),
        ls.MeshInstance(ls.sphere(0.55, material=matt(0.75, 0.5, 0.25)), position=(-0.9, 0.55, -0.7)),
        ls.MeshInstance(ls.box((0.8, 1.5, 0.8), material=matt(0.3, 0.45, 0.7)), position=(0.9, 0.75, -0.9)),
    ]


def rendered(scene: ls.Scene, camera: ls.Camera, samples: int) -> np.ndarray:
    """Returns a path-traced image as bytes."""
    frame = ls.render(scene, camera, ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=samples))
    return np.asarray(frame, np.uint8)


def main(width: int = 240, samples: int = 64, size: int = 64) -> None:
    """Writes out/lights_from_an_image.png: image, initial scene, fitted scene, and fitted scene with an object."""
    lights = [
        ls.LightPoint((-1.3, 2.2, 0.6), (1.0, 0.62, 0.3), 2.6, radius=0.06, name="warm"),
        ls.LightPoint((1.4, 1.2, 0.9), (0.35, 0.55, 1.0), 1.1, radius=0.06, name="cool"),
    ]
    environment = ls.LightEnvironment(color=(0.5, 0.6, 0.8), intensity=0.25, visible=False)
    truth = ls.Scene(meshes=room(), lights=[*lights, environment])
    camera = ls.Camera.look_at((0.2, 1.5, 4.6), (0, 1.15, 0), width=width, height=round(0.7 * width), fov_y=0.72)
    noise = np.random.default_rng(0).normal(0.0, 2.0, (camera.height, camera.width, 3))
    image = np.clip(rendered(truth, camera, samples) + noise, 0, 255).astype(np.uint8)

    # The positions of the lights are known; their brightness and the environment are not.
    initial = replace(truth, lights=[replace(light, color=(1, 1, 1), intensity=1.0) for light in lights])
    config = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=samples)
    fit = ls.fit_lights(initial, camera, image, environment_degree=1, size=size, config=config)
    for light, error in zip(fit.lights, fit.standard_errors, strict=True):
        print(light.name, np.round(np.multiply(light.color, light.intensity), 3), "+-", np.round(error, 3))
    print(*fit.remarks, sep="\n")

    ball = ls.MeshInstance(ls.sphere(0.35, material=matt(0.85, 0.85, 0.85)), position=(0.1, 0.35, 0.5))
    scenes = (initial, fit.scene, replace(fit.scene, meshes=(*fit.scene.meshes, ball)))
    pictures = [image, *(rendered(scene, camera, samples) for scene in scenes)]
    sheet = np.vstack([np.hstack(pictures[:2]), np.hstack(pictures[2:])])
    Path("out").mkdir(exist_ok=True)
    Image.fromarray(sheet).save("out/lights_from_an_image.png")


if __name__ == "__main__":
    main()
