"""Builds small mesh files by hand, for the tests of their readers."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
from PIL import Image

from support.files.gltf_writer import Gltf

QUAD = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], dtype=np.float32)
QUAD_TRIANGLES = np.array([(0, 1, 2), (0, 2, 3)], dtype=np.uint16)
QUAD_UVS = np.array([(0, 1), (1, 1), (1, 0), (0, 0)], dtype=np.float32)
"""Texture coordinates with a top-left origin: the quad's lower left corner shows the image's lower left corner."""

TEXELS = np.array([[(255, 0, 0), (0, 255, 0)], [(0, 0, 255), (255, 255, 255)]], dtype=np.uint8)
"""Texels: red, green in the upper row, blue, white in the lower row."""

OBJ = """\
mtllib quad.mtl
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
vn 0 0 2
usemtl painted
f 1/1/1 2/2/1 3/3/1 4/4/1
"""
MTL = "newmtl painted\nKd 0.5 0.25 1\nmap_Kd -s 1 1 1 quad texture.png\n"


def png_bytes(texels: np.ndarray = TEXELS) -> bytes:
    """Encodes ``texels`` as PNG."""
    stream = io.BytesIO()
    Image.fromarray(texels).save(stream, "PNG")
    return stream.getvalue()


def write_obj(folder: Path) -> Path:
    """Writes a textured quad with its material and texture. Returns the path of the OBJ."""
    (folder / "quad.obj").write_text(OBJ)
    (folder / "quad.mtl").write_text(MTL)
    (folder / "quad texture.png").write_bytes(png_bytes())
    return folder / "quad.obj"


def ply_text(order: str = "ascii", quad_first: bool = True) -> bytes:
    """Encodes a coloured quad and a triangle, polygons of different lengths, in any of the three PLY encodings."""
    header = f"ply\nformat {order} 1.0\ncomment by hand\nelement vertex 4\n"
    header += "".join(f"property float {n}\n" for n in "xyz") + "".join(
        f"property uchar {n}\n" for n in ("red", "green", "blue")
    )
    header += "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    vertices = [(*map(float, p), 255, 188, 0) for p in QUAD]
    faces = [(4, 0, 1, 2, 3), (3, 0, 1, 2)][:: 1 if quad_first else -1]
    if order == "ascii":
        return (header + "\n".join(" ".join(map(str, row)) for row in vertices + faces) + "\n").encode()
    sign = "<" if "little" in order else ">"
    body = b"".join(struct.pack(sign + "3f3B", *v) for v in vertices)
    body += b"".join(struct.pack(f"{sign}B{f[0]}i", *f) for f in faces)
    return header.encode() + body


def stl_bytes(corners: np.ndarray) -> bytes:
    """Encodes F triangles, corners (F, 3, 3), as binary STL whose header starts with the word that marks ASCII STL."""
    rows = b"".join(struct.pack("<12fH", 0, 0, 0, *triangle.reshape(-1), 0) for triangle in corners)
    return b"solid but binary".ljust(80) + struct.pack("<I", len(corners)) + rows


def stl_text(corners: np.ndarray) -> bytes:
    """Encodes F triangles, corners (F, 3, 3), as ASCII STL."""
    facets = "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x} {y} {z}\n" for x, y, z in triangle)
        + "endloop\nendfacet\n"
        for triangle in corners
    )
    return f"solid quad\n{facets}endsolid quad\n".encode()


def quad_gltf(textured: bool = True, **node: object) -> Gltf:
    """Returns the quad under one node, with a tinted material that may be textured."""
    gltf = Gltf()
    attributes = {"POSITION": gltf.accessor(QUAD), "TEXCOORD_0": gltf.accessor(QUAD_UVS)}
    pbr: dict = {"baseColorFactor": [0.5, 0.25, 1.0, 1.0], "metallicFactor": 0.25, "roughnessFactor": 0.75}
    if textured:
        gltf.add("images", bufferView=gltf.view(png_bytes()), mimeType="image/png", name="paint")
        gltf.add("textures", source=0)
        pbr["baseColorTexture"] = {"index": 0}
    gltf.add("materials", name="painted", pbrMetallicRoughness=pbr)
    indices = gltf.accessor(QUAD_TRIANGLES.reshape(-1))
    gltf.add("meshes", primitives=[{"attributes": attributes, "indices": indices, "material": 0}])
    gltf.add("nodes", mesh=0, name="quad", **node)
    return gltf
