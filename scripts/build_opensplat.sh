#!/usr/bin/env bash
# Builds OpenSplat 1.2.0 for the CPU, the program that densify=external/opensplat runs.
#   scripts/build_opensplat.sh FOLDER    # the program becomes FOLDER/opensplat; about ten minutes on two cores
# OPENSPLAT_SOURCE may name a checkout or mirror to clone from. It uses the torch in .venv; OpenCV, CMake and a compiler
# come from Debian's or Ubuntu's packages.
set -euo pipefail
COMMIT=bd0400db58aa14c597bf2f99c4b68cdef7b6134d # version 1.2.0, 2026-08-20
SOURCE=${OPENSPLAT_SOURCE:-https://github.com/WebODM/OpenSplat}
PYTHON="$(cd "$(dirname "$0")/.." && pwd)/.venv/bin/python"
mkdir -p "${1:?give the folder to build in}"
cd "$1"

missing=()
for package in cmake g++ git libopencv-dev; do
  dpkg-query --status "$package" >/dev/null 2>&1 || missing+=("$package")
done
if [ "${#missing[@]}" -gt 0 ]; then
  apt-get update -qq && apt-get install -y -qq --no-install-recommends "${missing[@]}"
fi

[ -d source ] || git clone --quiet "$SOURCE" source
git -C source checkout --quiet "$COMMIT"
torch=$("$PYTHON" -c 'import torch; print(torch.utils.cmake_prefix_path)')
cmake -S source -B build -DCMAKE_BUILD_TYPE=Release -DGPU_RUNTIME=CPU -DCMAKE_PREFIX_PATH="$torch"
cmake --build build --target opensplat --parallel "${JOBS:-$(nproc)}"
ln -sf "$PWD/build/opensplat" opensplat
./opensplat --version
