"""The search of the documentation site finds pages by the words of other programs."""

from __future__ import annotations

import json
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"
WORDS = {
    "environment map": "guide/light",
    "HDRI": "guide/light",
    "envmap": "guide/light",
    "shadow catcher": "guide/light",
    "light linking": "guide/light",
    "integrator": "guide/light",
    "samples per pixel": "guide/light",
    "spp": "guide/light",
    "denoiser": "guide/light",
    "BSDF": "guide/scenes",
    "glass": "guide/scenes",
    "AOV": "guide/outputs",
    "render passes": "guide/outputs",
    "Cryptomatte": "guide/outputs",
    "sensor": "guide/captures",
    "transforms.json": "guide/captures",
    "sh_degree": "guide/captures",
    "densification": "guide/training",
    "splatfacto": "guide/training",
    "depth of field": "guide/rays",
    "LiDAR": "guide/rays",
    "path tracing": "guide/paths",
    "baking": "guide/bake",
    "viewport": "guide/viewer",
    "differentiable rendering": "guide/packages",
}
"""Words of other programs -> the page that the search shows first."""


@pytest.fixture(scope="module")
def index(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Returns the search index of the guide, without the pages that take long to build."""
    pytest.importorskip("sphinx_design")
    pytest.importorskip("myst_parser")
    out = tmp_path_factory.mktemp("site")
    others = [
        "_build",
        "adr",
        "method",
        "tutorials",
        *(page.name for page in DOCS.glob("*.md") if page.stem != "index"),
    ]
    options = ["-Q", "-b", "html", "-d", str(out / "trees"), "-D", f"exclude_patterns={','.join(others)}"]
    subprocess.run([sys.executable, "-m", "sphinx", *options, str(DOCS), str(out)], check=True)
    return json.loads((out / "searchindex.js").read_text(encoding="utf-8").removeprefix("Search.setIndex(")[:-1])


def test_words_of_other_programs_are_found_first(index: dict[str, Any]) -> None:
    """Index entries rank above titles and text in Sphinx's search, by the share of the entry that the query covers."""
    first: dict[str, set[str]] = {}
    for word in WORDS:
        found = [
            (len(word) / len(entry), index["docnames"][page])
            for entry, places in index["indexentries"].items()
            for page, _, is_main in places
            if word.lower() in entry and 2 * len(word) >= len(entry) and is_main
        ]
        first[word] = {page for share, page in found if share == max(found)[0]}
    assert not {word: pages for word, pages in first.items() if pages != {WORDS[word]}}


def test_all_rows_of_words_lead_to_a_page() -> None:
    """The site's settings find each row of the tables, and the page that it names."""
    pytest.importorskip("sphinx")
    conf = runpy.run_path(str(DOCS / "conf.py"))
    text = (DOCS / "guide" / "from_other_programs.md").read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if line.startswith("| ") and not line.startswith(("| ---", "| there"))]
    assert len(conf["_ROW"].findall(text)) == len(lines) > 50
    assert all((DOCS / f"{page}.md").is_file() for page, _, _ in conf["words_of_other_programs"]())
