"""One contract, four trackers: what each shows of the same files, and after each interruption."""

import shutil
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.locks import BusyError, hold
from gsbench.tracking import connect
from gsbench.tracking.sync import make_sink, mirror
from tests.conftest import ROOT
from tests.helpers import read_json, refusal, write
from tests.tracking.helpers import (
    begun_trial,
    found_runs,
    mirror_trial,
    options,
    write_trial,
)
from tests.trials import STEPS

AT = {"50": {"metrics": {"psnr": 15.0}, "num_gaussians": 7}}
OWN = (ROOT / "examples/kept.py").read_text()


class FakeRun:
    """Stands in for a run of W&B's client."""

    def __init__(self, name):
        self.name, self.code = name, None
        self.summary = dict[str, Any]()
        self.rows, self.files = list[dict[str, Any]](), set[str]()
        self.config = SimpleNamespace(
            values={}, update=lambda new, **how: self.config.values.update(new)
        )

    def define_metric(self, name, step_metric):
        assert (name, step_metric) == ("*", "iteration")

    def log(self, row):
        self.rows.append(row)

    def save(self, path, base_path, policy):
        self.files.add(Path(path).relative_to(base_path).as_posix())

    def finish(self, code):
        self.code = code


class Shown:
    """What a tracker shows of its runs, in one form."""

    def __init__(self, kind, runs, monkeypatch):
        self.kind, self.runs = kind, runs
        self.settings = options() | {"_target_": f"gsbench.tracking.{kind}"}
        if kind == "WandB":
            self.fakes = {}
            wandb = ModuleType("wandb")
            wandb.__spec__ = SimpleNamespace()
            wandb.Settings, wandb.Image = dict, lambda pixels: pixels
            wandb.run = None
            wandb.init = lambda **how: self.fakes.setdefault(how["id"], FakeRun(how["name"]))
            monkeypatch.setitem(sys.modules, "wandb", wandb)
        if kind == "own":
            module = ModuleType("kept")
            monkeypatch.setitem(sys.modules, "kept", module)
            exec(OWN, vars(module))
            self.settings |= {"_target_": "kept.Kept", "folder": str(runs / "kept")}

    def mirror(self, folder, values):
        return mirror_trial(self.settings, folder, values, ["kept"])

    def __call__(self):
        return getattr(self, f"_{self.kind.lower()}")()

    def one(self):
        """The newest run; only W&B keeps those with earlier results."""
        shown = self()
        assert len(shown) == 1 or self.kind == "WandB"
        return shown[-1]

    def _own(self):
        shown = [read_json(file) for file in (self.runs / "kept").glob("*.json")]
        return [
            {
                "params": one["params"],
                "tags": one["tags"],
                "metrics": {
                    (key.split()[0], int(key.split()[1])): value
                    for key, value in one.get("metrics", {}).items()
                },
                "files": set(one.get("files", ())),
                "pictures": set(one.get("pictures", ())),
                "status": tuple(one.get("end", {"status": "RUNNING", "reason": None}).values()),
            }
            for one in shown
        ]

    def _mlflow(self):
        client = connect(None, self.runs)
        return [
            {
                "params": run.data.params,
                "tags": run.data.tags,
                "metrics": {
                    (key, one.step): one.value
                    for key in run.data.metrics
                    for one in _once(client.get_metric_history(run.info.run_id, key))
                },
                "files": {item.path for item in client.list_artifacts(run.info.run_id)},
                "pictures": {
                    Path(item.path).name.partition("+")[0].replace("~", "/")
                    for item in client.list_artifacts(run.info.run_id, "images")
                },
                "status": (run.info.status, run.data.tags.get("error")),
            }
            for run in found_runs(client, "tracked")
        ]

    def _wandb(self):
        status = {None: "RUNNING", 0: "FINISHED", 1: "FAILED"}
        return [
            {
                "params": run.config.values,
                "tags": run.config.values,
                "metrics": {
                    (key, row["iteration"]): value
                    for row in run.rows
                    for key, value in row.items()
                    if key != "iteration" and not isinstance(value, np.ndarray)
                },
                "files": run.files,
                "pictures": {
                    key
                    for row in run.rows
                    for key, value in row.items()
                    if isinstance(value, np.ndarray)
                },
                "status": (status[run.code], run.summary.get("error") if run.code else None),
            }
            for run in self.fakes.values()
        ]

    def _tensorboard(self):
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
        from tensorboard.util import tensor_util

        folder = next((self.runs / "tensorboard").glob("tracked/*/*/*"))
        assert len(list(folder.iterdir())) == 1
        sizes = {"scalars": 0, "images": 0, "tensors": 0}
        events = EventAccumulator(str(folder), size_guidance=sizes).Reload()
        names = events.Tags()

        def texts(name):
            key = f"{name}/text_summary"
            found = events.Tensors(key) if key in names["tensors"] else []
            return [tensor_util.make_ndarray(one.tensor_proto)[0].decode() for one in found]

        def table(name):
            rows = [
                line.strip("| ").split(" | ") for text in texts(name) for line in text.split("\n")
            ]
            return {row[0]: row[1] for row in rows if len(row) == 2}

        status, _, reason = (texts("status") or ["RUNNING"])[-1].partition(": ")
        metrics = {
            (key, one.step): pytest.approx(one.value)
            for key in names["scalars"]
            for one in _once(events.Scalars(key))
        }
        return [
            {
                "params": table("settings"),
                "tags": table("trial"),
                "metrics": metrics,
                "files": None,  # TensorBoard keeps none
                "pictures": set(names["images"]),
                "status": (status, reason or None),
            }
        ]


