"""The page where people compare renders blindly: its views, its pictures, and its key.

The page is a folder of one HTML file and pictures. It works from a file, sends nothing, and has no
names of arms.
"""

import itertools
import random
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path

import numpy as np
from PIL import Image, ImageFilter

from gsbench.analysis.images import Pixels, absolute_error, read_compared, view_names
from gsbench.analysis.pairing import pair_trials
from gsbench.analysis.results import TrialPair, TrialResult
from gsbench.analysis.table_formats import fill
from gsbench.errors import InputError
from gsbench.runs.experiments import Arm, stamp_now
from gsbench.runs.votes import BLURRED, PHOTOGRAPH, Chosen, Kind, RoundKey, Showing

PAGE, PICTURES = "index.html", "pictures"
SHOWN_AGAIN = 10  # every tenth pair is shown a second time, with its sides swapped
APART = 4  # places between a pair and its second showing, where the round is long enough
MIN_TRAPS, PAIRS_PER_TRAP = 4, 8
# One of six traps may fail. Of four or five none may fail; one guesser in sixteen passes four.
TRAPS_PER_MISTAKE = 6
BLUR = 0.008  # of the longest side: the deviation (px) of a trap's blur, 3 px for a picture of 400
MIN_BLUR = 2.0  # px


@dataclass(frozen=True)
class Candidate:
    """A view of two arms that may be shown.

    ``difference`` is the mean difference of the two renders in 8-bit levels.
    """

    trials: TrialPair
    view: str
    difference: float


def find_candidates(
    trials: Sequence[TrialResult], one: Arm, other: Arm
) -> dict[str, list[Candidate]]:
    """Every test view of two arms by scene, for one seed each; seeds take turns over the views.

    Raises InputError if the arms have no pair of trials with pictures.
    """
    by_scene: dict[str, list[TrialPair]] = {}
    for pair in pair_trials(trials, one, other):
        by_scene.setdefault(pair[0].scene, []).append(pair)
    candidates: dict[str, list[Candidate]] = {}
    for scene, pairs in by_scene.items():
        for pair, view in zip(itertools.cycle(pairs), view_names(pairs[0][0]), strict=False):
            first, second, _ = read_compared(*pair, view)
            difference = float(absolute_error(first, second).mean())
            candidates.setdefault(scene, []).append(Candidate(pair, view, difference))
    if not candidates:
        raise InputError(
            f"{one} and {other} have no pair of trials of one scene and seed, so nothing can be "
            "compared"
        )
    return candidates


def choose_views(
    by_scene: Mapping[str, Sequence[Candidate]], count: int, rng: random.Random
) -> list[tuple[Candidate, Chosen]]:
    """Choose at most ``count`` views, spread equally over scenes.

    Half of a scene's views are those with the most different renders, the others are chosen at
    random.
    """
    left_over = {
        scene: len(by_scene[scene]) for scene in rng.sample(sorted(by_scene), len(by_scene))
    }
    wanted = dict.fromkeys(left_over, 0)
    while sum(wanted.values()) < count and any(left_over.values()):
        # The scene with the fewest chosen views among those that have more.
        scene = min((name for name, rest in left_over.items() if rest), key=wanted.__getitem__)
        wanted[scene] += 1
        left_over[scene] -= 1
    chosen: list[tuple[Candidate, Chosen]] = []
    for scene, views in wanted.items():
        ordered = sorted(by_scene[scene], key=lambda candidate: -candidate.difference)
        half = (views + 1) // 2
        chosen += [(candidate, "most different") for candidate in ordered[:half]]
        chosen += [(candidate, "random") for candidate in rng.sample(ordered[half:], views - half)]
    return chosen


