"""The Python part of gpu_day.sh: what is carried along, the plan of the parts, the runner, and the tables.

Parts run in rows: those of a row side by side, the rows one after the other. A row has an absolute end, so a part that
hangs takes time from no later row, and a part that ends early gives its time to them. Until packages are unpacked,
only the standard library is here.
"""

from __future__ import annotations

import contextlib
import io
import json
import lzma
import os
import shutil
import signal
import subprocess
import sys
import tarfile
import time
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

PYTHON = os.environ["PYTHON"]
BROUGHT, STATE, OUT = (Path(os.environ[k]) for k in ("GPU_DAY_BROUGHT", "GPU_DAY_STATE", "OUT"))
RESULTS = STATE / "results"
TINY = bool(os.environ.get("GPU_DAY_TINY"))
PACKAGES = ["hydra-core", "omegaconf", "pydantic", "pydantic_core", "annotated-types", "typing-inspection"]
PACKAGES += ["flip-evaluator", "plyfile", "pycolmap", "gsplat"]
SOURCES = ["antlr4-python3-runtime"]  # packages without wheels
UNUSED = ["gsplat/cuda/csrc/third_party/glm/doc", "gsplat/cuda/csrc/third_party/glm/test"]
PLATFORMS = [f"manylinux{name}_x86_64" for name in ("_2_28", "_2_27", "_2_17", "2014", "1")]
WEIGHTS = ["squeezenet1_1*.pth", "lpips_v0.1_squeeze.pth", "squeeze.pth"]
SQUEEZED = [{"id": lzma.FILTER_X86}, {"id": lzma.FILTER_LZMA2, "preset": 6, "dict_size": 1 << 26}]
ARMS = ("adc", "volumetric", "volumetric_once")
COUNTS = ("3",) if TINY else ("100000", "1000000", "3000000")
SIZE, SMALL = ("16x16", "16x16") if TINY else ("1600x1060", "48x32")
DEVICE = "cpu" if TINY else "cuda"
PEER = "cpu" if TINY else "gsplat"
SECONDS = 540  # the plan's length
GRACE = 8.0  # seconds from SIGTERM, at which a training writes its checkpoint, to SIGKILL
PACK_EVERY = 20.0  # seconds
MOST_KEPT = 2_000_000  # bytes of a file, its end
KEPT = ("results.json", "failed.json", "log.txt", "metrics.jsonl", "events.jsonl", "per_view.csv")


@dataclass(frozen=True)
class Part:
    name: str
    command: list[str]
    needs: str | None = None  # the part that must have ended well
    environment: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Row:
    until: float  # seconds after the begin, in a plan of SECONDS
    parts: list[Part]
    alone: bool = False  # nothing else may run: the compilation pauses


def gsbench(*words: str) -> list[str]:
    return [PYTHON, "-m", "gsbench.cli", *words]


def own(*words: str) -> list[str]:
    return [PYTHON, "scripts/gpu_day.py", *words]


def bench(name: str, raster: str, count: str, needs: str | None = None) -> Part:
    words = ["--raster", raster, "--count", count, "--size", SIZE, "--kernels", "--json"]
    words += ["--repeats", "1" if TINY else "10"]
    return Part(f"bench-{name}", gsbench("bench", *words), needs)


def proof(raster: str, needs: str | None = None) -> Part:
    return Part(f"proof-{raster}", gsbench("doctor", "--prove", "--raster", raster, "--json"), needs)


def training(arm: str, seed: int) -> Part:
    words = ["scene=colmap", f"scene.path={STATE / 'brought/bonsai'}", "init=dataset", "train=paper"]
    words += ["eval.at=[7000]", "eval.download=false"]
    if TINY:
        words = ["scene=courtyard", "scene.views=8", "scene.width=32", "scene.height=24"]
        words += ["init=random", "init.count=6", "train=7k", "train.iterations=2", "eval.download=false"]
    words += [f"densify={arm}", f"seed={seed}", "raster=triton", f"device={DEVICE}", "tracking=none"]
    return Part(f"train-{arm}-{seed}", gsbench(f"name=gpu_day-{arm}-{seed}", *words))


