"""Damaged and hostile OpenUSD files: one clear line, whatever is wrong, and no file is read that nobody named."""

from __future__ import annotations

import os
import random
import struct
import tracemalloc
import zipfile
from contextlib import suppress
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.errors import FormatError, MissingExtraError
from lumisplat.io.usd import library
from lumisplat.io.usd.opening.crate import _check_sections, _is_tree, check_crate
from support.files.splat_files import capture
from support.files.usd_files import EXTENSIONS, field, usd_core, write_usda
from support.scenes.usd_scene import full_scene

WORDS = ["nan", "-1", "1e39", "0", "99999999999", "inf", "x", '"s"', "[]", "()", "None"]


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
    waving = ls.GaussianSequence([Path("1"), Path("2")], 2.0, lambda path: capture(4, seed=int(path.name)))
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
    check_mutations(tmp_path, extension, range(25))


@pytest.mark.deep
@pytest.mark.parametrize("extension", [".usda", ".usdc", ".usdz"])
def test_many_mutations(tmp_path: Path, extension: str) -> None:
    """Two thousand of each kind of file."""
    usd_core()
    check_mutations(tmp_path, extension, range(2000))


@pytest.mark.parametrize(("extension", "count"), [(".usda", 25), (".usdc", 50)])
def test_mutations_of_what_moves(tmp_path: Path, extension: str, count: int) -> None:
    """A few, and in the deep suite two thousand."""
    usd_core()
    check_mutations(tmp_path, extension, range(count), moves=True)


@pytest.mark.deep
def test_many_mutations_of_what_moves(tmp_path: Path) -> None:
    """Two thousand of a binary file, whose samples are lists in lists."""
    usd_core()
    check_mutations(tmp_path, ".usdc", range(2000), moves=True)


def values_of(data: bytes) -> list[int]:
    """The values of a binary layer."""
    (table,) = struct.unpack_from("<q", data, 16)
    (sections,) = struct.unpack_from("<Q", data, table)
    content: dict[str, bytes] = {}
    for number in range(sections):
        name, start, size = struct.unpack_from("<16sqq", data, table + 8 + 32 * number)
        content[name.rstrip(b"\0").decode()] = data[start : start + size]
    return _check_sections("a", content, {name: struct.unpack_from("<Q", one)[0] for name, one in content.items()})


@pytest.mark.parametrize(
    ("kind", "is_array", "at", "number", "message"),
    [
        (34, False, 1, 2**30 + 1, "has a list of 1,073,741,825 items"),  # 8 GB, before it was checked
        (41, False, 0, 2**40, "has a list of 1,099,511,627,776 items"),
        (24, True, 0, 2**33, "has a list of 8,589,934,592 items"),
        (31, False, 0, 2**50, "has a list of 1,125,899,906,842,624 items"),
        (41, False, 8, 0x9000_0006, "has number 2,415,919,110 of "),  # ended the process
    ],
)
def test_values_that_no_file_can_hold(
    tmp_path: Path, kind: int, is_array: bool, at: int, number: int, message: str
) -> None:
    """Lists longer than the file, and numbers of tokens that do not exist: of relationships, orders and arrays."""
    usd_core()
    path = tmp_path / "a.usdc"
    ls.save(path, full_scene("y-down"))
    data = bytearray(path.read_bytes())
    found = [one for one in values_of(bytes(data)) if one >> 48 & 0xFF == kind and bool(one >> 63) == is_array]
    place = next(one & (1 << 48) - 1 for one in found if not one >> 62 & 1)
    struct.pack_into("<I" if at == 8 else "<Q", data, place + at, number)
    path.write_bytes(data)
    assert message in refused(path)


