#!/bin/sh
# Frames as an array of SLURM: task k of n makes frames k, k + n, k + 2 n and so on, all in one folder.
#
#   sbatch --array=0-9 slurm_array.sh 240 animate scene.toml -o frames       240 frames by 10 tasks
#
# A task that is stopped, or that ends with status 3 (some frames could not be made), goes on when it is queued again;
# 2 is a mistake, which comes again. The film at the end, after all tasks: lumisplat animate scene.toml -o frames --video film.mp4
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
