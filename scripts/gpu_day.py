"""The Python part of gpu_day.sh. Parts of a row run side by side, rows one after the other.

A row has an absolute end: a part that hangs takes no time from later rows. A fast row leaves them
more.
"""

import contextlib
import itertools
import json
import lzma
import os
import shutil
import signal
import subprocess
import sys
import tarfile
import time
from pathlib import Path
from typing import Any, NamedTuple

PYTHON = os.environ["PYTHON"]
BROUGHT, STATE, OUT = (Path(os.environ[k]) for k in ("GPU_DAY_BROUGHT", "GPU_DAY_STATE", "OUT"))
RESULTS, ARCHIVE = STATE / "results", BROUGHT / "brought.tar.xz"
PACKAGES = "hydra-core omegaconf pydantic pydantic_core annotated-types typing-inspection"
PACKAGES += " plyfile pycolmap gsplat antlr4-python3-runtime"
# CUDA 13 no longer has this functor of the source of Faster-GS.
OLD_MAXIMUM, MAXIMUM = "cub::Max()", "[](auto a, auto b) { return a < b ? b : a; }"
WEIGHTS = ("squeezenet1_1*.pth", "lpips_v0.1_squeeze.pth")
MOST_CARRIED = 45  # MiB
SQUEEZED = [{"id": lzma.FILTER_X86}, {"id": lzma.FILTER_LZMA2, "preset": 6, "dict_size": 1 << 26}]
TINY = bool(os.environ.get("GPU_DAY_TINY"))
COUNTS, PEER = (("3",), "cpu") if TINY else (("100000", "1000000", "3000000"), "gsplat")
PEER_RASTER = PEER if TINY else "benchmarks.gsplat_raster.GsplatRasterizer"
ARMS = ("adc", "volumetric", "volumetric_once")
# Of gsplat and Faster-GS, on idle cores; a trial run has nothing to compile.
COMPILATION, OF_FASTER_GS = "compilation", "compilation-faster_gs"
COMPILE = "0" if TINY else "from gsplat.cuda._backend import _C; assert _C"
UNSPLIT = "from gsbench.raster.triton import executor; executor.SPLIT_BLOCKS = 0; "
UNSPLIT += "from gsbench.cli import main; main()"
HOST = "training way launches operations host_ms"
BENCHED = (
    "part raster count size forward_ms loss_ms backward_ms adam_ms step_ms steps_per_second fps"
)
BENCHED += " peak_memory_mb"
TRAINED = "training iterations num_gaussians times_adc train peak_memory_mb psnr gain_db ssim"
TRAINED += " lpips_squeeze flip"
PACK_EVERY, MOST_KEPT = 20.0, 2_000_000  # seconds; bytes of a file
KEPT = ("results.json", "failed.json", "log.txt", "metrics.jsonl", "events.jsonl", "per_view.csv")


class Part(NamedTuple):
    name: str
    command: list[str]
    needs: str = ""  # the part that must have ended well


class Row(NamedTuple):
    parts: list[Part]
    seconds: float  # of the plan; 0: in the background
    alone: bool = False  # for timing: compilations pause
    grace: float = 1.0  # seconds from SIGTERM, when a training writes its checkpoint, to SIGKILL


def gsbench(name: str, words: str, needs: str = "") -> Part:
    return Part(name, [PYTHON, "-m", "gsbench.cli", *words.split()], needs)


def bench(name: str, raster: str, count: str, needs: str = "") -> Part:
    at = "16x16 --repeats 1" if TINY else "1600x1060 --repeats 10"
    words = f"bench --raster {raster} --count {count} --json --size {at}"
    return gsbench(f"bench-{name}", words, needs)


def bench_of_lists(scene: str, *, split: bool) -> Part:
    """A bench of long lists; without ``split``, one program composites each block."""
    count, way = COUNTS[1 % len(COUNTS)], "split" if split else "whole"
    part = bench(f"triton-{scene}-{way}", "triton", count)
    words = ["bench", "--no-memory", "--scene", scene, *part.command[4:]]
    how = ["-m", "gsbench.cli"] if split else ["-c", UNSPLIT]
    return part._replace(command=[PYTHON, *how, *words])


