"""The address of a cell or a trial: as it is printed, so it is accepted, by every verb."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsbench.analysis.addresses import ArmName, trials_of_arm
from gsbench.analysis.cells import select_trials, with_variants
from gsbench.analysis.table_formats import to_markdown
from gsbench.renders.imported import find_destination
from gsbench.renders.sources import ReferenceImages
from gsbench.runs.experiments import Arm
from gsbench.verbs.results import explain_cell
from gsbench.view.trials import find_trial
from tests.analysis.helpers import table_of, trials_of
from tests.helpers import refusal
from tests.trials import write_arms

NAMES = st.from_regex(r"[a-z][a-z0-9_]{0,8}", fullmatch=True)
VALUES = st.one_of(
    st.floats(allow_nan=False),
    st.integers(),
    st.booleans(),
    st.none(),
    NAMES,
    st.lists(st.integers()),
    st.just("mine.a:b"),
)


@given(NAMES, NAMES, st.dictionaries(NAMES, VALUES, max_size=3), st.booleans())
def test_a_printed_arm_is_read_back(init, densify, values, short):
    arm = Arm(init, densify, tuple((f"densify.{key}", str(one)) for key, one in values.items()))
    read = ArmName.read(arm.short if short else str(arm))
    assert read.name == (densify if short else f"{init}-{densify}")
    assert dict(read.settings) == {key: str(one) for key, one in values.items()}


OBJECTS = [{"_target_": "mine.Depth", "weight": 0.1}, {"_target_": "mine.Edge"}]
MADE = [(0.9, "a:b"), (0.99, "a:b"), (0.9, [1, 2]), (0.9, OBJECTS)]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """An experiment with four momentum arms, which differ in a number, a text and two lists."""
    folder = tmp_path_factory.mktemp("runs")
    arms = [("adc", {}), *(("momentum", {"decay": decay, "kind": kind}) for decay, kind in MADE)]
    for name, options in arms:
        write_arms(folder, {name: options}, (0, 1), ("garden",))
    return folder


ARMS = {
    "momentum[decay=0.9, kind=a:b]": 1,
    "sfm-momentum[decay=0.9, kind=a:b]": 1,
    "momentum[decay=0.99]": 1,
    "momentum[decay=9.9e-1]": 1,
    "momentum[densify.decay=0.99]": 1,
    "sfm-momentum[kind=[1, 2]]": 1,
    "momentum[kind=mine.Depth(weight=0.1) + mine.Edge]": 1,
    "momentum[decay=0.9]": 3,
    "momentum": 4,
    "momentum[decay=0.5]": 0,
    "momentum[cay=0.9]": 0,
}


@pytest.mark.parametrize("word, count", ARMS.items())
def test_all_verbs_read_an_arm_alike(runs, word, count):
    readers = {
        "explain": lambda: explain_cell(f"exp:garden:psnr:{word}", runs),
        "view": lambda: find_trial(f"exp:garden:{word}:1", runs),
    }
    for reader in readers.values():
        if count == 1:
            reader()
        else:
            with refusal(r"momentum\[decay=0.9, kind=\[1, 2\]\]"):
                reader()


def test_objects_have_one_short_name_in_arms_tables_and_choices(runs):
    short = "mine.Depth(weight=0.1) + mine.Edge"
    shown = {trial.arm.short for trial in with_variants(trials_of(runs))}
    assert f"momentum[decay=0.9, kind={short}]" in shown
    assert f"| garden | sfm | momentum | 0.9 | {short} |" in to_markdown(table_of(runs))
    assert len(select_trials(trials_of(runs), {"densify.kind": short})) == 2


@pytest.mark.parametrize("word", ["momentum[decay=0.9", "[decay=1]", "momentum[0.9]", "a[b=1]c"])
def test_another_form_is_refused_in_a_line(runs, word):
    with refusal(re.escape(f"{word!r} is no arm such as")):
        trials_of_arm(trials_of(runs), word)


def test_renders_are_entered_under_an_arm_with_settings(runs):
    truth = ReferenceImages({}, "pictures", "0" * 64, (96, 72), {}, "garden", "sfm")
    entered = find_destination("exp:mine[decay=0.9, train.lr=1]", None, 0, truth, runs)
    assert (entered.init, entered.densify) == ("sfm", "mine")
    assert entered.settings == (("densify.decay", 0.9), ("train.lr", 1))
