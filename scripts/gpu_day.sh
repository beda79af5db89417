#!/usr/bin/env bash
# Checks and measures raster=triton in fifteen minutes on a borrowed machine with a GPU, offline.
#   scripts/gpu_day.sh wheels                 before, with a network: packs gpu_day/brought.tar.xz
#   scripts/gpu_day.sh run [SECONDS [PART…]]  there: every part, in nine minutes (540); again: these
#                                             parts, or those that did not end well
#   scripts/gpu_day.sh table ARCHIVE          after: tables for docs/gpu.md and docs/measurements.md
# GPU_DAY_TINY=1 tries all without a GPU, in Triton's interpreter.
#
# The machine needs torch for CUDA, numba, scipy, scikit-image, pandas, matplotlib, pyyaml, rich,
# requests, psutil, hypothesis and pytest, and nvcc for gsplat and Faster-GS.
#
# wheels: GPU_DAY_SCENE is the folder of bonsai, GSBENCH_WEIGHTS that of the weights, and
#   GPU_DAY_FASTER_GS a checkout of nerficg-project/faster-gaussian-splatting (commit 3cb0b755,
#   Apache-2.0; cub::Max, which CUDA 13 no longer has, is replaced). It packs 39 MiB: wheels for
#   Python 3.12 on x86-64, the 200 images that a trial takes, their cloud, and the weights.
# run: the proof (50 s); the contract test and the test of equal bits (50 s); benchmarks.host (15 s);
#   bench at 100,000, 1 and 3 million Gaussians (75 s), and with and without split lists
#   (60 s); Faster-GS in turns with ours (30 s, benchmarks/faster_gs.py); three trainings of bonsai
#   side by side (150 s); gsplat (50 s); compute-sanitizer (35 s). If a part ends early, later ones
#   get its time. Results are written to $OUT every 20 s and when a part ends.
#   A second command goes on with trainings from their checkpoints.
#
# The authors' 2023 code is not packed. With its checkout and an environment in which it runs, this
# trains it for 30,000 iterations on the same views:
#   gsbench name=authors scene=colmap scene.path=/tmp/gpu_day/bonsai scene.principal_point=centred \
#     init=dataset train=paper densify=external/3dgs densify.options.code=…/gaussian-splatting \
#     densify.options.python=…/bin/python
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
case ${1:-} in wheels | run | table) exec "$PYTHON" scripts/gpu_day.py "$@" ;; esac
sed -n '2,7s/^# \{0,1\}//p' "${BASH_SOURCE[0]}"
exit 2