def faster_gs(name: str, *words: str) -> Part:
    script = ["-c", "0"] if TINY else ["benchmarks/faster_gs.py", *words]
    needs = OF_FASTER_GS if words[1:] else ""
    return Part(name, ["env", f"FASTER_GS={STATE}/faster_gs", PYTHON, *script], needs)


def training(arm: str) -> Part:
    words = f"scene=colmap scene.path={STATE}/bonsai init=dataset train=paper eval.at=[7000]"
    if TINY:
        words = "scene=courtyard scene.views=8 scene.width=32 scene.height=24 init=random"
        words += " init.count=6 train=7k train.iterations=2"
    words += f" densify={arm} raster=triton tracking=none eval.download=false"
    return gsbench(f"train-{arm}", f"name=gpu_day-{arm} {words}")


def check(name: str, words: str, needs: str = "", tool: str = "") -> Part:
    """Tests, below a ``tool`` of compute-sanitizer, which needs an allocation for each tensor."""
    checker = "env PYTORCH_NO_CUDA_MEMORY_CACHING=1 compute-sanitizer --error-exitcode 9 --tool"
    before = [*checker.split(), tool] if tool else []
    command = [*before, PYTHON, "-m", "pytest", "-q", "-p", "no:cacheprovider", *words.split(";")]
    return Part(name, command, needs)


def plan() -> list[Row]:
    """All parts, the most telling first."""
    contract, bits = "tests/raster/test_contract.py;-k;", "tests/raster/test_same_bits.py"
    some = " and without_visible" if TINY else ""  # part of the name of one quick test
    of_peer = f"{contract}{PEER}{some}" if TINY else "tests/bench/test_gsplat.py;-k;on_a_gpu"
    return [
        Row([Part("install", [PYTHON, "-m", "tarfile", "-e", str(ARCHIVE), str(STATE)])], 25),
        Row([Part(COMPILATION, ["nice", "-n", "19", PYTHON, "-c", COMPILE])], 0),
        Row([faster_gs(OF_FASTER_GS, "compile")], 0),
        Row([gsbench("proof-triton", "doctor --json --prove --raster triton")], 50),
        Row([check("contract", f"{contract}triton{some}"), check("bits", bits)], 50),
        Row([Part("host", [PYTHON, "-m", "benchmarks.host"])], 15, True),
        *(Row([bench(f"triton-{n}", "triton", n)], 75 / len(COUNTS), True) for n in COUNTS),
        *(
            Row([bench_of_lists(scene, split=split)], 10, True)
            for scene in ("trained", "crowded")
            for split in (True, False)
        ),
        Row([faster_gs("bench-faster_gs", "triton", *COUNTS)], 30, True),
        Row([training(arm) for arm in ARMS], 150, grace=8.0),
        Row([bench(PEER, PEER_RASTER, ",".join(COUNTS), COMPILATION)], 30),
        Row([check(f"contract-{PEER}", of_peer, COMPILATION)], 20),
        Row([check(tool, f"{bits};-k;tiny", tool=tool) for tool in ("memcheck", "racecheck")], 35),
    ]


