"""Damage the files of a runs folder, one after the other, and read them.

It is a program of its own, so that a crash or a hang ends only this program.

    python -m tests.fuzz.records FOLDER FIRST COUNT [FILE]

It damages the files of a small experiment, or FILE alone, and reads them as the verbs do. It prints
how many cases were noticed and how many were read as sound. A case with any other end stops it; its
number is in ``FOLDER/current``.
"""

import itertools
import json
import logging
import os
import shutil
import sys
from collections import Counter
from pathlib import Path
from random import Random

from gsbench.analysis.cells import to_frame
from gsbench.analysis.fairness import tuning_notes
from gsbench.analysis.report.build import search_summary
from gsbench.analysis.report.curves import event_charts, training_charts
from gsbench.analysis.results import load_experiment, read_views
from gsbench.analysis.table_formats import to_html_page
from gsbench.analysis.tables import build_table
from gsbench.errors import InputError
from gsbench.launch import states
from gsbench.launch.estimates import FinishedTrials
from gsbench.launch.states import states_of_experiment
from gsbench.parsing import read_if_sound
from gsbench.runs.commands import read_history
from gsbench.runs.trial_folder import TrialFolder
from gsbench.tracking.sinks import Run
from gsbench.tracking.trial import TrackedTrial
from gsbench.verbs.results import explain_cell
from gsbench.verbs.trials import lines_of
from tests.fuzz.corrupt import cases, corrupt
from tests.helpers import read_json, write, write_lines
from tests.trials import record_of, search_record, trial_values

DONE, FAILED, EXPERIMENT = "sfm-adc", "sfm-volumetric", "exp"
NAMES = (
    "results.json",
    "config.yaml",
    "commands.jsonl",
    "metrics.jsonl",
    "events.jsonl",
    "per_view.csv",
    "failed.json",
    "building.json",
    ".submitted.json",
    "tuning.json",
    "mlflow.json",
    ".lock.holder",
)
STRANGE = (
    "null",
    "{}",
    "[]",
    '""',
    "true",
    "0",
    "-1",
    "NaN",
    "-Infinity",
    "1e400",
    "1e308",
    "9" * 400,
    "9" * 5000,
    '"x"',
    '"27"',
    "[" * 5000,
    "[" * 150 + "]" * 150,
    '{"a":' * 60 + "1" + "}" * 60,
    '"\\ud800"',
    '"../../x"',
    '"\\u0000"',
    '"a\\nb"',
    "[null]",
    '{"name": 3}',
    "1.5",
    "18446744073709551616",
    '{"": {}}',
    '["_target_"]',
)


def values_of(runs, densify, seed, threshold):
    """A configuration as a trial writes it, with the settings that readers use."""
    scene = {"name": "courtyard", "kind": "courtyard", "test_every": 8, "width": 64, "height": 48}
    tracking = {"enabled": True, "uri": None, "flush_seconds": 1.0, "patience_seconds": 1.0}
    return trial_values(runs, seed, EXPERIMENT) | {
        "scene": scene | {"max_size": None},
        "raster": {"name": "cpu"},
        "init": {"name": "sfm", "poses": "shared"},
        "densify": {"name": densify, "volume_threshold": threshold},
        "train": {"iterations": 100, "max_seconds": None},
        "eval": {"primary": None},
        "tracking": tracking | {"images": 1},
        "launch": {"name": "serial"},
    }


def write_trial(runs, densify, seed, threshold=0.03):
    """Write a trial with every file that its readers look for."""
    values = values_of(runs, densify, seed, threshold)
    folder = TrialFolder.of(values).path
    write(folder / "config.yaml", values)
    steps = range(10, 101, 10)
    rows = [
        {"step": k, "psnr": 20 + k / 50, "num_gaussians": 10 * k, "seconds": k / 10, "loss": 1 / k}
        for k in steps
    ]
    events = [
        {"step": k, "cloned": 2, "split_volume": 1, "opacity_reset": False, "strictness": 1.0}
        for k in steps
    ]
    for name, lines in (("metrics", rows), ("events", events)):
        write_lines(folder / f"{name}.jsonl", lines)
    psnr = 26.5 + seed
    (folder / "per_view.csv").write_text(f"view,psnr\na,{psnr - 1}\nb,{psnr + 1}\n")
    record = record_of(
        values,
        metrics={"psnr": psnr},
        seconds={"init": 1.0, "train": 60.0, "evaluate": 2.0},
        hashes={"config": folder.name, "data": "d", "init": "i"},
        events={"cloned": 20, "split_volume": 10},
        causes={"initial": 3, "clone": 7},
        resolution=(40, 30),
        test_views=2,
        init_report={"num_points": 5, "gauge": {"scene_extent": 4.5}},
        versions={"gsbench": "0"},
        machine={"cpu": "c", "kernels": "k", "torch": "t", "device": "cpu"},
    )
    TrialFolder(folder).write_finished(values, record)
    return folder


