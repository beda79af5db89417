"""The facts of the arms agree with the differences that their tests measure."""

import re

import pytest

from gsbench.config.groups import options
from tests.conftest import script

fidelity = script("fidelity")


def test_every_arm_has_a_row():
    names = re.findall(r"^\| `(\w+)` \|", fidelity.table(), re.MULTILINE)
    assert names == [option for option in options("densify") if "/" not in option]


@pytest.mark.parametrize("arm", fidelity.ARMS)
@pytest.mark.slow
def test_the_largest_difference_is_no_larger_than_stated(arm):
    """It is not much smaller, either; another processor rounds differently."""
    stated, found = float(fidelity.ARMS[arm].difference), fidelity.measured(arm)
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