class Runner:
    """Runs rows of parts in ``seconds``; a part's output and end are written to $OUT at once."""

    def __init__(self, seconds: float) -> None:
        self.archive, self.records = OUT / "gpu_day.tar.gz", RESULTS / "parts.jsonl"
        self.begin, self.seconds, self.packed = time.monotonic(), seconds, 0.0
        self.running: dict[str, tuple[subprocess.Popen[bytes], float]] = {}  # with its begin
        self.ends: dict[str, int | str] = {}  # an exit code, minus a signal, or why there is none

    def now(self) -> float:
        return time.monotonic() - self.begin

    def start(self, part: Part) -> None:
        if part.needs and self.ends.get(part.needs) != 0:
            return self.record(part.name, f"not tried: no {part.needs}", 0.0)
        where = RESULTS / part.name
        with open(f"{where}.out", "wb") as out, open(f"{where}.log", "wb") as log:
            process = subprocess.Popen(part.command, stdout=out, stderr=log, start_new_session=True)
        self.running[part.name] = process, self.now()

    def record(self, name: str, end: int | str, seconds: float) -> None:
        self.ends[name] = end
        with self.records.open("a") as file:
            file.write(json.dumps({"part": name, "end": end, "seconds": round(seconds, 1)}) + "\n")
        print(f"{self.now():4.0f} s  {name}: {end} after {seconds:.0f} s", flush=True)
        for file in (RESULTS / f"{name}.log", RESULTS / f"{name}.out"):
            if end != 0 and file.exists():
                print(*file.read_text(errors="replace").splitlines()[-8:], sep="\n")
        self.pack()

    def wait(self, names: list[str], until: float) -> None:
        """Wait for the parts until ``until``, in seconds after the begin."""
        while any(name in self.running for name in names) and self.now() < until:
            for name, (process, begin) in list(self.running.items()):
                if process.poll() is not None:
                    del self.running[name]
                    self.record(name, process.returncode, self.now() - begin)
            if self.now() - self.packed > PACK_EVERY:
                self.pack()
            time.sleep(0.1)

    def end(self, names: list[str], grace: float) -> None:
        """End the parts that still run. Nothing waits for a process that SIGKILL does not end."""
        names = [name for name in names if name in self.running]
        for name in names:
            signal_session(self.running[name][0].pid, signal.SIGCONT, signal.SIGTERM)
        until = self.now() + grace
        while self.now() < until and any(self.running[name][0].poll() is None for name in names):
            time.sleep(0.1)
        for name in names:
            process, begin = self.running.pop(name)
            signal_session(process.pid, signal.SIGKILL)
            self.record(name, "out of time", self.now() - begin)

    def run(self, rows: list[Row]) -> int:
        """Run ``rows``; 0 if all parts ended well, else 1."""
        until, planned = 0.0, sum(row.seconds for row in rows)
        try:
            for row in rows:
                until += row.seconds * self.seconds / planned
                names = [part.name for part in row.parts]
                if needed := row.parts[0].needs:
                    self.signal_compilations(signal.SIGCONT)
                    self.wait([needed], (self.now() + until) / 2)
                self.signal_compilations(signal.SIGSTOP if row.alone else signal.SIGCONT)
                for part in row.parts:
                    self.start(part)
                if row.seconds:
                    self.wait(names, until - row.grace)
                    self.end(names, row.grace)
        finally:
            self.end(list(self.running), 1.0)
            (OUT / "table.md").write_text(table(RESULTS))
        return 0 if all(end == 0 for end in self.ends.values()) else 1

    def signal_compilations(self, number: int) -> None:
        for name in {COMPILATION, OF_FASTER_GS} & self.running.keys():
            signal_session(self.running[name][0].pid, number)

    def pack(self) -> None:
        """Write all results so far to the archive, unless a file vanishes meanwhile."""
        self.packed, new = self.now(), self.archive.with_suffix(".new")
        with contextlib.suppress(OSError), tarfile.open(new, "w:gz") as archive:
            for trial in STATE.glob("runs/gpu_day-*/*/*/*-seed*"):
                target = RESULTS / f"train-{trial.parents[2].name.removeprefix('gpu_day-')}"
                target.mkdir(exist_ok=True)
                files = [trial / name for name in KEPT] + sorted(trial.glob("renders/*.png"))[:1]
                for file in filter(Path.is_file, files):
                    shutil.copyfile(file, target / file.name)
            archive.add(RESULTS, "results", filter=lambda x: x if x.size <= MOST_KEPT else None)
            archive.close()
            new.replace(self.archive)


