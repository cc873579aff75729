"""Damaged and hostile OpenUSD files: each gives a one-line error, and no unnamed file is read."""

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
    """Limits the processor time of the child process to one second; files of these tests take milliseconds."""
    monkeypatch.setattr(process, "USD_CPU_SECONDS", 1)


def refused(path: Path) -> str:
    """Returns the message with which loading is refused, after checking that it is one line with the path."""
    with pytest.raises(FormatError) as error:
        ls.load(path)
    message = str(error.value)
    assert str(path) in message and "\n" not in message
    return message


@pytest.mark.parametrize("extension", EXTENSIONS)
@pytest.mark.parametrize("fraction", [0.0, 0.001, 0.3, 0.98])
def test_truncated_usd_files_are_refused_at_any_length(tmp_path: Path, extension: str, fraction: float) -> None:
    """A file cut off at any byte gives a one-line error."""
    usd_core()
    path = tmp_path / f"a{extension}"
    ls.save(path, capture(40))
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * fraction)])
    refused(path)


def test_usd_read_error_names_the_file_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The message of the library repeats the absolute path and that the layer cannot be opened; both are removed."""
    usd_core()
    monkeypatch.chdir(tmp_path)
    for name, content in {"a.usda": "#usda 1.0\ndef Mesh (", "a.usdc": "no crate at all", "a.usdz": "no zip"}.items():
        Path(name).write_text(content)
        message = refused(Path(name))
        assert str(tmp_path) not in message and "@" not in message and "layer it" not in message, message


def mutated(data: bytes, chance: random.Random, is_text: bool) -> bytes:
    """Returns a file with bytes or words changed, removed, or cut off."""
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
    """Returns an animation with a moving and a deforming actor and a moving camera."""
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
    """Checks that every mutated file is read, or refused in one line, by each reader."""
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
def test_ten_mutated_usd_files_of_each_kind_either_load_or_are_refused(tmp_path: Path, extension: str) -> None:
    """Ten mutations are read, or refused in one line, for text, binary files and packages."""
    usd_core()
    check_mutations(tmp_path, extension, range(10))


@pytest.mark.deep
@pytest.mark.parametrize("extension", [".usda", ".usdc", ".usdz"])
def test_2000_mutated_usd_files_of_each_kind_either_load_or_are_refused(tmp_path: Path, extension: str) -> None:
    """Two thousand mutations are read, or refused in one line, for text, binary files and packages."""
    usd_core()
    check_mutations(tmp_path, extension, range(2000))


@pytest.mark.deep
@pytest.mark.parametrize(("extension", "count"), [(".usda", 8), (".usdc", 16)])
def test_few_mutated_usd_animations_either_load_or_are_refused(tmp_path: Path, extension: str, count: int) -> None:
    """Eight mutations are of a text file and 16 of a binary file."""
    usd_core()
    check_mutations(tmp_path, extension, range(count), moves=True)


@pytest.mark.deep
def test_2000_mutated_binary_usd_animations_either_load_or_are_refused(tmp_path: Path) -> None:
    """The time samples of a binary file are nested lists."""
    usd_core()
    check_mutations(tmp_path, ".usdc", range(2000), moves=True)


@pytest.mark.parametrize("step", [148, pytest.param(37, marks=pytest.mark.deep)])
def test_binary_usd_with_a_wrong_byte_in_its_tables_is_read_or_refused(tmp_path: Path, step: int) -> None:
    """A file with a changed byte in the tables after its values is refused or read."""
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
    """Returns a binary USD layer whose section ``name`` claims ``number`` entries."""
    ls.save(path, capture(5))
    data = bytearray(path.read_bytes())
    (table,) = struct.unpack_from("<q", data, 16)
    (sections,) = struct.unpack_from("<Q", data, table)
    entries = [struct.unpack_from("<16sqq", data, table + 8 + 32 * number) for number in range(sections)]
    (start,) = (start for found, start, _ in entries if found.rstrip(b"\0") == name)
    struct.pack_into("<Q", data, start, number)
    return bytes(data)


PEAK_MEMORY_PROGRAM = """
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
"""Program that prints the peak memory of reader processes for refused files, kB.

It runs in a process of its own, because the kernel's peak value includes earlier children.
"""


