#!/usr/bin/env bash
# Checks and times raster=triton on a GPU: 45 minutes on a machine without a network, no command above ten minutes.
#
#   scripts/gpu_day.sh wheels   before, with a network: download the packages for Python 3.12 on x86-64
#   scripts/gpu_day.sh setup    on the machine: install them; gsplat compiles in the background      (1 minute)
#   scripts/gpu_day.sh check    tests of the contract, equal bits in three runs, memory checker      (8 minutes)
#   scripts/gpu_day.sh speed    bench of triton and gsplat with the time of each kernel              (9 minutes)
#   scripts/gpu_day.sh train    7,000 steps of bonsai with both, then bench of the trained model     (9 minutes)
#   scripts/gpu_day.sh table    all results as Markdown, for docs/gpu.md                             (1 second)
#
# The wheels are in gpu_day/wheels1, wheels2, … of 50 MB at most each. If space is short, bring one folder after the other
# and repeat `setup`. The scene is in gpu_day/bonsai (a COLMAP folder). The machine needs Python, torch for CUDA, numba
# and pytest; gsplat needs nvcc. Results are in $GPU_DAY_STATE/results. If $OUT is set, they are also packed into it after
# each command; if the machine changes between commands, unpack them before `table`.
#
# GPU_DAY_TINY=1 tries everything without a GPU, in Triton's interpreter, at sizes whose times mean nothing.
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.." || exit 1

PYTHON=${PYTHON:-python3}
BROUGHT=${GPU_DAY_BROUGHT:-gpu_day}
STATE=${GPU_DAY_STATE:-/tmp/gpu_day}
RESULTS=$STATE/results
WHEELS=(hydra-core omegaconf pydantic pydantic_core annotated-types typing-inspection kornia kornia_rs flip-evaluator
  plyfile gsplat pycolmap)
SOURCES=(antlr4-python3-runtime) # packages without wheels
WHEELS_AT_ONCE=50000000          # bytes

if [ "${GPU_DAY_TINY:-}" ]; then
  export TRITON_INTERPRET=1 OMP_NUM_THREADS=1
  DEVICE=cpu RASTERS=(triton cpu) COUNTS=(3) SCENES=(trained) SIZE=16x16 SMALL=16x16 REPEATS=1
  CONTRACT="triton and nothing_to_see"
  TRAIN=(scene=courtyard scene.views=8 scene.width=32 scene.height=24 init=random init.count=6 train=7k train.iterations=2)
else
  DEVICE=cuda RASTERS=(triton gsplat) SIZE=1600x1060 SMALL=48x32 REPEATS=10
  COUNTS=(100000 1000000 3000000) SCENES=(trained random skewed)
  CONTRACT="triton or on_a_gpu"
  TRAIN=(scene=colmap "scene.path=$BROUGHT/bonsai" init=dataset train=7k)
fi
export PYTHONPATH="$STATE/site:$PWD/src:$PWD${PYTHONPATH:+:$PYTHONPATH}" PYTHONUNBUFFERED=1
export TORCH_EXTENSIONS_DIR=$STATE/extensions GSBENCH_RUNS=$STATE/runs

# step NAME LIMIT COMMAND…: runs a command for LIMIT seconds at most. Its output goes to NAME.out, errors to NAME.log,
# exit code and seconds to steps.tsv. A failure is shown, and the next step runs. No step begins after nine minutes.
failed=0
step() {
  local name=$1 limit=$2 begin=$SECONDS code=0
  shift 2
  local left=$((570 - SECONDS))
  if [ "$left" -lt 30 ]; then
    echo "$name: no time left"
    printf '%s\t%s\t%s\n' "$name" late 0 >>"$RESULTS/steps.tsv"
    failed=1
    return 1
  fi
  timeout --kill-after=10 "$((limit < left ? limit : left))" "$@" >"$RESULTS/$name.out" 2>"$RESULTS/$name.log" || code=$?
  printf '%s\t%s\t%s\n' "$name" "$code" "$((SECONDS - begin))" >>"$RESULTS/steps.tsv"
  echo "$name: exit $code, $((SECONDS - begin)) s"
  [ "$code" = 0 ] || { failed=1 && tail -n 20 "$RESULTS/$name.log" "$RESULTS/$name.out"; }
  return "$code"
}

wheels() {
  local folder=$BROUGHT/wheels package pinned number=1 size=0 bytes
  rm -rf "$BROUGHT"/wheels* && mkdir -p "$folder" || return 1
  for package in "${WHEELS[@]}"; do
    pinned=$(grep "^$package==" constraints.txt) || { echo "constraints.txt has no $package" >&2 && return 1; }
    "$PYTHON" -m pip download -q --no-deps --only-binary=:all: --python-version 3.12 --implementation cp \
      --platform manylinux_2_28_x86_64 --platform manylinux_2_27_x86_64 --platform manylinux_2_17_x86_64 \
      --platform manylinux2014_x86_64 --platform manylinux1_x86_64 -d "$folder" "$pinned" || return 1
  done
  for package in "${SOURCES[@]}"; do
    "$PYTHON" -m pip wheel -q --no-deps -w "$folder" "$(grep "^$package==" constraints.txt)" || return 1
  done
  for package in $(ls -Sr "$folder"); do
    bytes=$(stat -c %s "$folder/$package")
    [ $((size + bytes)) -lt "$WHEELS_AT_ONCE" ] || { number=$((number + 1)) && size=0; }
    size=$((size + bytes))
    mkdir -p "$folder$number" && mv "$folder/$package" "$folder$number/" || return 1
  done
  rmdir "$folder" && du -sh "$BROUGHT"/wheels*
}

