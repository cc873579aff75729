#!/bin/sh
# Renders frames as a Deadline job: each task makes a chunk of frames in one folder.
#
#   deadline_submit.sh 240 10 animate scene.toml -o /share/frames            240 frames, 10 a task
#
# Paths are those of the workers. Deadline repeats a task with an exit status other than 0; finished frames are
# kept. The video at the end: lumisplat animate scene.toml -o /share/frames --video walk.mp4
set -eu

count=$1
chunk=$2
shift 2
arguments=
for argument in "$@"; do
    arguments="$arguments<QUOTE>$argument<QUOTE> "
done
exec deadlinecommand -SubmitCommandLineJob \
    -executable "$(command -v lumisplat)" \
    -arguments "$arguments--frames <STARTFRAME>-<ENDFRAME>" \
    -frames "0-$((count - 1))" \
    -chunksize "$chunk" \
    -startupdirectory "$PWD" \
    -name lumisplat
