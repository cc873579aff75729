"""The search of the documentation site finds pages by the words of other programs."""

from __future__ import annotations

import json
import re
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"
WORDS = """environment map, HDRI, envmap, shadow catcher, light linking, integrator, samples per pixel, spp, denoiser
BSDF, glass, AOV, render passes, Cryptomatte, holdout, sensor, transforms.json, sh_degree, densification, splatfacto
depth of field, LiDAR, path tracing, baking, viewport, differentiable rendering""".replace("\n", ", ").split(", ")
"""Words of other programs that must lead to the page of their row."""


def conf() -> dict[str, Any]:
    """Returns the names in the site's settings."""
    pytest.importorskip("sphinx")
    return runpy.run_path(str(DOCS / "conf.py"))


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


def test_documentation_search_for_a_word_of_another_program_finds_its_page_first(index: dict[str, Any]) -> None:
    """Sphinx's search ranks index entries above titles and text, by the fraction of the entry that the query covers."""
    expected = {word.lower(): page for page, _, word in conf()["words_of_other_programs"]()}
    first: dict[str, set[str]] = {}
    for word in WORDS:
        found = [
            (len(word) / len(entry), index["docnames"][page])
            for entry, positions in index["indexentries"].items()
            for page, _, is_main in positions
            if word.lower() in entry and 2 * len(word) >= len(entry) and is_main
        ]
        first[word] = {page for fraction, page in found if fraction == max(found)[0]}
    assert first == {word: {expected[word.lower()]} for word in WORDS}


def test_every_word_of_another_program_in_the_search_index_leads_to_a_page_about_it() -> None:
    """Pages of rows exist, and at least one of the options, keys or functions of a row is on its page."""
    text = (DOCS / "guide" / "from_other_programs.md").read_text(encoding="utf-8")
    rows = [line for line in text.splitlines() if line.startswith("| ") and not line.startswith(("| ---", "| there"))]
    assert len(conf()["_ROW"].findall(text)) == len(rows) > 50
    strange: list[str] = []
    for row in rows:
        page = (DOCS / "guide" / row.rpartition("](")[2].split(")")[0].split("#")[0]).read_text(encoding="utf-8")
        names = re.findall(r"[\w-]{2,}", " ".join(re.findall(r"`([^`]+)`", row.split(" | ")[1])))
        if names and not any(name in page for name in names if name != "lumisplat"):
            strange.append(row)
    assert not strange