def write_original(runs):
    """Write a small experiment; return the files that are damaged in turn, by name."""
    home = runs / EXPERIMENT
    done, *_ = [write_trial(runs, name, seed) for name in ("adc", "volumetric") for seed in (0, 1)]
    variant = write_trial(runs, "volumetric", 0, 0.5)
    content = read_json(variant / "results.json")
    del content["made_of"]  # so that its settings are read from the YAML
    write(variant / "results.json", content)
    failed = write_trial(runs, "volumetric", 1, 0.5)
    (failed / "results.json").unlink()
    write(failed / "failed.json", {"error": "E", "message": "m", "time": 1.0, "seed": 1})
    write(failed / "building.json", {"stage": "train", "folder": str(done)})
    write(failed / ".submitted.json", {"job": "5", "log": "l", "user": "u"})
    write(
        variant / "mlflow.json",
        {"uri": "u", "token": "t", "started": 1, "logged": {"metrics.jsonl": 5}, "complete": "c"},
    )
    write(done / ".lock.holder", {"host": "h", "pid": 1, "since": 1.0, "slurm": None, "what": "w"})
    planned = {path.relative_to(home).as_posix(): {"words": ["seed=0"]} for path in (done, failed)}
    command = {"words": ["seed=0"], "cwd": str(runs), "time": 1.0, "trials": planned}
    write_lines(home / "commands.jsonl", [command])
    tuning = search_record([{"settings": {"densify.volume_threshold": 0.03}, "value": 20.0}])
    ranges = {"densify.volume_threshold": "0.01,0.03"}
    write(home / "tuning.json", tuning | {"sweep": home.name, "ranges": ranges})
    places_of = {name: done / name for name in NAMES}
    places_of |= {name: home / name for name in ("commands.jsonl", "tuning.json")}
    places_of |= {
        name: failed / name for name in ("failed.json", "building.json", ".submitted.json")
    }
    places_of |= {"mlflow.json": variant / "mlflow.json", "config.yaml": variant / "config.yaml"}
    assert all(path.is_file() for path in places_of.values())
    return places_of


def damage(path, sound, rng):
    """Damage the file; return the kind of damage in one word."""
    kind = rng.choice(("shape",) * 6 + ("bytes",) * 3 + ("place",))
    if kind == "bytes":
        path.write_bytes(corrupt(sound, rng))
    elif kind == "shape":
        path.write_bytes(_misshapen(sound, rng))
    else:
        path.unlink()
        kind = rng.choice(("fifo", "folder", "loop", "device", "absent", "empty", "huge"))
        if kind == "fifo":
            os.mkfifo(path)
        elif kind == "folder":
            path.mkdir()
        elif kind in ("loop", "device"):
            path.symlink_to(path if kind == "loop" else "/dev/zero")
        elif kind == "empty":
            path.touch()
        elif kind == "huge":
            with path.open("wb") as stream:
                stream.truncate(1 << 40)
    return kind


def _misshapen(sound, rng):
    """The JSON with one or two values, keys or whole lines replaced by strange ones."""
    lines = sound.decode().splitlines() if sound.count(b"\n{") else [sound.decode()]
    at = rng.randrange(len(lines))
    try:
        tree = json.loads(lines[at])
    except ValueError:  # per_view.csv is not JSON
        return rng.choice(STRANGE).encode().join(sound.split(b",", rng.randint(1, 3)))
    marks = {}
    for _ in range(rng.choice((1, 1, 2))):
        tree = _replaced(tree, rng, marks)
    text = json.dumps(tree)
    for mark, strange in marks.items():
        text = text.replace(f'"{mark}"', strange)
    lines[at] = text
    return ("\n".join(lines) + "\n").encode()


def _replaced(tree, rng, marks):
    if isinstance(tree, dict) and tree and rng.random() < 0.85:
        key = rng.choice(list(tree))
        how = rng.random()
        if how < 0.1:
            return {name: value for name, value in tree.items() if name != key}
        if how < 0.15:
            return tree | {rng.choice(("", "x", "\ud800", "a.b", "seed")): tree[key]}
        return tree | {key: _replaced(tree[key], rng, marks)}
    if isinstance(tree, list) and tree and rng.random() < 0.85:
        at = rng.randrange(len(tree))
        return [*tree[:at], _replaced(tree[at], rng, marks), *tree[at + rng.randint(0, 1) :]]
    mark = f"mark{len(marks)}{rng.randrange(10**9)}"
    marks[mark] = rng.choice(STRANGE)
    return mark


