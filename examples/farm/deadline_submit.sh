#!/bin/sh
# Frames as a job of Deadline: each task makes a chunk of frames, all in one folder.
#
#   deadline_submit.sh 240 10 animate scene.toml -o /share/frames            240 frames, 10 a task
#
# Paths are as the workers see them. Deadline tries a task again that ends with another status than 0; frames that are
# there stay. The film at the end: lumisplat animate scene.toml -o /share/frames --video film.mp4
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
