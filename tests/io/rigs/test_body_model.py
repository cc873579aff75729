"""Body models of the SMPL family, and AMASS poses."""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import shlex
import struct
import sys
import types
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.io.rigs import convert_pickle
from lumisplat.io.rigs.convert_pickle import read_pickled_arrays
from lumisplat.math.transforms import matrices_from_quaternions, quaternions_from_rotation_vectors
from support.files.body_files import body_arrays, body_file, pose_file
from support.kinds import present
from support.oracles.smpl_oracle import posed_body, rodrigues

UP = rodrigues(np.array([-np.pi / 2.0, 0.0, 0.0]))
"""Rotation from z up to y up."""


@pytest.mark.parametrize(("model", "directions"), [("SMPL", 10), ("SMPL-H", 16), ("SMPL-X", 20), ("SMPL-X", 400)])
def test_posed_bodies_equal_the_equations_of_smpl_in_float64(tmp_path: Path, model: str, directions: int) -> None:
    """Shape, expression, pose blend shapes, hands, orientation and translation are those of the paper."""
    arrays = body_arrays(model, directions=directions)
    path = body_file(tmp_path / "body.npz", model, directions=directions)
    first_expression = {20: 10, 400: 300}.get(directions, directions)
    betas, expression = np.array([1.5, -2.0, 0.5]), np.array([2.0, -1.0]) if model == "SMPL-X" else np.zeros(0)
    coefficients = np.zeros(directions)
    coefficients[:3] = betas
    coefficients[first_expression : first_expression + expression.size] = expression
    motion = pose_file(tmp_path / "walk.npz", model, frames=2)
    rig = ls.avatars.load_rig(path, motion=motion, betas=betas, expression=expression)
    assert rig.clips == ("walk",) and rig.duration() == pytest.approx(1.0 / 20.0)
    with np.load(motion) as stored:
        poses, moved = stored["poses"].reshape(2, -1, 3), stored["trans"]
    for frame in range(2):
        expected = posed_body(arrays, coefficients, poses[frame], moved[frame]) @ UP.T
        np.testing.assert_allclose(rig.pose(frame / 20.0).positions, expected, atol=2e-6)
    hands = np.zeros((len(poses[0]), 3))
    if "hands_meanl" in arrays:
        hands[-30:] = np.concatenate([arrays["hands_meanl"], arrays["hands_meanr"]]).reshape(30, 3)
    np.testing.assert_allclose(rig.mesh.positions, posed_body(arrays, coefficients, hands, np.zeros(3)), atol=2e-6)
    assert rig.mesh.positions[:, 1].argmin() // 4 in (10, 11)  # the feet are below: y is up


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-5, 1.0, np.pi - 1e-9, np.pi, np.pi + 1e-3, 2.0 * np.pi, 9.0])
def test_rotation_vectors_of_any_angle_give_the_rotation_of_rodrigues(angle: float) -> None:
    """Near 0 and pi, too."""
    vector = angle * np.array([0.6, -0.48, 0.64])
    found = matrices_from_quaternions(quaternions_from_rotation_vectors(vector[None]))[0]
    np.testing.assert_allclose(found, rodrigues(vector), atol=1e-14)


def test_flame_heads_have_expressions_and_joints_of_their_own(tmp_path: Path) -> None:
    """A head has five joints; expressions move it at rest."""
    arrays = body_arrays("FLAME", directions=400)
    rig = ls.avatars.load_rig(body_file(tmp_path / "flame.npz", "FLAME", directions=400), expression=[3.0])
    coefficients = np.eye(400)[300] * 3.0
    np.testing.assert_allclose(
        rig.mesh.positions, posed_body(arrays, coefficients, np.zeros((5, 3)), np.zeros(3)), atol=1e-6
    )


