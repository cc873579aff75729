"""Builds tiny splat files of every format, independently of the package's writers where it has none for a format."""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import lumisplat as ls
from lumisplat.scene.gaussians import Gaussians
from support.files.ksplat_files import ksplat
from support.kinds import expect_kind

SAVED = ("capture.ply", "capture.compressed.ply", "capture.spz")
FORMATS = (
    *SAVED,
    "ascii.ply",
    "big_endian.ply",
    "v1.spz",
    "v2.spz",
    "v3.spz",
    "bundle.sog",
    "linear.sog",
)
FUZZED = (*FORMATS, "written.sog", "old.splat", "level_0.ksplat", "level_1.ksplat", "level_2.ksplat")
"""Formats for damage tests; includes those that reorder Gaussians, and .splat, which has no header.

A .splat that is cut between two Gaussians is a valid file."""


def load_gaussians(path: Path, *, drop_invalid: bool = False) -> Gaussians:
    """Loads a file that must hold a capture."""
    return expect_kind(Gaussians, ls.load(path, drop_invalid=drop_invalid))


def capture(count: int = 300, degree: int = 1, seed: int = 7, **extra: object) -> Gaussians:
    """Returns Gaussians with varied properties and SH within -1..1, the range of SPZ; ``extra`` replaces fields."""
    rng = np.random.default_rng(seed)
    sh = rng.uniform(-0.95, 0.95, (count, (degree + 1) ** 2, 3))
    sh[:, 0] = rng.uniform(-1.6, 1.6, (count, 3))
    gaussians = Gaussians(
        rng.normal(0.0, 1.5, (count, 3)) + np.array([0.0, -1.0, 3.0]),
        rng.normal(size=(count, 4)),
        np.exp(rng.uniform(-6.0, 0.0, (count, 3))),
        rng.uniform(0.02, 0.98, count),
        sh,
    )
    return replace(gaussians, **extra)


def write_format(folder: Path, name: str, gaussians: Gaussians | None = None) -> Path:
    """Writes a capture in one of `FORMATS`. Returns its path."""
    gaussians = gaussians or capture(40)
    path = folder / name
    if name in (*SAVED, "written.sog"):
        ls.save(path, gaussians)
    elif name.endswith(".ply"):
        ls.save(path, gaussians)
        path.write_bytes(reencoded(path.read_bytes(), ascii=name.startswith("ascii")))
    elif name.endswith(".ksplat"):
        path.write_bytes(ksplat([gaussians], int(name[6])))
    elif name.endswith(".splat"):
        path.write_bytes(splat_rows(gaussians))
    elif name.endswith(".spz"):
        path.write_bytes(legacy_spz(gaussians, int(name[1])))
    else:
        path.write_bytes(zipped(sog_files(gaussians, linear=name.startswith("linear"))))
    return path


FLAT_NAMES = [
    "x",
    "y",
    "z",
    "f_dc_0",
    "f_dc_1",
    "f_dc_2",
    "opacity",
    "scale_0",
    "scale_1",
    "rot_0",
    "rot_1",
    "rot_2",
    "rot_3",
]
"""PLY properties of 2D Gaussians of SH degree 0."""


def ply_header(count: int, names: list[str], encoding: str = "binary_little_endian", kind: str = "float") -> bytes:
    """Returns the header of a PLY with only vertices."""
    lines = ["ply", f"format {encoding} 1.0", f"element vertex {count}"]
    return "\n".join([*lines, *(f"property {kind} {name}" for name in names), "end_header", ""]).encode()


def parse_ply(data: bytes) -> tuple[list[str], np.ndarray]:
    """Returns property names and values of a little-endian float PLY."""
    header, body = data.split(b"end_header\n", 1)
    names = [line.split()[-1] for line in header.decode().splitlines() if line.startswith("property")]
    return names, np.frombuffer(body, "<f4").reshape(-1, len(names))


def reencoded(data: bytes, ascii: bool) -> bytes:
    """Converts a little-endian float PLY to ASCII, or to big-endian doubles."""
    names, values = parse_ply(data)
    if ascii:
        text = "\n".join(" ".join(f"{value:.9g}" for value in row) for row in values)
        return ply_header(len(values), names, "ascii") + text.encode()
    return ply_header(len(values), names, "binary_big_endian", "double") + values.astype(">f8").tobytes()


