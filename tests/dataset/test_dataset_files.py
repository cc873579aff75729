"""Files of data sets: layers compared with the geometry of the scene, cameras, shards and settings."""

from __future__ import annotations

import json
import re
import tarfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import lumisplat as ls
from lumisplat.io import change_config
from lumisplat.math.transforms import transform_points
from lumisplat.scene.ops.views import world_rays
from support.scenes.dataset_scenes import block_scene, small_config

LAYERS = ("depth", "normal", "albedo", "alpha", "mask", "instance", "category", "exr")
VIEWS = 12


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Returns the folder of a data set with all layers, an inserted object and shards."""
    home = tmp_path_factory.mktemp("dataset")
    (home / "duck.obj").write_text("v -1 0 -1\nv 1 0 -1\nv 0 0 1\nv 0 1 0\nf 1 2 3\nf 1 4 2\nf 2 4 3\nf 3 4 1\n")
    summary = ls.dataset.render_dataset(block_scene(), home / "set", config_of(home), device="cpu")
    assert (summary.train + summary.val + summary.test, summary.missing, summary.left_out) == (VIEWS, 0, 0)
    return home / "set"


def config_of(home: Path) -> ls.config.DatasetConfig:
    """Returns the settings of the data set."""
    objects = ls.config.DatasetObjects(files=(str(home / "duck.obj"),), count=(1, 1), size=(0.1, 0.1))
    config = small_config(views=VIEWS, layers=LAYERS, objects=objects, shard_views=3, split=(0.5, 0.25, 0.25))
    return replace(config, poses=ls.config.DatasetPoses(fov=(50.0, 60.0)))


def record_of(folder: Path, index: int) -> dict:
    """Returns the JSON record of a view."""
    return json.loads((folder / f"views/view_{index:06d}.json").read_text())


def camera_of(record: dict) -> ls.Camera:
    """Returns the camera of a view."""
    return ls.Camera(**record["camera"])


def image(folder: Path, record: dict, layer: str) -> np.ndarray:
    """Returns a layer that is stored as PNG."""
    return png_pixels(folder / record["files"][layer])


def png_pixels(path: Path) -> np.ndarray:
    """Returns the pixels of a PNG file."""
    with Image.open(path) as opened:
        return np.asarray(opened)


@pytest.mark.parametrize("index", range(3))
def test_data_set_layers_match_the_geometry_of_the_scene(folder, index: int) -> None:
    """Depth and normals of the floor are computed; ids and tight boxes belong to their objects."""
    record = record_of(folder, index)
    camera = camera_of(record)
    ids, depth = image(folder, record, "instance"), np.load(folder / record["files"]["depth"])
    assert ids.dtype == np.uint8 and (depth.dtype, depth.shape) == (np.float32, (24, 32))
    objects = {entry["name"]: entry for entry in record["things"]}
    assert [*objects] == ["floor", "block", "duck"] and [entry["id"] for entry in objects.values()] == [1, 2, 3]
    # The floor is the plane y = 0.
    origins, directions = world_rays(camera)
    floor = ids == objects["floor"]["id"]
    along = -origins[..., 1] / directions[..., 1]
    view_depth = along * (directions @ camera.camera_from_world[2, :3])
    np.testing.assert_allclose(depth[floor], view_depth[floor], rtol=1e-5)
    np.testing.assert_array_equal(depth > 0.0, ids > 0)
    upward = np.round(127.5 * (1.0 + camera.camera_from_world[:3, 1]))
    assert np.abs(image(folder, record, "normal")[floor].astype(float) - upward).max() <= 1.0
    assert not image(folder, record, "normal")[ids == 0].any()
    # Surface points lie in the boxes of their objects.
    points = origins + along_rays(camera, depth)[..., None] * directions
    for entry in objects.values():
        rows, columns = np.nonzero(ids == entry["id"])
        assert len(rows) == entry["visible_pixels"]
        if not len(rows):
            assert entry["bbox"] is None
            continue
        left, top, width, height = entry["bbox"]
        assert (left, top) == (columns.min(), rows.min())
        assert (left + width, top + height) == (columns.max() + 1, rows.max() + 1)
        own = transform_points(np.linalg.inv(entry["world_from_object"]), points[rows, columns])
        low, high = np.array(entry["box_low"]), np.array(entry["box_high"])
        margin = 1e-3 * np.linalg.norm(high - low)
        assert (own >= low - margin).all() and (own <= high + margin).all()
    categories = image(folder, record, "category")
    table = json.loads((folder / "layers.json").read_text())["categories"]
    assert table == {"floor": 1, "block": 2, "duck": 3}
    np.testing.assert_array_equal(categories, ids)  # one object of each category
    np.testing.assert_array_equal(
        image(folder, record, "mask"), np.where(image(folder, record, "alpha") >= 128, 255, 0)
    )
    white = image(folder, record, "albedo")[floor & (image(folder, record, "alpha") == 255)]
    assert white.min() == white.max() > 200  # albedo is as bright in shadow as in light


def along_rays(camera: ls.Camera, depth: np.ndarray) -> np.ndarray:
    """Converts depths along z to distances along rays."""
    return depth / camera.ray_directions()[..., 2]


def test_data_set_loads_as_training_images(folder) -> None:
    """`ls.io.load_training_images` returns the same cameras, pixels, masks and splits."""
    images = ls.io.load_training_images(folder)
    training, held_out = images.training, images.held_out
    records = [record_of(folder, index) for index in range(VIEWS)]
    parts = {record["name"]: record["split"] for record in records}
    assert {training_image.name.split("/")[-1] for training_image in training} == {
        n for n, part in parts.items() if part == "train"
    }
    assert {training_image.name.split("/")[-1] for training_image in held_out} == {
        n for n, part in parts.items() if part == "test"
    }
    for training_image in (*training, *held_out):
        record = next(record for record in records if record["name"] == training_image.name.split("/")[-1])
        camera = camera_of(record)
        np.testing.assert_allclose(training_image.camera.camera_from_world, camera.camera_from_world, atol=1e-12)
        for name in ("width", "height", "fx", "fy", "cx", "cy"):
            assert getattr(training_image.camera, name) == pytest.approx(getattr(camera, name), abs=1e-12)
        shown = image(folder, record, "color")
        np.testing.assert_allclose(training_image.pixels(), shown / 255.0, atol=1e-6)
    content = json.loads((folder / "transforms.json").read_text())
    assert all(
        (folder / frame[key]).is_file() for frame in content["frames"] for key in ("depth_file_path", "mask_path")
    )
    assert sum(len(content[f"{part}_filenames"]) for part in ("train", "val", "test")) == VIEWS


def test_data_set_shards_contain_the_files_of_their_views(folder) -> None:
    """A shard has at most three views of one split; members are adjacent, equal to the files, and without times."""
    shards = sorted((folder / "shards").iterdir())
    stored = {}
    for shard in shards:
        with tarfile.open(shard) as tar:
            members = tar.getmembers()
            names = [member.name for member in members]
            keys = list(dict.fromkeys(name.split(".")[0] for name in names))
            assert names == sorted(names, key=lambda name: keys.index(name.split(".")[0])) and len(keys) <= 3
            assert {(member.mtime, member.uid, member.uname) for member in members} == {(0, 0, "")}
            for key in keys:
                record = record_of(folder, int(key.split("_")[1]))
                stored[key] = record["split"]
                assert shard.name.startswith(f"{record['split']}-00000")
                for layer, file in record["files"].items():
                    name = f"{key}.png" if layer == "color" else f"{key}.{layer}{Path(file).suffix}"
                    assert member_bytes(tar, name) == (folder / file).read_bytes()
                assert json.loads(member_bytes(tar, f"{key}.json")) == record
    assert len(stored) == VIEWS


def member_bytes(tar: tarfile.TarFile, name: str) -> bytes:
    """Returns the bytes of a shard's member."""
    member = tar.extractfile(name)
    assert member is not None
    return member.read()


