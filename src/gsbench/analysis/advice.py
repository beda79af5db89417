"""The command that compares two arms again, at equal numbers of Gaussians."""

import math
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from gsbench.analysis.results import TrialResult, group_by
from gsbench.parsing import DamagedError, read_json
from gsbench.runs.layout import PLAN

DIGITS = 3  # significant digits of a number of Gaussians
# Looks need both arms in one command, but the advice may give each arm its own.
LOOKS = "launch.stop_when_decided"
# words that the advice gives itself or leaves out
REPLACED = ("name", "densify.cap", "densify.max_gaussians", LOOKS)

EXPERIMENT = "+experiment"

Words = dict[str, list[str]]  # the values of each key of a command, in order


Advice = Callable[[Sequence[TrialResult], Sequence[TrialResult]], str]


def start_smaller(trials: Iterable[TrialResult]) -> str:
    """The advice where an arm ended with fewer Gaussians than initial points; "" elsewhere."""
    records = [trial.record for trial in trials]
    points = max((one.num_init_points or 0 for one in records), default=0)
    if all((one.num_gaussians or points) >= points for one in records):
        return ""
    return f"start both arms with fewer than {points:,} points, as no limit can be below these"


def equal_counts_words(baseline: Sequence[TrialResult], arm: Sequence[TrialResult]) -> str:
    """The words for arms that all end with the count of the smallest trial; "" without counts."""
    counts = [trial.record.num_gaussians for trial in (*baseline, *arm)]
    known = [count for count in counts if count]
    if not known:
        return ""
    unit = 10 ** max(0, math.floor(math.log10(min(known))) + 1 - DIGITS)
    return f"densify.cap=governor densify.max_gaussians={min(known) // unit * unit}"


def equal_counts_settings(baseline: Sequence[TrialResult], arm: Sequence[TrialResult]) -> str:
    """The advice to add `equal_counts_words` where the arms are written; "" without counts."""
    words = equal_counts_words(baseline, arm)
    return words and f"give both arms {words} and another name"


def equal_counts_command(baseline: Sequence[TrialResult], arm: Sequence[TrialResult]) -> str:
    """The command for arms that all end with the count of the smallest trial; "" without counts.

    It repeats the words of the trials' own commands, as the experiment's plan records them. If
    the plan does not have them, only the words to add are named.
    """
    added = equal_counts_words(baseline, arm)
    if not added:
        return ""
    home = baseline[0].path.parents[2]
    planned = _planned_words(home)
    sides = [_words_of([planned.get(trial.path, ()) for trial in own]) for own in (baseline, arm)]
    if not all(sides):
        return equal_counts_settings(baseline, arm)
    end = f"{added} name={shlex.quote(f'{home.name}_equal')}"
    if EXPERIMENT in sides[0] and sides[0][EXPERIMENT] == sides[1].get(EXPERIMENT):
        # The experiment's file has the arms and seeds; what all trials share was typed.
        shared = {
            key: values
            for key, values in sides[0].items()
            if sides[1].get(key) == values and len(values) == 1
        }
        return f"`gsbench {_joined(shared)} {end}`"
    differing = [key for key in {**sides[0], **sides[1]} if sides[0].get(key) != sides[1].get(key)]
    if len(differing) == 1 and all(differing[0] in own for own in sides):
        values = sides[0][differing[0]] + sides[1][differing[0]]
        sides = [sides[0] | {differing[0]: list(dict.fromkeys(values))}]
    return " && ".join(f"`gsbench -m {_joined(own)} {end}`" for own in sides)


def _planned_words(home: Path) -> Mapping[Path, Sequence[str]]:
    """The words of each planned trial by its folder; {} without a readable plan."""
    try:
        trials = read_json(home / PLAN)["trials"]
        return {
            home / name: [str(word) for word in one["overrides"]] for name, one in trials.items()
        }
    except (FileNotFoundError, DamagedError, KeyError, TypeError, AttributeError):
        return {}


def _words_of(trials: Sequence[Sequence[str]]) -> Words:
    """The words of an arm's trials as one command's; {} if a trial's are not known."""
    if not all(trials):
        return {}
    words: Words = {}
    for key, own in group_by(
        (word for trial in trials for word in trial), lambda word: word.partition("=")[0]
    ).items():
        if key not in REPLACED:
            words[key] = list(dict.fromkeys(word.partition("=")[2] for word in own))
    return words


def _joined(words: Words) -> str:
    """The words as a shell takes them."""
    return " ".join(
        shlex.quote(f"{key}={','.join(values)}" if any(values) else key)
        for key, values in words.items()
    )
