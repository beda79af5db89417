"""The search of ``gsbench bisect`` over commits with made-up trainings."""

from argparse import Namespace
from pathlib import Path
from shlex import split
from types import SimpleNamespace

import pytest

from gsbench.claims.gate import PASSED, WORSE, declare_gate, first_worse, most_steps
from gsbench.errors import TrainingError
from gsbench.verbs import versions
from gsbench.verbs.versions import CommitSearch
from tests.composed import composed
from tests.helpers import refusal, write
from tests.trials import write_trial

COMMITS = [
    (letter * 40, f"2026-01-0{day}", f"change {letter}") for day, letter in enumerate("abc", 1)
]
QUALITY = {"a": 26.0, "b": 26.001, "c": 25.0}  # PSNR, dB


class Trainings:
    """Writes a commit's results instead of training it.

    ``fails`` names a commit that does not train.
    """

    def __init__(self, fails=""):
        self.fails = fails
        self.done = []
        self.environments = []

    def __call__(self, command, log, folder, environment, _):
        commit = folder.parent.name[0]
        if commit == self.fails:
            raise TrainingError("it broke")
        name, seeds = (word.partition("=")[2] for word in command[-2:])
        self.done.append((commit, seeds))
        self.environments.append(environment)
        assert command[-4:-2] == ["-m", "scene=courtyard"]
        assert log == Path(environment["GSBENCH_RUNS"], name, "bisect.log")
        for seed in map(int, seeds.split(",")):
            psnr = QUALITY[commit] + 0.001 * seed
            write_trial(log.parents[1], seed, experiment=name, scene="courtyard", psnr=psnr)


def begun(tmp_path, monkeypatch, trainings):
    monkeypatch.setattr(versions, "run_program", trainings)
    arms = {"courtyard": ("sfm-adc", "sfm-adc")}
    declaration = declare_gate("psnr", "0.1", arms, range(3), {"eval": {"extra": {}}})
    for commit, _, _ in COMMITS:
        (tmp_path / f"{commit}/sub").mkdir(parents=True)
    write(tmp_path / COMMITS[1][0] / "src/gsbench/__init__.py", b"")
    trees = SimpleNamespace(tree=lambda commit: tmp_path / commit, prefix="sub")
    return CommitSearch(
        tmp_path / "runs/search",
        ["scene=courtyard"],
        frozenset({"courtyard"}),
        declaration,
        0.05 / most_steps(2),
        trees,
        COMMITS,
    )


def test_the_commit_is_found_and_nothing_is_trained_twice(tmp_path, monkeypatch):
    trainings = Trainings()
    search = begun(tmp_path, monkeypatch, trainings)
    found = first_worse(2, search.result)
    assert found == (1, 2)
    assert trainings.done == [("a", "0,1"), ("c", "0,1"), ("b", "0,1")]
    assert [environment.get("PYTHONPATH") for environment in trainings.environments][2] == str(
        tmp_path / COMMITS[1][0] / "src"
    )
    assert (search.result(2), search.result(1), len(trainings.done)) == (WORSE, PASSED, 3)
    newest, middle, oldest = search.table()
    assert newest.startswith(f"{'c' * 10}  2026-01-03  change c")
    assert "worse in PSNR" in newest
    assert "passed" in middle
    assert oldest.endswith("the good one")
    assert versions._conclusion(found, search) == [
        f"It became worse with {'c' * 10} (2026-01-03): change c"
    ]
    between = f"It became worse with one of 2 commits, from {'b' * 10} to {'c' * 10}."
    assert versions._conclusion((0, 2), search) == [between]
    assert versions._conclusion(None, search)[0].startswith(
        "The last commit is not shown to be worse"
    )


def test_a_commit_that_does_not_train_is_skipped_unless_it_is_the_first_or_last(
    tmp_path, monkeypatch
):
    search = begun(tmp_path, monkeypatch, Trainings(fails="b"))
    assert search.table()[1].endswith("not tried")
    assert first_worse(2, search.result) == (0, 2)
    assert search.table()[1].endswith("does not train: it broke")
    last = begun(tmp_path / "last", monkeypatch, Trainings(fails="c"))
    with pytest.raises(TrainingError, match="it broke"):
        last.result(2)
    good = begun(tmp_path / "good", monkeypatch, Trainings(fails="a"))
    with pytest.raises(TrainingError, match="it broke"):
        good.result(1)


@pytest.mark.usefixtures("runs")
def test_the_same_question_continues_the_same_search(monkeypatch, tmp_path):
    example = composed(split("scene=courtyard densify=adc name=bisect seed=0"))[0]
    monkeypatch.setattr(versions, "one_trial_per_scene", lambda *_: {"courtyard": example})
    settings = ["scene=courtyard", "densify=adc"]

    def begin(commits, *words, seeds=3):
        options = Namespace(metric="psnr", least="0.1", settings=[*settings, *words], seeds=seeds)
        named = [(commit * 40, "2026-01-01", "a change") for commit in commits]
        return versions._begin(options, SimpleNamespace(), named)

    first = begin("abc")
    assert first.home.parent == tmp_path / "runs"
    assert first.home.name.startswith("bisect_")
    assert first.scenes == {"courtyard"}
    assert begin("axc", "name=other", f"runs={tmp_path}").home == first.home
    assert begin("abc").declaration == first.declaration
    others = [begin(*words).home for words in (("abd",), ("dbc",), ("abc", "train=quick"))]
    assert len({first.home, *others}) == 4
    # all gates together err in 5 % at most
    gates = most_steps(2)
    assert first.share == pytest.approx(0.05 / gates)
    assert first.declaration.error_rate == pytest.approx(2 * first.share)
    with refusal("at least 2 seeds, and there is 0"):
        begin("abcd", seeds=-1)
    example.values["scene"]["path"] = "photos"
    with refusal(r"scene\.path=photos: commits are trained in other folders"):
        begin("abc")
    example.values["scene"]["path"] = "~/photos"
    assert begin("abc").settings == settings
