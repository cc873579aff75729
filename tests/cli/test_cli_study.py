"""Tests ``lumisplat study``: its page in Chromium, and the analysis of answers."""

from __future__ import annotations

import csv
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.stats import binomtest

import lumisplat as ls
from support.files.cli_files import Workspace

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
HEADER = "rater,question,pair,method,left,right,choice,winner,again"


@pytest.fixture
def work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Workspace:
    """Returns a folder with three pairs of images: white ones in ``ours``, black ones in ``base``."""
    workspace = Workspace(tmp_path, capsys)
    for method, shade in (("ours", 255), ("base", 0)):
        workspace.path(method).mkdir()
        for name in "abc":
            Image.fromarray(np.full((4, 6, 3), shade, np.uint8)).save(workspace.path(f"{method}/{name}.png"))
    return workspace


@pytest.mark.parametrize(("wins", "votes"), [(0, 5), (9, 12), (12, 12), (75, 100)])
def test_win_rate_has_the_wilson_interval_of_scipy(wins: int, votes: int) -> None:
    """SciPy computes the same interval by another formula."""
    expected = binomtest(wins, votes).proportion_ci(method="wilson")
    found = ls.metrics.win_rate(wins, votes)
    np.testing.assert_allclose(found, (wins / votes, expected.low, expected.high), atol=1e-12)


def test_win_rate_without_votes_is_unknown() -> None:
    """The interval is 0..1."""
    found = ls.metrics.win_rate(0, 0)
    assert np.isnan(found.rate) and found[1:] == (0.0, 1.0)
    with pytest.raises(ls.ConfigError, match="wins is 3, expected"):
        ls.metrics.win_rate(3, 2)


def test_study_analysis_counts_votes_by_question_and_pair(work: Workspace) -> None:
    """Repeated answers do not count as votes; a line says how many are as before."""
    rows = [
        f"{rater},Realism,{pair},ours,ours,base,left,{winner},{again}"
        for rater, pair, winner, again in (
            ("x", "a", "ours", 0),
            ("x", "b", "base", 0),
            ("x", "a", "base", 1),
            ("y", "a", "ours", 0),
            ("y", "b", "ours", 0),
            ("y", "b", "ours", 1),
        )
    ]
    for name, part in (("x.csv", rows[:3]), ("y.csv", rows[3:])):
        work.path(name).write_text("\r\n".join([HEADER, *part]) + "\r\n")
    outcome = work.run("study", "--analyse", "@x.csv", "@y.csv")
    assert outcome.status == 0, outcome.err
    for name, figures in (("a", r"2 +2 +100\.0"), ("b", r"1 +2 +50\.0"), ("all pairs", r"3 +4 +75\.0")):
        assert re.search(rf"Realism, {name} +{figures} +[\d.]+ to [\d.]+", outcome.out), outcome.out
    assert "wins of ours over base" in outcome.out and "1 of 2 repeated answers are as before" in outcome.out


@pytest.mark.parametrize(
    ("args", "problem"),
    [
        (("@ours",), "1 file given, expected two images"),
        (("@ours", "@none"), "none: no such file or folder"),
        (("@ours", "@base", "--repeats", "4"), "--repeats is 4, expected 0 to 3"),
        (("@ours", "@base", "--question", "Which?"), "expected NAME=TEXT"),
        (("@capture.ply", "@mesh.obj"), "capture.ply: browsers do not show it"),
        (("--analyse",), "--analyse needs files of answers"),
        (("--analyse", "@mesh.obj"), "is not a file of answers"),
    ],
)
def test_study_reports_mistakes_in_one_line(work: Workspace, args: tuple[str, ...], problem: str) -> None:
    """No page is written."""
    outcome = work.run("study", *args, "-o", "@s.html")
    assert outcome.status == 2 and problem in outcome.err and outcome.err.count("\n") == 1
    assert not work.path("s.html").exists()


def test_large_files_of_a_study_lie_beside_the_page_without_their_methods_names(
    work: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Small ones are part of the page, in which a question cannot end the script."""
    assert work.run("study", "@ours", "@base", "-o", "@in.html", "--question", "Q=</script>?").status == 0
    page = work.path("in.html").read_text()
    assert page.count("data:image/png;base64,") == 6 and page.count("</script>") == 1
    monkeypatch.setattr("lumisplat.cli.commands.study._INLINE_BYTES", 10)
    assert work.run("study", "@ours", "@base", "-o", "@out.html").status == 0
    names = sorted(path.name for path in work.path("out_files").iterdir())
    assert names == [f"{number:04d}{side}.png" for number in range(3) for side in "ab"]


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")
def test_page_of_a_study_saves_answers_of_which_the_analysis_finds_the_preference(work: Workspace) -> None:
    """A rater who always prefers white wins all votes for it; order and sides differ between raters."""
    playwright = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")
    assert work.run("study", "@ours", "@base", "-o", "@s.html", "--repeats", "1").status == 0
    seen: dict[str, list[tuple[str, str]]] = {}
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page()
        requests: list[str] = []
        page.on("request", lambda request: requests.append(request.url))
        is_white = """element => { const canvas = document.createElement("canvas"); const c = canvas.getContext("2d");
            return element.decode().then(() => {
                c.drawImage(element, 0, 0);
                return c.getImageData(1, 1, 1, 1).data[0] > 0;
            }); }"""
        for rater in ("x, the first", "y"):
            page.goto(work.path("s.html").as_uri())
            page.fill("#rater", rater)
            page.click("#begin")
            for _ in range(4):
                assert page.is_disabled("#next")
                side = "left" if page.eval_on_selector("#left img", is_white) else "right"
                for row in page.query_selector_all("#questions p"):
                    row.query_selector(f"text={side}").click()
                page.click("#next")
            with page.expect_download() as saved:
                page.click("#save")
            path = work.path(f"{rater[0]}.csv")
            saved.value.save_as(path)
            with path.open(newline="") as file:
                rows = list(csv.DictReader(file))
            assert {row["rater"] for row in rows} == {rater} and {row["winner"] for row in rows} == {"ours"}
            assert [row["again"] for row in rows] == ["0"] * 6 + ["1"] * 2
            seen[rater] = [(row["pair"], row["left"]) for row in rows]
            again = seen[rater][-1]
            assert (again[0], "base" if again[1] == "ours" else "ours") in seen[rater][:6]  # sides are swapped
        browser.close()
    assert not [url for url in requests if url.startswith("http")]
    assert len({tuple(trials) for trials in seen.values()}) == 2
    outcome = work.run("study", "--analyse", "@x.csv", "@y.csv")
    assert "2 raters" in outcome.out and "4 of 4 repeated answers are as before" in outcome.out
    assert sum("100.0" in line and "61.0 to 100.0" in line for line in outcome.out.splitlines()) == 2
