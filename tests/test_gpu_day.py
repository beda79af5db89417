"""scripts/gpu_day.sh without a GPU: every line is tried before the short time on a GPU."""

import json
import os
import re
import signal
import subprocess
import sys
import tarfile
import time
from pathlib import Path
from shlex import split

import pytest

from tests.composed import composed
from tests.conftest import ROOT, script
from tests.processes import wait_until

SCRIPT = ROOT / "scripts/gpu_day.sh"
# Stands in for Python: parts fail, hang or are killed as a test wants, and others print what real
# ones print. Python runs everything else, such as the script itself.
STAND_IN = r"""#!{python} -IS
import json, os, signal, sys, time
words = sys.argv[1:]
line = " ".join(words)
if words[:2] == ["-m", "pip"]:
    folder = words[words.index("-d" if "download" in words else "-w") + 1]
    os.makedirs(folder)
    import zipfile
    name = words[-1].partition("==")[0].replace("-", "_")
    with zipfile.ZipFile(f"{{folder}}/{{name}}-1-py3-none-any.whl", "w") as file:
        file.writestr(f"{{name}}/__init__.py", "")
    sys.exit()
for part, (pattern, fault) in json.loads(os.environ["FAULTS"]).items():
    if pattern in line:
        print("before", part, file=sys.stderr, flush=True)
        if fault == "fail":
            sys.exit("broken on purpose")
        if fault == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        import subprocess
        child = subprocess.Popen(["sleep", "987"], process_group=0)  # as ninja starts a compiler
        print(child.pid, flush=True)
        time.sleep(987)
if "gpu_day.py" in line or words[:2] == ["-m", "tarfile"]:
    os.execv({python!r}, [{python!r}, *words])
if "doctor" in words:
    raster = words[words.index("--raster") + 1]
    print(json.dumps({{"raster": raster, "passed": True, "device": "a GPU", "versions": {{"triton": "3.6.0"}},
                      "errors": {{"image": 1e-6}}, "seconds": 9.5}}))
elif "benchmarks.host" in words:
    print(json.dumps([{{"training": "adc", "way": "recorded", "launches": 0, "operations": 15, "host_ms": 0.06}}]))
elif "bench" in words:
    row = {{"raster": words[words.index("--raster") + 1], "size": "16x16", "count": 3, "step_ms": 1.25}}
    print(json.dumps([row]))
elif "pytest" in words:
    print("....\n3 passed in 1.2s")
elif "gsbench.cli" in words:
    name = words[2].partition("=")[2]
    trial = f"{{os.environ['GSBENCH_RUNS']}}/{{name}}/bonsai/dataset-x/12345678-seed0"
    os.makedirs(trial, exist_ok=True)
    with open(f"{{trial}}/results.json", "w") as file:
        json.dump({{"iterations": 30000, "num_gaussians": 12345, "metrics": {{"psnr": 31.54321}},
                   "seconds": {{"train": 99.5}}}}, file)
"""

LISTS = "trained", "crowded"  # the scenes in which long lists are split, and are not

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs bash, /proc and Triton")


