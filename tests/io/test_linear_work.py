"""Files with very many small items take linear work, or are refused at once.

Work is counted in executed lines of Python, which do not depend on the machine or its load.
"""

from __future__ import annotations

import json
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.cli.output.images import file_stems
from lumisplat.frame.layers import light_labels
from lumisplat.io.cameras.common import unique_names
from lumisplat.scene.camera import Camera


def _lines(work: Callable[[], object]) -> int:
    """Returns the number of lines of Python that a call executes."""
    count = 0

    def trace(frame: FrameType, event: str, argument: object) -> Any:
        nonlocal count
        count += event == "line"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        work()
    finally:
        sys.settrace(before)
    return count


def _cameras(count: int) -> None:
    camera = ls.Camera.look_at((0, 0, -1), (0, 0, 0), (0, 1, 0), width=4, height=4, name="same")
    assert unique_names([camera] * count)[-1].name == f"same_{count}"


@pytest.mark.parametrize(
    "work", [_cameras, lambda count: file_stems(["same"] * count), lambda count: light_labels(["same"] * count)]
)
def test_numbering_equal_names_takes_time_linear_in_their_number(work: Callable[[int], object]) -> None:
    """Executed lines grow with the number of names; quadratic growth would be a factor of 64."""
    work(10)
    assert _lines(lambda: work(1600)) < 10 * _lines(lambda: work(200))


def _count_checks(monkeypatch: pytest.MonkeyPatch) -> list[Camera]:
    """Returns a list that each checked camera is appended to."""
    checked: list[Camera] = []
    check = Camera.__post_init__
    monkeypatch.setattr(Camera, "__post_init__", lambda camera: (checked.append(camera), check(camera)))
    return checked


@pytest.mark.parametrize(("name", "checks"), [("{}", 1), ("same", 2)])
def test_loading_a_camera_file_checks_each_camera_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, checks: int
) -> None:
    """Renamed cameras, all but the first of equal names, are checked twice."""
    pose = {"position": [0, 0, 0], "rotation": np.eye(3).tolist()}
    lens = {"width": 4, "height": 4, "fx": 4, "fy": 4}
    entries = [{"img_name": name.format(k), **lens, **pose} for k in range(50)]
    (tmp_path / "cameras.json").write_text(json.dumps(entries))
    checked = _count_checks(monkeypatch)
    assert len(ls.load_cameras(tmp_path / "cameras.json")) == 50
    assert len(checked) == 50 * checks - (checks - 1)


def test_rescaling_a_camera_executes_fewer_than_420_lines_of_python() -> None:
    """Most of the 387 lines are checks; two calls of np.allclose had added 202."""
    camera = ls.Camera.look_at((0, 0, -1), (0, 0, 0), (0, 1, 0), width=4, height=4)
    lines = _lines(lambda: camera.scaled(8, 8))
    assert lines < 420, lines


def test_number_appended_to_a_repeated_name_never_gives_an_existing_name() -> None:
    """A third "a" becomes "a_3" if the name "a_2" exists already."""
    assert file_stems(["a", "a_2", "a", "a", "A"]) == ["a", "a_2", "a_3", "a_4", "A_5"]


@pytest.mark.parametrize("line", ["{} = 1", "[{}]", "[[{}]]", "x = {{ {} = 1 }}"])
@pytest.mark.parametrize("part", ["a", '"a"', "'a'"])
def test_dotted_toml_keys_of_more_than_32_parts_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: str, part: str
) -> None:
    """Python's parser takes more than 40 s for 100,000 parts; the error names the line."""

    def parse(text: str) -> dict[str, Any]:
        pytest.fail(f"a text of {len(text)} characters is parsed")

    monkeypatch.setattr(tomllib, "loads", parse)
    (tmp_path / "scene.toml").write_text("# first\n" + line.format(" . ".join([part] * 100_000)) + "\n")
    with pytest.raises(ls.FormatError, match="line 2: a dotted key has more than 32 parts"):
        ls.load(tmp_path / "scene.toml")


def test_long_toml_words_and_numbers_are_not_mistaken_for_dotted_keys(tmp_path: Path) -> None:
    """The text is searched in one pass; a search that restarts at each character would not end."""
    numbers = ", ".join(["1.5"] * 20_000)
    (tmp_path / "scene.toml").write_text(f"{'a' * 10**6} = [{numbers}]\nb = '{chr(34) * 10**6}'\n")
    with pytest.raises(ls.FormatError, match="unknown 'aaa"):
        ls.load(tmp_path / "scene.toml")


def _gltf(path: Path, count: int) -> Path:
    """Writes a glTF file with ``count`` nodes, the last of which has the camera, and returns its path."""
    nodes: list[dict[str, Any]] = [{"translation": [k, 0, 0], "name": str(k)} for k in range(count)]
    nodes[-1]["camera"] = 0
    lens = {"type": "perspective", "perspective": {"yfov": 1.0}}
    path.write_text(json.dumps({"asset": {"version": "2.0"}, "nodes": nodes, "cameras": [lens]}))
    return path


def test_reading_gltf_nodes_takes_time_linear_in_their_number(tmp_path: Path) -> None:
    """A node takes 110 lines of Python; pygltflib's conversion took 3,400, a quarter of a millisecond."""
    files = {count: _gltf(tmp_path / f"{count}.gltf", count) for count in (50, 100, 900)}
    ls.load_cameras(files[50])
    few, many = (_lines(lambda count=count: ls.load_cameras(files[count])) for count in (100, 900))
    assert (many - few) / 800 < 200
    assert np.allclose(ls.load_cameras(files[900])[0].eye, (899, 0, 0))


def test_loading_cameras_of_a_gltf_without_cameras_computes_no_transforms(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """World transforms of nodes would take time in large files."""

    def transforms(file: object) -> list[Any]:
        pytest.fail("transforms of nodes are worked out")

    monkeypatch.setattr("lumisplat.io.gltf.cameras.world_transforms", transforms)
    (tmp_path / "none.gltf").write_text(json.dumps({"asset": {"version": "2.0"}, "nodes": [{"name": "a"}] * 3}))
    assert ls.load_cameras(tmp_path / "none.gltf") == []


def _faces(path: Path, empty: int) -> Path:
    """Writes a PLY file with one triangle among ``empty`` faces without corners, and returns its path."""
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 3\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += f"element face {empty + 1}\nproperty list uchar int vertex_indices\nend_header\n"
    triangle = b"\3" + np.array([0, 1, 2], "<i4").tobytes()
    faces = b"\0" * (empty // 3) + triangle + b"\0" * (empty - empty // 3)
    path.write_bytes(header.encode() + np.eye(3, dtype="<f4").tobytes() + faces)
    return path


def test_reading_empty_ply_faces_takes_time_linear_in_their_number(tmp_path: Path) -> None:
    """Empty faces are found in bulk, not parsed one by one."""
    few, many = _faces(tmp_path / "few.ply", 300), _faces(tmp_path / "many.ply", 3000)
    mesh = ls.load(many)
    assert isinstance(mesh, ls.Mesh)
    assert mesh.face_count == 1
    # Building the Python lists takes one line for each row and list; parsing a row would take ten.
    assert _lines(lambda: ls.load(many)) - _lines(lambda: ls.load(few)) < 4 * 2700
    few.write_bytes(few.read_bytes()[:-1])
    with pytest.raises(ls.FormatError, match="truncated"):
        ls.load(few)