setup() {
  local found=("$BROUGHT"/wheels*/*.whl)
  if [ -e "${found[0]}" ]; then
    step setup 200 "$PYTHON" -m pip install -q --no-index --no-deps --no-compile --upgrade --target "$STATE/site" \
      "${found[@]}" || return 1
  fi
  step machine 100 "$PYTHON" scripts/gpu_day.py machine && cat "$RESULTS/machine.out"
  if [ ! -e "$STATE/gsplat.exit" ] && [ "$DEVICE" = cuda ]; then # continues after this command has ended
    TORCH_CUDA_ARCH_LIST=$("$PYTHON" -c 'import torch; print("%d.%d" % torch.cuda.get_device_capability())') MAX_JOBS=12 \
      setsid --fork bash -c '"$0" -c "from gsplat.cuda._backend import _C; assert _C" >"$1.log" 2>&1; echo $? >"$1.exit"' \
      "$PYTHON" "$STATE/gsplat" </dev/null >/dev/null 2>&1
  fi
}

check() {
  step contract 330 "$PYTHON" -m pytest -q -p no:cacheprovider tests/raster/test_contract.py tests/raster/test_gsplat.py \
    -k "$CONTRACT"
  step bits 100 "$PYTHON" scripts/gpu_day.py bits "$DEVICE" "$SIZE" "${COUNTS[0]}"
  local checker
  if checker=$(PATH=$PATH:/usr/local/cuda/bin command -v compute-sanitizer); then # without caching, each tensor is its own allocation, so that overruns are seen
    PYTORCH_NO_CUDA_MEMORY_CACHING=1 step memcheck 140 "$checker" --tool memcheck --error-exitcode 9 \
      "$PYTHON" scripts/gpu_day.py bits "$DEVICE" "$SMALL" "${COUNTS[0]:0:3}"
  else
    echo "memcheck: compute-sanitizer is not here"
  fi
}

wait_for_gsplat() {
  [ "$DEVICE" = cuda ] || return 0
  local until=$((SECONDS + ${1}))
  until [ -e "$STATE/gsplat.exit" ] || [ "$SECONDS" -ge "$until" ]; do sleep 2; done
  [ "$(cat "$STATE/gsplat.exit" 2>/dev/null)" = 0 ] && return
  echo "gsplat is not compiled (yet): triton alone" && tail -n 20 "$STATE/gsplat.log"
  cp "$STATE/gsplat.log" "$RESULTS/" 2>/dev/null
  RASTERS=(triton)
}

bench() { # NAME LIMIT ARGUMENT…
  local name=$1 limit=$2 rasters
  shift 2
  rasters=$(IFS=, && echo "${RASTERS[*]}")
  step "bench-$name" "$limit" "$PYTHON" -m gsbench.cli bench --raster "$rasters" --size "$SIZE" --repeats "$REPEATS" \
    --json "$@"
}

speed() {
  wait_for_gsplat 200
  local scene count
  for count in "${COUNTS[@]}"; do
    for scene in "${SCENES[@]}"; do
      bench "$scene-$count" 150 --scene "$scene" --count "$count"
    done
  done
}

train() {
  wait_for_gsplat 60
  local raster found model=
  for raster in "${RASTERS[@]}"; do
    step "train-$raster" 240 "$PYTHON" -m gsbench.cli "name=gpu_day_$raster" "${TRAIN[@]}" densify=adc "raster=$raster" \
      "device=$DEVICE" tracking=none || continue
    found=$(echo "$STATE/runs/gpu_day_$raster"/*/*/*/results.json)
    cp "$found" "$RESULTS/train-$raster.json" && model=${model:-$(dirname "$found")/point_cloud.ply}
  done
  [ -z "$model" ] || bench model 120 --ply "$model"
}

case ${1:-} in
wheels)
  wheels
  exit
  ;;
setup | check | speed | train) ;;
table) exec "$PYTHON" scripts/gpu_day.py table "$RESULTS" ;;
*)
  sed -n '2,18s/^# \{0,1\}//p' "${BASH_SOURCE[0]}"
  exit 2
  ;;
esac
mkdir -p "$RESULTS"
"$1"
[ -z "${OUT:-}" ] || tar -czf "$OUT/gpu_day-$1.tar.gz" -C "$STATE" results
exit "$failed"
