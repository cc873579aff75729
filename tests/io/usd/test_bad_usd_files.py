"""Damaged and hostile OpenUSD files: one clear line, whatever is wrong, and no file is read that nobody named."""

from __future__ import annotations

import importlib.util
import os
import random
import resource
import signal
import struct
import subprocess
import sys
import threading
import time
import zipfile
from contextlib import suppress
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.errors import FormatError, MissingExtraError
from lumisplat.io.usd import library, process
from lumisplat.io.usd.scene import scene_of
from support.files.splat_files import capture
from support.files.usd_files import EXTENSIONS, field, usd_core, write_usda
from support.scenes.usd_scene import full_scene

WORDS = ["nan", "-1", "1e39", "0", "99999999999", "inf", "x", '"s"', "[]", "()", "None"]


@pytest.fixture(autouse=True)
def little_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files of these tests are read in milliseconds: a second is plenty, and ends what would go on for ever."""
    monkeypatch.setattr(process, "USD_CPU_SECONDS", 1)


def refused(path: Path) -> str:
    """The message with which loading is refused; it names the path and fits one line."""
    with pytest.raises(FormatError) as error:
        ls.load(path)
    message = str(error.value)
    assert str(path) in message and "\n" not in message
    return message


@pytest.mark.parametrize("extension", EXTENSIONS)
@pytest.mark.parametrize("fraction", [0.0, 0.001, 0.3, 0.98])
def test_truncated(tmp_path: Path, extension: str, fraction: float) -> None:
    """A file that ends early is refused wherever it ends."""
    usd_core()
    path = tmp_path / f"a{extension}"
    ls.save(path, capture(40))
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * fraction)])
    refused(path)


def test_reasons_name_the_file_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the library says of a file by its whole path is of the file; that it cannot be opened is no reason."""
    usd_core()
    monkeypatch.chdir(tmp_path)
    for name, content in {"a.usda": "#usda 1.0\ndef Mesh (", "a.usdc": "no crate at all", "a.usdz": "no zip"}.items():
        Path(name).write_text(content)
        message = refused(Path(name))
        assert str(tmp_path) not in message and "@" not in message and "layer it" not in message, message


def mutated(data: bytes, chance: random.Random, is_text: bool) -> bytes:
    """The file with bytes or words changed, cut out, or cut off."""
    changed, at = bytearray(data), chance.randrange(len(data) - 8)
    match chance.randrange(5):
        case 0:
            changed[at] = chance.randrange(256)
        case 1:
            changed[at] ^= 1 << chance.randrange(8)
        case 2:
            del changed[at : at + chance.randrange(1, 64)]
        case 3:
            changed[at : at + 8] = chance.choice([b"\xff" * 8, b"\0" * 8, b"\x7f" * 8, chance.randbytes(8)])
        case _ if is_text:
            words = data.split(b" ")
            words[chance.randrange(len(words))] = chance.choice(WORDS).encode()
            return b" ".join(words)
        case _:
            changed[at : at + 16] = data[chance.randrange(len(data)) :][:16]
    return bytes(changed)


def moving_scene() -> ls.Animation:
    """Something that moves, deforms and is looked at by a camera that moves: values with samples in time."""
    cameras = [ls.Camera.look_at((x, 2, 1), (0, 0, 0), name="view") for x in (3, 4)]
    crate = ls.Actor(ls.box(0.3), ls.Keyframes([0, 1], [(0, 0, 3), (1, 0, 3)]), name="crate")
    waving = ls.io.GaussianSequence([Path("1"), Path("2")], 2.0, lambda path: capture(4, seed=int(path.name)))
    scene = ls.Scene([capture(5)])
    return ls.Animation(
        scene,
        [crate, ls.Actor(waving, name="waving")],
        fps=4.0,
        frame_count=5,
        camera_path=ls.CameraPath(cameras, [0.0, 1.0]),
    )


def check_mutations(tmp_path: Path, extension: str, seeds: range, *, moves: bool = False) -> None:
    """Every mutation is read, or refused in one line, by each of the readers."""
    path = tmp_path / f"a{extension}"
    if moves:
        ls.save(path, moving_scene())
    else:
        camera = ls.Camera.look_at((3, 2, 1), (0, 0, 0), name="view")
        ls.save(path, full_scene("y-down"), cameras=[camera])
    data, read = path.read_bytes(), 0
    for seed in seeds:
        path.write_bytes(mutated(data, random.Random(seed), extension == ".usda"))
        for load in (ls.load, ls.load_cameras, ls.load_animation):
            try:
                loaded = load(path)
                if isinstance(loaded, ls.Animation):
                    loaded.actors_at(0.0)
                    loaded.actors_at(0.6)
                read += 1
            except FormatError as error:
                assert str(path) in str(error) and "\n" not in str(error), seed
    assert 0 < read < 3 * len(seeds)


