"""`fit_lights` refuses inputs that it cannot fit, in one line with advice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from support.scenes.fit_rooms import DIRECT, closed, three_lights, view

GREY = np.full((72, 96, 3), 0.5)


def refusal(*images, scene: ls.Scene | None = None, cameras=None, **options) -> str:
    """Returns the error message of a refused fit, and asserts that it is one line."""
    options = {"config": DIRECT, "device": "cpu", "environment_degree": None} | options
    given = list(images) if len(images) != 1 else images[0]
    with pytest.raises((ls.ConfigError, ls.SceneError)) as caught:
        ls.fit_lights(scene or closed(*three_lights()), cameras or view(), given, **options)
    message = str(caught.value)
    assert "\n" not in message and len(message) < 300
    return message


def test_light_fit_refuses_images_that_do_not_match_their_cameras():
    """Images of another aspect ratio, number or shape are refused."""
    assert "the image is 96 x 96, but its camera" in refusal(np.full((96, 96, 3), 0.5))
    assert "1 cameras and 2 images" in refusal(GREY, GREY)
    assert "2 cameras and 1 images" in refusal(GREY, cameras=[view(), view()])
    assert "expected (H, W, 3)" in refusal(np.full((72, 96), 0.5))
    assert "expected (H, W, 3)" in refusal(np.full((72, 96, 4), 0.5))


def test_light_fit_accepts_images_of_another_size_but_equal_aspect_ratio():
    """An image may be larger or smaller than its camera."""
    for width in (48, 192):
        fit = ls.fit_lights(
            closed(*three_lights()),
            view(width, width * 3 // 4),
            GREY,
            config=DIRECT,
            device="cpu",
            environment_degree=None,
        )
        assert fit.views[0].image.shape == (72, 96, 3)


def test_light_fit_refuses_images_without_usable_pixels():
    """Images that are black, white, masked or not finite are refused."""
    assert "is black" in refusal(np.zeros((72, 96, 3)))
    assert "every pixel is clipped" in refusal(np.ones((72, 96, 3)))
    assert "clipped or masked" in refusal(GREY, masks=np.zeros((72, 96)))
    assert "the mask of the image has shape (10, 10)" in refusal(GREY, masks=np.ones((10, 10)))
    holes = GREY.copy()
    holes[3, 4:7] = np.nan
    assert "has 3 pixels that are NaN" in refusal(holes)


def test_light_fit_refuses_scenes_without_anything_to_fit():
    """Scenes without enabled lights, without visible surfaces, or without requested parameters are refused."""
    assert "no lights to fit" in refusal(GREY, scene=closed())
    off = [replace(light, enabled=False) for light in three_lights()]
    assert "no lights to fit" in refusal(GREY, scene=closed(*off))
    assert "nothing to fit" in refusal(GREY, intensities=False)
    away = ls.Camera.look_at((2, 1.5, -9), (2, 1.5, -20), width=96, height=72)
    assert "no pixel of the images can be fitted" in refusal(GREY, cameras=away)
    assert "no pixel of the images can be fitted" in refusal(GREY, cameras=away, positions=True)
    assert "empty" in refusal(GREY, scene=ls.Scene(lights=three_lights()))


def test_error_for_a_light_fit_setting_out_of_range_names_the_setting():
    """Each message names the setting."""
    assert "environment_degree" in refusal(GREY, environment_degree=5)
    assert "positions is 1" in refusal(GREY, positions=1)
    assert "exposure is 'bright'" in refusal(GREY, exposure="bright")
    assert "exposure is [0, 1]" in refusal(GREY, exposure=[0, 1])
    assert "tone_map is 'film'" in refusal(GREY, tone_map="film")
    assert "size is 8" in refusal(GREY, size=8)
    assert "REALTIME" in refusal(GREY, config=ls.RenderConfig(pipeline=ls.Pipeline.REALTIME))
    assert "base_colors names the material 'wood'" in refusal(GREY, base_colors=["wood"])
    assert "base_colors is 'wood'" in refusal(GREY, base_colors="wood")


def test_error_for_an_unreadable_image_of_a_light_fit_names_the_file(tmp_path):
    """Each message names the file."""
    assert "photo.png" in refusal(tmp_path / "photo.png")
    (tmp_path / "text.png").write_text("no picture")
    assert "text.png" in refusal(tmp_path / "text.png")