def test_gaussians_bound_to_a_body_follow_its_clip(tmp_path: Path) -> None:
    """`bind_gaussians` takes a body as any rig, and the Gaussians stay on the posed mesh."""
    rig = ls.avatars.load_rig(body_file(tmp_path / "b.npz", "SMPL"), motion=pose_file(tmp_path / "w.npz", "SMPL"))
    assert present(rig.mesh.normals).any()
    bound = ls.bind_gaussians(rig, 400)
    for time in (0.0, 0.1):
        mesh = rig.pose(time)
        low, high = mesh.positions.min(axis=0), mesh.positions.max(axis=0)
        assert ((bound.at(time).means >= low - 1e-5) & (bound.at(time).means <= high + 1e-5)).all()


def test_betas_of_a_motion_shape_models_of_the_same_shape_space(tmp_path: Path, caplog: Any) -> None:
    """SMPL and SMPL-H share shapes; the shape of SMPL-X is another one, which a log line says."""
    motion = pose_file(tmp_path / "walk.npz", "SMPL-H")
    with np.load(motion) as stored:
        betas = stored["betas"]
    body = body_file(tmp_path / "smpl.npz", "SMPL", directions=10)
    with caplog.at_level(logging.WARNING, "lumisplat"):
        shaped = ls.avatars.load_rig(body, motion=motion)
    assert "is shaped by 10 betas of walk.npz" in caplog.text
    assert "has poses of SMPL-H, so these joints rest: left_hand, right_hand" in caplog.text
    np.testing.assert_array_equal(shaped.mesh.positions, ls.avatars.load_rig(body, betas=betas[:10]).mesh.positions)
    caplog.clear()
    body = body_file(tmp_path / "smplx.npz", "SMPL-X")
    with caplog.at_level(logging.WARNING, "lumisplat"):
        mean = ls.avatars.load_rig(body, motion=motion)
    assert "its betas are of SMPL-H, and do not shape SMPL-X" in caplog.text
    np.testing.assert_array_equal(mean.mesh.positions, ls.avatars.load_rig(body).mesh.positions)


def test_poses_of_bodies_that_stand_along_y_are_not_rotated(tmp_path: Path, caplog: Any) -> None:
    """A file with y up is recognised by its bodies, which a log line says; the other frame rate key is read."""
    changes = {"poses": np.zeros((2, 72)), "trans": np.array([[0.0, 5.0, 0.0]] * 2), "betas": None}
    changes |= {"mocap_framerate": None, "mocap_frame_rate": np.array([50])}
    motion = pose_file(tmp_path / "walk.npz", "SMPL", frames=2, **changes)
    with caplog.at_level(logging.WARNING, "lumisplat"):
        rig = ls.avatars.load_rig(body_file(tmp_path / "smpl.npz", "SMPL"), motion=motion)
    assert "so y is taken as up" in caplog.text and rig.duration() == 0.02
    np.testing.assert_allclose(rig.pose(0.0).positions, rig.mesh.positions + np.array([0.0, 5.0, 0.0]), atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"v_template": None, "f": None}, "lacks v_template, f: expected a model of SMPL, SMPL-H, SMPL-X, FLAME"),
        ({"posedirs": np.zeros((96, 3, 93))}, "posedirs has the shape (96, 3, 93), expected (96, 3, 207)"),
        ({"weights": np.ones((96, 33))}, "has 33 joints, expected 24 (SMPL), 52 (SMPL-H), 55 (SMPL-X), 5 (FLAME)"),
        ({"weights": -np.ones((96, 24))}, "weights below 0"),
        ({"v_template": np.full((96, 3), np.nan)}, "v_template holds values that are not finite"),
        ({"f": np.full((4, 3), 96)}, "f has vertices that do not exist"),
        ({"kintree_table": np.ones((2, 24))}, "kintree_table has a joint before its parent"),
    ],
)
def test_wrong_body_models_give_one_line(tmp_path: Path, changes: dict[str, Any], problem: str) -> None:
    """The line says which array is wrong, and what was expected."""
    arrays = body_arrays("SMPL", directions=10) | changes
    np.savez(tmp_path / "body.npz", **{name: array for name, array in arrays.items() if array is not None})
    with pytest.raises(ls.FormatError) as caught:
        ls.avatars.load_rig(tmp_path / "body.npz")
    assert problem in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"poses": None}, "lacks poses: expected a file of AMASS poses"),
        ({"poses": np.zeros((3, 63))}, "poses has shape (3, 63), expected (T, 72), (T, 156) or (T, 165)"),
        ({"trans": np.zeros((2, 3))}, "trans has the shape (2, 3), expected (3, 3)"),
        ({"mocap_framerate": None}, "lacks mocap_framerate"),
        ({"mocap_framerate": np.array(0.0)}, "mocap_framerate is 0, expected frames per second"),
        ({"poses": np.array([[None] * 72] * 3)}, "poses holds Python objects"),
    ],
)
def test_wrong_poses_give_one_line(tmp_path: Path, changes: dict[str, Any], problem: str) -> None:
    """The line names the file of the poses."""
    motion = pose_file(tmp_path / "walk.npz", "SMPL", **changes)
    with pytest.raises(ls.FormatError) as caught:
        ls.avatars.load_rig(body_file(tmp_path / "body.npz", "SMPL"), motion=motion)
    assert problem in str(caught.value) and str(caught.value).startswith(str(motion))