@pytest.mark.parametrize("extension", [".usda", ".usdc", ".usdz"])
def test_mutations(tmp_path: Path, extension: str) -> None:
    """A few of each kind of file."""
    usd_core()
    check_mutations(tmp_path, extension, range(10))


@pytest.mark.deep
@pytest.mark.parametrize("extension", [".usda", ".usdc", ".usdz"])
def test_many_mutations(tmp_path: Path, extension: str) -> None:
    """Two thousand of each kind of file."""
    usd_core()
    check_mutations(tmp_path, extension, range(2000))


@pytest.mark.parametrize(("extension", "count"), [(".usda", 8), (".usdc", 16)])
def test_mutations_of_what_moves(tmp_path: Path, extension: str, count: int) -> None:
    """A few, and in the deep suite two thousand."""
    usd_core()
    check_mutations(tmp_path, extension, range(count), moves=True)


@pytest.mark.deep
def test_many_mutations_of_what_moves(tmp_path: Path) -> None:
    """Two thousand of a binary file, whose samples are lists in lists."""
    usd_core()
    check_mutations(tmp_path, ".usdc", range(2000), moves=True)


@pytest.mark.parametrize("step", [148, pytest.param(37, marks=pytest.mark.deep)])
def test_numbers_between_sections(tmp_path: Path, step: int) -> None:
    """Whatever byte of the tables behind the values is wrong, a file is refused or read: nothing crashes."""
    usd_core()
    path = tmp_path / "a.usdc"
    ls.save(path, moving_scene())
    data = path.read_bytes()
    (table,) = struct.unpack_from("<q", data, 16)
    start = min(struct.unpack_from("<16sqq", data, table + 8 + 32 * number)[1] for number in range(6))
    for at in range(start, table, step):
        for byte in (0x00, 0xFF, data[at] ^ 0x10):
            path.write_bytes(data[:at] + bytes([byte]) + data[at + 1 :])
            with suppress(FormatError):
                ls.load_animation(path)


def crate_with(path: Path, name: bytes, number: int) -> bytes:
    """A binary layer in which a section claims another number of entries."""
    ls.save(path, capture(5))
    data = bytearray(path.read_bytes())
    (table,) = struct.unpack_from("<q", data, 16)
    (sections,) = struct.unpack_from("<Q", data, table)
    entries = [struct.unpack_from("<16sqq", data, table + 8 + 32 * number) for number in range(sections)]
    (start,) = (start for found, start, _ in entries if found.rstrip(b"\0") == name)
    struct.pack_into("<Q", data, start, number)
    return bytes(data)


MOST_MEMORY = """
import resource, sys
import lumisplat as ls
from lumisplat.io.usd import process
for path in sys.argv[1:]:
    try:
        ls.load(path)
    except ls.FormatError:
        continue
    raise SystemExit(f"{path} is not refused")
process._end_idle()
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
"""
"""Prints the most memory of the processes that read files that are refused, kB.

A process of its own runs this: what it has of the kernel begins without the memory of those before.
"""


def test_counts_that_no_file_can_hold(tmp_path: Path) -> None:
    """Entries of terabytes in a binary layer, and in one in a package, cost this process nothing."""
    usd_core()
    paths: list[Path] = []
    for name in ("SPECS", "PATHS", "FIELDS", "TOKENS"):
        data = crate_with(tmp_path / "a.usdc", name.encode(), 2**40)
        paths += [tmp_path / f"{name}.usdc", tmp_path / f"{name}.usdz"]
        paths[-2].write_bytes(data)
        with zipfile.ZipFile(paths[-1], "w") as package:
            package.writestr("a.usdc", data)
    for path in paths:
        refused(path)
    command = [sys.executable, "-c", MOST_MEMORY, *map(str, paths)]
    most = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert 0 < int(most) < 300_000  # kB, most of them the library itself


def laughs(depth: int) -> str:
    """References to references: 2 to the power of ``depth`` prims, each of a few bytes."""
    references = "\n".join(
        f'def "a{k}" {{\n def "x" (references = </a{k + 1}>) {{\n}}\n def "y" (references = </a{k + 1}>) {{\n}}\n}}'
        for k in range(depth)
    )
    return f'{references}\ndef "a{depth}" {{\n}}\n'


