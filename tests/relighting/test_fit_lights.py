"""`fit_lights` recovers intensities, colours and SH environments of rendered images with known lights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.math.directions import panorama_directions
from lumisplat.relighting.probe import EnvironmentProbe
from support.scenes.fit_rooms import (
    DIRECT,
    assert_powers,
    closed,
    image_of,
    initial_lights,
    noisy,
    open_above,
    other_view,
    power,
    three_lights,
    view,
    with_unmodelled_objects,
)
from support.scenes.light_scenes import matte

VIEW, OTHER = view(64, 48), other_view(64, 48)


def fitted(scene: ls.Scene, images, cameras=None, **options) -> ls.inverse.LightFit:
    """Fits lights without bounces, at the images' own size."""
    options = {"config": DIRECT, "environment_degree": None, "device": "cpu"} | options
    return ls.fit_lights(scene, cameras or VIEW, images, **options)


def test_light_fit_of_a_noiseless_image_finds_three_lights_exactly():
    """Powers are within 0.1 %, and the residual is below 0.001."""
    lights = three_lights()
    found = fitted(closed(*initial_lights(*lights)), image_of(closed(*lights), VIEW))
    assert_powers(found.lights, lights, 1e-3)
    assert found.scene.lights == found.lights
    assert found.views[0].residual < 1e-3
    assert found.shares.sum() == pytest.approx(1.0, abs=1e-6) and (found.shares > 0.1).all()
    assert not found.remarks


def test_light_fit_errors_with_noise_are_within_5_standard_errors():
    """With noise and 8 bits, powers are within 5 %."""
    lights = three_lights()
    found = fitted(closed(*initial_lights(*lights)), noisy(image_of(closed(*lights), VIEW)))
    assert_powers(found.lights, lights, 0.05)
    off = np.array([np.abs(power(one) - power(light)) for one, light in zip(found.lights, lights, strict=True)])
    assert (found.standard_errors > 0.0).all() and (found.standard_errors < 0.1).all()
    assert (off < 5.0 * found.standard_errors).all()


def test_light_fit_gives_power_0_to_a_light_that_is_off_in_the_image():
    """No power is negative, and a remark reports a light that the fit turned off."""
    lights = three_lights()
    dark = replace(lights[1], intensity=0.0)
    found = fitted(closed(*initial_lights(*lights)), noisy(image_of(closed(lights[0], dark, lights[2]), VIEW)))
    assert power(found.lights[1]).max() < 0.02 * power(lights[0]).max()
    exact = fitted(closed(*initial_lights(*lights)), image_of(closed(lights[0], dark, lights[2]), VIEW))
    assert power(exact.lights[1]).max() < 1e-6
    assert exact.remarks == ("warm: the fit turned it off",)


def test_light_fit_with_keep_hues_scales_the_brightness_of_a_light_and_not_its_hue():
    """A blue light stays blue, and becomes about as bright as the white light of the image."""
    true_light = ls.LightPoint((2.0, 2.5, 3.0), (1.0, 1.0, 1.0), 3.0)
    tinted = replace(true_light, color=(0.5, 0.5, 1.0), intensity=0.1)
    found = fitted(closed(tinted), image_of(closed(true_light), VIEW), keep_hues=True)
    (light,) = found.lights
    assert isinstance(light, ls.LightPoint) and light.color == (0.5, 0.5, 1.0)
    assert 3.0 < light.intensity < 6.0
    exact = fitted(closed(tinted), image_of(closed(replace(tinted, intensity=4.0)), VIEW), keep_hues=True)
    assert exact.lights[0].intensity == pytest.approx(4.0, rel=1e-3)


