"""Renders frames as an OpenCue job (pip install opencue-pyoutline): each task makes a chunk in one folder.

python opencue_submit.py 240 10 animate scene.toml -o /share/frames          240 frames, 10 a task

Paths are those of the hosts. OpenCue repeats a task with an exit status other than 0; finished frames are kept.
The video at the end: lumisplat animate scene.toml -o /share/frames --video walk.mp4
"""

from __future__ import annotations

import sys
from importlib import import_module


def main(count: int, chunk: int, arguments: list[str]) -> None:
    """Submits the frames of a command.

    Args:
        count: Number of frames.
        chunk: Frames per task.
        arguments: Arguments after ``lumisplat``.
    """
    outline, cuerun, shell = map(import_module, ("outline", "outline.cuerun", "outline.modules.shell"))

    # Not #FRAME_START# and #FRAME_END#: the latter is too large for a shorter last chunk.
    command = ["lumisplat", *arguments, "--frames", "#FRAMESPEC#"]
    job = outline.Outline("lumisplat", shot="film", show="show")
    job.add_layer(shell.Shell("frames", command=command, range=f"0-{count - 1}", chunk=chunk))
    cuerun.launch(job, use_pycuerun=False)


if __name__ == "__main__":
    if len(sys.argv) < 4:
        raise SystemExit("usage: python opencue_submit.py FRAMES CHUNK animate scene.toml -o FOLDER")
    main(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3:])