def test_stages_that_grow_without_end_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """References nested 24 deep are sixteen million prims: processor time or memory of the child ends."""
    usd_core()
    path = write_usda(tmp_path / "a.usda", laughs(24))
    message = refused(path)
    assert "damaged, or made to exhaust this machine" in message
    monkeypatch.setattr(process, "USD_CPU_SECONDS", 30)
    monkeypatch.setattr(process, "USD_MEMORY", 300 * 2**20)
    assert "or takes more than 0.3 GB of memory: damaged, or made to exhaust this machine" in refused(path)


def limits_with_textures(path: Path) -> list[int]:
    """Memory that the child may take before, with one and with two textures of a megabyte."""
    found = [resource.getrlimit(resource.RLIMIT_DATA)[0]]
    for _ in range(2):
        process.raise_limit_for_asset(2**20)
        found.append(resource.getrlimit(resource.RLIMIT_DATA)[0])
    return found


def test_textures_raise_the_limits_by_their_own(tmp_path: Path) -> None:
    """Textures are bounded by themselves: a small stage may have many of them."""
    usd_core()
    none, one, two = process.read_in_child(tmp_path / "a.usda", limits_with_textures)
    assert none == process.USD_MEMORY < 2**30
    assert one - none == process.USD_ASSETS_MEMORY + process.USD_MEMORY_PER_BYTE * 2**20
    assert two - one == process.USD_MEMORY_PER_BYTE * 2**20


def crashing(path: Path) -> None:
    """Ends the process, as a fault of the library does."""
    os.kill(os.getpid(), signal.SIGSEGV)


def failing(path: Path) -> None:
    """A mistake of ours, which must not be taken for one of the file."""
    raise ZeroDivisionError("ours")


def sleeping(path: Path) -> None:
    """Waits for ever, without taking processor time."""
    threading.Event().wait()


def halving(path: Path, factor: float) -> list[object]:
    """A result of which a part stays in the child."""
    return [factor, process.Remote(lambda argument: np.full(3, factor * argument))]


def test_the_end_of_the_child_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A crash, and a wait without end; the next file is read by another child. Mistakes of ours stay tracebacks."""
    usd_core()
    ls.save(tmp_path / "a.usda", capture(3))
    with pytest.raises(FormatError, match=r"a\.usda: crashes the process that reads it, or takes more than"):
        process.read_in_child(tmp_path / "a.usda", crashing)
    with pytest.raises(RuntimeError, match="ZeroDivisionError: ours"):
        process.read_in_child(tmp_path / "a.usda", failing)
    monkeypatch.setattr(process, "USD_WALL_FACTOR", 1.0)
    with pytest.raises(FormatError, match=r"a\.usda: takes more than 1 s to read"):
        process.read_in_child(tmp_path / "a.usda", sleeping)
    assert isinstance(ls.load(tmp_path / "a.usda"), ls.Gaussians)


def test_functions_of_the_child_live_as_long_as_somebody_has_them(tmp_path: Path) -> None:
    """Two results at the same time, each with its own child, which ends with it."""
    usd_core()
    first, second = (process.read_in_child(tmp_path / "a.usda", halving, factor)[1] for factor in (0.5, 2.0))
    np.testing.assert_array_equal([first(4.0), second(4.0)], np.array([[2.0] * 3, [8.0] * 3]))
    assert not first(1.0).flags.writeable
    del first
    np.testing.assert_array_equal(second(1.0), [2.0] * 3)


def working(path: Path) -> process.Remote:
    """A function that takes as much processor time as it is told."""

    def work(seconds: float) -> float:
        until = time.process_time() + seconds
        while time.process_time() < until:
            pass
        return seconds

    return process.Remote(work)


def test_each_call_of_a_function_has_the_time_of_its_own(tmp_path: Path) -> None:
    """Frames of a long animation together take more than the limit of a file; a single one that does is ended."""
    usd_core()
    work = process.read_in_child(tmp_path / "a.usda", working)
    assert sum(work(0.5) for _ in range(4)) == 2.0
    with pytest.raises(FormatError, match="takes more than 1 s to read"):
        work(10.0)


def limits(path: Path) -> tuple[int, int]:
    """The limits of a child that has asked for nothing."""
    return resource.getrlimit(resource.RLIMIT_DATA)[0], resource.getrlimit(resource.RLIMIT_CPU)[0]


def test_limits_grow_with_the_file_before_it_is_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A large file has its memory and time from the start, by the settings of the parent."""
    usd_core()
    monkeypatch.setattr(process, "USD_MEMORY", 2**30)
    path = tmp_path / "a.usda"
    for size in (0, 100 * 2**20):
        with path.open("wb") as file:
            file.truncate(size)
        memory, seconds = process.read_in_child(path, limits)
        assert memory == 2**30 + 40 * size and 1 <= seconds - size / 2**20 <= 20