def test_second_image_from_another_camera_lowers_standard_errors_of_a_light_fit():
    """Only the second camera sees the surfaces lit by the light behind the box."""
    lights = three_lights()
    cameras = [VIEW, OTHER]
    images = [image_of(closed(*lights), camera) for camera in cameras]
    found = fitted(closed(*initial_lights(*lights)), images, cameras)
    assert_powers(found.lights, lights, 1e-3)
    assert len(found.views) == 2
    noisy_images = [noisy(one, seed=number) for number, one in enumerate(images)]
    both = fitted(closed(*initial_lights(*lights)), noisy_images, cameras)
    one = fitted(closed(*initial_lights(*lights)), noisy_images[0], cameras[0])
    assert both.standard_errors.sum() < one.standard_errors.sum()


def test_objects_missing_from_the_scene_do_not_bias_the_light_fit():
    """A black ball and a picture on the wall cover over a tenth of the image; powers are within 5 %."""
    lights = three_lights()
    room = closed(*lights)
    image = noisy(image_of(with_unmodelled_objects(room), VIEW))
    clean = noisy(image_of(room, VIEW))
    assert (np.abs(image.astype(int) - clean) > 12).any(axis=2).mean() > 0.1
    found = fitted(closed(*initial_lights(*lights)), image)
    assert_powers(found.lights, lights, 0.05)
    # Hidden pixels have weight 0.
    changed = (np.abs(image.astype(int) - clean) > 60).any(axis=2)
    assert np.median(found.views[0].weights.min(axis=2)[changed]) < 0.05


def test_light_fit_ignores_and_counts_clipped_pixels():
    """Lights six times as bright, which clip part of the image to white, are recovered."""
    lights = [replace(light, intensity=6.0 * light.intensity) for light in three_lights()]
    image = image_of(closed(*lights), VIEW)
    white = (image >= 0.995).any(axis=2)
    assert 0.1 < white.mean() < 0.7
    found = fitted(closed(*initial_lights(*lights)), image)
    assert_powers(found.lights, tuple(lights), 1e-3)
    assert found.views[0].clipped == np.count_nonzero(white | (image <= 0.0).any(axis=2))
    assert (found.views[0].weights[image >= 0.995] == 0.0).all()
    assert ("clipped" in " ".join(found.remarks)) == (white.mean() > 0.2)


def test_light_fit_ignores_and_counts_masked_pixels():
    """Twenty columns of the image are painted over and masked; the shares of the lights count all other pixels."""
    lights = three_lights()
    image = image_of(closed(*lights), VIEW)
    mask = np.ones(image.shape[:2])
    image[:, :20] = (0.9, 0.1, 0.9)
    mask[:, :20] = 0.0
    found = fitted(closed(*initial_lights(*lights)), image, masks=mask)
    assert_powers(found.lights, lights, 1e-3)
    assert found.views[0].masked == 20 * image.shape[0]
    # Shares are relative to all modelled light.
    counts = (found.views[0].weights > 0.0).all(axis=2)
    alone = [np.asarray(ls.render(closed(light), VIEW, DIRECT, device="cpu").color)[..., :3] for light in lights]
    given = np.array([(picture[counts] @ (0.2126, 0.7152, 0.0722)).sum() for picture in alone])
    np.testing.assert_allclose(found.shares, given / given.sum(), rtol=0.01)


def test_light_fit_applies_the_exposure_of_the_camera():
    """An image darker by two stops gives the same lights, by the camera's exposure or by the argument."""
    lights = three_lights()
    darker = replace(VIEW, exposure=-2.0)
    found = fitted(closed(*initial_lights(*lights)), image_of(closed(*lights), darker), darker)
    assert_powers(found.lights, lights, 2e-3)
    given = fitted(closed(*initial_lights(*lights)), image_of(closed(*lights), darker), VIEW, exposure=-2.0)
    assert_powers(given.lights, lights, 2e-3)