def test_impossible_counts_in_a_usd_file_take_under_300_mb_of_the_calling_process(tmp_path: Path) -> None:
    """Counts of terabytes are in a binary layer, alone and in a package."""
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
    command = [sys.executable, "-c", PEAK_MEMORY_PROGRAM, *map(str, paths)]
    most = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert 0 < int(most) < 300_000  # kB, mostly of the USD library


def nested_references(depth: int) -> str:
    """Returns nested references to 2^depth prims of a few bytes each ("billion nested_references")."""
    references = "\n".join(
        f'def "a{k}" {{\n def "x" (references = </a{k + 1}>) {{\n}}\n def "y" (references = </a{k + 1}>) {{\n}}\n}}'
        for k in range(depth)
    )
    return f'{references}\ndef "a{depth}" {{\n}}\n'


def test_exponentially_nested_usd_references_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """References nested 24 deep are 16 million prims: the child process exceeds its time or memory limit."""
    usd_core()
    path = write_usda(tmp_path / "a.usda", nested_references(24))
    message = refused(path)
    assert "damaged, or made to exhaust this machine" in message
    monkeypatch.setattr(process, "USD_CPU_SECONDS", 30)
    monkeypatch.setattr(process, "USD_MEMORY", 300 * 2**20)
    assert "or takes more than 0.3 GB of memory: damaged, or made to exhaust this machine" in refused(path)


def limits_with_textures(path: Path) -> list[int]:
    """Returns the memory limit of the child process before any texture, and after one and two of a megabyte."""
    found = [resource.getrlimit(resource.RLIMIT_DATA)[0]]
    for _ in range(2):
        process.raise_limit_for_asset(2**20)
        found.append(resource.getrlimit(resource.RLIMIT_DATA)[0])
    return found


def test_each_texture_of_a_usd_stage_raises_the_memory_limit_of_its_child_process(tmp_path: Path) -> None:
    """Textures have their own limit, so that a small stage may have many of them."""
    usd_core()
    none, one, two = process.read_in_child(tmp_path / "a.usda", limits_with_textures)
    assert none == process.USD_MEMORY < 2**30
    assert one - none == process.USD_ASSETS_MEMORY + process.USD_MEMORY_PER_BYTE * 2**20
    assert two - one == process.USD_MEMORY_PER_BYTE * 2**20


def crashing(path: Path) -> None:
    """Kills its process, as a fault in the USD library does."""
    os.kill(os.getpid(), signal.SIGSEGV)


def failing(path: Path) -> None:
    """Raises an error that is a bug in Lumisplat and not in the file."""
    raise ZeroDivisionError("ours")


def sleeping(path: Path) -> None:
    """Waits forever without using processor time."""
    threading.Event().wait()


def halving(path: Path, factor: float) -> list[object]:
    """Returns the factor, and a function that multiplies by it and runs in the child process."""
    return [factor, process.Remote(lambda argument: np.full(3, factor * argument))]


def test_crashed_or_hung_usd_child_process_gives_a_one_line_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next file is read by a new child. Bugs in Lumisplat still give a traceback."""
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


def test_child_process_that_reads_usd_ends_with_its_last_remote_function(tmp_path: Path) -> None:
    """Two results in use at once have a child process each; a child ends with its result."""
    usd_core()
    first, second = (process.read_in_child(tmp_path / "a.usda", halving, factor)[1] for factor in (0.5, 2.0))
    np.testing.assert_array_equal([first(4.0), second(4.0)], np.array([[2.0] * 3, [8.0] * 3]))
    assert not first(1.0).flags.writeable
    del first
    np.testing.assert_array_equal(second(1.0), [2.0] * 3)


def working(path: Path) -> process.Remote:
    """Returns a function that uses as much processor time as its argument says."""

    def work(seconds: float) -> float:
        until = time.process_time() + seconds
        while time.process_time() < until:
            pass
        return seconds

    return process.Remote(work)


def test_each_remote_call_to_a_usd_child_has_a_time_limit(tmp_path: Path) -> None:
    """The frames of a long animation may exceed a file's limit together; a single frame may not."""
    usd_core()
    work = process.read_in_child(tmp_path / "a.usda", working)
    assert sum(work(0.5) for _ in range(4)) == 2.0
    with pytest.raises(FormatError, match="takes more than 1 s to read"):
        work(10.0)


def limits(path: Path) -> tuple[int, int]:
    """Returns the limits of the child process before it opens a layer."""
    return resource.getrlimit(resource.RLIMIT_DATA)[0], resource.getrlimit(resource.RLIMIT_CPU)[0]