def make_round(
    trials: Sequence[TrialResult],
    arms: Sequence[Arm],
    pairs: int,
    people: int,
    out: Path,
    rng: random.Random,
) -> RoundKey:
    """Write the page of a new round into the new folder ``out``, and return its key.

    ``arms`` begin with the baseline; every two are compared. ``rng`` chooses views, order and
    sides, so it must not be guessable. Raises InputError if arms cannot be compared.
    """
    shown: list[tuple[Showing, Candidate]] = []
    combinations = list(itertools.combinations(arms, 2))
    for place, (one, other) in enumerate(combinations):
        wanted = pairs // len(combinations) + (place < pairs % len(combinations))
        chosen = choose_views(find_candidates(trials, one, other), wanted, rng)
        # Each arm is on the left in half of the views; of an odd number, in one more or one fewer.
        swapped = rng.sample([False, True] * ((len(chosen) + 1) // 2), len(chosen))
        for (candidate, how), swap in zip(chosen, swapped, strict=True):
            sides = (other, one) if swap else (one, other)
            shown.append(
                (_showing("pair", candidate, str(sides[0]), str(sides[1]), how), candidate)
            )
    traps = max(MIN_TRAPS, len(shown) // PAIRS_PER_TRAP)
    repeats = max(1, len(shown) // SHOWN_AGAIN)
    views = [rng.choice(shown)[1] for _ in range(traps)]
    for place, candidate in enumerate(views):
        # Sides take turns, so a person who always presses the same key fails.
        left, right = (PHOTOGRAPH, BLURRED) if place % 2 else (BLURRED, PHOTOGRAPH)
        shown.append((_showing("trap", candidate, left, right), candidate))
    rng.shuffle(shown)
    # People remember a pair that comes again soon, so only pairs of the first half come again, in
    # the last third.
    pairs_shown = [one for one in shown if one[0].kind == "pair"]
    again = rng.sample(pairs_shown[: max(repeats, len(pairs_shown) // 2)], repeats)
    for first, candidate in again:
        swapped_showing = replace(
            first, id=_new_id(), kind="again", left=first.right, right=first.left, of=first.id
        )
        place = next(place for place, (one, _) in enumerate(shown) if one is first)
        earliest = min(len(shown), max(place + APART, 2 * len(shown) // 3))
        shown.insert(rng.randint(earliest, len(shown)), (swapped_showing, candidate))
    key = RoundKey(
        salt=secrets.token_hex(32),
        time=stamp_now(),
        arms=tuple(arms),
        people=people,
        traps_allowed=traps // TRAPS_PER_MISTAKE,
        showings=tuple(showing for showing, _ in shown),
    )
    _write_page(key, [candidate for _, candidate in shown], out, rng)
    return key


def _new_id() -> str:
    return secrets.token_hex(6)


def _showing(
    kind: Kind, candidate: Candidate, left: str, right: str, chosen: Chosen = ""
) -> Showing:
    trial = candidate.trials[0]
    return Showing(
        id=_new_id(),
        kind=kind,
        scene=trial.scene,
        view=candidate.view,
        seed=trial.seed,
        left=left,
        right=right,
        chosen=chosen,
    )


def _write_page(
    key: RoundKey, candidates: Sequence[Candidate], out: Path, rng: random.Random
) -> None:
    (out / PICTURES).mkdir(parents=True)
    entries: dict[str, dict[str, str]] = {}
    places = list(enumerate(key.showings))
    rng.shuffle(places)  # so that the files' times do not tell the order
    for place, showing in places:
        pictures = _pictures(showing, candidates[place])
        names = {
            what: f"{PICTURES}/{_new_id()}.png"
            for what in rng.sample(sorted(pictures), len(pictures))
        }
        for what, name in names.items():
            # Saved from the pixels alone, so no text or time of the trial's file comes along.
            Image.fromarray(pictures[what]).save(out / name, optimize=True)
        entries[showing.id] = {"id": showing.id, **names, "hash": key.commitment(showing)}
    script = files("gsbench.claims").joinpath("vote.js").read_text(encoding="utf-8")
    page = {"round": key.round, "showings": [entries[showing.id] for showing in key.showings]}
    text = fill("vote.html.j2", "gsbench.claims", page=page, script=script)
    (out / PAGE).write_text(text, encoding="utf-8")


def _pictures(showing: Showing, candidate: Candidate) -> dict[str, Pixels]:
    """The photograph and the pictures of both sides, [H, W, 3] uint8."""
    *renders, truth = read_compared(*candidate.trials, candidate.view)
    sides = {
        str(trial.arm): render for trial, render in zip(candidate.trials, renders, strict=True)
    }
    sides[PHOTOGRAPH] = truth
    if showing.kind == "trap":
        blur = ImageFilter.GaussianBlur(max(MIN_BLUR, BLUR * max(truth.shape)))
        sides[BLURRED] = np.asarray(Image.fromarray(truth).filter(blur))
    return {"photo": truth, "left": sides[showing.left], "right": sides[showing.right]}
