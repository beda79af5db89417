"""What `gsbench sync` sends of running, ended and strange trials, to a stand-in of a tracker."""

from shlex import split
from typing import Any

import pytest

from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.locks import hold
from gsbench.tracking import sync as module
from gsbench.tracking.sync import MirrorError, mirror, refusal, sync
from tests.helpers import change_json
from tests.tracking.helpers import begin_trial, begun_trial, options, write_trial
from tests.trials import trial_values


class Tracker:
    """A tracker that keeps what it is told."""

    told: list[Any]
    refuses: BaseException | None = None

    def open(self, trial, run):
        self.told.append(("open", run.complete))
        return f"run {run.token}"

    def send(self, update):
        if self.refuses:
            raise self.refuses
        if update.scalars:
            keys = {one.key.split("/")[1] for one in update.scalars}
            self.told.append(("log", keys, len(update.scalars)))
        if update.status:
            self.told.append(("files", list(update.files)))
            self.told.append((update.status, update.reason))


@pytest.fixture
def told(monkeypatch):
    monkeypatch.setattr(Tracker, "told", [], raising=False)
    monkeypatch.setattr(module, "make_sink", lambda settings, allowed: Tracker())
    monkeypatch.setattr(module, "show_ideas", lambda home, uri: None)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    return Tracker.told


def words(told):
    return [word for word, *_ in told]


ENDED = split("log files FINISHED")


def test_a_tracker_that_fails_frees_the_trial(told, tmp_path, monkeypatch):
    values = trial_values(tmp_path)
    write_trial(TrialFolder.of(values).path, values)
    monkeypatch.setattr(Tracker, "refuses", ValueError("no\nmore"))
    for _ in range(2):
        with pytest.raises(ValueError, match="no"):
            mirror(TrialFolder.of(values), options(), values)
    error = refusal(TrialFolder.of(values), options(), ValueError("x" * 201 + "\nmore"))
    label = TrialFolder.of(values).label
    assert str(error) == f"{label} could not be sent to MLflow (ValueError: {'x' * 201} more)"
    # what is cut is marked
    long = refusal(TrialFolder.of(values), options(), ValueError("x" * 400))
    assert str(long).endswith("x…)")
    assert str(refusal(TrialFolder.of(values), options(), KeyError())).endswith("(KeyError:)")


def test_sync_sends_ended_trials_and_counts_them(told, tmp_path, monkeypatch):
    done, damaged, failed, partial, strange, busy = (
        begin_trial(trial_values(tmp_path, seed), "http://strange" if seed == 4 else None)
        for seed in range(6)
    )
    change_json(strange / "config.yaml", tracking=options("http://strange") | {"enabled": False})
    for folder, seed in ((done, 0), (strange, 4), (busy, 5)):
        write_trial(folder, trial_values(tmp_path, seed))
    (damaged / "results.json").write_text("{")
    (failed / "failed.json").write_text("{}")
    folders = [TrialFolder(one) for one in (done, damaged, failed, partial, strange, busy)]
    label = {one.path: one.label for one in folders}
    with hold(busy / module.LOCK, "mirroring"):
        lines = list(sync(folders, None))
    assert lines == [
        f"mirrored {label[done]}",
        f"left out: {label[damaged]}: damaged, see gsbench status",
        f"mirrored {label[failed]}",
        f"left out: {label[strange]}: its configuration names the tracker http://strange, and "
        "--uri http://strange was not typed",
        f"{label[busy]} is being mirrored by another process",
        "2 trials mirrored now, 0 before",
    ]
    again = [folders[0], folders[2]]
    assert list(sync(again, None)) == ["0 trials mirrored now, 2 before"]
    assert list(sync([folders[4]], "http://strange"))[-1] == "1 trial mirrored now, 0 before"
    assert list(sync([folders[4]], None, ["http://strange"]))[-1].endswith("1 before")
    (busy / "events.jsonl").unlink()
    for error in (ValueError("no"), SystemExit("no")):  # code of a user's may end the process
        monkeypatch.setattr(Tracker, "refuses", error)
        line = rf"could not be sent to MLflow \({type(error).__name__}: no\)"
        with pytest.raises(MirrorError, match=line):
            list(sync(folders[5:], None))


def test_the_curves_of_a_running_trial_are_sent_and_its_end_says_how_it_ended(told, tmp_path):
    folder, values = begun_trial(tmp_path)
    trial = [TrialFolder(folder)]
    assert list(sync(trial, None))[-1].startswith("0 trials")  # stopped before it was ever sent
    assert told == []
    with hold(folder / ".lock", "a trial"):
        list(sync(trial, None))
    list(sync(trial, None))
    list(sync(trial, None))
    assert [one for one in told if one[0] == "KILLED"] == [("KILLED", None)]
    (folder / "failed.json").write_text('{"message": "x", "time": 5.0}')
    list(sync(trial, None))
    assert told[-1] == ("FAILED", "x")
    (folder / "failed.json").unlink()
    del told[:]
    write_trial(folder, values)
    list(sync(trial, None))
    assert words(told) == ["open", "log", "log", *ENDED]


def test_the_ideas_are_renewed_once_and_in_mlflow_alone(told, tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr(module, "show_ideas", lambda home, uri: shown.append((home, uri)))
    folders = []
    for seed, more in enumerate(({}, {}, {"_target_": "gsbench.tracking.WandB"})):
        folder, values = begun_trial(tmp_path, seed, **more)
        write_trial(folder, values)
        folders.append(TrialFolder(folder))
    list(sync(folders, None))
    assert shown == [(folders[0].home, None)]

    def refuse(home, uri):
        raise KeyError("no page")

    monkeypatch.setattr(module, "show_ideas", refuse)
    with pytest.raises(MirrorError, match=r"could not be sent to MLflow .*KeyError: 'no page'"):
        list(sync(folders[:1], None))