def test_memory_and_time_limits_of_the_usd_child_process_grow_with_file_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The parent sets the memory and time for a large file before the child process opens it."""
    usd_core()
    monkeypatch.setattr(process, "USD_MEMORY", 2**30)
    path = tmp_path / "a.usda"
    for size in (0, 100 * 2**20):
        with path.open("wb") as file:
            file.truncate(size)
        memory, seconds = process.read_in_child(path, limits)
        assert memory == 2**30 + 40 * size and 1 <= seconds - size / 2**20 <= 20


def exhausted(path: Path) -> None:
    """Raises the error that the USD library raises when memory is exhausted."""
    raise FormatError(path, "damaged, or not a USD file: std::bad_alloc")


def test_usd_child_process_that_exhausts_its_memory_is_reported_as_a_limit(tmp_path: Path) -> None:
    """The library's std::bad_alloc is not reported as a damaged file."""
    usd_core()
    with pytest.raises(FormatError, match=r"or takes more than 0\.8 GB of memory"):
        process.read_in_child(tmp_path / "a.usda", exhausted)


def test_usd_child_process_imports_no_modules_from_the_working_folder(tmp_path: Path) -> None:
    """The reader process does not run modules in the user's working folder."""
    usd_core()
    write_usda(tmp_path / "a.usda", field())
    for name in ("struct", "lumisplat", "pxr", "sitecustomize", "usercustomize", "pickle"):
        (tmp_path / f"{name}.py").write_text("open('run', 'w')\n")
    code = "import sys, lumisplat as ls; sys.path.append(''); ls.load('a.usda')"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    subprocess.run([sys.executable, "-P", "-c", code], cwd=tmp_path, env=environment, check=True)
    assert not (tmp_path / "run").exists()


def test_idle_usd_child_process_keeps_no_id_of_its_ended_reader(tmp_path: Path) -> None:
    """Another process may have the id of the ended child by then."""
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
def test_usd_file_references_that_contain_expressions_are_refused(tmp_path: Path, body: str) -> None:
    """An expression may name any file, in places where names are no longer checked."""
    usd_core()
    (tmp_path / "in").mkdir()
    write_usda(tmp_path / "secret.usda", field())
    head = 'upAxis = "Y"\nexpressionVariables = { string P = "../secret.usda" }'
    head += '\nsubLayers = [@`"${P}"`@]' if not body else ""
    assert "names a file by the expression" in refused(write_usda(tmp_path / "in" / "a.usda", body, head))


def test_usd_file_references_with_format_arguments_are_refused(tmp_path: Path) -> None:
    """A pipe named with arguments would look like a missing file, and the library would wait for its writer."""
    usd_core()
    os.mkfifo(tmp_path / "pipe.usda")
    body = 'def "a" ( references = @./pipe.usda:SDF_FORMAT_ARGS:target=x@ ) {\n}'
    assert "with arguments" in refused(write_usda(tmp_path / "a.usda", body))


def test_usd_value_clips_of_variants_outside_the_folder_are_refused(tmp_path: Path) -> None:
    """A clip that only a variant names is a layer, too."""
    usd_core()
    (tmp_path / "in").mkdir()
    write_usda(tmp_path / "secret.usda", field())
    clips = "clips = {\n dictionary default = {\n asset[] assetPaths = [@../secret.usda@]\n }\n }"
    body = (
        'def "a" (\n variants = { string v = "x" }\n prepend variantSets = "v"\n) {\n'
        f'variantSet "v" = {{\n "x" ({clips}) {{\n}}\n }}\n}}'
    )
    assert "which is not in its folder" in refused(write_usda(tmp_path / "in" / "a.usda", body))


def test_usd_textures_in_packages_outside_the_folder_are_refused(tmp_path: Path) -> None:
    """The folder of the package counts, whatever is named inside the package; a pipe is refused, too."""
    usd_core()
    (tmp_path / "in").mkdir()
    with zipfile.ZipFile(tmp_path / "out.usdz", "w") as package:
        package.writestr("sky.hdr", b"secret")
    dome = 'def DomeLight "sky" {{\n asset inputs:texture:file = @{}@\n}}'
    path = write_usda(tmp_path / "in" / "a.usda", dome.format("../out.usdz[sky.hdr]"))
    assert "which is not in its folder" in refused(path)
    os.mkfifo(tmp_path / "in" / "pipe.usdz")
    path = write_usda(tmp_path / "in" / "b.usda", dome.format("./pipe.usdz[sky.hdr]"))
    with pytest.raises(FormatError, match=r"pipe\.usdz: is a device, a pipe or a socket"):
        ls.load(path)
    path = write_usda(tmp_path / "in" / "c.usda", dome.format('`"./pipe.usdz[sky.hdr]"`'))
    assert "names a file by the expression" in refused(path)