class Day:
    """The script with its folders below ``folder``, and the stand-in for Python."""

    def __init__(self, folder):
        self.out, self.state = folder / "out", folder / "state"
        stand_in = folder / "python"
        stand_in.write_text(STAND_IN.format(python=sys.executable))
        stand_in.chmod(0o755)
        sanitizer = folder / "compute-sanitizer"  # its own options, then the command
        sanitizer.write_text('#!/bin/sh\nshift 4\nexec "$@"\n')
        sanitizer.chmod(0o755)
        self.out.mkdir()
        self.environment = os.environ | {
            "GPU_DAY_TINY": "1",
            "GPU_DAY_STATE": str(self.state),
            "GPU_DAY_BROUGHT": str(folder / "brought"),
            "OUT": str(self.out),
            "PYTHON": str(stand_in),
            "PATH": f"{folder}{os.pathsep}{os.environ['PATH']}",
            "FAULTS": "{}",
        }

    def bring(self):
        """Make an archive like that of the verb ``wheels``."""
        brought = Path(self.environment["GPU_DAY_BROUGHT"])
        (brought / "site").mkdir(parents=True)
        with tarfile.open(brought / "brought.tar.xz", "w:xz") as archive:
            archive.add(brought / "site", "site")

    def start(self, *words, faults=None, **more):
        environment = self.environment | {"FAULTS": json.dumps(faults or {})} | more
        return subprocess.Popen(
            ["bash", str(SCRIPT), *words],
            env=environment,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )

    def run(self, *words, faults=None, **more):
        with self.start(*words, faults=faults, **more) as process:
            said, _ = process.communicate(timeout=1700)
        return process.returncode, said

    def results(self):
        """The end of each part in the archive in $OUT; "files" has the names of the files in it."""
        with tarfile.open(self.out / "gpu_day.tar.gz") as archive:
            file = archive.extractfile("results/parts.jsonl")
            records = [json.loads(line) for line in file.read().splitlines()]
            return {record["part"]: record["end"] for record in records} | {
                "files": archive.getnames()
            }


@pytest.fixture
def day(tmp_path):
    made = Day(tmp_path)
    made.bring()
    return made


@pytest.mark.slow
def test_parts_that_fail_hang_or_are_killed_do_not_harm_other_parts(day):
    faults = {
        "proof-triton": ("doctor --json --prove --raster triton", "hang"),
        "contract": ("test_contract.py -k triton", "kill"),
        "bench-triton-3": ("bench --raster triton --count", "fail"),
        "train-volumetric": ("densify=volumetric ", "hang"),
    }
    begin = time.monotonic()
    code, said = day.run("run", "45", faults=faults)
    assert time.monotonic() - begin < 48
    assert code == 1, said
    ends = day.results()
    files = ends.pop("files")
    assert {name: end for name, end in ends.items() if end != 0} == {
        "proof-triton": "out of time",
        "contract": -signal.SIGKILL,
        "bench-triton-3": 1,
        "train-volumetric": "out of time",
    }
    well = "install bits compilation compilation-faster_gs host bench-faster_gs train-adc "
    well = {*split(well + "train-volumetric_once bench-cpu")}
    well |= {f"bench-triton-{name}-{way}" for name in LISTS for way in ("split", "whole")}
    assert ends.keys() - faults.keys() == well | {"contract-cpu", "memcheck", "racecheck"}
    assert {
        "results/train-adc/results.json",
        "results/bench-cpu.out",
        "results/proof-triton.log",
    } <= set(files)
    assert "broken on purpose" in said  # the end of what it wrote
    for name in ("proof-triton", "train-volumetric"):  # the child of a part has ended, too
        child = Path("/proc") / (day.state / f"results/{name}.out").read_text().strip()
        assert not child.exists() or "\nState:\tZ" in (child / "status").read_text()
    table = (day.out / "table.md").read_text()
    assert "- proof-triton: NO (out of time), " in table
    assert "- contract: NO (-9), " in table

    # A second command runs what did not end well.
    code, said = day.run("run", "60")
    assert code == 0, said
    assert {name for name, end in day.results().items() if end != 0} == {"files"}
    assert set(re.findall(r"(\S+): 0 after", said)) == set(faults)


@pytest.mark.slow
def test_a_killed_command_leaves_the_results_so_far_and_no_process(day):
    process = day.start("run", "300", faults={"train-adc": ("densify=adc ", "hang")})
    marker = day.state / "results/train-adc.out"
    wait_until(lambda: marker.exists() and marker.read_text(), 60)
    child = Path("/proc") / marker.read_text().strip()
    assert child.exists()
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=60)
    ends = day.results()
    assert (ends["proof-triton"], ends["bits"], ends["train-adc"]) == (0, 0, "out of time")
    assert "memcheck" not in ends
    assert not child.exists() or "\nState:\tZ" in (child / "status").read_text()

    # The next command runs what failed and what was never reached.
    assert day.run("run", "60")[0] == 0
    ends = day.results()
    assert (ends["train-adc"], ends["memcheck"]) == (0, 0)


