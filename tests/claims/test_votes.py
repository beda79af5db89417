"""Votes: a blind page, a whole round in a browser by keyboard, and exact verdicts."""

import itertools
import json
import random
import re
from dataclasses import fields, replace
from pathlib import Path
from shlex import split

import numpy as np
import pytest
from PIL import Image
from scipy.optimize import minimize
from scipy.stats import binomtest

from gsbench.analysis.results import load_experiment
from gsbench.analysis.votes import bradley_terry, judge_round
from gsbench.claims.vote_page import make_round
from gsbench.cli import run
from gsbench.runs.experiments import Arm, read_declarations
from gsbench.runs.votes import Ballot, RoundKey, Showing, Vote, read_key
from gsbench.verbs.vote import choose_arms
from tests.analysis.helpers import page_of, trials_of
from tests.conftest import script
from tests.helpers import read_json, refusal, write
from tests.trials import write_runs
from tests.view.browser import Browser

ADC, VOLUMETRIC = "sfm-adc", "sfm-volumetric"
SHARP = {"left": "right", "right": "left"}


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """A runs folder with pictures: two scenes with seven views each, two seeds."""
    folder = tmp_path_factory.mktemp("votes")
    write_runs(
        folder,
        views=7,
        seeds=(0, 1),
        pictures=True,
        effect={"lpips_vgg_raw": 0.1},
        view_noise=0.1,
    )
    return folder


@pytest.fixture
def runs(pictures, monkeypatch):
    monkeypatch.setenv("GSBENCH_RUNS", str(pictures))
    return pictures


@pytest.fixture
def made(runs, tmp_path):
    """A function that makes a round of ``exp`` with its page in ``page``, and returns its key."""

    def make(*words, pairs="12", out="page"):
        before = set((runs / "exp/votes").glob("*"))
        made = ["vote", "make", "exp", "--out", str(tmp_path / out), "--pairs", pairs]
        assert run([*made, *words]) == 0
        (folder,) = set((runs / "exp/votes").glob("*")) - before
        return read_key(folder)

    return make


def prefers(arm):
    """The votes of a person who always prefers ``arm`` and passes every trap."""
    return lambda showing: next(
        (side for side in SHARP if getattr(showing, side) in (arm, "photograph")), "same"
    )


def ballot(key, person, choose, minute=0, name=""):
    votes = tuple(Vote(showing=one.id, answer=choose(one), seconds=1.0) for one in key.showings)
    finished = f"2099-11-27T00:{minute:02}:00Z"
    return Ballot(
        round=key.round, person=f"{person:016x}", finished=finished, votes=votes, name=name
    )


def saved(folder, one):
    file = folder / f"votes-{one.person}.json"
    write(file, one.to_json())
    return str(file)


@pytest.fixture
def judge(said, tmp_path):
    """A function that judges ballots, or the stored ones, and returns what is printed."""
    return lambda *ballots: said("vote judge exp", *(saved(tmp_path, one) for one in ballots))


def made_up(arms, scenes, views, people=9, traps=4):
    """A key without pictures: every two arms on each view."""
    pair = {"kind": "pair", "seed": 0}
    showings = [
        Showing(
            id=f"{scene}{view}{one}{two}",
            scene=str(scene),
            view=str(view),
            **pair | {"left": one, "right": two},
        )
        for scene in range(scenes)
        for view in range(views)
        for one, two in itertools.combinations(arms, 2)
    ]
    first = showings[0]
    showings.append(
        replace(first, id="again", kind="again", left=first.right, right=first.left, of=first.id)
    )
    trap = replace(first, kind="trap", left="photograph", right="blurred")
    showings += [replace(trap, id=f"trap{number}") for number in range(traps)]
    named = tuple(Arm(*arm.split("-")) for arm in arms)
    more = {"salt": "s", "time": "2026-11-27T00:00:00Z", "traps_allowed": 0}
    return RoundKey(arms=named, people=people, showings=tuple(showings), **more)


# ---- the page