def test_usd_layers_outside_the_folder_are_refused_without_allow_outside(tmp_path: Path) -> None:
    """References, payloads, sublayers and value clips outside the folder are refused by default."""
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


def test_usd_dome_light_images_that_are_pipes_or_outside_the_folder_are_refused(tmp_path: Path) -> None:
    """A missing image is refused, too."""
    usd_core()
    home = tmp_path / "home"
    home.mkdir()
    dome = 'def DomeLight "sky" {{\n asset inputs:texture:file = @{}@\n}}'
    assert "which is not in its folder" in refused(write_usda(home / "a.usda", dome.format("../sky.hdr")))
    os.mkfifo(home / "pipe.hdr")
    assert "is a device, a pipe or a socket" in refused(write_usda(home / "b.usda", dome.format("./pipe.hdr")))
    assert "no such file" in refused(write_usda(home / "c.usda", dome.format("./gone.hdr")))


def test_usd_layers_that_are_pipes_are_refused(tmp_path: Path) -> None:
    """The reader must not wait for a writer."""
    usd_core()
    os.mkfifo(tmp_path / "pipe.usda")
    path = write_usda(tmp_path / "a.usda", 'def "a" ( references = @./pipe.usda@ ) {\n}')
    with pytest.raises(FormatError, match=r"pipe\.usda: is a device, a pipe or a socket"):
        ls.load(path)


def test_missing_usd_layers_are_logged_and_the_rest_is_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A stage refers to a layer that does not exist beside a valid particle field."""
    path = write_usda(tmp_path / "a.usda", 'def "a" ( references = @./gone.usda@ ) {\n}\n' + field())
    assert isinstance(ls.load(path), ls.Gaussians)
    assert "layers that cannot be composed" in caplog.text and "gone.usda" in caplog.text


def test_recursive_usd_point_instancers_are_skipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An instancer that instances itself is skipped, and prims above the limit are refused."""
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


def test_number_of_nested_usd_instances_is_limited_even_if_their_prims_are_hidden(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Twenty instancers each instance the previous one ten times; the first instances a hidden prim."""
    monkeypatch.setattr("lumisplat.io.usd.stage.USD_INSTANCES_MAX", 1000)
    positions = ", ".join(f"({k}, 0, 0)" for k in range(10))
    body = 'def "a0" {\n}\n' + "".join(
        f"""def PointInstancer "a{k}" {{
            int[] protoIndices = {[0] * 10}
            point3f[] positions = [{positions}]
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
def test_error_for_an_invalid_usd_value_names_prim_and_attribute(
    tmp_path: Path, head: str, body: str, message: str
) -> None:
    """The message names the prim and attribute."""
    assert message in refused(write_usda(tmp_path / "a.usda", body, head))


def test_missing_usd_core_is_an_error_that_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No file is written."""

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


def test_reading_usd_prints_nothing_to_the_terminal(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """The library's own messages are silenced for damaged and for valid files."""
    usd_core()
    path = write_usda(tmp_path / "a.usda", 'def "a" ( references = @./gone.usda@ ) {\n}\n' + field())
    ls.load(path)
    write_usda(tmp_path / "b.usda", "def {")
    refused(tmp_path / "b.usda")
    ls.save(tmp_path / "c.usdz", capture(3))
    out, err = capfd.readouterr()
    assert not out and "Warning" not in err and "Error" not in err


def test_usd_files_changed_on_disk_are_read_again(tmp_path: Path) -> None:
    """The library caches open layers, so Lumisplat closes them."""
    usd_core()
    for count in (3, 5):
        ls.save(tmp_path / "a.usdc", capture(count))
        loaded = ls.load(tmp_path / "a.usdc")
        assert isinstance(loaded, ls.Gaussians) and loaded.count == count
        assert np.isfinite(loaded.means).all()
