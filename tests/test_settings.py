"""Values are checked by the annotations of gsbench's and users' dataclasses."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import pytest
from annotated_types import Ge, Interval, Predicate, doc
from hypothesis import given
from hypothesis import strategies as st
from pydantic import PositiveFloat, PositiveInt

from gsbench.densify import ADC, MCMC, Volumetric
from gsbench.errors import InputError
from gsbench.init import Dim, Random, Sfm
from gsbench.settings import (
    MAX_INTEGER,
    OpenFraction,
    TargetName,
    Threads,
    check_settings,
    check_values,
    describe,
    is_address,
    is_folder_name,
    unknown_setting,
)
from tests.helpers import table

if TYPE_CHECKING:
    from decimal import Decimal


@dataclass
class Options:
    count: PositiveInt = 1
    rate: PositiveFloat = 0.5
    share: Annotated[float, Interval(ge=0, lt=1)] = 0.5
    kind: Literal["soft", "hard"] = "soft"
    limit: Annotated[int, Ge(2)] | None = None
    color: tuple[float, float, float] = (0.0, 0.0, 0.0)
    steps: list[PositiveInt] = field(default_factory=list)
    label: str = ""
    digits: Annotated[str, Predicate(str.isdigit), doc("digits only")] = "0"
    flag: bool = False
    plain: int = 3
    farthest: float = math.inf
    folder: Path = Path()
    foreign: Decimal | None = None  # not checked, since only type checkers import its type
    state: int = field(init=False, default=-1)


@pytest.mark.parametrize(
    "name, given, words",
    table(__file__, "errors"),
)
def test_errors_state_the_key_the_rule_and_the_value(name, given, words):
    with pytest.raises(InputError) as error:
        check_values(Options, {name: given}, "options")
    assert str(error.value) == words


def test_values_are_converted_to_their_type():
    given = {"count": 1e3, "rate": 2, "color": [0, 1, 2], "label": 7, "flag": "yes", "folder": "a"}
    result = check_values(Options, given, "options")
    assert result == {
        "count": 1000,
        "rate": 2.0,
        "color": (0, 1, 2),
        "label": "7",
        "flag": True,
        "folder": Path("a"),
    }
    assert [type(result[name]) for name in ("count", "rate", "label")] == [int, float, str]


def test_the_fields_of_an_object_are_converted_also_if_it_is_frozen():
    @dataclass(frozen=True)
    class Frozen:
        count: PositiveInt = 1
        label: str = ""

    options = Frozen(count=1e3, label=7)
    check_settings(options, "options")
    assert (repr(options.count), options.label) == ("1000", "7")


def test_a_default_of_the_class_may_break_its_own_rule():
    assert check_values(Options, {"farthest": math.inf}, "options") == {"farthest": math.inf}
    with pytest.raises(InputError, match="farthest must be a number, got -inf"):
        check_values(Options, {"farthest": -math.inf}, "options")


def test_unknown_keys_name_the_nearest():
    with pytest.raises(
        InputError,
        match=r"^options\.cuont is not a setting; did you mean count\? \(there are: count, ",
    ):
        check_values(Options, {"cuont": 1}, "options")
    with pytest.raises(InputError, match=r"options\.state is not a setting"):
        check_values(Options, {"state": 1}, "options")


@pytest.mark.parametrize(
    "make, key",
    [
        (lambda: ADC(start=-1), "densify.start"),
        (lambda: ADC(stop=500), "densify.stop"),
        (lambda: ADC(prune_opacity=math.nan), "densify.prune_opacity"),
        (lambda: ADC(gradient="both"), "densify.gradient"),
        (lambda: ADC(cap="curve", max_gaussians=None), "densify.max_gaussians"),
        (lambda: Volumetric(volume_interval=150), "densify.volume_interval"),
        (lambda: Volumetric(split_size=0), "densify.split_size"),
        (lambda: MCMC(growth=-0.1), "densify.growth"),
        (lambda: Sfm(peak_threshold=-1), "init.peak_threshold"),
        (lambda: Sfm(seed=2**31), "init.seed"),
        (lambda: Dim(extractor="sift"), "init.extractor"),
        (lambda: Random(count=0), "init.count"),
    ],
)
def test_library_callers_get_the_same_errors(make, key):
    with pytest.raises(InputError, match=key):
        make()


@dataclass
class Own(ADC):
    """A user's class, whose own field has no rule but its type."""

    patience: int = 5


