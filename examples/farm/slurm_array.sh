#!/bin/sh
# Renders frames as a SLURM array: task k of n makes frames k, k + n, k + 2 n and so on in one folder.
#
#   sbatch --array=0-9 slurm_array.sh 240 animate scene.toml -o frames       240 frames by 10 tasks
#
# A stopped task, or one with exit status 3 (some frames failed), continues when it is queued again; status 2 is a
# usage error and repeats. The video at the end, after all tasks: lumisplat animate scene.toml -o frames --video walk.mp4
#SBATCH --job-name=lumisplat
#SBATCH --cpus-per-task=4
#SBATCH --requeue
set -eu

count=$1
shift
tasks=$SLURM_ARRAY_TASK_COUNT
task=$(((SLURM_ARRAY_TASK_ID - SLURM_ARRAY_TASK_MIN) / SLURM_ARRAY_TASK_STEP))
if [ "$task" -ge "$count" ]; then
    exit 0
fi
exec lumisplat "$@" --frames "$task-$((count - 1))x$tasks"
