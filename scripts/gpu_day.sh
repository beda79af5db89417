#!/usr/bin/env bash
# Checks and measures raster=triton in fifteen minutes on a borrowed machine with a GPU, offline.
#   scripts/gpu_day.sh wheels                 before, with a network: packs gpu_day/brought.tar.xz
#   scripts/gpu_day.sh all [SECONDS]          there: every part, one command of nine minutes (540)
#   scripts/gpu_day.sh rest [SECONDS [PART…]] there: these, what failed, or another seed (200)
#   scripts/gpu_day.sh table FOLDER           after: tables for docs/gpu.md and docs/measurements.md
# docs/measurements.md says more. GPU_DAY_TINY=1 tries all without a GPU, in Triton's interpreter.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
export PYTHON=${PYTHON:-python3}
export GPU_DAY_BROUGHT=${GPU_DAY_BROUGHT:-gpu_day} GPU_DAY_STATE=${GPU_DAY_STATE:-/tmp/gpu_day}
export OUT=${OUT:-$GPU_DAY_STATE/out} PYTHONUNBUFFERED=1 PATH=$PATH:/usr/local/cuda/bin MAX_JOBS=12
export PYTHONPATH="$GPU_DAY_STATE/site:$PWD/src:$PWD${PYTHONPATH:+:$PYTHONPATH}"
export GSBENCH_RUNS=$GPU_DAY_STATE/runs TORCH_EXTENSIONS_DIR=$GPU_DAY_STATE/extensions
export GSBENCH_WEIGHTS=${GSBENCH_WEIGHTS:-$GPU_DAY_STATE/weights}
if [ "${GPU_DAY_TINY:-}" ]; then export TRITON_INTERPRET=1 OMP_NUM_THREADS=1; fi
mkdir -p "$GPU_DAY_BROUGHT" "$GPU_DAY_STATE/results" "$OUT"
case ${1:-} in wheels | all | rest | table) exec "$PYTHON" scripts/gpu_day.py "$@" ;; esac
sed -n '2,7s/^# \{0,1\}//p' "${BASH_SOURCE[0]}"
exit 2