def test_light_fit_finds_exposures_relative_to_the_first_image():
    """The exposure of image 0 stays, which a remark reports, because the scene has no emissive object."""
    lights = three_lights()
    cameras = [VIEW, replace(OTHER, exposure=-1.3)]
    images = [image_of(closed(*lights), camera) for camera in cameras]
    found = fitted(closed(*initial_lights(*lights)), images, [VIEW, OTHER], exposure="fit")
    np.testing.assert_allclose(found.exposures, [0.0, -1.3], atol=5e-3)
    assert_powers(found.lights, lights, 5e-3)
    assert "the exposure of image 0 stays 0 stops" in found.remarks[0]


def test_object_of_known_emission_lets_the_light_fit_find_the_cameras_exposure():
    """The scene has a luminous sign."""
    lights = three_lights()
    shining = replace(matte(0.0), emissive=(0.5, 0.4, 0.3))
    sign = ls.Mesh(
        [[0.6, 0.8, 0.02], [2.0, 0.8, 0.02], [2.0, 2.0, 0.02], [0.6, 2.0, 0.02]],
        [[0, 1, 2], [0, 2, 3]],
        material=shining,
    )

    def with_sign(scene: ls.Scene) -> ls.Scene:
        return replace(scene, meshes=(*scene.meshes, ls.MeshInstance(sign)))

    image = image_of(with_sign(closed(*lights)), replace(VIEW, exposure=-0.8))
    found = fitted(with_sign(closed(*initial_lights(*lights))), image, exposure="fit")
    np.testing.assert_allclose(found.exposures, [-0.8], atol=5e-3)
    assert_powers(found.lights, lights, 5e-3)


@pytest.mark.parametrize("tone_map", ["neutral", "agx"])
def test_light_fit_inverts_the_tone_map_of_the_image(tone_map):
    """Without the argument ``tone_map``, the lights of a tone-mapped image are wrong."""
    lights = three_lights()
    image = image_of(closed(*lights), VIEW, replace(DIRECT, tone_map=tone_map))
    found = fitted(closed(*initial_lights(*lights)), image, tone_map=tone_map)
    assert_powers(found.lights, lights, 0.01)
    wrong = fitted(closed(*initial_lights(*lights)), image)
    with pytest.raises(AssertionError):
        assert_powers(wrong.lights, lights, 0.01)


def test_light_fit_takes_exr_images_as_linear_without_clipping(tmp_path):
    """Values above 1 count in EXR files, and in arrays with ``linear``."""
    lights = [replace(light, intensity=6.0 * light.intensity) for light in three_lights()]
    frame = ls.render(closed(*lights), VIEW, DIRECT, device="cpu")
    frame.save(tmp_path / "photo.exr")
    found = fitted(closed(*initial_lights(*lights)), tmp_path / "photo.exr")
    assert_powers(found.lights, tuple(lights), 1e-4)
    assert found.views[0].clipped == 0
    array = fitted(closed(*initial_lights(*lights)), frame.color, linear=True)
    assert_powers(array.lights, tuple(lights), 1e-4)


def sh_environment(degree: int = 2) -> EnvironmentProbe:
    """Returns an SH environment that is bright on one upper side, dark below, and nowhere negative."""
    coefficients = np.zeros((9, 3))
    coefficients[0] = (1.4, 1.5, 1.8)
    coefficients[1:4] = np.array([[-0.5], [0.2], [0.2]]) * (1.0, 1.0, 1.1)
    coefficients[4:9] = np.array([[0.08], [0.12], [-0.1], [0.08], [0.08]]) * (1.0, 0.8, 0.6)
    coefficients = coefficients[: (degree + 1) ** 2]
    directions = panorama_directions(32, 64).reshape(-1, 3)
    assert (EnvironmentProbe(coefficients).radiance(directions) > 0.0).all()
    return EnvironmentProbe(coefficients)


def test_light_fit_recovers_an_sh_environment_of_degree_1():
    """The irradiance of all surfaces is recovered from few samples, and no radiance is negative."""
    truth, camera = sh_environment(1), view(48, 36)
    image = image_of(open_above(truth.light()), camera, ls.RenderConfig(samples=128))
    config = ls.RenderConfig(samples=32, seed=77)
    found = fitted(open_above(), image, camera, config=config, environment_degree=1)
    check_environment(found, truth)


