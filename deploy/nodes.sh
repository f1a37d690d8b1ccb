#!/bin/bash
# One run on machines that start together and know their rank: RANK=0 HEAD=10.0.0.4 deploy/nodes.sh SCENE RUN [options of
# `panolog run`]. SCENE and RUN are URLs of an object store, so that no disk of a machine is needed. How to use it: spot.md.
set -euo pipefail

scene=${1:?which scene} run=${2:?which run}
shift 2
: "${RANK:?rank of this machine, 0 for the first}" "${HEAD:?address of the machine with rank 0}"
address=$HEAD:${PANOLOG_PORT:-6380}

set -a
# shellcheck source=deploy/recovery.env
. "$(dirname "$0")/recovery.env"
set +a
export RAY_USAGE_STATS_ENABLED=0
if [[ ${RAY_AUTH_TOKEN:-} ]]; then export RAY_AUTH_MODE=token; fi

if ((RANK > 0)); then # a machine that was cut off for a while joins again, until the first one has ended
    until ray health-check --address="$address" 2> /dev/null; do sleep 1; done
    while ray health-check --address="$address" 2> /dev/null; do
        ray start --address="$address" --block || true
        sleep 5
    done
    exit 0
fi

ray start --head --node-ip-address="$HEAD" --port="${address#*:}"
trap 'ray stop' EXIT
if panolog status "$run" > /dev/null; then
    panolog resume "$run" --address="$address"
else
    panolog run "$scene" --output "$run" --address="$address" "$@"
fi