def _once(history):
    """The history of a number, which no step may have twice."""
    steps = [one.step for one in history]
    assert len(steps) == len(set(steps))
    return history


@pytest.fixture(params=["MLflow", "TensorBoard", "WandB", "own"])
def shown(request, database, tmp_path, monkeypatch):
    """A tracker for a new runs folder."""
    if request.param == "TensorBoard":
        pytest.importorskip("tensorboard", reason="needs tensorboard")
    folder = tmp_path / "runs"
    folder.mkdir()
    if request.param == "MLflow":
        shutil.copy(database, folder)
    return Shown(request.param, folder, monkeypatch)


def finished(runs, psnr=20.0):
    """A finished trial with a picture, which was also measured at iteration 50."""
    folder, values = begun_trial(runs, 1)
    write_trial(folder, values, psnr=psnr, metrics_at=AT)
    for kind, value in (("renders", 200), ("ground_truth", 50)):
        (folder / kind).mkdir(exist_ok=True)
        Image.fromarray(np.full((4, 6, 3), value, np.uint8)).save(folder / f"{kind}/view 1#.png")
    return folder, values


def check_whole(run, psnr=20.0):
    """The run shows the trial of `finished`, all of it."""
    losses = {("train/loss", i): 1 / i for i in range(1, STEPS + 1)}
    cloned = {("train/densify/cloned", i): i for i in (50, 100)}
    ends = {("eval/psnr_dB", 50): 15.0, ("eval/psnr_dB", STEPS): psnr}
    ends |= {("eval/gaussians", STEPS): 11, ("eval/init_points", STEPS): 5}
    for key, value in (losses | cloned | ends).items():
        assert run["metrics"][key] == value, key
    assert run["params"]["densify.name"] == "a_densify"
    assert next(iter(run["params"])) == "arm" or run["params"]["arm"] == "a_densify · a_init"
    tags = {"seed": "1", "protocol": "paper-1", "hash_config": "abc"}
    assert tags.items() <= run["tags"].items()
    assert run["files"] is None or {"config.yaml", "results.json", "events.jsonl"} <= run["files"]
    kinds = ("1 render", "2 photograph", "3 error")
    assert run["pictures"] == {f"view 1_/{kind}" for kind in kinds}
    assert run["status"] == ("FINISHED", None)


@pytest.fixture
def mirrored(shown):
    """A finished trial that the tracker shows, as (folder, values)."""
    trial = finished(shown.runs)
    assert shown.mirror(*trial)
    return trial


def check_one(shown, trial):
    """Mirror the trial again: one run shows all of it."""
    assert shown.mirror(*trial)
    check_whole(shown.one())
    assert len(shown()) == 1


def test_a_whole_trial_is_shown_once(shown, mirrored):
    before = shown.one()
    check_whole(before)
    assert not shown.mirror(*mirrored)
    assert shown.one() == before


def test_what_was_sent_before_a_crash_is_not_shown_twice(shown, mirrored):
    (state,) = [path for path in mirrored[0].glob("*.json") if "token" in path.read_text()]
    kept = read_json(state)
    del kept["complete"]
    write(state, kept | {"logged": {"metrics.jsonl": 70}})
    check_one(shown, mirrored)


