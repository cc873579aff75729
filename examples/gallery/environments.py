"""Writes environment maps of the npm package @pmndrs/assets (Poly Haven, CC0) as .exr files of 512x256.

npm pack @pmndrs/assets && tar xzf pmndrs-assets-*.tgz
python examples/gallery/environments.py package hdri
"""

from __future__ import annotations

import base64
import sys
from pathlib import Path


def main(package: Path, output: Path) -> None:
    """Decodes each ``hdri/NAME.exr.js``, a JavaScript module that exports the file as a base64 data URL."""
    output.mkdir(parents=True, exist_ok=True)
    for module in sorted((package / "hdri").glob("*.exr.js")):
        data = module.read_text().split("base64,", 1)[1].split("'", 1)[0]
        (output / module.name.removesuffix(".js")).write_bytes(base64.b64decode(data))
        print(output / module.name.removesuffix(".js"))


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python examples/gallery/environments.py PACKAGE OUTPUT")
    main(Path(sys.argv[1]), Path(sys.argv[2]))
