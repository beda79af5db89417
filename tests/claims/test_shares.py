"""A check that several machines share: the same verdicts as of one, no trial twice, no pair across machines."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from gsbench.analysis.results import load_experiment, read_experiment
from gsbench.claims.archive import unpack_archive, write_archive
from gsbench.claims.file import ClaimsFile, parse_claims
from gsbench.claims.recheck import check_can_go_on, recheck, with_shares
from gsbench.claims.shares import Shares, check_plan_keeps, gather, merge, read_shares
from gsbench.claims.sweep import Check, Find, prepare, run_looks
from gsbench.claims.verdict import Pair, Verdict
from gsbench.cli import run
from gsbench.errors import InputError
from gsbench.launch.declare import declare_plan
from gsbench.runs.declaration import DeclaredPlan, read_declarations, read_plans, standing_plan
from gsbench.runs.layout import DECLARED, FROM_PIXELS, RESULTS
from gsbench.verbs.check import describe
from tests.analysis.synthetic import Plan, write_runs
from tests.claims.test_archive import members
from tests.claims.test_recheck import SCENES, Runner
from tests.claims.test_sweep import content, ready

pytestmark = pytest.mark.slow

NOISE = 6.0  # dB: no claim is decided before the last look
TRIALS = 2 * 2 * 4  # arms, scenes, seeds


def two_scenes() -> ClaimsFile:
    return parse_claims(content() | {"scenes": {name: SCENES[name] for name in ("courtyard", "own")}})


def machine(runs: Path, *only: str, lacks: str = "") -> Check:
    """The check in a runs folder of its own, of ``only`` these scenes; photographs of ``lacks`` are not there."""
    return prepare(two_scenes(), runs, lambda trial, _: "no data" * (trial.values["scene"]["name"] == lacks), only=only)


def go_on(check: Check, shares: Shares | None = None) -> tuple[list[Verdict], int]:
    """Run what is to be run; the verdicts, and the number of trials that were run."""
    runner = Runner(noise=NOISE)
    declared = declare_plan(check.home, check.plan, check.plan_hash, check.missing)
    if shares is not None:  # as the verb does: here the plan may be written down a second after trials elsewhere
        declared = min(declared, shares.declared, key=lambda plan: plan.time)
    return run_looks(check, declared, runner, ready), sum(runner.batches)


def archived(check: Check, file: Path) -> Path:
    assert write_archive(read_experiment(check.home), file) == []
    return file


def numbers(verdicts: list[Verdict]) -> list[object]:
    return [(one.word, one.decision, one.by_scene, one.baseline, one.beforehand) for one in verdicts]


def test_two_machines_look_by_look_end_as_one_does(tmp_path: Path) -> None:
    alone, count = go_on(machine(tmp_path / "alone"))
    assert (alone[0].word, count) == ("undecided", TRIALS)
    homes = {name: machine(tmp_path / name, name) for name in ("courtyard", "own")}
    assert {check.plan_hash for check in homes.values()} == {machine(tmp_path / "alone").plan_hash}
    verdicts, trained, archives = {}, 0, {}
    for look in range(3):  # at 2, 3 and 4 seeds: each machine does its part, and is given the other's
        for name, check in homes.items():
            others = [file for other, file in archives.items() if other != name]
            shares = read_shares(others, tmp_path / f"{name}{look}", "check_it") if others else None
            verdicts[name], count = go_on(check if shares is None else with_shares(check, shares), shares)
            trained += count
            archives[name] = archived(check, tmp_path / f"{name}{look}.zip")
    assert trained == TRIALS
    assert numbers(verdicts["own"]) == numbers(alone)
    found = recheck(two_scenes(), list(archives.values()), tmp_path / "both")
    assert numbers(list(found.verdicts)) == numbers(alone)
    merge(list(archives.values()), "check_it", tmp_path / "merged.zip")
    merged = recheck(two_scenes(), [tmp_path / "merged.zip"], tmp_path / "merged")
    assert numbers(list(merged.verdicts)) == numbers(alone)
    assert merged.declared == found.declared


def test_a_new_machine_goes_on_where_a_lost_one_stood(tmp_path: Path) -> None:
    alone, _ = go_on(machine(tmp_path / "alone"))
    first = machine(tmp_path / "first", "courtyard")
    (waiting,), count = go_on(first)
    assert (waiting.word, count) == ("undecided", 4)
    assert "waits for own" in waiting.reason
    archive = archived(first, tmp_path / "first.zip")
    shares = read_shares([archive], tmp_path / "there", "check_it")
    second = with_shares(machine(tmp_path / "second"), shares)
    assert f"{TRIALS - 4} at most" in "\n".join(describe(second))
    assert "2 pairs of trials come from archives and are not run again" in describe(second)
    verdicts, count = go_on(second, shares)
    assert count == TRIALS - 4
    assert numbers(verdicts) == numbers(alone)


def test_a_scene_whose_photographs_only_others_have(tmp_path: Path) -> None:
    whole = machine(tmp_path / "first")
    alone, _ = go_on(whole)
    archive = archived(whole, tmp_path / "a.zip")
    shares = read_shares([archive], tmp_path / "there", "check_it")
    poor = with_shares(machine(tmp_path / "poor", lacks="own"), shares)
    verdicts, count = go_on(poor, shares)
    assert count == 0
    assert numbers(verdicts) == numbers(alone)
    other, shares = (
        prepare(parse_claims(content(least=0.1)), tmp_path, lambda *_: ""),
        read_shares([archive], tmp_path / "b", "check_it"),
    )
    with pytest.raises(InputError, match="give the file as it was then"):
        with_shares(other, shares)
    edited = read_shares([archive], tmp_path / "c", "check_it")
    nothing = replace(edited, sources=(("old.zip", lambda values: None),))
    with pytest.raises(InputError, match=r"old\.zip holds no trial of this plan"):
        with_shares(machine(tmp_path / "x"), nothing)


def test_half_a_pair_is_no_share(tmp_path: Path) -> None:
    """A lone trial of another machine is no partner: its cloud, of the same photographs, may be another."""
    first = machine(tmp_path / "first")
    go_on(first)
    for results in first.home.glob(f"own/*-volumetric/*/{RESULTS}"):
        results.unlink()
    archive = archived_rest(first, tmp_path / "half.zip")
    second = with_shares(machine(tmp_path / "second"), read_shares([archive], tmp_path / "there", "check_it"))
    _, count = go_on(second)
    assert count == TRIALS // 2  # both arms of the scene


def archived_rest(check: Check, file: Path) -> Path:
    write_archive(read_experiment(check.home), file)
    return file


def test_a_pair_that_was_trained_here_and_there_is_refused_and_half_of_one_is_not(tmp_path: Path) -> None:
    there, here = machine(tmp_path / "there"), machine(tmp_path / "here")
    go_on(there)
    go_on(here)
    archive = archived(there, tmp_path / "same.zip")
    verdicts, count = go_on(with_shares(here, read_shares([archive], tmp_path / "x", "check_it")))
    assert count == 0
    for results in there.home.glob(f"*/*-volumetric/*/{RESULTS}"):
        values = json.loads(results.read_text())
        results.write_text(json.dumps(values | {"num_gaussians": values["num_gaussians"] + 1}))
    other = read_shares([archived(there, tmp_path / "other.zip")], tmp_path / "y", "check_it")
    with pytest.raises(InputError, match=r"has other results in .*other\.zip than here: it was trained twice"):
        go_on(with_shares(here, other))
    for results in there.home.glob(f"*/*-adc/*/{RESULTS}"):
        results.unlink()
    half = read_shares([archived_rest(there, tmp_path / "half.zip")], tmp_path / "z", "check_it")
    assert numbers(go_on(with_shares(here, half))[0]) == numbers(verdicts)


def test_after_a_kill_within_a_pair_both_archives_are_judged(tmp_path: Path) -> None:
    """The lost machine had one trial of the pair, the next one ran both: no archive can hold all three."""
    alone, _ = go_on(machine(tmp_path / "alone"))
    first = machine(tmp_path / "first")
    go_on(first)
    for results in first.home.glob(f"own/*-volumetric/*-seed[123]/{RESULTS}"):
        results.unlink()
    for results in first.home.glob(f"own/*-adc/*-seed[23]/{RESULTS}"):
        results.unlink()
    lost = archived_rest(first, tmp_path / "lost.zip")
    second = with_shares(machine(tmp_path / "second"), read_shares([lost], tmp_path / "a", "check_it"))
    verdicts, count = go_on(second)
    assert count == 6
    edit_results(second.home, "own/*/*", seconds={"train": 12.5})  # no two trainings take as long
    rest = archived(second, tmp_path / "rest.zip")
    assert numbers(verdicts) == numbers(alone)
    for k, archives in enumerate(([lost, rest], [rest, lost])):
        found = recheck(two_scenes(), archives, tmp_path / f"b{k}")
        assert numbers(list(found.verdicts)) == numbers(alone)
    with pytest.raises(InputError, match="gsbench check --from takes each pair from the one that has it whole"):
        merge([lost, rest], "check_it", tmp_path / "all.zip")


def test_a_pair_is_never_made_of_two_machines_trials(tmp_path: Path) -> None:
    """Neither of two archives, nor of one in which they were joined."""
    halves = []
    for name, kept in (("adc", "theirs"), ("volumetric", "ours")):
        check = machine(tmp_path / name)
        go_on(check)
        edit_results(check.home, "own/*/*", hashes={"init": "one", "cloud": kept, "data": "one"})
        for results in check.home.glob(f"own/*/*/{RESULTS}"):
            if results.parents[1].name.rpartition("-")[2] != name:
                results.unlink()
        halves.append(archived_rest(check, tmp_path / f"{name}.zip"))
    merge(halves, "check_it", tmp_path / "joined.zip")
    for k, archives in enumerate((halves, [tmp_path / "joined.zip"])):
        (verdict,) = recheck(two_scenes(), archives, tmp_path / f"x{k}").verdicts
        assert verdict.reason == "trials are missing: the next look waits for own"


def test_a_machine_that_lacks_a_scene_cannot_drop_it_from_the_verdict(tmp_path: Path) -> None:
    first, poor = machine(tmp_path / "first", "courtyard"), machine(tmp_path / "poor", lacks="courtyard")
    for check in (first, poor):
        go_on(check)
    archives = [archived(check, tmp_path / f"{check.runs.name}.zip") for check in (first, poor)]
    for k, order in enumerate((archives, archives[::-1])):
        with pytest.raises(InputError, match=r"not one plan was declared: .*first\.zip .* on courtyard, own"):
            recheck(two_scenes(), order, tmp_path / f"a{k}")
        with pytest.raises(InputError, match="one that lacks a scene names those that it runs"):
            merge(order, "check_it", tmp_path / "all.zip")
    ours = read_plans(first.home)[-1]
    theirs = read_shares(archives[1:], tmp_path / "b", "check_it")
    with pytest.raises(InputError, match="not one plan was declared: here"):
        check_plan_keeps(ours, theirs.declared, "poor.zip")
    check_plan_keeps(theirs.declared, ours, "first.zip")  # the wider one may be taken up
    with pytest.raises(InputError, match="cannot be tested here on own, which --scene names: no data"):
        prepare(two_scenes(), tmp_path, lambda trial, _: "no data", only=["own"])
    shares = read_shares(archives[:1], tmp_path / "c", "check_it")
    both, _ = go_on(with_shares(machine(tmp_path / "poor", lacks="courtyard"), shares), shares)
    assert numbers(both)  # it declared the wider plan, and so both archives are of one now
    archived(poor, archives[1])
    found = recheck(two_scenes(), archives, tmp_path / "d")
    assert found.verdicts[0].word == both[0].word
    assert {scene for scene, _ in found.verdicts[0].by_scene} == {"courtyard", "own"}


def test_a_trial_that_was_evaluated_again_is_one_training(tmp_path: Path) -> None:
    """As when weights of LPIPS had come since the first export: what has more metrics is taken."""
    check = machine(tmp_path / "one")
    go_on(check)
    before = archived(check, tmp_path / "before.zip")
    for results in check.home.glob(f"*/*/*/{RESULTS}"):
        values = json.loads(results.read_text())
        more = {"metrics": values["metrics"] | {"flip": 0.25}, "measured": "2026-11-23T00:00:00Z"}
        results.write_text(json.dumps(values | more))
    rows = [file.read_text().splitlines() for file in check.home.glob("*/*/*/per_view.csv")]
    for file, lines in zip(check.home.glob("*/*/*/per_view.csv"), rows, strict=True):
        file.write_text("\n".join([f"{lines[0]},flip", *(f"{line},0.25" for line in lines[1:])]) + "\n")
    after = archived(check, tmp_path / "after.zip")
    for k, order in enumerate(([before, after], [after, before])):
        merge(order, "check_it", tmp_path / f"{k}.zip")
        for trial in unpack_archive(tmp_path / f"{k}.zip", tmp_path / f"u{k}").trials:
            assert trial.metrics["flip"] == 0.25
        (verdict,) = recheck(two_scenes(), order, tmp_path / f"r{k}").verdicts
        assert all("flip" in trial.metrics for trial in verdict.trials)


def test_measures_of_pictures_do_not_hang_on_the_order(tmp_path: Path) -> None:
    check = machine(tmp_path / "one")
    go_on(check)

    def copied(name: str, value: float | None) -> tuple[str, Find]:
        """The same trials in another place, with what an archive brings of their pictures."""
        home = shutil.copytree(check.home, tmp_path / name / "check_it")
        for results in home.glob(f"*/*/*/{RESULTS}") if value is not None else ():
            (results.parent / FROM_PIXELS).write_text(json.dumps({"error_textured": value}))
        found = {(trial.scene, trial.densify, trial.seed): trial for trial in read_experiment(home).trials}
        keys = ("scene", "densify")
        return name, lambda trial: found[*(trial.values[key]["name"] for key in keys), trial.values["seed"]]

    def pairs(*sources: tuple[str, Find]) -> list[Pair]:
        return list(replace(check, elsewhere=sources).pairs(check.questions[0], lambda trial: None).values())

    bare, seen, other = copied("bare", None), copied("seen", 3.0), copied("other", 4.0)
    for found in (pairs(bare, seen), pairs(seen, bare)):
        assert {trial.path.parents[3].name for pair in found for trial in pair} == {"seen"}
        assert len(found) == TRIALS // 2
    with pytest.raises(InputError, match="has other results in other than seen"):
        pairs(seen, bare, other)


def test_a_trial_that_was_trained_twice_is_refused_and_the_same_one_counts_once(tmp_path: Path) -> None:
    check = machine(tmp_path / "one")
    go_on(check)
    one = archived(check, tmp_path / "one.zip")
    assert len(gather([one, one], tmp_path / "same").trials) == TRIALS
    results = next(check.home.glob(f"own/*/*/{RESULTS}"))
    values = json.loads(results.read_text())
    results.write_text(json.dumps(values | {"seconds": {"train": 12.5}}))
    two = archived(check, tmp_path / "two.zip")
    with pytest.raises(InputError, match=r"own/.* stands in .*one\.zip and in .*two\.zip with other results"):
        gather([one, two], tmp_path / "twice")
    with pytest.raises(
        InputError, match=r"own/.* has other results in .*two\.zip than .*one\.zip: it was trained twice"
    ):
        recheck(two_scenes(), [one, two], tmp_path / "judged")


def edit_results(home: Path, pattern: str, **changes: object) -> None:
    for results in home.glob(f"{pattern}/{RESULTS}"):
        results.write_text(json.dumps(json.loads(results.read_text()) | changes))


def go_on_from(archive: Path, here: Check, folder: Path) -> None:
    shares = read_shares([archive], folder, "check_it")
    check_can_go_on(with_shares(here, shares), lambda trial: "ours")


def test_a_scene_is_gone_on_with_by_the_same_code_and_photographs_alone(tmp_path: Path) -> None:
    first = machine(tmp_path / "first", "courtyard")
    go_on(first)
    edit_results(first.home, "*/*/*", hashes={"data": "theirs"})
    archive = archived(first, tmp_path / "data.zip")
    with pytest.raises(InputError, match="courtyard: photographs or their model are not those of"):
        go_on_from(archive, machine(tmp_path / "x"), tmp_path / "a")
    for k, here in enumerate((machine(tmp_path / "x", "own"), machine(tmp_path / "x", lacks="courtyard"))):
        go_on_from(archive, here, tmp_path / f"b{k}")  # another scene has photographs of its own
    recheck(two_scenes(), [archive], tmp_path / "c")  # where nothing is run, nothing is asked
    code = {"files": {"raster/base.py": "0123456789abcdef"}, "commit": "c0ffee" * 6}
    edit_results(first.home, "*/*/*", hashes={"data": "ours"}, code=code)
    with pytest.raises(InputError, match=r"made by other code \(raster/base\.py, commit c0ffeec0ffee\)"):
        go_on_from(archived(first, archive), machine(tmp_path / "x"), tmp_path / "d")
    edit_results(first.home, "*/*/*", code={"sources": {"mine.Own": "0"}})  # of a class that no configuration names
    go_on_from(archived(first, archive), machine(tmp_path / "x"), tmp_path / "e")


def test_shares_by_unlike_code_or_photographs_are_refused(tmp_path: Path) -> None:
    archives = []
    for k, scene in enumerate(("courtyard", "own")):
        check = machine(tmp_path / scene, scene)
        go_on(check)
        edit_results(check.home, "*/*/*", code={"files": {"raster/base.py": str(k) * 16}})
        archives.append(archived(check, tmp_path / f"{scene}.zip"))
    with pytest.raises(InputError, match=r"made by unlike code, gsbench.s raster/base\.py: 00000000 \(courtyard"):
        recheck(two_scenes(), archives, tmp_path / "x")
    edit_results(tmp_path / "own" / "check_it", "*/*/*", code={})
    edit_results(tmp_path / "own" / "check_it", "*/*/*-seed1", hashes={"data": "other"})
    write_archive(read_experiment(tmp_path / "own" / "check_it"), tmp_path / "mixed.zip")
    edit_results(tmp_path / "courtyard" / "check_it", "*/*/*", code={})
    write_archive(read_experiment(tmp_path / "courtyard" / "check_it"), archives[0])
    with pytest.raises(InputError, match="own: seeds were trained on unlike photographs"):
        recheck(two_scenes(), [archives[0], tmp_path / "mixed.zip"], tmp_path / "y")


def test_days_by_unlike_code_are_refused_before_they_are_trained(tmp_path: Path) -> None:
    """One machine, one folder: a scene today, another one after gsbench was edited, or a stage has another version."""
    first = machine(tmp_path / "runs", "courtyard")
    go_on(first)
    second = machine(tmp_path / "runs", "own")
    check_can_go_on(second, lambda trial: None)
    for code in ({"files": {"raster/base.py": "0123456789abcdef"}}, {"stages": {"train": 999}}):
        edit_results(first.home, "courtyard/*/*", code=code)
        with pytest.raises(InputError, match=r"courtyard/.* was made by other code \((raster/base\.py|stage train)\)"):
            check_can_go_on(second, lambda trial: None)
        archive = archived(first, tmp_path / "a.zip")
        with pytest.raises(InputError, match="was made by other code"):
            go_on_from(archive, machine(tmp_path / "other", "own"), tmp_path / str(len(code)) / next(iter(code)))


def test_the_earliest_of_two_times_of_a_plan_stands(tmp_path: Path) -> None:
    archives, times = [], []
    for k, name in enumerate(("courtyard", "own")):
        check = machine(tmp_path / name, name)
        go_on(check)
        line = json.loads((check.home / DECLARED).read_text()) | {"time": f"2026-01-0{2 - k}T00:00:00Z"}
        (check.home / DECLARED).write_text(json.dumps(line) + "\n")
        archives.append(archived(check, tmp_path / f"{name}.zip"))
        times += [plan.time for plan in read_plans(check.home)]
    (plan,) = read_plans(gather(archives, tmp_path / "x").folder)
    assert plan.time == min(times) < max(times)


@pytest.mark.parametrize(
    ("lines", "stands"),
    [
        (["a1"], "a1"),
        (["a1", "a2"], "a1"),
        (["a1", "b2", "a3"], "a3"),
        (["b1", "a2", "a3"], "a2"),
        (["a1", "b2"], "b2"),
    ],
)
def test_a_plan_stands_since_the_last_other_one(lines: list[str], stands: str) -> None:
    plans = [DeclaredPlan(int(line[1]), line[0], {}) for line in lines]
    assert standing_plan(plans) == DeclaredPlan(int(stands[1]), stands[0], {})


def test_a_plan_that_was_left_and_taken_up_again_is_as_old_as_that(tmp_path: Path) -> None:
    check = machine(tmp_path / "one")
    go_on(check)
    line = json.loads((check.home / DECLARED).read_text())
    days = [line | {"time": f"2026-01-0{day}T00:00:00Z", "hash": name} for day, name in enumerate("aba", 1)]
    (check.home / DECLARED).write_text("".join(json.dumps(day) + "\n" for day in days))
    archive = archived(check, tmp_path / "a.zip")
    (one, other, again) = read_plans(gather([archive], tmp_path / "x").folder)
    assert [plan.hash for plan in (one, other, again)] == list("aba")
    assert read_shares([archive], tmp_path / "y", "check_it").declared == again


def test_declared_trials_of_a_sweep_add_up(tmp_path: Path) -> None:
    """As in one folder, to which a second command added its trials: with the time of the second."""
    archives = []
    for k, scene in enumerate(("garden", "room")):
        runs = tmp_path / scene
        write_runs(runs, Plan(scenes=[scene]))
        line = {"metric": "psnr", "time": f"2026-01-0{1 + k}T00:00:00Z", "trials": {f"{scene}/sfm-adc/aa": [0, 1]}}
        (runs / "exp" / DECLARED).write_text(json.dumps(line) + "\n")
        archives.append(tmp_path / f"{scene}.zip")
        write_archive(load_experiment(runs, "exp"), archives[-1])
    together = gather(archives[::-1], tmp_path / "x")
    assert {trial.scene for trial in together.trials} == {"garden", "room"}
    first, second = read_declarations(together.folder)
    assert first.trials == {"garden/sfm-adc/aa": (0, 1)}
    assert second.trials == {"garden/sfm-adc/aa": (0, 1), "room/sfm-adc/aa": (0, 1)}


def test_archives_of_other_experiments_are_refused(tmp_path: Path) -> None:
    archives = []
    for name in ("one", "other"):
        write_runs(tmp_path / name, Plan(experiment=name))
        archives.append(tmp_path / f"{name}.zip")
        write_archive(load_experiment(tmp_path / name, name), archives[-1])
    with pytest.raises(InputError, match="is of the experiment other, not of one"):
        gather(archives, tmp_path / "x")
    with pytest.raises(InputError, match="no plan of claims was declared in it"):
        read_shares(archives[:1], tmp_path / "y", "one")
    with pytest.raises(InputError, match="is of the experiment one, not of check_it"):
        read_shares(archives[:1], tmp_path / "z", "check_it")
    with pytest.raises(InputError, match=r"has no scene cortyard; did you mean courtyard\?"):
        machine(tmp_path, "cortyard")


def test_the_verbs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """``export --with`` joins archives with the runs folder, and without it; ``check`` judges what they hold."""
    archives = {}
    for name in ("courtyard", "own"):
        check = machine(tmp_path / name, name)
        go_on(check)
        archives[name] = str(archived(check, tmp_path / f"{name}.zip"))
    claims = tmp_path / "claims.yaml"
    scenes = {name: SCENES[name] for name in ("courtyard", "own")}
    claims.write_text(yaml.safe_dump(content() | {"scenes": scenes}))
    for runs, shares in (("courtyard", ["own"]), ("nothing", ["own", "courtyard"])):
        monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path / runs))
        out = tmp_path / f"of_{runs}.zip"
        words = ["--with", *(archives[name] for name in shares), "--out", str(out)]
        assert run(["export", "--results", "check_it", *words]) == 0
        assert len(unpack_archive(out, tmp_path / f"un_{runs}").trials) == 8
    assert capsys.readouterr().out.count(".zip") == 2
    one, other = (members(tmp_path / f"of_{runs}.zip") for runs in ("courtyard", "nothing"))
    crate = "ro-crate-metadata.json"  # dates results that do not say when they were measured by their files
    assert one | {crate: b""} == other | {crate: b""}
    for given in ([str(out)], list(archives.values())):
        assert run(["check", str(claims), "--from", *given]) == 0
    first, second = capsys.readouterr().out.split("check_it: claims and verdicts")[1:]
    assert first == second
    assert "2 scenes, 2 seeds" in first
    assert run(["check", str(claims), "--dry-run", "--with", str(out), "--scene", "courtyard"]) == 0
    said = capsys.readouterr().out
    assert "4 pairs of trials come from archives" in said
    assert "0 trials until the first look, 4 at most" in said
    assert "left to others: own" in said
    for words in (["--from", str(out), "--dry-run"], ["--from", str(out), "--scene", "own"], ["--scene", "nowhere"]):
        assert run(["check", str(claims), *words]) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1
    assert run(["export", "exp:a:b:0", "--out", "a.ply", "--with", str(out)]) == 2
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path / "nothing"))
    repeated = [word for file in archives.values() for word in ("--with", file)]
    assert run(["export", "--results", "check_it", *repeated, "--out", str(out)]) == 0
    assert len(unpack_archive(out, tmp_path / "un_repeated").trials) == 8
    (tmp_path / "nothing" / "check_it" / "own").mkdir(parents=True)  # where nothing was trained
    assert run(["export", "--results", "check_it", *repeated, "--out", str(out)]) == 0
    assert "has no whole trial here" in capsys.readouterr().err
    for name in ("check_it/", "own/check_it", "/tmp/check_it", "", "x\0y"):
        assert run(["export", "--results", name, *repeated, "--out", str(out)]) == 2
        assert "is no name of an experiment" in capsys.readouterr().err
    both = [word for file in archives.values() for word in ("--from", file)]
    assert run(["check", str(claims), *both]) == 0
    assert "2 scenes, 2 seeds" in capsys.readouterr().out
    assert run(["check", str(claims), "allow_targets=[mine]", *both]) == 0
    assert run(["check", str(claims), "nonsense=1", *both]) == 2
