"""Text for people: times, sizes, names in sentences, suggestions."""

import pytest

from gsbench.events import Cause, RefineEvent, sum_events
from gsbench.words import (
    counted,
    did_you_mean,
    is_path,
    least_text,
    listed,
    readable_bytes,
    readable_time,
    signed,
    some_of,
)
from tests.helpers import table


@pytest.mark.parametrize(
    "seconds, text",
    table(__file__, "times"),
)
def test_times_are_shown_in_a_readable_unit(seconds, text):
    assert readable_time(seconds) == text


@pytest.mark.parametrize(
    "count, text",
    table(__file__, "sizes"),
)
def test_sizes_are_shown_in_a_readable_unit(count, text):
    assert readable_bytes(count) == text


def test_numbers_and_names_are_put_into_sentences():
    assert [counted(n, "trial") for n in (0, 1, 2)] == ["0 trials", "1 trial", "2 trials"]
    assert [least_text(0.005, relative) for relative in (False, True)] == ["0.005", "0.5 %"]
    assert [signed(0.5, ".2f"), signed(-0.03, ".1%")] == ["+0.50", "−3.0%"]
    names = ["a", "b", "c", "d", "e"]
    assert [listed(names[:n]) for n in range(4)] == ["", "a", "a and b", "a, b and c"]
    assert [some_of(names[:n]) for n in (2, 3, 4, 5)] == [
        "a, b",
        "a, b, c",
        "a, b, c and 1 more",
        "a, b, c and 2 more",
    ]


def test_a_similar_word_is_suggested_whatever_its_case():
    words = (word for word in ("status", "tables"))
    assert did_you_mean("statsu", words) == "; did you mean status?"
    assert did_you_mean("TABLES", ["status", "tables"]) == "; did you mean tables?"
    assert did_you_mean("SEEd", ["seed", "SEED"]) == "; did you mean SEED?"
    assert did_you_mean("xyz", ["status"]) == ""
    assert did_you_mean("min_model_size", ["max_image_size"]) == ""
    assert did_you_mean("grad", ["gradient"]) == "; did you mean gradient?"


@pytest.mark.parametrize("text", ["", " ", "a\tb", "~nosuchuser/x"])
def test_some_texts_can_be_no_path(text):
    assert not is_path(text)
    assert is_path("~/a b")


def test_the_counts_of_a_refinement_explain_the_number_after_it():
    grown = {"cloned": 1, "split_gradient": 2, "split_volume": 4, "added": 8}
    event = RefineEvent(step=7, before=100, after=67, pruned_opacity=16, pruned_size=32, **grown)
    assert event.balances()
    event.relocated = event.blocked_by_cap = event.isotropic_resplit = event.vanished = 5
    assert event.balances()
    for name in ("before", "after", "pruned_size", *grown):
        value = getattr(event, name)
        setattr(event, name, value + 1)
        assert not event.balances()
        setattr(event, name, value)
    event.volume_threshold, event.target, event.strictness = 0.1, 0, float("inf")
    record = event.as_dict()
    assert {key: record.get(key) for key in ("volume_threshold", "target", "opacity_reset")} == {
        "volume_threshold": 0.1,
        "target": 0,
        "opacity_reset": False,
    }
    assert not {"strictness", "cull"} & set(record)
    counts = sum_events([record, {"cloned": 5, "step": 9}])
    assert (counts["cloned"], counts["pruned_size"], counts["opacity_reset"]) == (6, 32, 0)
    assert not {"step", "before", "after", "target", "volume_threshold"} & set(counts)


def test_causes_have_fixed_numbers():
    assert {cause.key: int(cause) for cause in Cause} == {
        "initial": 0,
        "clone": 1,
        "split_gradient": 2,
        "split_volume": 3,
        "relocated": 4,
        "added": 5,
    }