def splat_rows(gaussians: Gaussians) -> bytes:
    """Encodes a .splat, Gaussian by Gaussian."""
    rows = bytearray()
    for i in range(gaussians.count):
        rows += struct.pack("<6f", *gaussians.means[i], *gaussians.scales[i])
        color = 0.5 + 0.28209479177387814 * gaussians.sh[i, 0].astype(float)
        values = [255 * v for v in (*color, gaussians.opacities[i])]
        values += [128 * v + 128 for v in gaussians.rotations_wxyz[i]]
        rows += bytes(min(255, max(0, round(float(v)))) for v in values)
    return bytes(rows)


def legacy_spz(gaussians: Gaussians, version: int, flags: int = 0, extensions: bytes = b"") -> bytes:
    """Encodes an SPZ file of version 1 to 3 in RUB axes, Gaussian by Gaussian."""
    odd = ["", "y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x"]
    flips = [(-1) ** sum(axis in "yz" for axis in axes) for axes in odd]
    sections: list[bytearray] = [bytearray() for _ in range(6)]
    for i in range(gaussians.count):
        x, y, z = (float(value) for value in gaussians.means[i])
        for value in (x, -y, -z):
            sections[0] += struct.pack("<e", value) if version == 1 else struct.pack("<i", round(value * 4096))[:3]
        sections[1].append(round(float(gaussians.opacities[i]) * 255))
        sections[2] += bytes(round(float(np.clip(v * 0.15 * 255 + 127.5, 0, 255))) for v in gaussians.sh[i, 0])
        sections[3] += bytes(round((float(v) + 10) * 16) for v in np.log(gaussians.scales[i]))
        qw, qx, qy, qz = (float(v) for v in gaussians.rotations_wxyz[i])
        sections[4] += _spz_rotation(np.array([qx, -qy, -qz, qw]), version)
        for k in range(1, gaussians.sh.shape[1]):
            sections[5] += bytes(round(flips[k] * float(v) * 128 + 128) for v in gaussians.sh[i, k])
    header = struct.pack("<IIIBBBB", 0x5053474E, version, gaussians.count, gaussians.sh_degree, 12, flags, 0)
    return gzip.compress(header + b"".join(sections) + extensions, mtime=0)


def _spz_rotation(xyzw: np.ndarray, version: int) -> bytes:
    if version < 3:
        return bytes(round(float(v) * 127.5 + 127.5) for v in xyzw[:3] * (1 if xyzw[3] >= 0 else -1))
    largest = int(np.abs(xyzw).argmax())
    word = largest
    for i in range(4):
        if i != largest:
            value = xyzw[i] * np.sign(xyzw[largest])
            word = word << 10 | (value < 0) << 9 | round(abs(float(value)) * np.sqrt(2) * 511)
    return struct.pack("<I", word)


