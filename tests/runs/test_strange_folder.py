"""A runs folder of a stranger: none of its links is followed, and nothing in it blocks a reader."""

import os
from contextlib import suppress

import pytest

from gsbench.analysis.results import read_experiment
from gsbench.errors import InputError
from gsbench.files import require_no_links
from gsbench.launch.record import remove
from gsbench.launch.states import states_of_experiment
from gsbench.logs import log_to
from gsbench.parsing import DamagedError, read_bytes
from gsbench.runs.commands import remember_result
from gsbench.runs.experiments import list_experiments
from gsbench.runs.keys import Step
from gsbench.runs.store import Store
from gsbench.system.locks import describe_holder, hold, is_held
from tests.helpers import refusal
from tests.runs.toy import TOY, build, toy_inputs
from tests.trials import trial_values, write_results

SECRET = "what nobody else may read or change"


@pytest.fixture
def outside(tmp_path):
    """A private folder beside the runs folder."""
    folder = tmp_path / "outside"
    folder.mkdir()
    (folder / "private").write_text(SECRET)
    return folder


@pytest.fixture
def trial(tmp_path):
    """A finished trial in the runs folder, with results alone."""
    folder = tmp_path / "runs/x/s/a-b/01234567-seed0"
    write_results(folder, trial_values("runs", name="x", scene="s", init="a", densify="b"))
    return folder


def _log(folder):
    with log_to(folder / "log.txt"):
        pass


def _hold(folder):
    with hold(folder / ".lock", "work"):
        pass


def _remember(folder):
    remember_result(folder.parents[2], folder, "a-b/01234567")


# The file in a trial's folder that is a link, and the function that writes it.
WRITERS = {
    "the log": ("log.txt", _log),
    "a lock": (".lock", _hold),
    "a lock's holder": (".lock.holder", _hold),
    "the commands' holder": ("../../../.commands.jsonl.lock.holder", _remember),
    "the commands": ("../../../commands.jsonl", _remember),
}


@pytest.mark.parametrize("case", WRITERS)
def test_no_link_is_written_through(case, trial, outside):
    name, write = WRITERS[case]
    (trial / name).symlink_to(outside / "private")
    with suppress(InputError, OSError):
        write(trial)
    assert (outside / "private").read_text() == SECRET


@pytest.mark.parametrize("level", range(3))
def test_trials_in_a_linked_folder_are_ignored(level, trial, outside):
    doomed = [trial.parents[2], trial.parents[1], trial.parent][level]
    doomed.rename(outside / "moved")
    doomed.symlink_to(outside / "moved")
    home = trial.parents[2]
    assert read_experiment(home).trials == () or level == 0  # a named folder may be a link
    assert states_of_experiment(home) == [] or level == 0
    assert (list_experiments(home.parent) == []) == (level == 0)
    with refusal("follows no links"):
        remove(home, [trial])
    assert trial.is_dir()


def _link(path, outside):
    path.symlink_to(outside / "private")


def _folder_link(path, outside):
    path.symlink_to(outside)


def _pipe(path, outside):
    os.mkfifo(path)


@pytest.mark.parametrize("make", [_link, _folder_link, _pipe])
@pytest.mark.parametrize(
    "name", ["per_view.csv", "renders", "ground_truth/v.png", "log.txt", ".lock.holder"]
)
def test_a_trial_with_a_link_or_a_pipe_is_left_out(name, make, trial, outside):
    assert len(read_experiment(trial.parents[2]).trials) == 1
    (trial / name).parent.mkdir(exist_ok=True)
    make(trial / name, outside)
    found = read_experiment(trial.parents[2])
    assert not found.trials
    assert name in found.warnings[0]
    with refusal("not a regular file"):
        require_no_links(trial.parents[3], trial, below=True)


@pytest.mark.parametrize("make", [_link, _pipe])
def test_no_link_and_no_pipe_is_read(make, trial, outside):
    for name in ("declared.jsonl", ".lock", ".lock.holder"):
        make(trial / name, outside)
    with pytest.raises(DamagedError):
        read_bytes(trial / "declared.jsonl")
    assert not is_held(trial / ".lock")
    assert describe_holder(trial / ".lock") == "another process"


def test_the_store_builds_nothing_in_a_linked_folder(tmp_path, outside):
    store, step = (
        Store(tmp_path / "runs/store"),
        Step(TOY, toy_inputs(1), lambda folder: build(folder, 1, 0.0)),
    )
    partial = store.partial(step.stage, step.key)
    partial.parent.mkdir(parents=True)
    partial.symlink_to(outside)
    with refusal("follows no links"):
        store.get(step)
    assert [path.name for path in outside.iterdir()] == ["private"]
    partial.unlink()
    made = store.get(step).path
    made.rename(outside / "moved")
    made.symlink_to(outside / "moved")
    assert not store.get(step).path.is_symlink()
    assert (outside / "moved").is_dir()


def _edited(made):
    (made / "lines.txt").write_text("0")


def _linked(made):
    (made / "lines.txt").unlink()
    (made / "lines.txt").symlink_to(made.parents[3] / "outside/private")


def _linked_beside(made):
    (made / "more.txt").symlink_to(made.parents[3] / "outside/private")


@pytest.mark.parametrize(
    "spoil, words",
    [
        (_edited, "lines.txt differs from what was written"),
        (_linked, "is a link"),
        (_linked_beside, "is a link"),
        (lambda made: (made / "manifest.json").unlink(), "is missing or unreadable"),
        (lambda made: made.rename(made.with_name("abc")), "is gone"),
    ],
)
def test_a_stored_result_that_is_shown_is_as_it_was_written(tmp_path, outside, spoil, words):
    """`gsbench view` and `gsbench export` read the initial model of somebody's trial."""
    store = Store(tmp_path / "runs/store")
    step = Step(TOY, toy_inputs(1), lambda folder: build(folder, 1, 0.0))
    made = store.get(step).path
    assert store.existing(TOY, step.key) == made
    for key in ("", f"../toy/{step.key}", str(made)):
        with refusal("is gone"):
            store.existing(TOY, key)
    spoil(made)
    with refusal(words):
        store.existing(TOY, step.key)


@pytest.mark.parametrize(
    "name", ["<img src=x>", "=1+1", "@SUM(1)", "a|b", "a\nb", "\u202eab", "-x"]
)
def test_a_folder_that_gsbench_could_not_have_made_is_no_trial(tmp_path, trial, caplog, name):
    trial.parents[1].rename(trial.parents[2] / name)
    assert read_experiment(tmp_path / "runs/x").trials == ()
    assert "gsbench gives no folder such a name" in caplog.text


def test_a_pipe_in_place_of_the_note_on_a_locks_holder_does_not_block(tmp_path):
    os.mkfifo(tmp_path / "x.lock.holder")
    with hold(tmp_path / "x.lock", "this"):
        assert (tmp_path / "x.lock.holder").is_file()