@pytest.mark.deep
def test_light_fit_recovers_an_sh_environment_beside_a_light():
    """Beside an environment of degree 2, the power of the light is within 3 %."""
    light = ls.LightPoint((3.0, 2.0, 3.2), (1.0, 0.7, 0.4), 1.5, name="lamp")
    truth, camera = sh_environment(2), view(64, 48)
    image = image_of(open_above(light, truth.light()), camera, ls.RenderConfig(samples=256))
    config = ls.RenderConfig(samples=128, seed=77)
    found = fitted(open_above(*initial_lights(light)), image, camera, config=config, environment_degree=2)
    assert_powers(found.lights[:1], (light,), 0.03)
    check_environment(found, truth)


def check_environment(found: ls.inverse.LightFit, truth: EnvironmentProbe) -> None:
    """Asserts that the irradiance of floor and end wall is within 5 % of the mean, and of the side walls within 10 %.

    The side walls are red and green, and reflect little of the other channels.
    """
    assert found.environment is not None and isinstance(found.lights[-1], ls.LightEnvironment)
    pale, colored = np.array([(0, 1, 0), (0, 0, 1)]), np.array([(1, 0, 0), (-1, 0, 0)])
    for normals, error in ((pale, 0.05), (colored, 0.10)):
        expected = truth.irradiance(normals)
        np.testing.assert_allclose(found.environment.irradiance(normals), expected, atol=error * float(expected.mean()))
    directions = panorama_directions(16, 32).reshape(-1, 3)
    assert (found.environment.radiance(directions) > -0.02).all()


@pytest.mark.parametrize("room", [open_above, closed])
def test_light_fit_removes_and_reports_an_sh_environment_that_adds_no_light(room):
    """In a room open above, the environment is black; in a closed room, it is blocked."""
    lights = three_lights()
    options = {"config": ls.RenderConfig(samples=4), "environment_degree": 1}
    found = fitted(room(*initial_lights(*lights)), image_of(room(*lights), VIEW), **options)
    assert found.environment is None and found.scene.lights == found.lights and len(found.lights) == 3
    assert len(found.shares) == len(found.standard_errors) == len(found.position_errors) == 3
    assert found.remarks[0] == "environment: none of its light was found in the images, so the scene has none"
    assert_powers(found.lights, lights, 0.03)


def test_light_fit_recovers_an_environment_with_two_black_channels():
    """The environment is red, and the fit leaves out the channels that are black in the whole image."""
    red, camera = ls.LightEnvironment(color=(1.0, 0.0, 0.0), intensity=0.4), view(32, 24)
    config = ls.RenderConfig(samples=16)
    found = fitted(open_above(), image_of(open_above(red), camera, config), camera, config=config, environment_degree=0)
    assert found.environment is not None and found.shares == pytest.approx([1.0], abs=1e-6)
    np.testing.assert_allclose(found.environment.radiance(np.eye(3))[:, 0], 0.4, rtol=0.05)


def test_light_fit_keeps_the_image_of_an_environment_light():
    """Only colour and intensity of the environment are fitted, and no SH environment is added by default."""
    image = sh_environment().image(16)
    truth = ls.LightEnvironment(image, (1.0, 0.8, 0.6), 1.4, visible=False, name="sky")
    many = ls.RenderConfig(samples=64)
    rendered = image_of(open_above(truth), view(48, 36), many)
    found = ls.fit_lights(
        open_above(replace(truth, color=(1, 1, 1), intensity=1.0)), view(48, 36), rendered, config=many, device="cpu"
    )
    (light,) = found.lights
    assert found.environment is None and isinstance(light, ls.LightEnvironment) and light.image is truth.image
    assert_powers((light,), (truth,), 0.01)