def test_numbers_between_sections(tmp_path: Path) -> None:
    """Whatever byte of the tables behind the values is wrong, a file is refused or read: nothing crashes."""
    usd_core()
    path = tmp_path / "a.usdc"
    ls.save(path, moving_scene())
    data = path.read_bytes()
    (table,) = struct.unpack_from("<q", data, 16)
    start = min(struct.unpack_from("<16sqq", data, table + 8 + 32 * number)[1] for number in range(6))
    for at in range(start, table, 37):
        for byte in (0x00, 0xFF, data[at] ^ 0x10):
            path.write_bytes(data[:at] + bytes([byte]) + data[at + 1 :])
            with suppress(FormatError):
                ls.load_animation(path)


def test_values_in_values_pass(tmp_path: Path) -> None:
    """What the library writes is what is expected: dictionaries, references, variants, samples, lists of all kinds."""
    usd, sdf = usd_core(), usd_core("Sdf")
    stage = usd.Stage.CreateInMemory(".usdc")
    prim = stage.DefinePrim("/a", "Xform")
    deep: dict[str, object] = {"number": 1, "name": "x"}
    for _ in range(20):
        deep = {"in": deep, "list": [1.0, 2.0]}
    prim.SetCustomDataByKey("deep", deep)
    stage.DefinePrim("/b")
    prim.GetReferences().AddInternalReference("/b", sdf.LayerOffset(1.0, 2.0))
    prim.GetPayloads().AddInternalPayload("/b")
    prim.GetVariantSets().AddVariantSet("v").AddVariant("one")
    prim.GetVariantSets().GetVariantSet("v").SetVariantSelection("one")
    samples = prim.CreateAttribute("samples", sdf.ValueTypeNames.StringArray)
    for time in range(5):
        samples.Set(["one", "two", f"{time}"], time)
    prim.CreateAttribute("tokens", sdf.ValueTypeNames.TokenArray).Set(["x", "y"])
    prim.CreateAttribute("assets", sdf.ValueTypeNames.AssetArray).Set([sdf.AssetPath("p.png")])
    prim.CreateAttribute("many", sdf.ValueTypeNames.IntArray).Set(list(range(1000)))
    path = tmp_path / "a.usdc"
    stage.GetRootLayer().Export(str(path))
    with path.open("rb") as file:
        check_crate(path, file, path.stat().st_size)


def test_counts_that_no_file_can_hold(tmp_path: Path) -> None:
    """Eleven million prims in 93 bytes would take 20 seconds and 740 MB before the library noticed."""
    usd_core()
    path = tmp_path / "a.usdc"
    ls.save(path, capture(5))
    data = bytearray(path.read_bytes())
    (table,) = struct.unpack_from("<q", data, 16)
    (sections,) = struct.unpack_from("<Q", data, table)
    starts = {}
    for number in range(sections):
        name, start, _ = struct.unpack_from("<16sqq", data, table + 8 + 32 * number)
        starts[name.rstrip(b"\0")] = start
    struct.pack_into("<Q", data, starts[b"SPECS"], 11_468_822)
    path.write_bytes(data)
    assert "damaged: 11,468,822 entries in " in refused(path)
    with zipfile.ZipFile(tmp_path / "b.usdz", "w") as package:
        package.writestr("a.usdc", bytes(data))
    assert "damaged: 11,468,822 entries in " in refused(tmp_path / "b.usdz")


def test_paths_that_are_no_tree(tmp_path: Path) -> None:
    """One byte of the jumps between paths makes the library visit subtrees again and again; whatever it is, it ends."""
    usd_core()
    path = tmp_path / "a.usdc"
    ls.save(path, full_scene("y-down"))
    data = path.read_bytes()
    (table,) = struct.unpack_from("<q", data, 16)
    (sections,) = struct.unpack_from("<Q", data, table)
    entries = [struct.unpack_from("<16sqq", data, table + 8 + 32 * number) for number in range(sections)]
    ((start, size),) = [(start, size) for name, start, size in entries if name.startswith(b"PATHS")]
    messages = set[str]()
    for back in range(1, 40):
        damaged = bytearray(data)
        damaged[start + size - back] ^= 0x1E
        path.write_bytes(damaged)
        with suppress(FormatError):
            ls.load(path)
            continue
        messages.add(refused(path))
    assert any("the paths in its binary layer are no tree" in message for message in messages)