def sanitizer(tool: str) -> Part:
    """Without caching, each tensor is its own allocation, so that overruns are seen."""
    words = ["compute-sanitizer", "--tool", tool, "--error-exitcode", "9"]
    paths = {"PATH": f"{os.environ['PATH']}:/usr/local/cuda/bin", "PYTORCH_NO_CUDA_MEMORY_CACHING": "1"}
    return Part(tool, words + own("bits", DEVICE, SMALL, "100" if not TINY else "3", "1"), None, paths)


def plan(seed: int = 0) -> list[Row]:
    """All parts, the most telling first; the trainings with ``seed``."""
    tests = "triton and nothing_to_see" if TINY else "triton or on_a_gpu"
    files = ["tests/raster/test_contract.py", "tests/raster/test_gsplat.py"]
    pytest = [PYTHON, "-m", "pytest", "-q", "-p", "no:cacheprovider", *files, "-k", tests]
    bits = own("bits", DEVICE, SIZE, COUNTS[0], "3")
    return [
        Row(25, [Part("install", own("unpack"))]),
        Row(95, [Part("machine", own("machine")), proof("triton")]),
        Row(155, [Part("contract", pytest), Part("bits", bits)]),
        *(Row(180 + 30 * k, [bench(f"triton-{n}", "triton", n)], True) for k, n in enumerate(COUNTS)),
        Row(450, [training(arm, seed) for arm in ARMS]),
        Row(490, [bench(PEER, PEER, ",".join(COUNTS), COMPILATION)]),
        Row(504, [proof(PEER, COMPILATION)]),
        Row(SECONDS, [sanitizer("memcheck"), sanitizer("racecheck")]),
    ]


def compilation() -> Part:
    """The compilation of gsplat, on the idle cores from the installation on; in a trial run nothing is compiled."""
    command = ["nice", "-n", "19", PYTHON, "-c", "from gsplat.cuda._backend import _C; assert _C"]
    return Part(COMPILATION, [PYTHON, "-c", ""] if TINY else command, None, {"MAX_JOBS": "12"})


