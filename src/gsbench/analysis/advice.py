"""The command that compares arms again, at equal numbers of Gaussians."""

import itertools
import math
import re
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import reduce
from pathlib import Path

from gsbench.analysis.attempts import places_of
from gsbench.analysis.results import TrialResult, group_by
from gsbench.parsing import DamagedError, read_json
from gsbench.runs.experiments import Planned, merge_planned, read_declarations
from gsbench.runs.layout import PLAN
from gsbench.runs.user_code import PERMISSIONS

DIGITS = 3  # significant digits of a number of Gaussians
LOOKS = "launch.stop_when_decided"  # needs all arms in one command
GRIDS = "hydra.sweeper.grids"
CAP, LIMIT = "densify.cap", "densify.max_gaussians"
REPLACED = ("name", CAP, LIMIT)  # words that the advice gives itself
# the word that records ``--config-dir``
OF_CONFIG_DIR = re.compile(r"hydra\.searchpath=\['file://([\w./-]+)'\]")

Words = dict[str, list[str]]  # the values of each key of a command, in order

# of the trials of a baseline, and of those of one arm or more
Advice = Callable[[Sequence[TrialResult], Sequence[TrialResult]], str]


def start_smaller(trials: Iterable[TrialResult]) -> str:
    """The advice where an arm ended with no more Gaussians than initial points; "" elsewhere."""
    records = [trial.record for trial in trials]
    points = max((record.num_init_points or 0 for record in records), default=0)
    if all((record.num_gaussians or math.inf) > points for record in records):
        return ""
    return f"start all arms with fewer than {points:,} points, as no limit can be below these"


def train_longer(trials: Iterable[TrialResult]) -> str:
    """The advice where arms differ although all are steered to one count; "" elsewhere."""
    aims = {(trial.config.get(CAP), trial.config.get(LIMIT)) for trial in trials}
    if len(aims) > 1 or {cap for cap, _ in aims} != {"governor"}:
        return ""
    return "train longer, since the governor (densify.cap) had too few rounds to reach its count"


def equal_counts_words(baseline: Sequence[TrialResult], arms: Sequence[TrialResult]) -> str:
    """The words for arms that all end with the count of the smallest trial; "" without counts."""
    counts = [trial.record.num_gaussians for trial in (*baseline, *arms)]
    known = [count for count in counts if count]
    if not known:
        return ""
    unit = 10 ** max(0, math.floor(math.log10(min(known))) + 1 - DIGITS)
    return f"{CAP}=governor {LIMIT}={min(known) // unit * unit}"


def equal_counts_settings(baseline: Sequence[TrialResult], arms: Sequence[TrialResult]) -> str:
    """The advice to add `equal_counts_words` where the arms are written; "" without counts."""
    words = equal_counts_words(baseline, arms)
    return words and f"give all arms {words} and another name"