def test_finishing_a_data_set_again_writes_the_same_bytes(folder, tmp_path) -> None:
    """Output depends only on the views; old shards are removed, and missing views are counted."""
    names = ("transforms.json", "layers.json", "contact_sheet.png", "shards/train-000000.tar")
    before = {name: (folder / name).read_bytes() for name in names}
    config = config_of(folder.parent)
    shards = ls.dataset.finish_dataset(folder, replace(config, shard_views=100)).shards
    assert [path.name for path in shards] == ["train-000000.tar", "val-000000.tar", "test-000000.tar"]
    assert sorted((folder / "shards").iterdir()) == sorted(shards)
    ls.dataset.finish_dataset(folder, config)
    assert {name: (folder / name).read_bytes() for name in names} == before
    assert ls.dataset.finish_dataset(folder, replace(config, views=VIEWS + 2)).missing == 2
    assert png_pixels(folder / "contact_sheet.png").shape == (6 * 150, 200 * 8, 3)


def test_existing_data_set_views_are_not_rendered_again(folder, monkeypatch) -> None:
    """A second call for a finished data set renders nothing."""
    monkeypatch.setattr(ls.Renderer, "render", None)
    assert ls.dataset.render_dataset(block_scene(), folder, config_of(folder.parent), device="cpu").missing == 0


def test_data_set_ids_of_more_than_255_objects_are_16_bit(tmp_path) -> None:
    """The largest possible number of objects decides, not the number in a view."""
    scene = ls.Scene(meshes=[*block_scene().meshes, *([ls.MeshInstance(ls.box(0.01), position=(9, 9, 9))] * 300)])
    config = small_config(views=1, layers="instance,category", poses=ls.config.DatasetPoses(seen=0.0))
    ls.dataset.render_dataset(scene, tmp_path, config, device="cpu")
    assert png_pixels(tmp_path / "instance/view_000000.png").dtype == np.uint16