def signal_session(session: int, *signals: int) -> None:
    """Send signals to a whole session: ninja gives each compiler a process group of its own."""
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it has just ended
            if int(stat.read_text().rpartition(")")[2].split()[3]) == session:
                for number in signals:
                    os.kill(int(stat.parent.name), number)


def chosen(names: tuple[str, ...]) -> list[Row]:
    """Rows of the named parts; without names, of those that did not end well yet."""
    parts = {part.name: part for row in plan() for part in row.parts}
    if unknown := set(names) - parts.keys():
        sys.exit(f"there is no part {', '.join(sorted(unknown))}")
    done = {name for name, record in read_ends(RESULTS).items() if record["end"] == 0}
    wanted = set(names) or parts.keys() - done
    wanted |= {parts[name].needs for name in wanted} | ({"install"} - done)
    rows = [row._replace(parts=[x for x in row.parts if x.name in wanted]) for row in plan()]
    return [row for row in rows if row.parts]


def wheels() -> str:
    """Pack packages for Python 3.12 on x86-64, the scene and weights into one archive."""
    import pycolmap

    from gsbench.scene.colmap import model_points, read_reference
    from gsbench.scene.options import SceneConfig
    from gsbench.scene.pipe import read_capture

    new, pinned = STATE / "new", Path("constraints.txt").read_text().split()
    shutil.rmtree(new, ignore_errors=True)
    platforms = [f"--platform=manylinux{x}_x86_64" for x in ("_2_28", "_2_17", "2014")]
    binary = ["download", "--only-binary=:all:", "--python-version=3.12", *platforms, "-d"]
    for package in PACKAGES.split():
        (release,) = (line for line in pinned if line.startswith(f"{package}=="))
        how = ["wheel", "-w"] if package.startswith("antlr4") else binary  # it has no wheel
        folder = str(new / "wheels" / package)
        subprocess.run([PYTHON, "-m", "pip", "-q", *how, folder, "--no-deps", release], check=True)
        shutil.unpack_archive(next(Path(folder).glob("*.whl")), new / "site", "zip")
    for unused in ("wheels", "site/gsplat/cuda/csrc/third_party/glm/doc"):  # 20 MB
        shutil.rmtree(new / unused, ignore_errors=True)
    # Keypoints and tracks, 20 MB of bonsai's model, only tell which points the chosen images see.
    capture = read_capture(
        SceneConfig(name="bonsai", kind="colmap", path=os.environ["GPU_DAY_SCENE"])
    )
    model = read_reference(capture)
    cloud = model_points(model)
    model.delete_all_points2D_and_points3D()
    for point, color in zip(*cloud, strict=True):
        model.add_point3D(point, pycolmap.Track(), color)
    (new / "bonsai/sparse/0").mkdir(parents=True)
    model.write_binary(new / "bonsai/sparse/0")
    unseen = set(os.listdir(capture.images)) - set(capture.image_names)
    shutil.copytree(capture.images, new / "bonsai/images", ignore=lambda *_: unseen)
    if source := os.environ.get("GPU_DAY_FASTER_GS"):
        shutil.copytree(Path(source) / "FasterGSCudaBackend/FasterGSCudaBackend", new / "faster_gs")
        for file in (new / "faster_gs").rglob("*.cuh"):
            file.write_text(file.read_text().replace(OLD_MAXIMUM, MAXIMUM))
    (new / "weights").mkdir()
    files = (x for name in WEIGHTS for x in Path(os.environ["GSBENCH_WEIGHTS"]).rglob(name))
    weights = [shutil.copy(file, new / "weights") for file in files]
    with lzma.open(ARCHIVE, "wb", filters=SQUEEZED) as xz, tarfile.open(None, "w", xz) as archive:
        archive.add(new, ".")
    size = ARCHIVE.stat().st_size / 2**20
    if size > MOST_CARRIED:
        sys.exit(f"{ARCHIVE} has {size:.1f} MiB, more than {MOST_CARRIED}: leave something out")
    without = "" if source else "; without Faster-GS: GPU_DAY_FASTER_GS is not set"
    return f"{ARCHIVE}: {size:.1f} MiB, {len(weights)} files of weights{without}"


