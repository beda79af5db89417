"""docs/fidelity.md agrees with the differences that the tests of the arms measure."""

import re

import pytest

from gsbench.config.groups import options
from tests.conftest import script

fidelity = script("fidelity")
PAGE = fidelity.PAGE.read_text(encoding="utf-8")


def test_every_arm_has_a_row_and_the_page_is_made_of_them():
    assert sorted(fidelity.ARMS) == [option for option in options("densify") if "/" not in option]
    stated = fidelity.bounds_of(PAGE)
    assert set(stated) == set(fidelity.ARMS)
    assert fidelity.page(stated) == PAGE


@pytest.mark.parametrize("arm", fidelity.ARMS)
def test_the_largest_difference_is_no_larger_than_the_page_says(arm):
    """It is not much smaller, either; another processor rounds differently."""
    stated, found = float(fidelity.bounds_of(PAGE)[arm]), fidelity.measured(arm)
    assert found <= 10 * stated
    assert found >= stated / 1000
    assert stated <= 1e-6


def test_a_wrong_restatement_is_measured_and_refused(monkeypatch):
    """A small error changes the measured difference, and a large one fails the tests."""
    from tests.densify import restatement

    correct = restatement.rotation
    monkeypatch.setattr(restatement, "rotation", lambda q: correct(q) * (1 + 1e-7))
    assert fidelity.measured("adc") > 1e-9
    monkeypatch.setattr(restatement, "rotation", lambda q: correct(q).T)
    with pytest.raises(AssertionError):
        fidelity.measured("adc")


def test_sources_are_named_by_commit():
    for name, arm in fidelity.ARMS.items():
        named = re.search(
            r"\b[0-9a-f]{7}\b|arXiv \d{4}\.\d{5}|^ours|pull request \d+|absgrad", arm.source
        )
        assert named, name


def test_differences_are_rounded_up():
    assert [fidelity.bound(d) for d in (0.0, 2e-9, 1e-12, 9.9e-16)] == [
        "0",
        "1e-8",
        "1e-12",
        "1e-15",
    ]