class Runner:
    """Runs rows of parts within ``seconds``; keeps what each part says and how it ends, in $OUT at once."""

    def __init__(self, verb: str, seconds: float) -> None:
        self.archive = OUT / f"gpu_day-{verb}.tar.gz"
        self.begin, self.seconds, self.packed = time.monotonic(), seconds, 0.0
        self.running: dict[str, tuple[subprocess.Popen[bytes], float]] = {}  # by name, with its begin
        self.codes: dict[str, int | str] = {}  # an exit code, minus a signal, or why there is none
        RESULTS.mkdir(parents=True, exist_ok=True)
        OUT.mkdir(parents=True, exist_ok=True)

    def now(self) -> float:
        return time.monotonic() - self.begin

    def start(self, part: Part) -> None:
        if part.needs and self.codes.get(part.needs) != 0:
            return self.record(part.name, f"{part.needs} is missing", 0.0)
        environment = os.environ | part.environment
        try:
            with open(RESULTS / f"{part.name}.out", "wb") as output, open(RESULTS / f"{part.name}.log", "wb") as log:
                process = subprocess.Popen(
                    part.command, stdout=output, stderr=log, stdin=subprocess.DEVNULL, env=environment,
                    start_new_session=True,
                )
        except OSError as error:
            return self.record(part.name, f"not tried: {error}", 0.0)
        self.running[part.name] = process, self.now()

    def record(self, name: str, code: int | str, seconds: float) -> None:
        self.codes[name] = code
        with (RESULTS / "parts.jsonl").open("a") as file:
            file.write(json.dumps({"part": name, "end": code, "seconds": round(seconds, 1)}) + "\n")
        print(f"{self.now():4.0f} s  {name}: {code} after {seconds:.0f} s", flush=True)
        for kind in ("log", "out") if code != 0 else ():
            file = RESULTS / f"{name}.{kind}"
            print("\n".join((file.read_text(errors="replace") if file.exists() else "").splitlines()[-8:]))
        keep_training(name)
        self.pack()

    def wait(self, names: list[str], until: float) -> None:
        """Wait for the parts; end those that are not done at ``until``."""
        while left := [name for name in names if name in self.running]:
            for name in left:
                process, begin = self.running[name]
                if process.poll() is not None:
                    del self.running[name]
                    signal_session(process.pid, signal.SIGKILL)  # what it left behind
                    self.record(name, process.returncode, self.now() - begin)
            if self.now() >= until:
                return self.end([name for name in left if name in self.running], "out of time")
            if self.now() - self.packed > PACK_EVERY:
                for name in left:
                    keep_training(name)
                self.pack()
            time.sleep(0.1)

    def end(self, names: list[str], cause: str) -> None:
        """End parts: first by SIGTERM, so that trainings write a checkpoint, then by SIGKILL, and wait for none."""
        until = self.now() + min(GRACE, self.seconds / 10)
        for name in names:
            signal_session(self.running[name][0].pid, signal.SIGCONT, signal.SIGTERM)
        while self.now() < until and any(self.running[name][0].poll() is None for name in names):
            time.sleep(0.1)
        for name in names:
            process, begin = self.running.pop(name)
            signal_session(process.pid, signal.SIGKILL)
            self.record(name, cause, self.now() - begin)

    def run(self, rows: list[Row], length: float) -> bool:
        """Run ``rows``, whose plan has the given ``length``; whether all parts ended well."""
        try:
            for row in rows:
                until = row.until * self.seconds / length
                names = [part.name for part in row.parts]
                self.pause(row.alone)
                if any(part.needs == COMPILATION for part in row.parts):
                    self.wait([COMPILATION], until - (until - self.now()) / 2)
                for part in row.parts:
                    self.start(part)
                self.wait(names, until)
                if "install" in names:
                    self.start(compilation())
        finally:
            self.end(list(self.running), "out of time")
            write(OUT / "table.md", table(RESULTS).encode())
        return all(code == 0 for code in self.codes.values())

    def pause(self, paused: bool) -> None:
        if COMPILATION in self.running:
            pid = self.running[COMPILATION][0].pid
            signal_session(pid, signal.SIGSTOP if paused else signal.SIGCONT)

    def pack(self) -> None:
        """Write all results so far to the archive, whole or not at all."""
        self.packed = self.now()
        stream = io.BytesIO()
        with tarfile.open(fileobj=stream, mode="w:gz") as archive:
            for file in sorted(path for path in RESULTS.rglob("*") if path.is_file()):
                content = file.read_bytes()[-MOST_KEPT:]
                entry = tarfile.TarInfo(str(file.relative_to(STATE)))
                entry.size = len(content)
                archive.addfile(entry, io.BytesIO(content))
        write(self.archive, stream.getvalue())


def signal_session(session: int, *signals: int) -> None:
    """Send signals to all processes of a session; ninja gives each compiler a process group of its own."""
    for number in signals:
        for stat in Path("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError):  # it has just ended
                fields = stat.read_text().rpartition(")")[2].split()
                if int(fields[3]) == session:
                    os.kill(int(stat.parent.name), number)


def write(path: Path, content: bytes) -> None:
    path.with_suffix(".new").write_bytes(content)
    path.with_suffix(".new").replace(path)


def keep_training(name: str) -> None:
    """Copy the small files of a training, finished or not, and one picture to the results."""
    for trial in (STATE / "runs" / f"gpu_day-{name.removeprefix('train-')}").glob("*/*/*-seed*"):
        target = RESULTS / name
        target.mkdir(exist_ok=True)
        for file in [trial / kept for kept in KEPT] + sorted(trial.glob("renders/*.png"))[:1]:
            if file.is_file():
                shutil.copyfile(file, target / file.name)


def rest(seconds: float, names: list[str]) -> bool:
    """Run the named parts, else those of ``all`` that did not end well, else trainings of the next seed."""
    ends = read_ends(RESULTS)
    known = [row for seed in range(SEEDS) for row in plan(seed)]
    names = names or [name for name, end in ends.items() if end != 0]
    if not names:
        seed = next(seed for seed in range(SEEDS) if ends.get(f"train-{ARMS[0]}-{seed}") != 0)
        names = [f"train-{arm}-{seed}" for arm in ARMS]