@pytest.mark.parametrize(
    "jumps",
    [
        [3, -2, -2, -2],  # a sibling behind an entry that nobody visits
        [2, -1, -2],  # a child's child is the sibling
        [1, -2],  # a sibling where the child is
        [-2, -2],
        [-1],
        [2, -2, 5],
    ],
)
def test_walks_that_are_no_trees(jumps: list[int]) -> None:
    """Each entry is to be visited once, and none left out."""
    assert not _is_tree(jumps)
    assert _is_tree([2, -2, 0, -1, -2])


@pytest.mark.parametrize("count", [0, 1, 2, 40, 2000])
def test_trees_of_any_form_pass(tmp_path: Path, count: int) -> None:
    """Prims below prims at random, written by the library, are trees by our own decoding of them."""
    usd, geom, chance = usd_core(), usd_core("UsdGeom"), random.Random(count)
    stage, paths = usd.Stage.CreateInMemory(".usdc"), ["/a"]
    for number in range(count):
        paths.append(f"{chance.choice(paths)}/p{number}")
        geom.Xform.Define(stage, paths[-1]).AddTranslateOp()
    path = tmp_path / "a.usdc"
    stage.GetRootLayer().Export(str(path))
    with path.open("rb") as file:
        check_crate(path, file, path.stat().st_size)


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
    monkeypatch.setattr("lumisplat.io.usd.walk.USD_INSTANCES_MAX", 3)
    many = loop.replace("rel prototypes = [</a>, </b>]", "rel prototypes = </b>").replace("[0, 0]", "[0, 0, 0]")
    many = many.replace("(1, 0, 0)]", "(1, 0, 0), (2, 0, 0)]")
    assert "shows more than 3 prims" in refused(write_usda(tmp_path / "b.usda", many + field(name="b")))


def test_instances_of_nothing_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twenty instancers, each of which shows the one before ten times, the first of them something that is not seen."""
    monkeypatch.setattr("lumisplat.io.usd.walk.USD_INSTANCES_MAX", 1000)
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
    assert "shows more than 1,000 prims" in refused(write_usda(tmp_path / "a.usda", body + field(name="b")))


def test_paths_that_unpack_to_more_than_a_file_can_hold(tmp_path: Path) -> None:
    """Zeros that LZ4 stores as a byte for 255: forty million paths in 40 kB, refused before they are unpacked."""
    usd_core()
    count = 40_000_000
    run, rest = divmod(count // 4 - 15, 255)
    zeros = b"\0\x1f\0\x01\0" + b"\xff" * run + bytes([rest]) + b"\x50" + bytes(5)
    blocks = b"".join(struct.pack("<Q", len(block)) + block for block in (b"x", b"x", zeros))
    section = struct.pack("<QQ", count, count) + blocks
    table = struct.pack("<Q16sqq", 1, b"PATHS", 24, len(section))
    path = tmp_path / "a.usdc"
    path.write_bytes(struct.pack("<8sBB6xq", b"PXR-USDC", 0, 8, 24 + len(section)) + section + table + bytes(64))
    tracemalloc.start()
    assert "40,000,000 entries of its binary layer would take" in refused(path)
    assert tracemalloc.get_traced_memory()[1] < 2**22
    tracemalloc.stop()


@pytest.mark.parametrize(
    ("head", "body", "message"),
    [
        ('upAxis = "Y"', "", "shows no particle field, mesh, light or camera"),
        ('upAxis = "X"', field(), "has upAxis 'X', expected Y or Z"),
        ('upAxis = "Y"\nmetersPerUnit = 0', field(), "has metersPerUnit 0, expected a length above 0"),
        ('upAxis = "Y"', field({"point3f[] positions": "[]"}), "fields without particles"),
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
