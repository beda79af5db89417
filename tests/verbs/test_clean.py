"""`gsbench clean` frees what no trial refers to, and never what a finished trial needs."""

import os
import time

import pytest

from gsbench.runs.keys import Step
from gsbench.runs.layout import STORE
from gsbench.runs.store import Store, free, stored
from gsbench.system.locks import hold
from tests.helpers import refusal, write
from tests.runs.toy import TOY, build
from tests.trials import trial_values, write_results

pytestmark = pytest.mark.usefixtures("runs")
DAY = 86_400


def made(runs, number, **more):
    """A finished result in the store, with the inputs ``more``."""
    step = Step(TOY, {"number": number, **more}, lambda folder: build(folder, number, 0.0))
    return Store(runs / STORE).get(step).path


def age(folder, days):
    """Make a folder and its files look so many days old."""
    then = time.time() - days * DAY
    for path in (folder, *folder.rglob("*")):
        os.utime(path, (then, then))


@pytest.fixture
def trial(runs):
    """A finished trial of the experiment ``x``; `needs` makes it refer to results."""
    folder = runs / "x/s/a-b/01234567-seed0"
    write_results(folder, trial_values(runs, name="x", scene="s", init="a", densify="b"))
    write(folder / "config.yaml", trial_values(runs, name="x", scene="s", init="a", densify="b"))
    return folder


def needs(trial, *results):
    values = trial_values("runs", name="x", scene="s", init="a", densify="b")
    hashes = {f"h{number}": path.name for number, path in enumerate(results)}
    write_results(trial, values, hashes=hashes)


def test_what_a_trial_needs_stays_with_all_that_made_it(runs, trial, said):
    first = made(runs, 1)
    second = made(runs, 2, upstream=first.name)
    lost = made(runs, 3)
    needs(trial, second)
    for path in (first, second, lost):
        age(path, 40)
    text = said("clean --dry-run")
    assert "3 results" in text
    assert "2 needed by trials, 0 kept for their age, 1 to free" in text
    assert lost.exists()
    assert "freed 1 result" in said("clean")
    assert [path.exists() for path in (first, second, lost)] == [True, True, False]
    assert "freed 0 results" in said("clean --older-than 0d")


def test_young_results_stay_since_a_stopped_sweep_continues_from_them(runs, trial, said, refused):
    young = made(runs, 1)
    age(young, 3)
    assert "1 kept for their age, 0 to free" in said("clean")
    assert young.exists()
    assert "must be an age such as 12h" in refused("clean --older-than 3")
    said("clean --older-than 2d")
    assert not young.exists()


def test_a_damaged_record_still_protects_what_it_names(runs, trial, said):
    kept = made(runs, 1)
    age(kept, 40)
    needs(trial, kept)
    content = (trial / "results.json").read_text()
    (trial / "results.json").write_text(content[:-3])
    said("clean --older-than 0d")
    assert kept.exists()


def test_an_experiment_lets_go_what_its_failed_trials_had(runs, trial, said):
    failed = trial.with_name("01234567-seed1")
    write(failed / "config.yaml", trial_values(runs, 1, "x", scene="s", init="a", densify="b"))
    write(failed / "failed.json", {"message": "no"})
    part = Store(runs / STORE).partial(TOY, "ab" * 32)
    write(part / "half.txt", "half")
    write(failed / "building.json", {"stage": "toy", "folder": str(part)})
    said("clean --older-than 0d")
    assert part.exists()
    said("clean x --older-than 0d")
    assert not part.exists()


def test_nothing_is_freed_while_a_trial_runs_or_a_result_is_built(runs, trial, refused, said):
    lost = made(runs, 1)
    with hold(trial / ".lock", "a trial"):
        assert "1 trial of this runs folder run now" in refused("clean --older-than 0d")
    with hold(lost.with_name(f".{lost.name}.lock"), "building"):
        assert "freed 0 results" in said("clean --older-than 0d")
    assert lost.exists()


def test_files_that_a_trial_shares_are_not_counted_as_freed(runs, trial, said):
    lost = made(runs, 1)
    (lost / "big").write_bytes(b"0" * 5000)
    os.link(lost / "big", trial / "point_cloud.ply")
    (one,) = stored(runs, [])
    assert one.size - one.own == 5000
    assert not one.needed
    free(runs, [one])
    assert (trial / "point_cloud.ply").stat().st_size == 5000


def test_no_link_is_followed(runs, trial, tmp_path, said):
    outside = write(tmp_path / "outside/private", "secret").parent
    made(runs, 1)
    (runs / STORE / TOY.name / ("cd" * 32)).symlink_to(outside)
    (runs / STORE / "linked").symlink_to(outside)
    said("clean --older-than 0d")
    assert (outside / "private").read_text() == "secret"
    (runs / STORE).rename(tmp_path / "moved")
    (runs / STORE).symlink_to(tmp_path / "moved")
    with refusal("follows no links"):
        stored(runs, [])