def test_the_page_does_not_reveal_arms(made, tmp_path):
    key = made("--people", "2")
    text = (tmp_path / "page/index.html").read_text()
    for word in ("sfm", "volumetric", "courtyard", "garden", "view0", key.salt, "blurred"):
        assert word not in text
    for showing in key.showings:
        assert key.commitment(showing) in text
    files = sorted((tmp_path / "page/pictures").iterdir())
    assert len(files) == 3 * len(key.showings)
    for file in files:
        assert not set(file.stem) - set("0123456789abcdef")
        with Image.open(file) as image:
            assert not image.info
    again = made("--people", "2", out="again")
    assert not set(map(key.commitment, key.showings)) & set(map(again.commitment, again.showings))


def test_each_showing_has_the_pictures_that_its_key_names(made, runs, tmp_path):
    page = tmp_path / "page"
    key = made()
    text = (page / "index.html").read_text()
    entries = json.loads(text.partition('id="data">')[2].partition("</script>")[0])["showings"]
    trials = {(t.scene, str(t.arm), t.seed): t.path for t in trials_of(runs)}
    for entry, showing in zip(entries, key.showings, strict=True):
        photo, left, right = (pixels(page / entry[what]) for what in ("photo", "left", "right"))
        name = f"{showing.view}.png"
        folder = trials[showing.scene, ADC, showing.seed]
        np.testing.assert_array_equal(photo, pixels(folder / f"ground_truth/{name}"))
        for side, shown in (("left", left), ("right", right)):
            what = getattr(showing, side)
            if showing.kind == "trap":
                assert np.array_equal(shown, photo) == (what == "photograph")
            else:
                folder = trials[showing.scene, what, showing.seed]
                np.testing.assert_array_equal(shown, pixels(folder / f"renders/{name}"))


def pixels(file):
    return np.asarray(Image.open(file))


def test_views_sides_repeats_and_traps_follow_the_rules(made, runs):
    key = made()
    kinds = [one.kind for one in key.showings]
    assert [kinds.count(kind) for kind in ("pair", "again", "trap")] == [12, 1, 4]
    assert [one.left for one in key.pairs].count(ADC) == 6
    assert sorted(one.left for one in key.showings if one.kind == "trap") == 2 * ["blurred"] + 2 * [
        "photograph"
    ]
    for scene in ("courtyard", "garden"):
        own = [one for one in key.pairs if one.scene == scene]
        assert len({one.view for one in own}) == len(own) == 6
        most = {one.view for one in own if one.chosen == "most different"}
        assert len(most) == 3
        # Views and seeds take turns, so each view has one pair of renders that may be shown.
        differences = {}
        for place in range(7):
            both = [
                pixels(t.path / f"renders/view{place:03}.png").astype(float)
                for t in trials_of(runs)
                if t.scene == scene and t.seed == place % 2
            ]
            differences[f"view{place:03}"] = np.abs(both[0] - both[1]).mean()
        assert most == set(sorted(differences, key=lambda view: -differences[view])[:3])
    for showing in key.showings:
        if showing.kind == "again":
            first = next(one for one in key.pairs if one.id == showing.of)
            swapped = replace(first, left=first.right, right=first.left)
            assert (showing.left, showing.right) == (swapped.left, swapped.right)
            assert showing.view == first.view
            assert key.showings.index(showing) > key.showings.index(first)


def test_a_repeated_pair_does_not_follow_its_first_showing_soon(runs, tmp_path):
    trials = trials_of(runs)
    for seed in range(3):
        arms = [Arm("sfm", "adc"), Arm("sfm", "volumetric")]
        key = make_round(trials, arms, 12, 1, tmp_path / str(seed), random.Random(seed))
        places = {showing.id: place for place, showing in enumerate(key.showings)}
        (again,) = (one for one in key.showings if one.kind == "again")
        place = places[again.id]
        assert place - places[again.of] >= 4
        assert place >= 2 * (len(key.showings) - 1) // 3  # in the last third


def test_a_lack_of_views_or_people_is_reported(made, capsys):
    key = made("--people", "9", pairs="40")
    out = capsys.readouterr().out
    assert len(key.pairs) == 14
    assert "no more than 14 views" in out
    assert "judged at 126 votes of 9 people" in out
    assert "decide nothing" not in out
    made("--people", "5", pairs="40", out="two")
    assert "decide nothing: that needs 6 people" in capsys.readouterr().out