def exhausted(path: Path) -> None:
    """Raises what is made of the library's error when memory is at its end."""
    raise FormatError(path, "damaged, or not a USD file: std::bad_alloc")


def test_memory_at_its_end_is_not_called_damage(tmp_path: Path) -> None:
    """The message is that of the limit of memory."""
    usd_core()
    with pytest.raises(FormatError, match=r"or takes more than 0\.8 GB of memory"):
        process.read_in_child(tmp_path / "a.usda", exhausted)


def test_no_code_of_the_working_folder_is_run(tmp_path: Path) -> None:
    """Modules beside a file, in the folder in which somebody works, are no modules of the process that reads it."""
    usd_core()
    write_usda(tmp_path / "a.usda", field())
    for name in ("struct", "lumisplat", "pxr", "sitecustomize", "usercustomize", "pickle"):
        (tmp_path / f"{name}.py").write_text("open('run', 'w')\n")
    code = "import sys, lumisplat as ls; sys.path.append(''); ls.load('a.usda')"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    subprocess.run([sys.executable, "-P", "-c", code], cwd=tmp_path, env=environment, check=True)
    assert not (tmp_path / "run").exists()


def test_a_process_that_has_ended_is_not_ended_again(tmp_path: Path) -> None:
    """Its number may be that of another one by now."""
    usd_core()
    ls.save(tmp_path / "a.usda", capture(3))
    ls.load(tmp_path / "a.usda")
    assert process._Child._idle and all(child._reader == 0 for child in process._Child._idle)


@pytest.mark.parametrize(
    "body",
    [
        'def "a" (references = @`"${P}"`@) {\n}',
        'def "a" (payload = @`"${P}"`@) {\n}',
        'def "a" (clips = {\n dictionary default = {\n asset[] assetPaths = [@`"${P}"`@]\n }\n }) {\n}',
        'def "a" (\n variants = { string v = "x" }\n prepend variantSets = "v"\n) {\nvariantSet "v" = {\n "x" '
        '(references = @`"${P}"`@) {\n}\n }\n}',
        "",
    ],
    ids=["reference", "payload", "clip", "variant", "sublayer"],
)
def test_layers_named_by_expressions_are_refused(tmp_path: Path, body: str) -> None:
    """An expression may name any file, and does so where names are no longer checked."""
    usd_core()
    (tmp_path / "in").mkdir()
    write_usda(tmp_path / "secret.usda", field())
    head = 'upAxis = "Y"\nexpressionVariables = { string P = "../secret.usda" }'
    head += '\nsubLayers = [@`"${P}"`@]' if not body else ""
    assert "names a file by the expression" in refused(write_usda(tmp_path / "in" / "a.usda", body, head))


def test_layers_named_with_arguments_are_refused(tmp_path: Path) -> None:
    """Behind arguments, a pipe looked like a file that is not there, and the library waited for its writer."""
    usd_core()
    os.mkfifo(tmp_path / "pipe.usda")
    body = 'def "a" ( references = @./pipe.usda:SDF_FORMAT_ARGS:target=x@ ) {\n}'
    assert "with arguments" in refused(write_usda(tmp_path / "a.usda", body))


def test_clips_of_variants_stay_in_the_folder(tmp_path: Path) -> None:
    """Clips that only a variant names are layers as well."""
    usd_core()
    (tmp_path / "in").mkdir()
    write_usda(tmp_path / "secret.usda", field())
    clips = "clips = {\n dictionary default = {\n asset[] assetPaths = [@../secret.usda@]\n }\n }"
    body = (
        'def "a" (\n variants = { string v = "x" }\n prepend variantSets = "v"\n) {\n'
        f'variantSet "v" = {{\n "x" ({clips}) {{\n}}\n }}\n}}'
    )
    assert "which is not in its folder" in refused(write_usda(tmp_path / "in" / "a.usda", body))