def equal_counts_command(baseline: Sequence[TrialResult], arms: Sequence[TrialResult]) -> str:
    """The command for arms that all end with the count of the smallest trial; "" without counts.

    It repeats the words of the trials' own commands, as the experiment's plan records them. If
    the plan does not have them, only the words to add are named.
    """
    added = equal_counts_words(baseline, arms)
    if not added:
        return ""
    shared = places_of(baseline) & places_of(arms)
    # Arms without a common seed are run with the seeds of both, since only pairs are compared.
    places = shared or places_of(baseline) | places_of(arms)
    trials = [one for one in (*baseline, *arms) if (one.scene, one.seed) in places]
    home = baseline[0].path.parents[2]
    planned = _planned_words(home)
    if not all(planned.get(trial.path) for trial in trials):
        return equal_counts_settings(baseline, arms)
    # a sweep in looks may have stopped before its last seed
    looks = [declaration.planned for declaration in read_declarations(home) if declaration.looks]
    most: Planned = reduce(merge_planned, looks, {})
    commands: list[Words] = []
    for trial in trials:
        words = {key: [value] for key, _, value in (w.partition("=") for w in planned[trial.path])}
        of_scene = sorted(seed for scene, seed in places if scene == trial.scene)
        seeds = most.get(trial.key, [trial.seed] if shared else of_scene)
        words |= {"seed": [*map(str, seeds)]}
        commands.append({key: words[key] for key in words if key.lstrip("+") not in REPLACED})
    commands = _in_one(_merged(commands))
    lost = len(commands) > 1 and any(LOOKS in own for own in commands)
    commands = [{key: own[key] for key in own if key != LOOKS or not lost} for own in commands]
    name = f"name={shlex.quote(f'{home.name}_equal')}"
    texts = [_joined(own) for own in commands]
    # A class of the user's own may be based on a choice that lacks these settings.
    ends = [re.sub("(?=densify)", "++", added) if "_target_" in text else added for text in texts]
    pairs = zip(texts, ends, strict=True)
    whole = f"`{' && '.join(f'gsbench -m {text} {end} {name}' for text, end in pairs)}`"
    return f"{whole}, without looks, which need all arms in one command" if lost else whole


def _planned_words(home: Path) -> Mapping[Path, Sequence[str]]:
    """The words of each planned trial by its folder; {} without a readable plan."""
    try:
        trials = read_json(home / PLAN)["trials"]
        return {
            home / name: [str(word) for word in one["overrides"]] for name, one in trials.items()
        }
    except (FileNotFoundError, DamagedError, KeyError, TypeError, AttributeError):
        return {}


def _merged(commands: list[Words]) -> list[Words]:
    """As few commands as have the same trials: those that differ in the values of one key join."""
    for key in dict.fromkeys(["seed", *itertools.chain(*commands)]):

        def others(words: Words, key: str = key) -> tuple[bool, str]:
            return key in words, repr(sorted((k, v) for k, v in words.items() if k != key))

        commands = [
            same[0] | {key: list(dict.fromkeys(itertools.chain(*(own[key] for own in same))))}
            if key in same[0]
            else same[0]
            for same in group_by(commands, others).values()
        ]
    return commands


def _in_one(commands: list[Words]) -> list[Words]:
    """One command that gives its arms as grids, if they can be written so."""
    allowed = {
        name for own in commands for text in own.get(PERMISSIONS, ()) for name in _names(text)
    }
    shared = {
        key: values
        for key, values in commands[0].items()
        if key != "densify" and all(own.get(key) == values for own in commands)
    }
    grids = [
        {key: ",".join(own[key]) for key in own if key not in (*shared, PERMISSIONS)}
        for own in commands
    ]
    fits = all(own and all(map(_fits_grid, own.items())) for own in grids)
    if len(commands) == 1 or not fits:
        return commands
    texts = [", ".join(f'{key}: "{value}"' for key, value in own.items()) for own in grids]
    arms = ", ".join(f"{{{text}}}" for text in texts)
    permissions = {PERMISSIONS: [f"[{','.join(sorted(allowed))}]"]} if allowed else {}
    return [shared | permissions | {GRIDS: [f"[{arms}]"]}]


def _names(text: str) -> list[str]:
    """The names in a list such as ``[mine,helper]``."""
    return [name.strip() for name in text.strip("[]").split(",")]


def _fits_grid(word: tuple[str, str]) -> bool:
    """Return whether a grid can have a word: it sets a value, and has no quotes."""
    key, value = word
    return (
        bool(value) and not key.startswith(("~", "hydra.")) and not set("'\"\\") & set(key + value)
    )


def _joined(words: Words) -> str:
    """The words as a shell takes them."""
    texts = []
    for key, values in words.items():
        folder = OF_CONFIG_DIR.fullmatch(f"{key}={','.join(values)}")
        word = f"{key}={','.join(values)}" if any(values) else key
        texts.append(f"--config-dir {folder[1]}" if folder else shlex.quote(word))
    return " ".join(texts)
