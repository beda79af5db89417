"""A round of votes in words."""

from dataclasses import replace
from types import SimpleNamespace

from gsbench.analysis.statistics import Interval, LikeThese
from gsbench.analysis.vote_words import describe_round, load_rounds, people_words, vote_table
from gsbench.analysis.votes import PairVotes, RoundVerdict
from gsbench.runs.experiments import Arm
from gsbench.runs.votes import RoundKey, Showing
from tests.analysis.helpers import trials_of
from tests.trials import write_runs

ADC, MCMC = Arm("sfm", "adc"), Arm("sfm", "mcmc")


def showing(number, chosen):
    sides = {"left": "sfm-adc", "right": "sfm-mcmc"}
    place = {"kind": "pair", "scene": "yard", "view": f"v{number}", "seed": 0}
    return Showing(id=f"s{number}", chosen=chosen, **place, **sides)


PEOPLE = LikeThese(
    scenes=9,
    helped=8,
    beyond=None,
    share=Interval(0.52, 1.0),
    median=Interval(0.1, 0.66),
    p=0.0390625,
    level=0.05,
    outcome="supported",
)
PAIR = PairVotes(
    baseline=ADC,
    arm=MCMC,
    wins=12,
    losses=5,
    ties=3,
    people=PEOPLE,
    scenes=None,
    views=(
        (showing(0, "most different"), 0.5),
        (showing(1, "most different"), 0.1),
        (showing(2, "random"), -0.2),
    ),
)


def verdict(count, people, *pairs, **more):
    key = RoundKey(
        salt="s",
        time="2026-02-03T04:05:06Z",
        arms=(ADC, MCMC),
        people=people,
        traps_allowed=0,
        showings=(showing(0, "random"), showing(1, "random")),
    )
    ballots = tuple(SimpleNamespace() for _ in range(count))
    parts = {"left_out": {}, "ranking": (), "consistent": 0.75, "left": 0.52} | more
    return RoundVerdict(key=key, counted=ballots, pairs=pairs, **parts)


def test_a_round_is_described_by_votes_people_scenes_and_consistency():
    found = verdict(9, 9, PAIR, left_out={"Ann": "failed 2 traps"})
    first, *lines = describe_round(found)
    assert first == (
        f"Round {found.key.round}: 18 votes of 9 people; 18 were declared (2026-02-03 04:05 UTC)."
    )
    assert lines == [
        "sfm-mcmc against sfm-adc: 68 % of 20 votes (12 for it, 5 against it, 3 without a "
        "difference, 65 % of the most different views, 40 % of the random views).",
        "People like these, on these views: better; for it are 8 of 9 people (sign test at 5 %, "
        "p 0.039; median share 55 to 83 %); exact for: a new person, asked the same pairs, would "
        "more often prefer it.",
        "Scenes like these, for these people: undecided, since the sign test needs six scenes.",
        "75 % of the pairs shown again, swapped, had the same answer; 52 % of the votes were for "
        "the left side.",
        "Left out: Ann failed 2 traps.",
    ]


def test_an_early_look_decides_nothing():
    pair = replace(PAIR, people=replace(PEOPLE, median=None), views=())
    _, early, votes, people, *_ = describe_round(verdict(8, 9, pair))
    assert early == "This is an early look: nothing is decided before 18 votes."
    assert votes.endswith("3 without a difference).")
    assert "undecided; for it are 8 of 9 people (sign test at 5 %, p 0.039); exact" in people


def test_a_ranking_gives_chances_with_intervals_and_no_votes_give_no_shares():
    ranking = ((MCMC, 0.625, Interval(0.5, 0.751)), (ADC, 0.375, Interval(0.249, 0.5)))
    assert describe_round(verdict(0, 1, ranking=ranking))[2:] == [
        "Chance to win against the average arm, with 95 % intervals: sfm-mcmc 62 % (50 to 75); "
        "sfm-adc 38 % (25 to 50)."
    ]


def test_one_is_a_person():
    assert [people_words(count) for count in (0, 1, 2)] == ["0 people", "1 person", "2 people"]


def test_a_linked_round_of_votes_is_left_out(tmp_path, caplog):
    """A runs folder may be a stranger's, and the link may lead anywhere."""
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "runs/x/votes").mkdir(parents=True)
    (tmp_path / "runs/x/votes/round").symlink_to(tmp_path / "elsewhere")
    assert load_rounds(tmp_path / "runs/x") == []
    (line,) = caplog.messages
    assert "link" in line


def test_the_table_has_the_verdicts_of_people_and_scenes(tmp_path):
    write_runs(tmp_path, scenes=("yard",), densifiers=("adc", "mcmc"), effect={})
    trials = trials_of(tmp_path)
    pair = replace(PAIR, scenes=replace(PEOPLE, outcome="undecided"), views=())
    table = vote_table(pair, True, trials, ())
    rows = {row.labels[0]: [entry.text for entry in row.entries] for row in table.rows}
    assert rows["people like these"] == ["better", "68 % of 20 votes", ""]
    assert rows["scenes like these"] == ["undecided", "68 % of 20 votes", ""]
    assert rows["PSNR (dB) ↑"] == ["not compared", "", "0 of 0 views"]
    early = vote_table(pair, False, trials, ()).rows[0]
    assert early.entries[0].text == "undecided"
