"""Tests failures of ``lumisplat train``: each failure is one line, and no finished work is lost."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lumisplat.cli import main
from lumisplat.training import train
from support.files.small_disks import small_disk
from support.scenes.training_scenes import write_training_folder

SHORT = ("--iterations", "60", "--cap", "120", "--sh-degree", "1", "--device", "cpu")


def error_line(capsys: pytest.CaptureFixture[str]) -> str:
    """Returns the single line of standard error."""
    text = capsys.readouterr().err
    assert text.startswith("error: ") and text.count("\n") == 1, text
    return text


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """Returns a small file system that is soon full."""
    with small_disk(tmp_path / "disk", "200k") as folder:
        yield folder


def test_train_refuses_a_single_image(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Depth needs several images."""
    folder = write_training_folder(tmp_path / "set", 1)
    assert main(["train", str(folder), "-o", str(tmp_path / "a.ply"), *SHORT]) == 2
    assert "transforms.json: has a single image, expected two or more" in error_line(capsys)
    assert not (tmp_path / "a.training").exists()


def test_train_refuses_a_mask_that_is_black_everywhere(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The message names the mask."""
    folder = write_training_folder(tmp_path / "set", 3)
    (folder / "masks").mkdir()
    Image.fromarray(np.zeros((40, 40), np.uint8)).save(folder / "masks" / "01.png")
    assert main(["train", str(folder), "-o", str(tmp_path / "a.ply"), *SHORT]) == 2
    assert "01.png: is black everywhere, so no pixel of its image would be used" in error_line(capsys)
    assert not (tmp_path / "a.training").exists()


def test_train_refuses_a_checkpoint_of_other_settings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The message names the first different setting, and all files stay unchanged."""
    folder, output = write_training_folder(tmp_path / "set"), tmp_path / "a.ply"
    command = ["train", str(folder), "-o", str(output), *SHORT]
    assert main(command) == 0
    capsys.readouterr()
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    before = {path: path.read_bytes() for path in files}
    for option, problem in (
        (("--seed", "7"), "with seed 0, not 7"),
        (("--exposures",), "with exposures False, not True"),
        (("--seed", "7", "--normals", "0.1", "--exposures"), "with normals 0.0, not 0.1"),
    ):
        assert main([*command, *option]) == 2
        file = tmp_path / "a.training" / "checkpoint.npz"
        advice = "use the earlier settings, or start again (--overwrite, overwrite=True)"
        assert error_line(capsys) == f"error: {file}: was trained {problem}: {advice}\n"
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a folder of images, and the files of a finished training of them."""
    folder = tmp_path_factory.mktemp("whole")
    assert main(["train", str(write_training_folder(folder / "set")), "-o", str(folder / "a.ply"), *SHORT]) == 0
    return folder


@pytest.mark.parametrize(
    ("options", "damaged", "output", "advice"),
    [
        (("--seed", "7"), "", "a.ply", "use the earlier settings, or start again"),
        (("--hold-out", "4"), "", "a.ply", "use the earlier ones, or start again"),
        (("--iterations", "30"), "", "a.ply", "request at least as many, or start again"),
        ((), "a.training/checkpoint.npz", "a.ply", "remove it, or start again"),
        ((), "a.training", "b.ply", "choose another output"),
    ],
)
def test_train_succeeds_by_each_remedy_that_its_error_names(
    options: tuple[str, ...],
    damaged: str,
    output: str,
    advice: str,
    whole: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The option in the error trains anew; the other remedy is the earlier command, without a damaged file."""
    for name in ("anew", "other"):
        shutil.copytree(whole, tmp_path / name)
    if damaged.endswith(".npz"):
        (tmp_path / "anew" / damaged).write_bytes(b"of another program")
        (tmp_path / "other" / damaged).unlink()
    elif damaged:
        for name in ("anew", "other"):
            shutil.rmtree(tmp_path / name / damaged)
    command = ["train", str(whole / "set"), *SHORT]
    capsys.readouterr()
    anew = [*command, "-o", str(tmp_path / "anew" / "a.ply"), *options]
    assert main(anew) == 2
    line = error_line(capsys)
    overwrite = re.search(r"\((--\S+),", line)
    assert advice in line and overwrite
    assert main([*anew, overwrite[1]]) == 0
    assert main([*command, "-o", str(tmp_path / "other" / output)]) == 0


@pytest.mark.parametrize(
    ("file", "writes"), [("checkpoint.npz", 20), ("curve.json", 20), ("a.ply", 1), ("metrics.json", 1), ("08.png", 1)]
)
def test_train_on_a_disk_that_fills_up_loses_no_file(
    file: str,
    writes: int,
    whole: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """One line names the file that cannot be written; existing files stay, and the same command continues."""
    folder, output, written = whole / "set", tmp_path / "a.ply", 0
    capsys.readouterr()
    monkeypatch.setattr(train, "CHECKPOINT_EVERY_S", 0.0)
    replace = os.replace

    def full(source: str, target: Path) -> None:
        nonlocal written
        written += target.name == file
        if written == writes:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        replace(source, target)

    command = ["train", str(folder), "-o", str(output), *SHORT]
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", full)
        assert main(command) == 2
    line = error_line(capsys)
    assert file in line and "cannot be written: No space left on device" in line
    assert (tmp_path / "a.training" / "checkpoint.npz").exists()
    assert not list(tmp_path.rglob(".*lumisplat*")), "no half of a file"
    assert main(command) == 0
    for name in ("a.ply", "a.training/curve.json", "a.training/metrics.json"):
        assert (tmp_path / name).read_bytes() == (whole / name).read_bytes()


def test_train_reports_a_full_disk_in_one_line(
    disk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The file system of this test is really full; with free space, the same command continues."""
    folder, output = write_training_folder(tmp_path / "set"), disk / "a.ply"
    monkeypatch.setattr(train, "CHECKPOINT_EVERY_S", 0.0)
    command = ["train", str(folder), "-o", str(output), *SHORT]
    assert main([*command, "--stop-after", "0.01"]) == 0
    capsys.readouterr()
    steps = json.loads((disk / "a.training" / "curve.json").read_text())["count"]
    ballast = disk / "ballast"
    with pytest.raises(OSError, match="No space left"), ballast.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    assert main(command) == 2
    assert "cannot be written: No space left on device" in error_line(capsys)
    ballast.unlink()
    subprocess.run(["mount", "-o", "remount,size=2m", str(disk)], check=True)
    assert main(command) == 0 and steps < 60
    assert "60 of 60 steps" in capsys.readouterr().out
