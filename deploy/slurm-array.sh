#!/bin/bash
# Many runs on Slurm, some at a time: sbatch --array=1-20%2 deploy/slurm-array.sh LIST. How to use it: slurm.md.
#SBATCH --job-name=panolog
#SBATCH --nodes=4
#SBATCH --ntasks-per-node=1
#SBATCH --gpus-per-node=1
#SBATCH --exclusive
#SBATCH --time=24:00:00
#SBATCH --signal=B:TERM@600
#SBATCH --no-kill
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --output=panolog-%A-%a.log
set -euo pipefail

list=${1:?which list of runs}
line=$(sed --quiet "${SLURM_ARRAY_TASK_ID:?start it with --array}p" "$list")
# xargs knows quotes, so that paths may hold spaces
mapfile -t words < <(printf '%s\n' "$line" | xargs --no-run-if-empty printf '%s\n')
if ((${#words[@]} < 2)); then
    echo "$list: line $SLURM_ARRAY_TASK_ID is not of the form SCENE RUN [options]" >&2
    exit 2
fi
exec bash "$SLURM_SUBMIT_DIR/deploy/slurm.sh" "${words[@]}" # with the same number: Slurm's signal reaches it