def test_textures_in_packages_outside_of_the_folder_are_refused(tmp_path: Path) -> None:
    """The package is the file that is read, whatever is named in it; a pipe is none."""
    usd_core()
    (tmp_path / "in").mkdir()
    with zipfile.ZipFile(tmp_path / "out.usdz", "w") as package:
        package.writestr("sky.hdr", b"secret")
    sky = 'def DomeLight "sky" {{\n asset inputs:texture:file = @{}@\n}}'
    path = write_usda(tmp_path / "in" / "a.usda", sky.format("../out.usdz[sky.hdr]"))
    assert "which is not in its folder" in refused(path)
    os.mkfifo(tmp_path / "in" / "pipe.usdz")
    path = write_usda(tmp_path / "in" / "b.usda", sky.format("./pipe.usdz[sky.hdr]"))
    with pytest.raises(FormatError, match=r"pipe\.usdz: is a device, a pipe or a socket"):
        ls.load(path)
    path = write_usda(tmp_path / "in" / "c.usda", sky.format('`"./pipe.usdz[sky.hdr]"`'))
    assert "names a file by the expression" in refused(path)


def test_layers_outside_of_the_folder_are_refused(tmp_path: Path) -> None:
    """A reference, payload, sublayer or clip that leads out of the folder needs the user's trust."""
    home = tmp_path / "home"
    home.mkdir()
    write_usda(tmp_path / "secret.usda", f'def Xform "in" {{\n{field()}\n}}', 'upAxis = "Y"\ndefaultPrim = "in"')
    clips = "clips = {\n dictionary default = {\n asset[] assetPaths = [@../secret.usda@]\n }\n }"
    for name, body, head in (
        ("reference", 'def "a" ( references = @../secret.usda@ ) {\n}', ""),
        ("payload", 'def "a" ( payload = @../secret.usda@ ) {\n}', ""),
        (
            "variant",
            'def "a" (\n variants = { string v = "x" }\n prepend variantSets = "v"\n) {\n'
            'variantSet "v" = {\n "x" (references = @../secret.usda@) {\n}\n }\n}',
            "",
        ),
        ("sublayer", 'def "a" {\n}', "subLayers = [@../secret.usda@]"),
        ("clip", f'def "a" ( {clips} ) {{\n}}', ""),
        ("absolute", f'def "a" ( references = @{tmp_path}/secret.usda@ ) {{\n}}', ""),
    ):
        path = write_usda(home / f"{name}.usda", body, f'upAxis = "Y"\n{head}')
        assert "which is not in its folder: move it there, or trust the file by --allow-outside" in refused(path), name
    trusted = ls.load(home / "reference.usda", allow_outside=True)
    assert isinstance(trusted, ls.Gaussians)


def test_textures_outside_of_the_folder_are_refused(tmp_path: Path) -> None:
    """The image of a sky in another folder, and one that is a pipe."""
    usd_core()
    home = tmp_path / "home"
    home.mkdir()
    sky = 'def DomeLight "sky" {{\n asset inputs:texture:file = @{}@\n}}'
    assert "which is not in its folder" in refused(write_usda(home / "a.usda", sky.format("../sky.hdr")))
    os.mkfifo(home / "pipe.hdr")
    assert "is a device, a pipe or a socket" in refused(write_usda(home / "b.usda", sky.format("./pipe.hdr")))
    assert "no such file" in refused(write_usda(home / "c.usda", sky.format("./gone.hdr")))


def test_layers_that_are_no_files(tmp_path: Path) -> None:
    """A reference to a pipe does not wait for somebody to write."""
    usd_core()
    os.mkfifo(tmp_path / "pipe.usda")
    path = write_usda(tmp_path / "a.usda", 'def "a" ( references = @./pipe.usda@ ) {\n}')
    with pytest.raises(FormatError, match=r"pipe\.usda: is a device, a pipe or a socket"):
        ls.load(path)


