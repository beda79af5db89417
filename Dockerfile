# gsbench in a container, built by what the README's two commands are built of.
#
#   docker build -t gsbench .                                         gsbench, ready to run on a CPU
#   docker run --rm -v "$PWD/runs:/runs" gsbench +experiment=demo     as `gsbench` anywhere else; results in ./runs
#   docker build --target demo .                                      `make demo`, in the build
#   docker build --target test .                                      `make test`, in the build
#
# For an NVIDIA GPU, build with --build-arg PIP_EXTRA_INDEX_URL= (torch for CUDA) and run with --gpus all.
ARG PYTHON=3.11
FROM docker.io/library/python:${PYTHON}-slim-bookworm AS run
ARG PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu
ENV PIP_NO_CACHE_DIR=1
RUN apt-get update && apt-get install -y --no-install-recommends make && rm -rf /var/lib/apt/lists/*
WORKDIR /opt/gsbench
COPY . .
RUN make .venv/.stamp-run
ENV PATH=/opt/gsbench/.venv/bin:$PATH GSBENCH_RUNS=/runs
WORKDIR /work
ENTRYPOINT ["gsbench"]

FROM run AS demo
WORKDIR /opt/gsbench
RUN make demo

FROM run AS test
WORKDIR /opt/gsbench
RUN make test

FROM run AS gsbench
CMD ["--help"]