def look(runs, places):
    """Read everything as the verbs do; return how much was refused or left out.

    Raises any error that is not an InputError.
    """
    home = runs / EXPERIMENT
    refused = 0

    def attempt(read):
        nonlocal refused
        try:
            read()
        except InputError as error:
            if len(str(error).splitlines()) != 1:
                raise RuntimeError("more than a line") from error
            refused += 1

    def tables():
        experiment = load_experiment(runs, EXPERIMENT)
        assert all(len(line.splitlines()) == 1 for line in experiment.warnings)
        nonlocal refused
        refused += len(experiment.warnings) - 1  # one trial has failed
        arms = sorted({trial.arm for trial in experiment.trials})
        attempt(lambda: to_html_page(build_table(experiment)).encode())
        attempt(lambda: to_frame(experiment).to_csv())
        attempt(lambda: training_charts(experiment.trials, arms))
        attempt(lambda: event_charts(experiment.trials, arms))
        for first, second in itertools.pairwise(arms):
            attempt(lambda pair=(first, second): tuning_notes(experiment.trials, pair))
        for trial in experiment.trials:
            attempt(lambda trial=trial: read_views(trial))

    attempt(tables)
    attempt(lambda: explain_cell(f"{EXPERIMENT}:courtyard:psnr:adc", runs))
    attempt(lambda: "\n".join(lines_of(states_of_experiment(home), with_done=True)).encode())
    attempt(lambda: read_history(home))
    attempt(lambda: FinishedTrials(runs).estimate(values_of(runs, "adc", 0, 0.03)))
    attempt(lambda: search_summary(home))
    for folder in {path.parent for path in places.values()} - {home}:
        attempt(lambda folder=folder: TrialFolder(folder).configuration())
        attempt(lambda folder=folder: TrialFolder(folder).stage_and_step())
        attempt(lambda folder=folder: read_if_sound(folder / "mlflow.json", Run))
        attempt(lambda folder=folder: _mirror(folder))
    attempt(lambda: TrialFolder.of(v := values_of(runs, "adc", 0, 0.03)).why_not_done(v))
    return refused


def _mirror(folder):
    trial = TrackedTrial(TrialFolder(folder), TrialFolder(folder).configuration())
    assert trial.params()
    assert trial.tags()
    list(trial.curves({}, live=False))
    results = trial.folder.sound_record()
    if results is not None:
        trial.summary(results, 2, False)


class Noticed(logging.Handler):
    """Counts warnings, each of which must be one line."""

    def __init__(self):
        super().__init__(logging.WARNING)
        self.count = 0

    def emit(self, record):
        assert len(record.getMessage().splitlines()) == 1
        self.count += 1


def main(folder, first, count, only):
    """Run the cases; ``FOLDER/current`` has the number of the present one."""
    runs = folder / "runs"
    shutil.rmtree(runs, ignore_errors=True)
    places = write_original(runs)
    states.read_queue = lambda users: {}  # Slurm is not tested here, and may be slow
    warnings = Noticed()
    logging.getLogger("gsbench").addHandler(warnings)
    logging.getLogger("gsbench").propagate = False
    assert look(runs, places) == 0
    assert warnings.count == 0
    found = Counter()
    kinds = Counter()
    for case in cases(folder, first, count):
        rng = Random(case)
        name = only or NAMES[case % len(NAMES)]
        path = places[name]
        sound, stamp = path.read_bytes(), path.stat()
        kinds[damage(path, sound, rng)] += 1
        warnings.count = 0
        noticed = look(runs, places) + warnings.count
        found["noticed" if noticed else "read"] += 1
        if path.is_dir() and not path.is_symlink():
            path.rmdir()
        else:
            path.unlink(missing_ok=True)
        path.write_bytes(sound)
        os.utime(path, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
    of = ", ".join(f"{number} {kind}" for kind, number in sorted(kinds.items()))
    print(f"{count} cases: {found['noticed']} noticed, {found['read']} read as sound ({of})")


if __name__ == "__main__":
    main(
        Path(sys.argv[1]),
        int(sys.argv[2]),
        int(sys.argv[3]),
        sys.argv[4] if len(sys.argv) > 4 else None,
    )
