"""Files with very many small things take time in proportion, or are refused: sizes grow eightfold, times hardly more.

Times are of the process, the smaller of two, so that other work on the machine counts little.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.cli.output.pictures import file_stems
from lumisplat.frame.aovs import light_labels
from lumisplat.io.cameras.names import unique_names


def _seconds(work: Callable[[int], object], count: int) -> float:
    times: list[float] = []
    for _ in range(2):
        begun = time.process_time()
        work(count)
        times.append(time.process_time() - begun)
    return min(times)


def _cameras(count: int) -> None:
    camera = ls.Camera.look_at((0, 0, -1), (0, 0, 0), (0, 1, 0), width=4, height=4, name="same")
    assert unique_names([camera] * count)[-1].name == f"same_{count}"


@pytest.mark.parametrize(
    "work", [_cameras, lambda count: file_stems(["same"] * count), lambda count: light_labels(["same"] * count)]
)
def test_equal_names(work: Callable[[int], object]) -> None:
    """Numbering them takes no search; the square would be 64 times."""
    assert _seconds(work, 8000) < 24.0 * max(_seconds(work, 1000), 0.002)


def test_equal_names_are_numbered_around_others() -> None:
    """Numbers that other names have are left out."""
    assert file_stems(["a", "a_2", "a", "a", "A"]) == ["a", "a_2", "a_3", "a_4", "A_5"]


@pytest.mark.parametrize("line", ["{} = 1", "[{}]", "[[{}]]", "x = {{ {} = 1 }}"])
@pytest.mark.parametrize("part", ["a", '"a"', "'a'"])
def test_long_dotted_keys(tmp_path, line: str, part: str) -> None:
    """100,000 parts took Python's parser more than 40 s: refused at once, with the line."""
    (tmp_path / "scene.toml").write_text("# first\n" + line.format(" . ".join([part] * 100_000)) + "\n")
    begun = time.process_time()
    with pytest.raises(ls.FormatError, match="line 2: a dotted key has more than 32 parts"):
        ls.load(tmp_path / "scene.toml")
    assert time.process_time() - begun < 2.0


def test_words_and_numbers_are_no_long_keys(tmp_path) -> None:
    """Long words, quotes and rows of numbers are searched in one pass."""
    numbers = ", ".join(["1.5"] * 20_000)
    (tmp_path / "scene.toml").write_text(f"{'a' * 10**6} = [{numbers}]\nb = '{chr(34) * 10**6}'\n")
    begun = time.process_time()
    with pytest.raises(ls.FormatError, match="unknown 'aaa"):
        ls.load(tmp_path / "scene.toml")
    assert time.process_time() - begun < 4.0


def test_nodes_of_a_scene(tmp_path) -> None:
    """20,000 nodes, each a millisecond once."""
    nodes = [{"translation": [k, 0, 0], "name": str(k)} for k in range(20_000)]
    nodes[-1]["camera"] = 0
    lens = {"type": "perspective", "perspective": {"yfov": 1.0}}
    gltf = {"asset": {"version": "2.0"}, "nodes": nodes, "cameras": [lens]}
    (tmp_path / "many.gltf").write_text(json.dumps(gltf))
    begun = time.process_time()
    (camera,) = ls.load_cameras(tmp_path / "many.gltf")
    assert time.process_time() - begun < 6.0
    assert np.allclose(camera.eye, (19_999, 0, 0))


def test_faces_without_corners(tmp_path) -> None:
    """A triangle among two million of them is found, and they take no time of their own."""
    count = 2_000_000
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 3\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += f"element face {count}\nproperty list uchar int vertex_indices\nend_header\n"
    triangle = b"\3" + np.array([0, 1, 2], "<i4").tobytes()
    faces = b"\0" * 700_000 + triangle + b"\0" * (count - 700_001)
    (tmp_path / "empty.ply").write_bytes(header.encode() + np.eye(3, dtype="<f4").tobytes() + faces)
    begun = time.process_time()
    mesh = ls.load(tmp_path / "empty.ply")
    assert time.process_time() - begun < 6.0
    assert isinstance(mesh, ls.Mesh)
    assert mesh.face_count == 1
    (tmp_path / "short.ply").write_bytes((tmp_path / "empty.ply").read_bytes()[:-1])
    with pytest.raises(ls.FormatError, match="truncated"):
        ls.load(tmp_path / "short.ply")