def test_wrong_uses_of_body_files_say_what_to_do(tmp_path: Path) -> None:
    """Poses in place of a body, too many numbers, and a body in place of a scene."""
    motion, body = pose_file(tmp_path / "walk.npz", "SMPL"), body_file(tmp_path / "body.npz", "SMPL")
    with pytest.raises(ls.FormatError, match=r'holds poses, not a body: load_rig\("SMPLX_NEUTRAL.npz", motion='):
        ls.avatars.load_rig(motion)
    with pytest.raises(ls.FormatError, match=r"betas has shape \(21,\), expected at most 20 numbers"):
        ls.avatars.load_rig(body, betas=np.zeros(21))
    (tmp_path / "walk.vrma").write_bytes(b"glTF")
    for load in (ls.load, ls.load_animation):
        with pytest.raises(ls.FormatError, match=r"may be a body model or poses: use it in \[\[actors\]\]"):
            load(body)
        with pytest.raises(ls.FormatError, match=r"may be a motion: use it in \[\[actors\]\]"):
            load(tmp_path / "walk.vrma")
    with pytest.raises(ls.FormatError, match="has no betas or expression: they shape a body model"):
        ls.avatars.load_rig(tmp_path / "walker.glb", betas=[1.0])
    with pytest.raises(ls.FormatError, match=r"unknown extension '.mp4' of a motion, expected .npz of AMASS, .bvh"):
        ls.avatars.load_rig(body, motion="a.mp4")


def test_a_sparse_regressor_is_read_after_the_conversion_that_the_error_names(tmp_path: Path) -> None:
    """The advice in the error is Python that makes the array dense."""
    sparse = pytest.importorskip("scipy.sparse")
    arrays = body_arrays("SMPL")
    path, dense = tmp_path / "body.npz", arrays["J_regressor"]
    arrays["J_regressor"] = np.array(sparse.csc_matrix(dense), dtype=object)
    np.savez(path, **arrays)
    with pytest.raises(ls.FormatError, match=r"J_regressor holds Python objects") as caught:
        ls.avatars.load_rig(path)
    advice = str(caught.value).partition("(a sparse matrix: ")[2].removesuffix(")")
    with np.load(path, allow_pickle=True) as stored:
        np.testing.assert_array_equal(eval(advice, {"J_regressor": stored["J_regressor"]}), dense)


