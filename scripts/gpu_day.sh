#!/usr/bin/env bash
# Checks and measures raster=triton in fifteen minutes on a borrowed machine with a GPU and no network.
#
#   scripts/gpu_day.sh wheels            before, with a network: pack all that the machine lacks into gpu_day/
#   scripts/gpu_day.sh all [SECONDS]     on the machine: every part, in one command of nine minutes (540 s)
#   scripts/gpu_day.sh rest [SECONDS [PART…]]  on the machine: these parts; without names, the parts of `all`
#                                        that did not end well, or else trainings of the next seed (200 s)
#   scripts/gpu_day.sh table FOLDER      after: the tables for docs/gpu.md and docs/measurements.md
#
# `wheels` needs GPU_DAY_SCENE, a COLMAP folder of bonsai; it takes LPIPS weights from $GSBENCH_WEIGHTS.
# Carry the folder gpu_day along with the repository. The machine needs Python 3.12 with torch for CUDA,
# numba, scipy, pandas and pytest; gsplat needs nvcc. Each part has its own limit, and its result is in $OUT
# (gpu_day-all.tar.gz, gpu_day-rest.tar.gz) as soon as it ends, so it is kept whatever happens to the others.
#
# GPU_DAY_TINY=1 tries everything without a GPU, in Triton's interpreter, at sizes whose times mean nothing.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

export PYTHON=${PYTHON:-python3}
export GPU_DAY_BROUGHT=${GPU_DAY_BROUGHT:-gpu_day} GPU_DAY_STATE=${GPU_DAY_STATE:-/tmp/gpu_day}
export OUT=${OUT:-$GPU_DAY_STATE/out}
export PYTHONPATH="$GPU_DAY_STATE/site:$PWD/src:$PWD${PYTHONPATH:+:$PYTHONPATH}" PYTHONUNBUFFERED=1
export GSBENCH_RUNS=$GPU_DAY_STATE/runs TORCH_EXTENSIONS_DIR=$GPU_DAY_STATE/extensions
if [ "${1:-}" != wheels ]; then export GSBENCH_WEIGHTS=${GSBENCH_WEIGHTS:-$GPU_DAY_STATE/brought/weights}; fi
if [ "${GPU_DAY_TINY:-}" ]; then export TRITON_INTERPRET=1 OMP_NUM_THREADS=1; fi

case ${1:-} in
wheels | all | rest | table) exec "$PYTHON" scripts/gpu_day.py "$@" ;;
*)
  sed -n '2,17s/^# \{0,1\}//p' "${BASH_SOURCE[0]}"
  exit 2
  ;;
esac