def test_data_sets_refuse_the_realtime_pipeline_and_albedo_layers_of_unlit_views(tmp_path) -> None:
    """The error has one line."""
    with pytest.raises(ls.ConfigError, match=r"Pipeline\.REALTIME renders frames that depend on earlier frames"):
        ls.dataset.render_dataset(
            block_scene(), tmp_path, small_config(), render=ls.RenderConfig(pipeline=ls.Pipeline.REALTIME), device="cpu"
        )
    unlit = ls.RenderConfig(lighting=False)
    with pytest.raises(ls.ConfigError, match="layers has 'albedo', which unlit views do not have"):
        ls.dataset.render_dataset(block_scene(), tmp_path, small_config(layers="albedo"), render=unlit, device="cpu")
    assert not list(tmp_path.rglob("*.json"))


def test_data_set_settings_file_is_read_with_all_groups(tmp_path) -> None:
    """The file has words for None, and paths relative to its folder."""
    (tmp_path / "duck.obj").write_text("v 0 0 0\n")
    file = tmp_path / "set.toml"
    file.write_text(
        'views = 9\nlayers = ["mask", "depth"]\nsplit = [8, 1, 1]\n[poses]\nwhere = "inside"\nfov = 50\n'
        '[lights]\nsuns = "auto"\npoints = [1, 2]\n[objects]\nfiles = ["duck.obj"]\n'
    )
    config = ls.io.load_dataset_config(file)
    assert (config.views, config.layers, config.split) == (9, ("depth", "mask"), (0.8, 0.1, 0.1))
    assert (config.poses.where, config.poses.fov) == (ls.config.PosePlaces.INSIDE, (50.0, 50.0))
    assert (config.lights.suns, config.lights.points) == (None, (1, 2))
    assert config.objects.files == (str(tmp_path / "duck.obj"),)


def test_settings_file_in_the_guide_to_data_sets_is_read(tmp_path: Path) -> None:
    """Each value differs from its default or states it; the table of all settings is generated and tested by itself."""
    guide = Path(__file__).parents[2] / "docs" / "guide" / "dataset.md"
    (text,) = re.findall(r"```toml\n(.*?)```", guide.read_text(), re.DOTALL)
    for name in ("sky.exr", "statue.glb"):
        (tmp_path / name).touch()
    (tmp_path / "set.toml").write_text(text)
    config = ls.io.load_dataset_config(tmp_path / "set.toml")
    assert (config.views, config.seed, config.poses.elevation, config.lights.suns) == (1000, 7, (5, 60), (0, 2))
    assert [Path(file).name for file in config.lights.environments] == ["sky.exr"]
    assert [Path(file).name for file in config.objects.files] == ["statue.glb"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("view = 9", "line 1: unknown 'view', did you mean 'views'?"),
        ("views = 0", "line 1: views is 0, expected a whole number from 1 to 10000000"),
        ('layers = ["dept"]', "line 1: layers has 'dept', did you mean 'depth'?"),
        ("split = [1, 2]", "line 1: split is (1, 2), expected three fractions"),
        (
            "[poses]\nelevation = [60, 5]",
            "line 2, poses: elevation is (60, 5), expected the smallest and the largest value",
        ),
        ('[poses]\nwhere = "domes"', "line 2, poses: where is 'domes', did you mean 'dome'?"),
        ("[lights]\nlamps = [1, 2]", "line 2, lights: unknown 'lamps', it is called 'points' now"),
        ("[poses]\nfov = [10, 200]", "fov is (10, 200), expected the smallest and the largest value, 1 to 179"),
        ("[lights]\npoints = [0.5, 2]", "points is (0.5, 2), expected the smallest and the largest number, whole ones"),
        ("[lights]\nsun_elevatoin = 3", "unknown 'sun_elevatoin', did you mean 'sun_elevation'?"),
        ('[objects]\nfiles = ["lost.glb"]', "line 2, objects: files has 'lost.glb', no such file"),
        ('[objects]\nfiles = "lost.glb"', "files is 'lost.glb', expected a list of file names"),
        ("[objects]\ncount = [-1, 2]", "count is (-1, 2), expected the smallest and the largest number"),
        ("seed = ", "is not valid TOML"),
    ],
)
def test_each_mistake_in_data_set_settings_is_named_by_a_one_line_error(tmp_path, text: str, message: str) -> None:
    """The message has the file, the line and what was expected."""
    file = tmp_path / "set.toml"
    file.write_text(text + "\n")
    with pytest.raises(ls.FormatError) as error:
        ls.io.load_dataset_config(file)
    assert message in str(error.value) and "\n" not in str(error.value)
    assert str(error.value).startswith(str(file))


@pytest.mark.parametrize(("former", "present"), [("lights.sky", "lights.ambient"), ("lights.lamps", "lights.points")])
def test_error_for_a_former_name_of_a_data_set_setting_states_the_present_name(former: str, present: str) -> None:
    """The error names the setting that has replaced the former one."""
    with pytest.raises(ls.ConfigError, match=f"it is called '{present}' now"):
        change_config(ls.config.DatasetConfig(), former, "1")