def test_truncated_or_damaged_body_files_raise_only_format_errors(tmp_path: Path) -> None:
    """At any length, and with any bit flipped, a file is refused in one line or read."""
    body, motion = body_file(tmp_path / "body.npz", "SMPL", directions=2), pose_file(tmp_path / "walk.npz", "SMPL")
    rng = np.random.default_rng(3)
    for path in (body, motion):
        whole = path.read_bytes()
        for length in np.linspace(1, len(whole) - 1, 15).astype(int):
            path.write_bytes(whole[:length])
            with pytest.raises(ls.FormatError):
                ls.avatars.load_rig(body, motion=motion)
        for place in (*rng.integers(0, len(whole), 15), *rng.integers(len(whole) - 400, len(whole), 15)):
            damaged = bytearray(whole)
            damaged[place] ^= 1 << int(rng.integers(0, 8))
            path.write_bytes(damaged)
            with contextlib.suppress(ls.FormatError):
                ls.avatars.load_rig(body, motion=motion)
        path.write_bytes(whole)


def test_truncated_or_damaged_pickles_raise_only_format_errors(tmp_path: Path) -> None:
    """At any length, and with any bit flipped, a pickle is refused in one line or converted."""
    path = tmp_path / "body.pkl"
    whole, rng = pickle.dumps(body_arrays("SMPL", directions=2), 2), np.random.default_rng(3)
    for length in np.linspace(1, len(whole) - 1, 15).astype(int):
        path.write_bytes(whole[:length])
        with pytest.raises(ls.FormatError):
            read_pickled_arrays(path)
    for place in (*rng.integers(0, len(whole), 15), *rng.integers(len(whole) - 400, len(whole), 15)):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(0, 8))
        path.write_bytes(damaged)
        with contextlib.suppress(ls.FormatError):
            read_pickled_arrays(path)