def test_the_commands_of_the_full_day_name_what_exists(tmp_path, monkeypatch):
    """The rehearsals here are small ones; a full day has other files, words and sizes."""
    pytest.importorskip("triton")
    from gsbench.bench import measure
    from gsbench.raster import EXECUTORS
    from gsbench.raster.triton import executor
    from gsbench.verbs import machine

    for name in ("GPU_DAY_STATE", "GPU_DAY_BROUGHT", "OUT", "PYTHON", "GSBENCH_RUNS"):
        monkeypatch.setenv(name, str(tmp_path / name))
    gpu_day = script("gpu_day")
    monkeypatch.chdir(ROOT)
    said, rasters = [], {one.name for one in EXECUTORS}
    monkeypatch.setattr(machine, "_prove", lambda raster, *_: said.append(raster) or 0)
    monkeypatch.setattr(measure, "run_bench", lambda names, *_, **__: said.extend(names) or [])
    monkeypatch.setattr(executor, "SPLIT_BLOCKS", executor.SPLIT_BLOCKS)  # an error if it is gone

    untried = []
    for part in (part for row in gpu_day.plan() for part in row.parts):
        files = [Path(word) for word in part.command if word.endswith(".py")]
        assert [file for file in files if not file.is_file()] == [], part.name
        verb, *words = part.command[3:] or [""]
        if "pytest" in part.command:
            names = " ".join([*rasters, *(str(file) + file.read_text() for file in files)])
            chosen = part.command[part.command.index("-k") + 1] if "-k" in part.command else ""
            unknown = {word for word in re.findall(r"\w+", chosen) if word not in names}
            assert unknown <= {"and", "or"}, part.name
        elif verb in ("bench", "doctor"):
            assert getattr(machine, verb)(words, tmp_path) == 0, part.name
        elif verb.startswith("name="):
            (trial,) = composed((verb, *words), multirun=False)
            assert trial.values["raster"]["name"] == "triton"
        else:
            untried.append(part.name)
    assert set(said) == {"triton", gpu_day.PEER_RASTER}
    assert " ".join(untried) == "install compilation compilation-faster_gs host bench-faster_gs"
    exec(gpu_day.UNSPLIT.partition("; from gsbench.cli")[0])
    assert executor.SPLIT_BLOCKS == 0


@pytest.mark.slow
def test_a_table_of_two_commands(day):
    assert day.run("run", "45", faults={"bits": ("test_same_bits.py", "fail")})[0] == 1
    code, said = day.run("run", "60", "bits")  # a part by its name
    assert (code, re.findall(r"(\S+): 0 after", said)) == (0, ["bits"])
    assert day.run("run", "60", "bites")[1].endswith("there is no part bites\n")
    code, said = day.run("table", str(day.out / "gpu_day.tar.gz"))
    assert code == 0
    assert re.search(
        r"^- proof-triton: yes, \d+ s; device a GPU; versions .*3.6.0.*; errors .*image",
        said,
        re.MULTILINE,
    )
    assert re.search(r"^- bits: yes, \d+ s; 3 passed in 1.2s$", said, re.MULTILINE)
    assert "| triton-3 | triton | 3 | 16x16 | - | - | - | - | 1.25 | - | - | - |" in said
    assert "| triton-crowded-whole | triton | 3 |" in said
    assert "| adc | recorded | 0 | 15 | 0.06 |" in said
    trained = "| train-volumetric_once | 30000 | 12345 | 1 | 99.5 | - | 31.543 | 0 | - | - | - |"
    assert trained in said


def test_an_unknown_verb_prints_the_usage(tmp_path):
    code, said = Day(tmp_path).run("everything")
    assert code == 2
    assert "scripts/gpu_day.sh wheels" in said
    assert "exec" not in said