def test_a_round_is_declared_apart_from_metrics_and_claims(made, runs, tmp_path):
    key = made("--people", "7")
    declared = [one for one in read_declarations(runs / "exp") if one.vote_round == key.round]
    assert [(one.kind, one.votes, len(one.questions)) for one in declared] == [("votes", 84, 1)]
    page = page_of(runs)
    assert "no metric was declared (eval.primary)" in page
    archive = str(tmp_path / "exp.zip")
    assert run(["export", "--results", "exp", "--out", archive]) == 0
    assert run(["site", archive, "--out", str(tmp_path / "site")]) == 0
    assert "vote " + key.round not in (tmp_path / "site/index.html").read_text()


@pytest.mark.parametrize(
    "words, message",
    [
        ("make exp", "needs --out"),
        ("make exp --out .", "is there already"),
        ("make exp --out new --arms adc", "sfm-adc alone"),
        (
            "make exp --out new --arms adc,mcmc",
            "'mcmc' names 0 arms; choose one of sfm-adc",
        ),
        ("make exp --out new --pairs 0", "in [1, 1000]"),
        ("make exp x.json --out new", "takes no files"),
        ("judge exp absent.json", "absent.json is not there"),
        ("judge exp --arms adc", "files of votes alone"),
        ("look exp", "invalid choice"),
    ],
)
def test_bad_input_of_vote_is_refused_in_one_line(
    runs, words, message, tmp_path, monkeypatch, refused
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    assert message in refused("vote", *split(words))


def test_trials_without_pictures_are_refused_and_no_page_is_written(tmp_path):
    write_runs(tmp_path, experiment="bare")
    trials = load_experiment(tmp_path, "bare").trials
    arms = choose_arms(trials, ())
    with refusal("holds no renders"):
        make_round(trials, arms, 4, 9, tmp_path / "page", random.Random(0))
    assert not (tmp_path / "page").exists()


# ---- files of votes


def test_files_of_votes_that_do_not_fit_the_round_are_refused(made, tmp_path, refused, judge):
    key = made("--people", "2")
    sound = ballot(key, 1, prefers(ADC))
    part = replace(sound, person=f"{2:016x}", votes=sound.votes[:-1])
    twice = replace(sound, person=f"{3:016x}", votes=(*sound.votes, sound.votes[0]))
    foreign = replace(sound, person=f"{4:016x}", round="0" * 12)
    for bad, message in (
        (part, "answers 16 of the 17 showings"),
        (twice, "answers 17 of the 17 showings"),
        (foreign, "no round 000000000000"),
    ):
        assert message in refused("vote", "judge", "exp", saved(tmp_path, bad))
    for change in ({"person": "../../../x"}, {"round": ".."}, {"finished": "soon"}, {"votes": 1}):
        file = write(tmp_path / "changed.json", sound.to_json() | change)
        assert "is damaged" in refused("vote", "judge", "exp", file)
    first = saved(tmp_path, sound)
    assert "same person" in refused("vote", "judge", "exp", first, first)
    out = judge(sound)
    assert f"Round {key.round}: " in out
    assert "\n| SSIM ↑ | undecided | " in out
    assert "other votes before" in refused(
        "vote", "judge", "exp", saved(tmp_path, ballot(key, 1, prefers(VOLUMETRIC)))
    )


OTHER_KEYS = {
    "salt": lambda key: {"salt": "other"},
    "time": lambda key: {"time": "2026-01-01T00:00:00Z"},
    "arms": lambda key: {"arms": key.arms[::-1]},
    "people": lambda key: {"people": 1},
    "traps_allowed": lambda key: {"traps_allowed": 4},
    "showings": lambda key: {"showings": key.showings[::-1]},
}
OTHER_SHOWINGS = dict.fromkeys(("id", "scene", "view", "left", "right", "of"), "x")
OTHER_SHOWINGS |= {"kind": "again", "seed": 7, "chosen": ""}


def test_every_field_of_the_key_is_sealed_by_the_rounds_name():
    key = made_up(["sfm-a", "sfm-b"], scenes=2, views=2)
    key = replace(key, showings=(replace(key.showings[0], chosen="random"), *key.showings[1:]))
    assert OTHER_KEYS.keys() == {field.name for field in fields(RoundKey)}
    assert OTHER_SHOWINGS.keys() == {field.name for field in fields(Showing)}
    for name, change in OTHER_KEYS.items():
        assert replace(key, **change(key)).round != key.round, name
    for name, value in OTHER_SHOWINGS.items():
        edited = replace(key.showings[0], **{name: value})
        assert replace(key, showings=(edited, *key.showings[1:])).round != key.round, name


def test_a_changed_key_is_refused(made, runs, tmp_path, refused):
    key = made()
    file = runs / f"exp/votes/{key.round}/key.json"
    text = file.read_text()
    write(file, replace(key, traps_allowed=4).to_json())
    assert "was changed after the page was made" in refused(
        "vote", "judge", "exp", saved(tmp_path, ballot(key, 1, prefers(ADC)))
    )
    file.write_text(text)


def test_late_files_never_take_the_place_of_counted_ones(made, tmp_path, refused, judge):
    key = made("--people", "6")
    for first in range(0, 12, 6):  # the first six, then six more that finished earlier
        arm = VOLUMETRIC if first == 0 else ADC
        own = [ballot(key, first + n, prefers(arm), minute=50 - first - n) for n in range(6)]
        assert "(72 for it, 0 against it" in judge(*own)
    old = replace(ballot(key, 99, prefers(ADC)), finished="1970-01-01T00:00:00Z")
    assert "before its round was made" in refused("vote", "judge", "exp", saved(tmp_path, old))


def _copied(path):
    path.with_name(f"{7:016x}.json").write_text(path.read_text())


def _edited(path):
    path.write_text(path.read_text().replace('"left"', '"right"'))


def _without_votes(path):
    values = read_json(path)
    write(path, values | {"ballot": values["ballot"] | {"votes": []}})


@pytest.mark.parametrize(
    "change, people, words",
    [
        (_copied, 2, "copy of another file"),
        (_edited, 1, "was edited"),
        (_without_votes, 1, "was edited"),
        (Path.unlink, 1, "no longer as it was handed in"),
        (lambda path: path.with_name("stray.json").write_text("{}"), 2, "stray.json"),
        (lambda path: path.with_name("stray.json").write_text("\xff"), 2, "stray.json"),
    ],
)
def test_a_change_of_stored_votes_costs_that_file_and_is_shown(
    change, people, words, made, runs, judge
):
    key = made("--people", "9")
    ballots = [ballot(key, n, prefers(VOLUMETRIC), minute=n) for n in range(2)]
    judge(*ballots)
    change(runs / f"exp/votes/{key.round}/{0:016x}.json")
    out = judge(ballots[1])
    assert f"Round {key.round}: {12 * people} votes of {people} p" in out
    assert re.search(f"Left out: .*{words}", out)
    assert words in page_of(runs)


def test_a_stored_file_of_another_round_does_not_count(made, runs, judge):
    one, two = made("--people", "9"), made("--people", "9", out="two")
    for key in (one, two):
        judge(ballot(key, 1, prefers(ADC)))
    name = f"{1:016x}.json"
    folders = [runs / f"exp/votes/{key.round}" for key in (one, two)]
    (folders[1] / name).write_text((folders[0] / name).read_text())
    assert re.search(f"Left out: {name} .*of another round", judge())


def test_a_name_cannot_write_lines_or_elements_of_its_own(made, runs, judge):
    key = made("--people", "9")
    forged = "Ann\nRound zero: 99 votes\u2028x\u202e\x1b[2J<img src=x>"
    out = judge(ballot(key, 1, lambda showing: "same", name=forged))
    assert "\nRound zero" not in out
    assert {"\u2028", "\u202e", "\x1b"}.isdisjoint(out)
    assert "Left out: Ann Round zero: 99 votes x[2J<img src=x> (000000) failed" in out
    page = page_of(runs)
    assert "&lt;img src=x" in page
    assert "<img src=x" not in page


def test_the_report_shows_where_people_and_lpips_disagree(made, runs, judge):
    key = made("--people", "1")
    judge(ballot(key, 1, prefers(VOLUMETRIC)))
    page = page_of(runs)
    part = page.partition(f"Round {key.round}")[2].partition("</section>")[0].partition("Round ")[0]
    # LPIPS is worse by 0.1 for the arm that this person prefers, on every view.
    assert re.search(
        r"LPIPS VGG raw ↓</th><td>undecided</td><td>\+0.1\d+</td><td>0 of 12 views", part
    )
    assert (
        part.count("people prefer sfm-volumetric (mean vote +1.00), LPIPS VGG raw prefers sfm-adc")
        == 3
    )
    assert part.count("<img") == 12


# ---- the verdict


@pytest.mark.parametrize("agree", range(10))
def test_people_are_the_units_of_an_exact_sign_test(agree):
    key = made_up(["sfm-a", "sfm-b"], scenes=2, views=5)
    ballots = [ballot(key, n, prefers("sfm-b" if n < agree else "sfm-a")) for n in range(9)]
    (pair,) = judge_round(key, ballots).pairs
    p = binomtest(agree, 9).pvalue
    assert pair.people.p == pytest.approx(p)
    word = "undecided" if p > 0.05 else "supported" if agree > 4 else "refuted"
    assert pair.people.outcome == word
    assert (pair.wins, pair.losses, pair.ties) == (10 * agree, 90 - 10 * agree, 0)
    assert pair.scenes is None


def test_scenes_are_the_units_of_another_exact_sign_test():
    key = made_up(["sfm-a", "sfm-b"], scenes=7, views=3)

    def choose(showing):
        return prefers("sfm-b" if showing.scene < "6" else "sfm-a")(showing)

    (pair,) = judge_round(key, [ballot(key, 1, choose)]).pairs
    assert pair.people is None
    assert (pair.scenes.helped, pair.scenes.scenes) == (6, 7)
    assert pair.scenes.p == pytest.approx(binomtest(6, 7).pvalue)


def test_votes_with_failed_traps_or_after_the_declared_people_are_left_out():
    key = made_up(["sfm-a", "sfm-b"], scenes=2, views=5, people=6)
    good = [ballot(key, n, prefers("sfm-b"), minute=10 + n) for n in range(5)]
    blind = ballot(key, 8, lambda showing: "same", minute=1, name="Ann")
    early = judge_round(key, [*good, blind])
    assert not early.final
    assert early.left_out == {blind.label: "failed 4 of 4 traps, and 0 may fail"}
    late = [ballot(key, 20 + n, prefers("sfm-a"), minute=30 + n) for n in range(5)]
    full = judge_round(key, [blind, *good, *late])
    assert full.final
    assert [one.person for one in full.counted] == [one.person for one in (*good, late[0])]
    assert all("came after the 6 people" in full.left_out[one.label] for one in late[1:])
    assert full.consistent == 1.0
    allowed = replace(key, traps_allowed=4)
    assert blind.label not in judge_round(allowed, [replace(blind, round=allowed.round)]).left_out


def test_a_person_who_always_answers_left_is_inconsistent():
    key = made_up(["sfm-a", "sfm-b"], scenes=2, views=5, traps=0)
    verdict = judge_round(key, [ballot(key, 1, lambda showing: "left")])
    assert (verdict.consistent, verdict.left) == (0.0, 1.0)
    assert judge_round(key, []).pairs == ()


def test_several_arms_share_the_error_rate_and_are_ranked():
    key = made_up(["sfm-a", "sfm-b", "sfm-c"], scenes=2, views=2)
    order = split("sfm-a sfm-c sfm-b photograph")

    def choose(showing):
        return max(
            SHARP,
            key=lambda side: (
                order.index(getattr(showing, side)) if showing.kind != "trap" else side == "left"
            ),
        )

    verdict = judge_round(key, [ballot(key, n, choose) for n in range(9)])
    assert [str(pair.arm) for pair in verdict.pairs] == ["sfm-b", "sfm-c"]
    assert [pair.people.level for pair in verdict.pairs] == pytest.approx([0.025, 0.025])
    assert [str(arm) for arm, _, _ in verdict.ranking] == ["sfm-b", "sfm-c", "sfm-a"]
    assert all(interval.low <= chance <= interval.high for _, chance, interval in verdict.ranking)


def test_the_ranking_maximises_its_likelihood():
    rng = np.random.default_rng(3)
    wins = rng.integers(0, 20, (4, 5, 5)).astype(float)
    for counts, chances in zip(wins, bradley_terry(wins), strict=True):
        games = (counts + 0.5) * (1 - np.eye(5))

        def loss(theta, games=games):
            return float((games * np.logaddexp(0, theta[None] - theta[:, None])).sum())

        theta = minimize(loss, np.zeros(5), tol=1e-12).x
        np.testing.assert_allclose(chances, 1 / (1 + np.exp(theta.mean() - theta)), atol=1e-5)


@pytest.mark.parametrize(
    "name", ["everybody guesses", "people differ", "scenes differ", "people and scenes differ"]
)
def test_without_an_effect_at_most_5_percent_of_rounds_state_one(name):
    untruths = script("vote_untruths")
    people, scenes, both, votes = untruths.rates(untruths.KINDS[name], 0.0, 300)[1::2]
    # The error rate is 5 %; of 300 rounds, 8.8 % lie three standard errors above it.
    assert max(people, scenes, both) < 0.088
    if name != "everybody guesses":
        assert votes > 0.3  # of a test that takes all votes as independent


def test_intervals_of_a_ranking_contain_the_truth():
    assert script("vote_untruths").ranking_misses(9, 9, 30) < 0.1


# ---- in a browser


class Voter:
    """A person at the page, who uses the keyboard alone."""

    def __init__(self, browser, key, choose):
        self.browser, self.key, self.choose = browser, key, choose

    def press(self, name, modifiers=0):
        for kind in ("keyDown", "keyUp"):
            self.browser.call("Input.dispatchKeyEvent", type=kind, key=name, modifiers=modifiers)

    def value(self, script):
        return self.browser.call("Runtime.evaluate", expression=script)["result"].get("value")

    def wait(self, script):
        self.browser.wait_for(lambda: self.value(script) or None, script)

    def answer(self, first, last):
        keys = {"left": "ArrowLeft", "right": "ArrowRight", "same": "ArrowDown"}
        for number in range(first, last):
            self.wait(f"ready && state.votes.length === {number}")
            self.press(keys[self.choose(self.key.showings[number])])


@pytest.mark.slow
@pytest.mark.browser
def test_two_people_vote_by_keyboard_and_are_judged(made, runs, tmp_path, capsys, said):
    key = made("--people", "2")
    address, files, last = (tmp_path / "page/index.html").as_uri(), [], len(key.showings)
    for width, chooser in ((1200, prefers(VOLUMETRIC)), (400, prefers(ADC))):
        with Browser(address, tmp_path / f"profile{width}", (width, 800)) as browser:
            metrics = {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": False}
            browser.call("Emulation.setDeviceMetricsOverride", **metrics)
            browser.call(
                "Browser.setDownloadBehavior",
                behavior="allow",
                downloadPath=str(tmp_path / str(width)),
            )
            voter = Voter(browser, key, chooser)
            voter.wait("!document.getElementById('start').hidden")
            browser.call("Input.insertText", text=f"person {width}")
            voter.press("Enter")
            voter.answer(0, 7)
            voter.wait("ready")
            voter.value("window.before = true")
            browser.call("Page.reload")
            voter.wait("!window.before && state.votes.length === 7 && ready")
            # All three pictures have the same part and zoom; a vote starts the next pair with whole
            # pictures.
            voter.press("+")
            voter.press("ArrowRight", modifiers=8)
            boxes = (
                "[...document.querySelectorAll('.panel img')].map((i) => "
                "getComputedStyle(i).transform)"
            )
            assert voter.value(
                f"new Set({boxes}).size === 1 && !{boxes}[0].startsWith('matrix(1, 0, 0, 1, 0')"
            )
            voter.press("f")
            assert voter.value("document.querySelectorAll('.side.under').length") == 1
            voter.press("Backspace")
            voter.answer(6, last)
            voter.wait("!document.getElementById('end').hidden")
            assert voter.value(
                "document.documentElement.scrollWidth <= document.documentElement.clientWidth"
            )
            voter.press("Enter")
            voter.wait("document.getElementById('saved').textContent !== ''")
            saved_in = tmp_path / str(width)
            browser.wait_for(lambda place=saved_in: list(place.glob("*.json")) or None, "the file")
            files += [str(file) for file in saved_in.glob("*.json")]
    capsys.readouterr()
    out = said("vote", "judge", "exp", *files)
    assert "24 votes of 2 people; 24 were declared" in out
    assert "50 % of 24 votes (12 for it, 12 against it, 0 without a difference" in out
    assert "100 % of the pairs shown again" in out
    stored = [json.loads(Path(file).read_text()) for file in files]
    assert [one["name"] for one in stored] == ["person 1200", "person 400"]
    page = page_of(runs)
    assert "24 votes of 2 people" in page