def _converted(path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Converts a pickle by the command in the error about it; returns the .npz."""
    with pytest.raises(ls.FormatError, match="is a pickle, which is not read: convert a body model") as caught:
        ls.avatars.load_rig(path)
    words = shlex.split(str(caught.value).partition(" to .npz by ")[2].partition(" ; ")[0])
    assert words[:3] == [sys.executable, "-m", "lumisplat.io.rigs.convert_pickle"]
    with monkeypatch.context() as patch:
        patch.setattr(sys, "argv", words[2:])
        convert_pickle.main()
    return path.with_suffix(".npz")


def _chumpy(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """Installs classes that are pickled as those of chumpy are: by name, with their arrays as attributes."""
    module = types.ModuleType("chumpy.ch")
    for name in ("Ch", "Select"):
        setattr(module, name, type(name, (), {"__module__": "chumpy.ch"}))
    monkeypatch.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
    monkeypatch.setitem(sys.modules, "chumpy.ch", module)
    return module


_PICKLER: Any = pickle._Pickler  # pyright: ignore[reportAttributeAccessIssue]


class _Python2(_PICKLER):
    """Writes bytes as Python 2 does: as text."""

    dispatch: ClassVar[dict[type, Any]] = dict(_PICKLER.dispatch)

    def save_bytes(self, obj: bytes) -> None:
        self.write(b"T" + struct.pack("<i", len(obj)) + obj)
        self.memoize(obj)

    dispatch[bytes] = save_bytes


@pytest.mark.parametrize(
    ("protocol", "kind"), [(0, pickle.Pickler), (2, _Python2), (2, pickle.Pickler), (5, pickle.Pickler)]
)
def test_pickled_bodies_equal_those_of_archives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, protocol: int, kind: Any
) -> None:
    """Arrays may be objects of chumpy and sparse matrices; neither package is needed to read them."""
    sparse = pytest.importorskip("scipy.sparse")
    arrays = body_arrays("SMPL", directions=10)
    path = tmp_path / "SMPL.pkl"
    with monkeypatch.context() as patch, path.open("wb") as file:
        chumpy = _chumpy(patch)
        shapes, template, inner = chumpy.Select(), chumpy.Ch(), chumpy.Ch()
        inner.x, template.x = np.concatenate([np.zeros(1), arrays["shapedirs"].ravel()]), arrays["v_template"]
        shapes.a, shapes.idxs, shapes.preferred_shape = inner, np.arange(1, inner.x.size), arrays["shapedirs"].shape
        changes = {"shapedirs": shapes, "v_template": template, "J_regressor": sparse.csc_matrix(arrays["J_regressor"])}
        changes |= {"posedirs": np.asfortranarray(arrays["posedirs"]), "weights": arrays["weights"].astype(">f8")}
        kind(file, protocol).dump(arrays | changes | {"bs_style": "lbs", 3: template})
    body, motion = body_file(tmp_path / "expected.npz", "SMPL", directions=10), pose_file(tmp_path / "a.npz", "SMPL")
    converted = _converted(path, monkeypatch)
    found, expected = (ls.avatars.load_rig(file, betas=[1.0, 2.0], motion=motion) for file in (converted, body))
    np.testing.assert_array_equal(found.pose(0.07).positions, expected.pose(0.07).positions)
    np.testing.assert_array_equal(found.mesh.indices, expected.mesh.indices)


class _Harmful:
    def __init__(self, *call: Any) -> None:
        self.call = call

    def __reduce__(self) -> tuple[Any, ...]:
        return self.call[0], self.call[1:]


@pytest.mark.parametrize("protocol", [0, 2, 5])
def test_pickles_that_would_run_code_run_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, protocol: int) -> None:
    """Named functions are not called, wherever they stand; the arrays beside them are converted."""
    made, path = str(tmp_path / "made"), tmp_path / "SMPL.pkl"
    for call in ((os.mkdir, made), (exec, f"open({made!r}, 'w')"), (np.testing.runstring, f"open({made!r}, 'w')", {})):
        arrays = body_arrays("SMPL", directions=2)
        del arrays["v_template"]
        path.write_bytes(pickle.dumps(arrays | {"harm": _Harmful(*call)}, protocol))
        with pytest.raises(ls.FormatError, match="lacks v_template: expected a model of SMPL"):
            ls.avatars.load_rig(_converted(path, monkeypatch))
        (tmp_path / "SMPL.npz").unlink()
        for harm, problem in (
            (arrays | {"v_template": _Harmful(*call)}, "damaged, or not a pickle: an object is no array that is known"),
            ({"f": [_Harmful(*call)]}, "holds no arrays of a body model"),
            (_Harmful(*call), "holds no arrays of a body model"),
        ):
            path.write_bytes(pickle.dumps(harm, protocol))
            with pytest.raises(SystemExit, match=rf"error: .*SMPL.pkl: {problem}"):
                _converted(path, monkeypatch)
    assert not os.path.exists(made)


def _number(value: int) -> bytes:
    return pickle.LONG1 + b"\x08" + struct.pack("<q", value)


def _kept(state: bytes) -> bytes:
    """Returns the code of an object with a state."""
    return b"cnumpy\nx\n)R" + state + b"b"


def _text(value: str) -> bytes:
    return pickle.BINUNICODE + struct.pack("<I", len(value)) + value.encode()


_DTYPE = (
    b"cnumpy\ndtype\n" + _text("i8") + b"\x85R(K\x03" + _text("<") + b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
)
_ONE = _kept(
    b"(K\x01" + _number(1) + b"\x85" + _DTYPE + b"\x89" + pickle.BINBYTES + struct.pack("<I", 8) + bytes(8) + b"t"
)
_COLUMN = b"".join(_text(key) + _ONE for key in ("indptr", "indices", "data"))
_MATRIX = b"}(" + _COLUMN + _text("_shape") + _number(2**15) + _number(2**14) + b"\x86u"


@pytest.mark.parametrize(
    ("code", "problem"),
    [
        (b"\x96" + struct.pack("<Q", 2**40) + b".", "ends too early for a pickle"),
        (b"}" + _text("f") + _kept(_MATRIX) + b"s.", "its arrays take far more memory than the file"),
        (b"}" + _text("f") + b"cnumpy\nx\n)R\x94}" + _text("x") + b"h\x00sbs.", "nested too deeply"),
        (b"})" + b"\x85" * 10**6 + b"Ns.", "damaged, or not a pickle"),
        (b"cnumpy\nx\n(" + b"N" * 17 + b"tR.", "an object has 17 arguments"),
    ],
    ids=["bytes of 1 TB", "matrix of 4 GB", "object in itself", "deep key", "many arguments"],
)
def test_small_pickles_that_take_much_memory_give_one_line(tmp_path: Path, code: bytes, problem: str) -> None:
    """Lengths and shapes in the file, and objects within objects, neither fill the memory nor end the process."""
    path = tmp_path / "SMPL.pkl"
    path.write_bytes(b"\x80\x05" + code)
    with pytest.raises(ls.FormatError) as caught:
        read_pickled_arrays(path)
    assert problem in str(caught.value) and "\n" not in str(caught.value)


def test_conversion_keeps_the_arrays_of_a_model_and_replaces_no_file(tmp_path: Path, monkeypatch: Any) -> None:
    """Names that mean something to NumPy do not stop it; each array is made once, whatever names it has."""
    arrays, path = body_arrays("SMPL", directions=2), tmp_path / "SMPL.pkl"
    more = dict.fromkeys(("file", "allow_pickle"), arrays["f"])
    path.write_bytes(pickle.dumps(arrays | more | {"hands_meanl": arrays["f"], "hands_meanr": arrays["f"]}, 2))
    found = read_pickled_arrays(path)
    used = ["v_template", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table", "f"]
    assert sorted(found) == sorted([*used, "hands_meanl", "hands_meanr"])
    assert found["f"] is found["hands_meanl"]
    written = _converted(path, monkeypatch)
    before = written.read_bytes()
    with pytest.raises(SystemExit, match=r"^error: .*SMPL\.npz: already exists: use it, or move it away"):
        _converted(path, monkeypatch)
    assert written.read_bytes() == before


def test_errors_about_files_of_python_programs_have_the_call_that_saves_their_content(tmp_path: Path) -> None:
    """Poses that are saved so move a body, and Gaussians are saved by `lumisplat.save`."""
    body, saved = body_file(tmp_path / "body.npz", "SMPL", directions=2), tmp_path / "walk.npz"
    for name in ("a.pt", "a.pth", "a.pkl"):
        (tmp_path / name).write_bytes(b"PK")
        with pytest.raises(
            ls.FormatError, match=r'save its Gaussians by ls.save\("avatar.ply", ls.Gaussians\(...\)\) in'
        ):
            ls.load(tmp_path / name)
        with pytest.raises(ls.FormatError, match="is not read as a motion: save its poses of SMPL in Python") as caught:
            ls.avatars.load_rig(body, motion=tmp_path / name)
        call = str(caught.value).partition(" by ")[2].replace('"walk.npz"', repr(str(saved)))
        eval(call.replace("poses=...", "poses=np.zeros((2, 72))").replace("trans=...", "trans=np.zeros((2, 3))"))
        assert ls.avatars.load_rig(body, motion=saved).clips == ("walk",)
        saved.unlink()


def test_the_command_in_the_error_about_fbx_imports_it_and_exports_glb(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A shell hands Blender a program that runs, and the names of both files."""
    with pytest.raises(ls.FormatError, match="is FBX, which is not read") as caught:
        ls.avatars.load_rig(tmp_path / "it's me.fbx")
    words = shlex.split(str(caught.value).partition("convert it by ")[2])
    assert words[:3] == ["blender", "--background", "--python-expr"]
    calls: list[tuple[str, dict[str, Any]]] = []

    class Operators:
        def __init__(self, name: str = "bpy") -> None:
            self.name = name

        def __getattr__(self, name: str) -> Operators:
            return Operators(f"{self.name}.{name}")

        def __call__(self, **options: Any) -> None:
            calls.append((self.name, options))

    monkeypatch.setitem(sys.modules, "bpy", Operators())
    monkeypatch.setattr(sys, "argv", words)
    exec(words[3], {})
    assert calls[1:] == [
        ("bpy.ops.import_scene.fbx", {"filepath": str(tmp_path / "it's me.fbx")}),
        ("bpy.ops.export_scene.gltf", {"filepath": str(tmp_path / "it's me.glb")}),
    ]