def read_ends(results: Path) -> dict[str, dict[str, Any]]:
    """The last record of each part."""
    file = results / "parts.jsonl"
    lines = file.read_text().splitlines() if file.exists() else []
    return {record["part"]: record for record in map(json.loads, lines)}


def read(file: Path, kind: type) -> Any:
    """The JSON in a file, or an empty ``kind`` if it is missing, cut off, or something else."""
    with contextlib.suppress(OSError, ValueError):
        value = json.loads(file.read_text())
        return value if isinstance(value, kind) else kind()
    return kind()


def table(results: Path) -> str:
    """Lists and tables for the two documents, as Markdown."""
    lines = ["For docs/gpu.md:", ""]
    for name, record in read_ends(results).items():
        end = "yes" if record["end"] == 0 else f"NO ({record['end']})"
        out = results / f"{name}.out"
        text = out.read_text(errors="replace") if out.exists() else ""
        if "Device not supported" in text:  # says compute-sanitizer
            end = "not tried, since compute-sanitizer does not support the device"
        facts = [f"- {name}: {end}, {record['seconds']:.0f} s"]
        if name.startswith("proof-"):
            proven = read(out, dict)
            facts += [f"{key} {proven.get(key)}" for key in ("device", "versions", "errors")]
        elif name.startswith(("contract", "bits", "memcheck", "racecheck")):
            facts += text.splitlines()[-1:]
        lines.append("; ".join(facts))
    lines += [
        "",
        "For docs/measurements.md:",
        "",
        *markdown(HOST, read(results / "host.out", list)),
    ]
    rows = [
        {"part": file.stem.removeprefix("bench-")} | row
        for file in sorted(results.glob("bench-*.out"))
        for row in read(file, list)
    ]
    lines += ["", *markdown(BENCHED, rows)]
    rows = []
    for folder in sorted(results.glob("train-*/")):
        record = read(folder / "results.json", dict) | {"training": folder.name}
        rows.append(record | record.get("metrics", {}) | record.get("seconds", {}))
    for row, adc in itertools.product(
        rows, [one for one in rows if one["training"] == "train-adc"]
    ):
        with contextlib.suppress(KeyError):  # one of them has not ended
            row["times_adc"] = row["num_gaussians"] / adc["num_gaussians"]
            row["gain_db"] = row["psnr"] - adc["psnr"]
    return "\n".join([*lines, "", *markdown(TRAINED, rows)])


def markdown(names: str, rows: list[dict[str, Any]]) -> list[str]:
    """Lines of a table with these columns."""
    lines = [f"| {names.replace(' ', ' | ')} |", "|---" * len(names.split()) + "|"]
    for row in rows:
        values = [row.get(name, "-") for name in names.split()]
        cells = (f"{x:.5g}" if isinstance(x, float) else str(x) for x in values)
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def tables(archive: str) -> str:
    """The tables of an archive."""
    results = STATE / "tables" / "results"
    shutil.rmtree(results, ignore_errors=True)
    shutil.unpack_archive(archive, results.parent, filter="data")
    paper = Path("src/gsbench/analysis/published/volumetric.yaml").read_text().splitlines()
    (row, *_) = (line.strip() for line in paper if line.startswith("      bonsai:"))
    return f"{table(results)}\n\nThe paper: SSIM, PSNR, LPIPS, million Gaussians, minutes; {row}"


def main(verb: str, *words: str) -> int:
    if verb in ("wheels", "table"):
        print(wheels() if verb == "wheels" else tables(words[0]))
        return 0
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    return Runner(float(words[0]) if words else 540.0).run(chosen(words[1:]))


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