def test_a_users_own_fields_are_checked_by_their_type():
    assert Own(patience=7).patience == 7
    for wrong in ({"patience": "long"}, {"interval": 0}):
        with pytest.raises(InputError, match=f"densify.{next(iter(wrong))}"):
            Own(**wrong)


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=3)
    ),
    max_leaves=6,
)


@given(st.sampled_from([one.name for one in dataclasses.fields(Options) if one.init]), ANYTHING)
def test_any_value_is_accepted_or_refused_in_one_line(name, value):
    options = dataclasses.replace(Options(), **{name: value})
    refusal = ""
    try:
        check_settings(options, "options")
    except InputError as error:
        refusal = str(error)
    if refusal:
        assert refusal.startswith(f"options.{name} must be ")
        assert len(refusal.splitlines()) == 1
        return
    number = getattr(options, name)
    if isinstance(number, float):
        assert math.isfinite(number) or number == Options.farthest
    check_settings(options, "options")  # an accepted value is accepted again, unchanged
    assert getattr(options, name) == number


@pytest.mark.parametrize(
    "value, good",
    [
        ("a b", True),
        ("größe", True),
        ("x" * 100, True),
        ("x" * 101, False),
        ("ö" * 51, False),  # 102 bytes
        *(
            (name, False)
            for name in ("", ".a", "-a", "=a", "+a", "@a", " a", "a ", "a/b", "a:b", "a\tb", 'a"b')
        ),
        ("a.-b", True),
    ],
)
def test_a_name_must_fit_into_a_path_on_every_system(value, good):
    assert is_folder_name(value) == good


@pytest.mark.parametrize(
    "value, good",
    [
        ("http://a:1", True),
        ("sqlite:///x", True),
        ("a+b.c-1://", True),
        *((text, False) for text in ("http:/a", "://a", "1a://b", "http://a b", "http://a\x07")),
    ],
)
def test_an_address_names_its_kind(value, good):
    assert is_address(value) == good


def test_whole_numbers_have_at_most_64_bits_at_any_depth():
    @dataclass
    class Large:
        number: int = 0
        numbers: list[int] = field(default_factory=list)
        mapping: dict[str, Any] = field(default_factory=dict)
        target: TargetName = "a.B"

    for good in ({"number": MAX_INTEGER}, {"number": -MAX_INTEGER}, {"mapping": {"a": [1e300]}}):
        assert check_values(Large, good, "x") == good
    for wrong in (
        {"number": MAX_INTEGER + 1},
        {"number": -MAX_INTEGER - 1},
        {"numbers": [1, MAX_INTEGER + 1]},
        {"mapping": {"a": [{"b": MAX_INTEGER + 1}]}},
    ):
        with pytest.raises(InputError, match=f": whole numbers lie between -{MAX_INTEGER} and"):
            check_values(Large, wrong, "x")
    assert check_values(Large, {"target": "mine.sub.A"}, "") == {"target": "mine.sub.A"}
    for target in ("A", "mine.", "mine.1a", "mine a.B"):
        with pytest.raises(InputError, match=r"^target must be the import path of a class"):
            check_values(Large, {"target": target}, "")
    with pytest.raises(InputError, match=r"^x is not a setting \(there are no settings\)"):
        raise InputError(unknown_setting("x", "x", []))


def test_annotations_are_described_in_words():
    assert describe(Annotated[int, Interval(gt=0, le=4)]) == "a whole number in (0, 4]"
    assert describe(OpenFraction) == "a number in (0, 1)"
    assert describe(Threads) == "a whole number in [1, 4096]"
    assert describe(Annotated[float, Interval(lt=2)]) == "a number below 2"
    assert describe(Annotated[int, Interval(gt=2)]) == "a whole number above 2"
    assert describe(PositiveInt | Literal["auto"]) == "a whole number above 0 or 'auto'"
    assert describe(Annotated[float, Interval(le=2)]) == "a number of at most 2"
    assert describe(dict[str, Any]) == "a mapping {key: value}"