def sog_files(gaussians: Gaussians, linear: bool) -> dict[str, bytes]:
    """Encodes the files of a SOG capture, version 1 (``linear``) or 2. Each Gaussian has its own SH palette entry."""
    count = gaussians.count
    width = 64
    height = -(-count // width)

    def image(values: np.ndarray, columns: int = width, rows: int = height) -> bytes:
        pixels = np.full((rows * columns, 4), 255, dtype=np.uint8)
        pixels[: len(values), : values.shape[1]] = values
        buffer = io.BytesIO()
        Image.fromarray(pixels.reshape(rows, columns, 4)).save(buffer, "WEBP", lossless=True, exact=True)
        return buffer.getvalue()

    logs = np.sign(gaussians.means) * np.log1p(np.abs(gaussians.means))
    means, means_range = _quantised(logs, 65535, per_channel=True)
    logits = np.log(gaussians.opacities / (1 - gaussians.opacities))
    dc = np.column_stack([gaussians.sh[:, 0], logits]) if linear else gaussians.sh[:, 0]
    scales, scales_range = _quantised(np.log(gaussians.scales), 255, per_channel=linear)
    sh0, sh0_range = _quantised(dc, 255, per_channel=linear)
    if not linear:
        sh0 = np.column_stack([sh0, np.round(gaussians.opacities * 255)])
    files = {
        "means_l.webp": image(means % 256),
        "means_u.webp": image(means // 256),
        "scales.webp": image(scales),
        "quats.webp": image(_sog_rotations(gaussians.rotations_wxyz)),
        "sh0.webp": image(sh0),
    }
    meta: dict[str, object] = {
        "means": _meta_entry(means_range, linear=True, shape=[count, 3], files=["means_l.webp", "means_u.webp"]),
        "scales": _meta_entry(scales_range, linear=linear, files=["scales.webp"]),
        "quats": {"files": ["quats.webp"]},
        "sh0": _meta_entry(sh0_range, linear=linear, files=["sh0.webp"]),
    }
    rest = gaussians.sh.shape[1] - 1
    if rest:
        palette, sh_range = _quantised(gaussians.sh[:, 1:], 255, per_channel=False)
        labels = np.arange(count)[::-1]  # Not the identity: a reader that ignores the labels fails.
        files["shN_centroids.webp"] = image(palette[::-1].reshape(-1, 3), width * rest)
        files["shN_labels.webp"] = image(np.column_stack([labels % 256, labels // 256]))
        names = ["shN_centroids.webp", "shN_labels.webp"]
        meta["shN"] = _meta_entry(sh_range, linear=linear, files=names, count=count, bands=gaussians.sh_degree)
    if not linear:
        meta |= {"version": 2, "count": count, "antialias": gaussians.antialiased}
    return {"meta.json": json.dumps(meta).encode()} | files


def _quantised(
    values: np.ndarray, levels: int, *, per_channel: bool
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Quantises values to integers 0..``levels``. Also returns the values of the first and the last level."""
    axis = 0 if per_channel else None
    low, high = values.min(axis=axis), values.max(axis=axis)
    return np.round((values - low) / (high - low) * levels).astype(int), (low, high)


def _meta_entry(bounds: tuple[np.ndarray, np.ndarray], *, linear: bool, **others: object) -> dict[str, object]:
    """Returns an entry of meta.json with the range of the values (``linear``) or a codebook of 256 values."""
    low, high = (bound.tolist() for bound in bounds)
    scale = {"mins": low, "maxs": high} if linear else {"codebook": np.linspace(low, high, 256).tolist()}
    return scale | others


def _sog_rotations(wxyz: np.ndarray) -> np.ndarray:
    pixels = np.empty((len(wxyz), 4))
    for i, quaternion in enumerate(wxyz):
        largest = int(np.abs(quaternion).argmax())
        smallest = np.delete(quaternion * np.sign(quaternion[largest]), largest)
        pixels[i] = (*np.round((smallest / np.sqrt(2) + 0.5) * 255), 252 + largest)
    return pixels


def zipped(files: dict[str, bytes]) -> bytes:
    """Packs files into a zip archive."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as bundle:
        for name, data in files.items():
            bundle.writestr(zipfile.ZipInfo(name), data)
    return buffer.getvalue()


def unpacked(folder: Path, files: dict[str, bytes]) -> Path:
    """Writes files into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return folder


def rows_of_level(file: int, offset: int, count: int) -> dict[str, int]:
    """Returns the JSON entry that tells where a level's Gaussians are stored, for a leaf of a streamed SOG."""
    return {"file": file, "offset": offset, "count": count}


def streamed(folder: Path, **changed: Any) -> Path:
    """Writes a streamed SOG with two leaves and three levels of SH degree 1, 1 and 0; the second leaf lacks level 1."""
    for name, (count, degree) in {"0_0": (50, 1), "1_0": (20, 1), "2_0": (8, 0)}.items():
        unpacked(folder / name, sog_files(capture(count, degree, seed=count), linear=False))
    first = {"0": rows_of_level(0, 0, 30), "1": rows_of_level(1, 0, 20), "2": rows_of_level(2, 0, 5)}
    second = {"0": rows_of_level(0, 30, 20), "2": rows_of_level(2, 5, 3)}
    tree = {"children": [{"lods": first}, {"children": [{"lods": second}]}]}
    names = ["0_0/meta.json", "1_0/meta.json", "2_0/meta.json"]
    meta = {"lodLevels": 3, "environment": None, "filenames": names, "tree": tree} | changed
    (folder / "lod-meta.json").write_text(json.dumps(meta))
    return folder / "lod-meta.json"
