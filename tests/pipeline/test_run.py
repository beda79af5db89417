"""A trial's steps in order, its files, and its failures, with stand-ins for the steps."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch.testing import assert_close

from gsbench.errors import GsbenchError, InputError, TrainingError
from gsbench.files import DiskFullError
from gsbench.gaussians.ply import read_ply, write_ply
from gsbench.normalization import IDENTITY, Normalization
from gsbench.pipeline import trial as trials
from gsbench.pipeline.trial import _publish, _recorded_failures, run_trial
from gsbench.runs.code import config_hash
from gsbench.runs.keys import CAPTURE, EVALUATE, GROUND_TRUTH, INIT, TRAIN, Step
from gsbench.runs.store import StoredResult
from gsbench.runs.trial_folder import TrialFolder
from gsbench.runs.trial_record import FROM_RENDERS
from gsbench.system.locks import BusyError, hold
from tests.gaussians.helpers import random_gaussians
from tests.helpers import read_json, write
from tests.trials import bare_trial as trial
from tests.trials import record_of

# ---- the frame


def test_a_trial_runs_unless_it_is_done_and_one_process_at_a_time(tmp_path, monkeypatch, logged):
    one = trial(tmp_path)
    record = record_of(one.values, hashes={"config": config_hash(one.values)})
    ran = []

    def run(given, folder):
        ran.append((given, sorted(path.name for path in folder.path.iterdir())))
        folder.write_finished(one.values, record)
        return record

    monkeypatch.setattr(trials, "_run", run)
    write(one.folder / ".a.tmp-1", b"")
    with hold(one.files.lock, "other"), pytest.raises(BusyError, match="seed 0"):
        run_trial(one, wait=False)
    assert run_trial(one) == record
    ((given, names),) = ran
    assert given is one
    assert {".lock", "log.txt"} < set(names)
    assert ".a.tmp-1" not in names
    assert run_trial(one, wait=False) == record
    assert len(ran) == 1
    assert logged.messages == [f"{one.files.label}: already done"]
    assert "already done" in (one.folder / "log.txt").read_text()


@pytest.mark.parametrize(
    "error, kind, message, bad_input",
    [
        (InputError("no photos"), InputError, "no photos", True),
        (TrainingError("nan"), TrainingError, "nan", False),
        (KeyError("x"), KeyError, "KeyError: 'x'", False),
        (
            torch.OutOfMemoryError("out of memory"),
            TrainingError,
            "device=cuda has no memory ",
            False,
        ),
        (MemoryError("x"), TrainingError, "device=cuda has no memory left: lower ", False),
        (
            RuntimeError("[alloc_cpu.cpp] DefaultCPUAllocator: can't allocate memory: 9 bytes"),
            *(TrainingError, "device=cuda has no memory left: ", False),
        ),
        (RuntimeError("No space left"), DiskFullError, "the disk of ", False),
        *[
            (SystemExit(code), TrainingError, "code of the trial ended the process", False)
            for code in (0, None, 3, "text")
        ],
    ],
)
def test_a_failure_is_recorded_and_raised(tmp_path, monkeypatch, error, kind, message, bad_input):
    monkeypatch.setattr("time.time", lambda: 12.5)
    folder = TrialFolder(tmp_path / "a/b/c/d")
    folder.path.mkdir(parents=True)
    for _ in range(2):
        with pytest.raises(kind), _recorded_failures({"seed": 4, "device": "cuda"}, folder):
            raise error
        failure = folder.failure()
        assert failure.message.startswith(message)
        assert (failure.error, failure.seed, failure.time, failure.bad_input) == (
            kind.__name__,
            4,
            12.5,
            bad_input,
        )
        assert type(error).__name__ in failure.traceback

    def full(path, values):
        raise OSError(28, "full")

    monkeypatch.setattr(trials, "write_json", full)
    with pytest.raises(kind), _recorded_failures({"seed": 4, "device": "cuda"}, folder):
        raise error


def step(stage, **inputs):
    return Step(stage, inputs, lambda folder: (folder / "made").write_text(str(inputs)))


# ---- the files of the trial


@pytest.mark.parametrize("normalization", [IDENTITY, Normalization((1.0, 2.0, 3.0), 0.5)])
def test_files_of_the_steps_are_published_in_the_trials_folder(tmp_path, normalization):
    content = {
        INIT: "picture.png report.json",
        TRAIN: "lineage.npz metrics.jsonl events.jsonl checkpoint-1.pt",
        EVALUATE: "per_view.csv renders/a.png renders/b.png metrics.json",
        GROUND_TRUTH: "a.png b.png masks/b.png",
    }
    entries = {}
    for stage, names in content.items():
        place = tmp_path / stage.name
        for name in names.split():
            write(place / name, f"{stage.name} {name}")
        entries[stage.name] = SimpleNamespace(path=place)
    gaussians = random_gaussians(5, dtype=torch.float32)
    write_ply(gaussians, tmp_path / "train/point_cloud.ply")
    folder = tmp_path / "trial"
    folder.mkdir()
    published = _publish(folder, entries, normalization)
    texts = {
        **{name: f"train {name}" for name in ("lineage.npz", "metrics.jsonl", "events.jsonl")},
        **{name: f"evaluate {name}" for name in content[EVALUATE].split()[:3]},
        **{f"ground_truth/{name}": f"ground_truth {name}" for name in ("a.png", "b.png")},
        "masks/b.png": "ground_truth masks/b.png",
    }
    found = {path.relative_to(folder).as_posix() for path in published}
    assert found == {*texts, "point_cloud.ply"}
    assert len(published) == len(found)
    assert {name: (folder / name).read_text() for name in texts} == texts
    model = read_ply(folder / "point_cloud.ply")
    given = gaussians.means / normalization.scale + torch.tensor(normalization.center)
    assert_close(model.means, given.float())
    is_linked = (folder / "point_cloud.ply").samefile(tmp_path / "train/point_cloud.ply")
    assert is_linked == (normalization is IDENTITY)


@pytest.fixture
def running(tmp_path, monkeypatch):
    """A trial whose steps write a file each; ``record`` are the results."""
    one = trial(tmp_path)
    state = SimpleNamespace(trial=one, seen={}, error=None, raster="raster")
    hashes = {"config": config_hash(one.values)}
    state.record = record_of(one.values, metrics={"psnr": 20.456}, hashes=hashes)

    class Parts:
        threads = 3
        raster = "proven"
        program = "a program that trains"

        def __init__(self, values):
            self.values = values

        def check(self, on_this_machine):
            state.seen["checked"] = on_this_machine
            if state.error:
                raise state.error

        @property
        def rasterizer(self):
            state.seen["rasterizer"] = True
            return "r"

    class Steps:
        capture = photographs = SimpleNamespace(normalization=IDENTITY)
        views = SimpleNamespace(scene=SimpleNamespace(train=(1, 2, 3), test=(1, 2)))

        def __init__(self, parts, store):
            pass

        def steps(self):
            for number, stage in enumerate((CAPTURE, INIT, TRAIN, GROUND_TRUTH, EVALUATE)):
                code = dict.fromkeys((stage.name, "all"), str(number))
                yield replace(step(stage, number=number), code=code, build=build)
                if stage is INIT:  # read while the training runs
                    state.seen["report"] = (one.folder / "init_report.json").read_text()

    def build(folder):
        (folder / trials.REPORT_FILE).write_text("{}")
        state.seen.setdefault("building", []).append(one.files.building())

    def results_of(*given):
        state.seen["given"] = given
        return state.record

    monkeypatch.setattr(trials, "Parts", Parts)
    monkeypatch.setattr(trials, "TrialSteps", Steps)
    monkeypatch.setattr(trials, "results_of", results_of)
    monkeypatch.setattr(trials, "_publish", lambda folder, *given: [folder / "init_report.json"])
    monkeypatch.setattr(trials, "source_files", lambda *given: [])
    monkeypatch.setattr(torch, "set_num_threads", lambda count: state.seen.update(threads=count))
    return state


def test_a_trial_builds_its_steps_and_writes_its_results(running, logged):
    one, folder = running.trial, running.trial.folder
    write(folder / "failed.json", "{}")
    assert run_trial(one) == running.record
    seen, names = running.seen, ("scene", "init", "train", "ground_truth", "evaluate")
    assert (seen["checked"], seen["rasterizer"], seen["threads"]) == (True, True, 3)
    assert [building.stage for building in seen["building"]] == [*names]
    assert all(building.folder for building in seen["building"])
    assert seen["report"] == "{}"
    values, _, scene, raster, entries, code, _ = seen["given"]
    assert (values, raster) == (one.values, "proven")
    assert len(scene.train) == 3
    assert [type(entry) for entry in entries.values()] == [StoredResult] * 5
    assert code == {name: str(number) for number, name in enumerate(names)} | {"all": "4"}
    assert (folder / "config.yaml").read_text() == one.yaml
    assert not (folder / "failed.json").exists()
    assert not (folder / "building.json").exists()
    made_of = one.files.made_of()
    # the photographs of a scene that gsbench made are not looked at again
    assert set(made_of.entries) == {*names[1:]}
    assert set(made_of.published) == {"config.yaml", "init_report.json"}
    lines = ("3 training and 2 test views", "psnr 20.46  10 Gaussians")
    assert logged.messages == [f"{one.files.label}: {line}" for line in lines]


def test_equal_results_are_called_done_and_useless_ones_are_named(running, logged):
    one = running.trial
    renders = {"num_gaussians": None, "evaluated_from": FROM_RENDERS}
    running.record = replace(running.record, one_color_psnr=21.0, **renders)
    run_trial(one)
    assert logged.messages[-2].endswith(": psnr 20.46")
    assert "not better than one colour" in logged.messages[-1]
    (one.folder / "init_report.json").write_text("other")
    run_trial(one)
    assert logged.messages[-2].endswith(": psnr 20.46  (already done)")


def test_a_refused_part_leaves_the_earlier_configuration(running):
    one, running.error = running.trial, InputError("no such device")
    write(one.folder / "config.yaml", "earlier")
    with pytest.raises(GsbenchError, match="no such device"):
        run_trial(one)
    assert (one.folder / "config.yaml").read_text() == "earlier"
    assert read_json(one.folder / "failed.json")["status"] == "failed"
