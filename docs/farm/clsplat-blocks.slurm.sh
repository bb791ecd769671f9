#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# Submits a large scene in blocks to Slurm: the plan, an array with a job for each block and one for the sky, the merge
# and the finish.
#
#     BLOCKS=2x2 COUNT=5 sh clsplat-blocks.slurm.sh /shared/scene /shared/city [settings of clsplat blocks plan]
#
# COUNT is the number of blocks, and one more for the sky; jobs of the array without a block end at once. Both folders
# must have the same paths on all nodes. SBATCH has further options of sbatch, such as "--gres=gpu:1 --time=8:00:00".
# What was interrupted goes on when this script is run again. CLSPLAT names the command, if it is not clsplat.
set -eu

scene=$(realpath "$1")
city=$(realpath "$2")
shift 2
BLOCKS=${BLOCKS:-2x2}
COUNT=${COUNT:-5}
CLSPLAT=${CLSPLAT:-clsplat}
mkdir -p "$city/jobs"

# submit NAME DEPENDENCY [OPTIONS]: submits the job script on standard input, and prints the number of the job. If the
# job that it depends on fails, it is cancelled. Slurm sends SIGTERM (B: to the job script, which is the command) two
# minutes before a job's time is over, so that the command can write a checkpoint.
submit() {
    name=$1 after=$2
    shift 2
    case "$*" in *--array*) number=%A_%a ;; *) number=%j ;; esac
    # SBATCH is split into words
    # shellcheck disable=SC2086
    sbatch --parsable --job-name "clsplat-$name" --output "$city/jobs/slurm-$name-$number.log" --signal=B:TERM@120 \
        --kill-on-invalid-dep=yes ${after:+--dependency=afterok:$after} ${SBATCH:-} "$@"
}

# job COMMAND...: a job script that runs the command, whose words may have spaces
job() {
    printf '#!/bin/sh\nexec'
    for word; do
        printf " '%s'" "$(printf %s "$word" | sed "s/'/'\\\\''/g")"
    done
    printf '\n'
}

plan=$(job "$CLSPLAT" blocks plan "$scene" -o "$city" --blocks "$BLOCKS" "$@" | submit plan '')
blocks=$(
    job "$CLSPLAT" blocks train "$city" --block SLURM_ARRAY_TASK_ID | sed "s/'SLURM_ARRAY_TASK_ID'/\$SLURM_ARRAY_TASK_ID/" |
        submit block "$plan" --array="0-$((COUNT - 1))"
)
merge=$(job "$CLSPLAT" blocks merge "$city" | submit merge "$blocks")
finish=$(job "$CLSPLAT" blocks finish "$city" | submit finish "$merge")
echo "$finish"
