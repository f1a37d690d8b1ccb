#!/bin/bash
# One run on Slurm: sbatch deploy/slurm.sh SCENE RUN [options of `panolog run`]. How to use it: slurm.md.
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
#SBATCH --output=panolog-%j.log
set -euo pipefail

scene=${1:?which scene} run=${2:?which run folder}
shift 2

# Slurm runs a copy of this script: other files are found from the folder where sbatch was called.
# shellcheck source=/dev/null
. "$SLURM_SUBMIT_DIR/.venv/bin/activate"
set -a
# shellcheck source=deploy/recovery.env
. "$SLURM_SUBMIT_DIR/deploy/recovery.env"
set +a
RAY_AUTH_TOKEN=$(od --address-radix=n --read-bytes=32 --format=x1 /dev/urandom | tr --delete ' \n')
export RAY_AUTH_TOKEN RAY_AUTH_MODE=token RAY_USAGE_STATS_ENABLED=0

ip=$(hostname --all-ip-addresses | cut --delimiter=' ' --fields=1)
head=$ip:$((20000 + SLURM_JOB_ID % 10000))
while :; do ray start --head --block --node-ip-address="$ip" --port="${head#*:}" || true; sleep 5; done &
until ray health-check --address="$head" 2> /dev/null; do sleep 1; done

# A node that Ray has declared dead, because it could not be reached for a while, ends its Ray: it joins again.
workers=$((SLURM_NNODES - 1))
if ((workers > 0)); then
    srun --nodes="$workers" --ntasks="$workers" --exclude="$SLURMD_NODENAME" --no-kill --kill-on-bad-exit=0 \
        bash -c "while :; do ray start --address=$head --block; sleep 5; done" &
fi

# Ten minutes before the time limit Slurm sends TERM: checkpoints are written, and the job is queued again.
driver='' stopping=''
stop() {
    stopping=yes
    if [[ $driver ]]; then kill -TERM "$driver" || true; fi
}
trap stop TERM
if [[ -e $run/run.json ]]; then
    panolog resume "$run" --address="$head" --supervise &
else
    panolog run "$scene" --output "$run" --address="$head" --supervise "$@" &
fi
driver=$!
if [[ $stopping ]]; then stop; fi

while kill -0 "$driver" 2> /dev/null; do wait "$driver" || true; done # a signal ends a wait, not the driver
code=0
wait "$driver" || code=$? # bash keeps the exit code
if ((code == 130 || code == 143)); then # interrupted, or before its signal handler
    scontrol requeue "$SLURM_JOB_ID"
fi
exit "$code"