@pytest.mark.parametrize("method, number", [("open", 1), ("send", 1), ("send", 4)])
def test_after_an_error_anywhere_the_next_time_completes_the_run(
    shown, method, number, monkeypatch
):
    """What is sent: settings, two files of curves, and the end."""
    trial = finished(shown.runs)
    cls = type(make_sink(shown.settings, ["kept"]))
    whole, calls = getattr(cls, method), []

    def fail(*given):
        calls.append(1)
        if len(calls) < number:
            return whole(*given)
        if done:
            whole(*given)
        raise ConnectionError

    with monkeypatch.context() as patch:
        patch.setattr(cls, method, fail)
        # before the tracker did it, and after: its answer is lost
        for done in (False, True):  # noqa: B007 - read by fail
            with pytest.raises(ConnectionError):
                shown.mirror(*trial)
    check_one(shown, trial)


def test_changed_results_replace_those_that_were_shown(shown, mirrored):
    finished(shown.runs, psnr=33.0)
    assert shown.mirror(*mirrored)
    check_whole(shown.one(), psnr=33.0)
    assert len(shown()) == (2 if shown.kind == "WandB" else 1)
    assert not shown.mirror(*mirrored)


def test_a_failure_is_shown_with_its_reason_until_the_trial_succeeds(shown):
    folder, values = begun_trial(shown.runs, 1)
    write(folder / "failed.json", {"message": "the loss became nan\nagain"})
    assert shown.mirror(folder, values)
    run = shown.one()
    assert run["status"] == ("FAILED", "the loss became nan")
    assert run["files"] is None or run["files"] >= {"config.yaml", "failed.json"}
    assert not shown.mirror(folder, values)
    assert shown.one() == run
    (folder / "failed.json").unlink()
    check_one(shown, finished(shown.runs))


def test_curves_are_shown_while_the_trial_runs(shown, tmp_path):
    folder, values = finished(shown.runs)  # an earlier command left results and curves
    files = TrialFolder(folder)
    (folder / "results.json").unlink()
    with hold(folder / ".mlflow.lock", "mirroring"), pytest.raises(BusyError):
        mirror(files, shown.settings, values, ["kept"], live=True)
    assert mirror(files, shown.settings, values, ["kept"], live=True)
    assert ("train/loss", 1) not in shown.one()["metrics"]
    training = {"stage": "train", "folder": str(tmp_path / "building")}
    (tmp_path / "building").mkdir()
    write(folder / "building.json", training)
    seen = []
    for text in ('{"step": 10, "loss": 0.5}\n{"step": 20, "lo', 'ss": 0.25}\n', ""):
        with (tmp_path / "building/metrics.jsonl").open("a") as stream:
            stream.write(text)
        mirror(files, shown.settings, values, ["kept"], live=True)
        curve = {s: v for (key, s), v in shown.one()["metrics"].items() if key == "train/loss"}
        seen.append(curve)
    assert seen == [{10: 0.5}, {10: 0.5, 20: 0.25}, {10: 0.5, 20: 0.25}]
    assert shown.mirror(folder, values)
    assert shown.one()["status"][0] == ("FAILED" if shown.kind == "WandB" else "KILLED")


@pytest.mark.parametrize("shown", ["MLflow", "TensorBoard", "own"], indirect=True)
def test_a_run_that_was_deleted_there_is_made_again(shown, mirrored):
    if shown.kind == "MLflow":
        client = connect(None, shown.runs)
        client.delete_run(found_runs(client, "tracked")[0].info.run_id)
    else:
        shutil.rmtree(shown.runs / {"TensorBoard": "tensorboard", "own": "kept"}[shown.kind])
    check_one(shown, mirrored)


@pytest.mark.parametrize("shown", ["WandB"], indirect=True)
@pytest.mark.parametrize("name", ["wandb", "wandb/wandb", "wandb/.wandb"])
def test_a_client_does_not_write_through_a_link(name, shown, tmp_path):
    (tmp_path / "private").mkdir()
    folder, values = finished(shown.runs)
    (shown.runs / name).parent.mkdir(exist_ok=True)
    (shown.runs / name).symlink_to(tmp_path / "private")
    with refusal("follows no links"):
        shown.mirror(folder, values)