def test_light_fit_reports_lights_at_one_position_as_indistinguishable():
    """The sum of the two powers is correct."""
    light = ls.LightPoint((2.0, 2.5, 3.0), (1.0, 0.9, 0.8), 3.0, name="left")
    twin = replace(light, name="right")
    found = fitted(closed(*initial_lights(light, twin)), image_of(closed(light), VIEW))
    assert found.remarks == ("left and right cannot be distinguished in the images: only their sum is determined",)
    np.testing.assert_allclose(power(found.lights[0]) + power(found.lights[1]), power(light), rtol=1e-3)


def test_light_fit_leaves_lights_that_no_image_shows_unchanged():
    """One light is inside a closed box, and one is disabled."""
    lights = three_lights()
    hidden = ls.LightPoint((2.75, 0.85, 1.3), (1.0, 0.2, 0.1), 9.0, name="hidden")
    switched = replace(hidden, enabled=False, name="switched off")
    found = fitted(closed(*initial_lights(*lights), hidden, switched), image_of(closed(*lights), VIEW))
    assert found.scene.lights[3].intensity == 9.0 and found.scene.lights[3].color == hidden.color
    assert found.scene.lights[4] is switched and len(found.lights) == 4
    assert found.remarks == ("hidden: none of its light appears in the images, so it is unchanged",)


def test_light_fit_reports_requested_parameters_such_as_radii_that_no_light_has():
    """Radii and angles are requested for point lights; each gets its own remark."""
    lights = three_lights()
    small = view(32, 24)
    found = fitted(closed(*initial_lights(*lights)), image_of(closed(*lights), small), small, radii=True, angles=True)
    assert found.remarks == (
        "radii is set, but no light has any: none were fitted",
        "angles is set, but no light has any: none were fitted",
    )


def test_light_fit_recovers_the_base_colors_of_two_materials():
    """Base colours are fitted alone with known lights, and together with unknown lights."""
    lights = three_lights()
    image = image_of(closed(*lights), VIEW)
    room = closed(*lights)
    grey = [
        replace(instance, name=name, mesh=replace(instance.mesh, material=matte(0.4)))
        for name, instance in zip(("ball", "box"), room.meshes[-2:], strict=True)
    ]
    scene = replace(room, meshes=(*room.meshes[:-2], *grey))
    found = fitted(scene, image, intensities=False, base_colors=["ball", "box"])
    np.testing.assert_allclose(found.base_colors["ball"], (0.8, 0.5, 0.2), atol=2e-3)
    np.testing.assert_allclose(found.base_colors["box"], (0.2, 0.5, 0.8), atol=2e-3)
    assert [power(light).tolist() for light in found.lights] == [power(light).tolist() for light in lights]
    both = fitted(replace(scene, lights=initial_lights(*lights)), image, base_colors=["ball", "box"])
    np.testing.assert_allclose(both.base_colors["box"], (0.2, 0.5, 0.8), atol=4e-3)
    assert_powers(both.lights, lights, 5e-3)


def test_light_fit_of_all_base_colours_keeps_their_geometric_mean_fixed():
    """Lights and base colours are determined up to one factor, which a remark reports."""
    lights = three_lights()
    room, camera = closed(*lights), view(32, 24)
    image = image_of(room, camera)
    grey = [replace(one, mesh=replace(one.mesh, material=matte(0.5))) for one in room.meshes]
    found = fitted(replace(room, meshes=grey, lights=initial_lights(*lights)), image, camera, base_colors=True)
    assert any("up to one factor" in line for line in found.remarks)
    assert found.views[0].residual < 0.01
    colors = np.array(list(found.base_colors.values()))
    np.testing.assert_allclose(np.log(colors).mean(axis=0), np.log(0.5), atol=0.1)
    truth = np.array([one.mesh.material.base_color for one in room.meshes])
    seen = [0, 1, 2, 3, 6, 7]
    ratios = np.log(colors[seen] / truth[seen])
    assert (ratios.max(axis=0) - ratios.min(axis=0) < 0.05).all()
