"""Tests ``lumisplat metrics``: images, folders, shadows and avatars."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.io.images.exr import write_exr
from lumisplat.io.images.texture import write_png
from support.files.cli_files import Workspace
from support.scenes.raster_scenes import random_gaussians


@pytest.fixture
def work(tmp_path, capsys) -> Workspace:
    """Returns a folder with images, folders of them, and an avatar in a room."""
    workspace = Workspace(tmp_path, capsys)
    rng = np.random.default_rng(1)
    image = rng.uniform(0.2, 0.8, (16, 20, 3))
    for folder, change in (("ours", 0.1), ("theirs", 0.0)):
        workspace.path(folder).mkdir()
        for index in range(3):
            write_png(workspace.path(folder) / f"frame_{index}.png", np.clip(image + index * change, 0, 1))
    workspace.path("empty").mkdir()
    workspace.path("fewer").mkdir()
    for index in (0, 2):
        write_png(workspace.path("fewer") / f"frame_{index}.png", image)
    write_png(workspace.path("a.png"), np.full((16, 20, 3), 102 / 255))
    write_png(workspace.path("b.png"), np.full((16, 20, 3), 51 / 255))
    write_png(workspace.path("small.png"), np.full((16, 19, 3), 0.5))
    room = random_gaussians(3, count=300)
    avatar = random_gaussians(4, count=60)
    ls.save(workspace.path("room.ply"), replace(room, means=1.2 * (room.means - room.means.mean(axis=0))))
    figure = replace(avatar, means=0.3 * (avatar.means - avatar.means.mean(axis=0)))
    ls.save(workspace.path("avatar.ply"), figure)
    ls.save(workspace.path("relit.ply"), ls.editing.scale_light(figure, np.full((60, 3), [0.9, 0.7, 0.5])))
    ls.save(workspace.path("lost.ply"), replace(figure, means=figure.means + np.array([50.0, 0.0, 0.0], np.float32)))
    return workspace


def rows(text: str) -> dict[str, list[str]]:
    """Returns the cells of a printed table by the first cell of each line."""
    return {line.split()[0]: line.split()[1:] for line in text.splitlines() if line.split()}


def test_metrics_of_two_images_equal_those_of_the_library(work):
    """An error of 51 of 255 is 20 log10(5) = 13.98 dB."""
    done = work.run("metrics", "@a.png", "@b.png")
    assert (done.status, done.err) == (0, "")
    table = rows(done.out)
    assert table["psnr"] == ["ssim", "flip"]
    pair = [ls.load_image(work.path(name)) for name in ("a.png", "b.png")]
    assert table["a"] == ["13.98", f"{ls.metrics.ssim(*pair):.4f}", f"{ls.metrics.flip(*pair):.4f}"]


def test_metrics_pairs_images_of_two_folders_by_name(work):
    """Each pair has a row, followed by the means; equal images have an infinite PSNR."""
    done = work.run("metrics", "@ours", "@theirs", "--metrics", "psnr,ssim")
    assert done.status == 0
    table = rows(done.out)
    assert list(table) == ["psnr", "frame_0", "frame_1", "frame_2", "mean"]
    assert table["frame_0"] == ["inf", "1.0000"]
    middle = float(table["frame_1"][1]), float(table["frame_2"][1])
    assert float(table["mean"][1]) == pytest.approx((1.0 + sum(middle)) / 3.0, abs=1e-4)


def test_metrics_json_has_all_metrics_in_full_precision(work):
    """Infinity is "inf"."""
    done = work.run("metrics", "@ours", "@theirs", "--metrics", "psnr,flip", "--json")
    report = json.loads(done.out)
    assert [image["name"] for image in report["images"]] == ["frame_0", "frame_1", "frame_2"]
    assert report["images"][0]["psnr"] == report["mean"]["psnr"] == "inf"
    flips = [image["flip"] for image in report["images"]]
    pair = [ls.load_image(work.path(f"{folder}/frame_2.png")) for folder in ("ours", "theirs")]
    assert flips[2] == ls.metrics.flip(*pair)
    assert report["mean"]["flip"] == pytest.approx(sum(flips) / 3.0)


def test_metrics_compares_shadow_strengths_of_images(work):
    """Means are over existing values; images without shadow have a dash."""
    for folder, strengths in (("mine", (0.6, 0.5)), ("truth", (0.4, 0.0))):
        work.path(folder).mkdir()
        for name, strength in zip("xy", strengths, strict=True):
            shadow = np.zeros((12, 12))
            shadow[3:9, 3:9] = strength
            write_exr(work.path(folder) / f"{name}.exr", dict.fromkeys("RGB", shadow))
    done = work.run("metrics", "@mine", "@truth", "--metrics", "sae,sm-iou,bf")
    table = rows(done.out)
    assert table["x"] == ["0.2000", "1.0000", "1.0000"]
    assert table["y"] == ["-", "0.0000", "0.0000"]
    assert table["mean"] == ["0.2000", "0.5000", "0.5000"]
    report = json.loads(work.run("metrics", "@mine", "@truth", "--metrics", "sae", "--json").out)
    assert report["images"][1] == {"name": "y", "sae": None}


def test_metrics_compares_an_exr_in_display_colours(work):
    """An EXR equals the PNG of the same light."""
    linear = ((51 / 255 + 0.055) / 1.055) ** 2.4
    write_exr(work.path("b.exr"), dict.fromkeys("RGB", np.full((16, 20), linear)))
    done = json.loads(work.run("metrics", "@b.exr", "@b.png", "--metrics", "psnr", "--json").out)
    assert done["mean"]["psnr"] > 120.0


def test_metrics_composites_transparent_images_over_black(work):
    """White with an alpha of 0.2 equals the grey of 0.2."""
    pixels = np.full((16, 20, 4), 1.0)
    pixels[..., 3] = 51 / 255
    write_png(work.path("veil.png"), pixels)
    done = json.loads(work.run("metrics", "@veil.png", "@b.png", "--metrics", "psnr", "--json").out)
    assert done["mean"]["psnr"] == "inf" or done["mean"]["psnr"] > 120.0


def test_metrics_command_compares_lighting_of_an_avatar_with_that_of_its_scene(work):
    """Values equal those of the library; with ``--before``, the table has the gain."""
    avatar, relit, room = (work.capture(name) for name in ("avatar.ply", "relit.ply", "room.ply"))
    report = json.loads(work.run("metrics", "@avatar.ply", "--scene", "@room.ply", "--json").out)
    assert report == {name: getattr(ls.metrics, name)(avatar, room) for name in ("paa_y", "apf_y", "ncm_ab")}
    options = ("--before", "@avatar.ply", "--radius", "2")
    done = work.run("metrics", "@relit.ply", "--scene", "@room.ply", *options)
    table = rows(done.out)
    assert table["original"] == ["relit", "delta"]
    before, after = (ls.metrics.ncm_ab(side, room, radius=2.0) for side in (avatar, relit))
    assert table["NCM-ab"] == [f"{before:.2f}", f"{after:.2f}", f"{before - after:.2f}"]
    assert list(table)[1:] == ["PAA-Y", "APF-Y", "NCM-ab"]
    assert all(math.isfinite(float(cell)) for cell in table["APF-Y"])


def test_metrics_with_drop_invalid_leaves_out_invalid_gaussians(work):
    """The option is the advice in the refusal, and the metrics are those of the valid Gaussians."""
    data = bytearray(work.path("avatar.ply").read_bytes())
    data[-4:] = np.float32(np.nan).tobytes()
    work.path("nan.ply").write_bytes(data)
    args = ("metrics", "@nan.ply", "--scene", "@room.ply", "--radius", "2", "--json")
    refused = work.run(*args)
    assert refused.status == 2 and "--drop-invalid" in refused.err
    report = json.loads(work.run(*args, "--drop-invalid").out)
    avatar, room = (work.capture(name) for name in ("avatar.ply", "room.ply"))
    assert report["ncm_ab"] == ls.metrics.ncm_ab(avatar.subset(np.arange(59)), room, radius=2.0)


def test_metrics_table_of_an_avatar_without_the_option_before_has_one_column(work):
    """The gain needs ``--before``."""
    table = rows(work.run("metrics", "@avatar.ply", "--scene", "@room.ply").out)
    assert table["avatar.ply"] == []
    assert [len(table[name]) for name in ("PAA-Y", "APF-Y", "NCM-ab")] == [1, 1, 1]


@pytest.mark.parametrize(
    ("args", "named"),
    [
        ((), "no file given, expected an image and its reference"),
        (("@a.png",), "1 file given"),
        (("@a.png", "@b.png", "@a.png"), "3 files given"),
        (("@a.png", "@missing.png"), "missing.png: no such file or folder"),
        (("@a.png", "@small.png"), "small.png: the image is 20 x 16, its reference 19 x 16"),
        (("@a.png", "@room.ply"), "room.ply: is corrupt, or not an image"),
        (("@ours", "@a.png"), "ours: is a folder and"),
        (("@ours", "@empty"), "empty: holds no images"),
        (("@a.png", "@b.png", "--metrics", "psnr,vmaf"), "--metrics has 'vmaf', expected some of psnr, ssim"),
        (("@a.png", "@b.png", "--metrics", ""), "--metrics has ''"),
        (("@a.png", "@b.png", "--before", "@a.png"), "--before needs --scene"),
        (("@a.png", "@b.png", "--radius", "2"), "--radius needs --scene"),
        (("@a.png", "@b.png", "--drop-invalid"), "--drop-invalid needs --scene"),
        (("@avatar.ply", "@room.ply", "--scene", "@room.ply"), "2 files given, expected one avatar"),
        (("@avatar.ply", "--scene", "@room.ply", "--metrics", "psnr"), "--metrics selects image metrics"),
        (("@avatar.ply", "--scene", "@mesh.obj"), "mesh.obj: has no Gaussians"),
        (("@avatar.ply", "--scene", "@nowhere.ply"), "nowhere.ply: no such file"),
        (("@lost.ply", "--scene", "@room.ply"), "no Gaussian of the scene is within 1.5 of the avatar's centre"),
        (("@avatar.ply", "--scene", "@room.ply", "--radius", "-1"), "--radius is -1"),
    ],
)
def test_metrics_command_reports_mistakes_of_the_user_in_one_line(work, args, named):
    """Each mistake ends with status 2."""
    done = work.run("metrics", *args)
    assert (done.status, done.out) == (2, "")
    assert done.err.startswith("error: ") and done.err.count("\n") == 1
    assert named in done.err


def test_metrics_command_logs_missing_packages_and_computes_all_other_metrics(work, monkeypatch, caplog):
    """The line names the package to install."""
    monkeypatch.setitem(__import__("sys").modules, "flip_evaluator", None)
    caplog.clear()
    done = work.run("metrics", "@a.png", "@b.png")
    assert done.status == 0 and rows(done.out)["a"][0] == "13.98" and rows(done.out)["a"][2] == "-"
    (line,) = caplog.messages
    assert line.startswith("no flip: ") and "pip install 'lumisplat[metrics]'" in line
    done = work.run("metrics", "@a.png", "@b.png", "--metrics", "flip")
    assert done.status == 2 and "pip install 'lumisplat[metrics]'" in done.err
    assert work.run("metrics", "@a.png", "@b.png", "--metrics", "psnr").status == 0


def test_metrics_computes_remaining_images_if_some_fail(work, caplog):
    """A log line names an image without a partner or of another size."""
    done = work.run("metrics", "@ours", "@fewer", "--metrics", "psnr")
    assert done.status == 0 and list(rows(done.out)) == ["psnr", "frame_0", "frame_2", "mean"]
    assert caplog.messages == [f"{work.path('fewer')}: lacks an image 'frame_1', which the other folder has: left out"]
    caplog.clear()
    write_png(work.path("fewer") / "frame_2.png", np.full((16, 19, 3), 0.5))
    done = work.run("metrics", "@ours", "@fewer", "--metrics", "psnr", "--json")
    content = json.loads(done.out)
    first, second = content["images"]
    assert done.status == 0 and first["psnr"] == content["mean"]["psnr"] and second["psnr"] is None
    assert len(content["problems"]) == 1 and "its reference 19 x 16" in content["problems"][0]