def test_missing_layers_are_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A scene without one of its parts is shown, with a line about the part."""
    path = write_usda(tmp_path / "a.usda", 'def "a" ( references = @./gone.usda@ ) {\n}\n' + field())
    assert isinstance(ls.load(path), ls.Gaussians)
    assert "layers that cannot be composed" in caplog.text and "gone.usda" in caplog.text


def test_instances_of_instances_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An instancer that shows itself is not followed; more prims than the limit are refused."""
    loop = """def PointInstancer "a" {
        int[] protoIndices = [0, 0]
        point3f[] positions = [(0, 0, 0), (1, 0, 0)]
        rel prototypes = [</a>, </b>]
    }
    """
    path = write_usda(tmp_path / "a.usda", loop + field(name="b"))
    assert isinstance(ls.load(path), ls.Gaussians)
    monkeypatch.setattr("lumisplat.io.usd.stage.USD_INSTANCES_MAX", 3)
    many = loop.replace("rel prototypes = [</a>, </b>]", "rel prototypes = </b>").replace("[0, 0]", "[0, 0, 0]")
    many = many.replace("(1, 0, 0)]", "(1, 0, 0), (2, 0, 0)]")
    with pytest.raises(FormatError, match="has more than 3 prims or instances"):
        scene_of(write_usda(tmp_path / "b.usda", many + field(name="b")), False)


def test_instances_of_nothing_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twenty instancers, each of which shows the one before ten times, the first of them something that is not seen."""
    monkeypatch.setattr("lumisplat.io.usd.stage.USD_INSTANCES_MAX", 1000)
    places = ", ".join(f"({k}, 0, 0)" for k in range(10))
    body = 'def "a0" {\n}\n' + "".join(
        f"""def PointInstancer "a{k}" {{
            int[] protoIndices = {[0] * 10}
            point3f[] positions = [{places}]
            rel prototypes = </a{k - 1}>
        }}
        """
        for k in range(1, 21)
    )
    with pytest.raises(FormatError, match="has more than 1,000 prims or instances"):
        scene_of(write_usda(tmp_path / "a.usda", body + field(name="b")), False)


@pytest.mark.parametrize(
    ("head", "body", "message"),
    [
        ('upAxis = "Y"', "", "contains no particle field, mesh, light or camera"),
        ('upAxis = "X"', field(), "has upAxis 'X', expected Y or Z"),
        ('upAxis = "Y"\nmetersPerUnit = 0', field(), "has metersPerUnit 0, expected a length above 0"),
        ('upAxis = "Y"', field({"point3f[] positions": "[]"}), "particle fields without particles"),
        ('upAxis = "Y"', field({"float[] opacities": "[2, 0.5]"}), "opacities: 1 of 2 are outside 0..1"),
        ('upAxis = "Y"', 'def SphereLight "l" {\n float inputs:intensity = -1\n}', "/l: intensity is -1"),
        ('upAxis = "Y"', 'def SphereLight "l" {\n float inputs:radius = 0\n}', "/l: radius is 0"),
    ],
)
def test_wrong_values(tmp_path: Path, head: str, body: str, message: str) -> None:
    """What is wrong is named."""
    assert message in refused(write_usda(tmp_path / "a.usda", body, head))


def test_without_the_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reading and writing say how to install it; nothing is written."""

    def missing(name: str) -> ModuleType:
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(library, "import_module", missing)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    library.pxr.cache_clear()
    try:
        with pytest.raises(MissingExtraError, match=r"USD needs .*: pip install 'lumisplat\[usd\]'"):
            ls.save(tmp_path / "a.usdc", capture(3))
        (tmp_path / "b.usda").write_text("#usda 1.0\n")
        for load in (ls.load, ls.load_cameras, ls.load_animation):
            with pytest.raises(MissingExtraError, match=r"pip install 'lumisplat\[usd\]'"):
                load(tmp_path / "b.usda")
        assert not (tmp_path / "a.usdc").exists()
    finally:
        library.pxr.cache_clear()


def test_the_library_is_silent(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """It writes nothing of its own to the terminal, of files that are damaged and of those that are not."""
    usd_core()
    path = write_usda(tmp_path / "a.usda", 'def "a" ( references = @./gone.usda@ ) {\n}\n' + field())
    ls.load(path)
    write_usda(tmp_path / "b.usda", "def {")
    refused(tmp_path / "b.usda")
    ls.save(tmp_path / "c.usdz", capture(3))
    out, err = capfd.readouterr()
    assert not out and "Warning" not in err and "Error" not in err


def test_changed_files_are_read_again(tmp_path: Path) -> None:
    """The library keeps layers that it has open; ours are closed, so that a file that was changed is read as it is."""
    usd_core()
    for count in (3, 5):
        ls.save(tmp_path / "a.usdc", capture(count))
        loaded = ls.load(tmp_path / "a.usdc")
        assert isinstance(loaded, ls.Gaussians) and loaded.count == count
        assert np.isfinite(loaded.means).all()
