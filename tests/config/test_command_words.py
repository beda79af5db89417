"""Words of a command line, without a composition."""

import re
from pathlib import Path
from shlex import split

import pytest

from gsbench.config import command_words
from gsbench.config.command_words import (
    check_single,
    check_text,
    check_words,
    grid_points,
    is_interval,
    makes_other_trials,
    parse,
)
from gsbench.config.groups import hint_for, options
from gsbench.config.overrides import is_sweep, key_of, parse_word, value_text
from gsbench.config.search_path import check_search_path, search_path, searched_folders
from tests.helpers import refusal, table


def test_options_and_words_may_come_in_any_order(tmp_path):
    folder = f"hydra.searchpath=['file://{tmp_path}']"
    for words in (
        ["a=1", "--config-dir", str(tmp_path), "-m", "b=2", "--dry-run"],
        ["--multirun", f"-cd={tmp_path}", "a=1", "--dry-run", "b=2"],
    ):
        assert parse(words) == ([folder, "a=1", "b=2"], True, True)
    assert parse(["a=1"]) == (["a=1"], False, False)
    quoted = tmp_path / "it's"
    quoted.mkdir()
    (word,) = search_path([quoted], [])
    assert parse_word(word).value() == [f"file://{quoted}"]
    assert searched_folders(["a=1", word]) == [quoted]
    assert search_path([], ["hydra.searchpath=[a]"]) == []
    assert searched_folders(["hydra.searchpath=[pkg://a,file:///b,/c]"]) == [Path("/b"), Path("/c")]


@pytest.mark.parametrize(
    "words, said",
    table(__file__, "options"),
)
def test_options_that_do_not_exist_are_explained(words, said):
    with refusal(re.escape(said)):
        parse(split(words))


@pytest.mark.parametrize(
    "words, said",
    table(__file__, "words"),
)
def test_words_without_effect_are_refused(words, said):
    with refusal(said and re.escape(said)):
        check_words(words)


def test_brackets_are_counted_while_they_are_open():
    for word in ("a=" + "[" * 40 + "]" * 40, "a=[" + ",".join(["[1]"] * 50) + "]"):
        assert parse_word(word).key_or_group == "a"
    for name in ("name", "x.path"):
        check_text(f"{name}=12, a ,3")
        with refusal(r"type '.*=\"1_0\"'"):
            check_text(f"{name}=a, 1_0")


@pytest.mark.parametrize(
    "word, said",
    table(__file__, "packages"),
)
def test_packages_of_settings_need_permission(word, said):
    with refusal(said):
        check_search_path(["a=1", word], ["json"])


def points(*words):
    return [" ".join(point) for point in grid_points([parse_word(word) for word in words])]


def test_a_grid_is_a_product_whose_last_list_varies_first(monkeypatch):
    assert points("a=1,2", "b=x", "~c", "d=range(0,2)") == [
        f"a={a} b=x ~c d={d}" for a in (1, 2) for d in (0, 1)
    ]
    assert points("seed=1,2", "seed=3") == ["seed=3"]  # the later one counts
    monkeypatch.setattr(command_words, "MAX_POINTS", 3)
    assert len(points("seed=1,2,3")) == 3
    for words, said in (
        (["seed=1,2,3,4"], "lists more than 3 values"),
        (["seed=range(0)"], "lists no value"),
        (["seed=range(0,2,0)"], "must not be zero"),
        (["seed=interval(0,1)"], "a sweep is a list of values, such as seed=1,2,3"),
        (["threads=1,2"], "threads does not make a different trial"),
    ):
        with refusal(said):
            points(*words)


@pytest.mark.parametrize(
    "key, other",
    [
        *((key, True) for key in split("seed name densify densify.start scene.path")),
        *((key, False) for key in split("threads init.threads eval.primary launch.parallel")),
        ("densify.primary", True),
    ],
)
def test_settings_that_make_other_trials(key, other):
    assert makes_other_trials(key) == other


def test_words_tell_their_key_value_and_kind():
    assert [key_of(word) for word in ("+a.b=1", "~a.b", "++a/b=1", "a=1")] == split("a.b a.b a/b a")
    assert [is_sweep(word) for word in ("a=1", "a=1,2", "a=[1,2]", "a=range(3)")] == [
        False,
        True,
        False,
        True,
    ]
    assert [is_interval(parse_word(word)) for word in ("a=1", "a=1,2", "a=interval(0,1)")] == [
        False,
        False,
        True,
    ]
    values = [None, True, [1, [None, "a"]], 1.5, "True"]
    assert [value_text(value) for value in values] == [
        "null",
        "true",
        "[1,[null,a]]",
        "1.5",
        "True",
    ]
    with refusal("seed=1,2 lists several values: take one"):
        check_single(["a=1", "seed=1,2", "b=3,4"], "take one")
    check_single(["a=1"], "take one")
    with refusal("a setting cannot be removed"):
        check_single(["~seed"], "take one")


@pytest.mark.parametrize(
    "word, said",
    table(__file__, "quoted"),
)
def test_special_characters_are_shown_quoted(word, said):
    with refusal(said):
        parse_word(word)


@pytest.mark.parametrize("group, word", [("experiment", "experiment=a"), ("init", "init=[a]")])
def test_choices_of_the_users_folder_are_listed_too(tmp_path, group, word):
    (tmp_path / group).mkdir()
    (tmp_path / f"{group}/of_mine.yaml").touch()
    words, *_ = parse(["--config-dir", str(tmp_path), word])
    with refusal(r"\bof_mine\b"):
        check_words(words)


def test_a_word_that_is_a_choice_gets_a_hint(tmp_path):
    assert hint_for("raster").startswith("; raster is a group: choose one by raster=NAME (")
    assert hint_for("mcmc") == "; did you mean densify=mcmc?"
    assert hint_for("demo") == "; did you mean +experiment=demo?"
    assert hint_for("none").startswith("; did you mean densify=none or ")
    assert hint_for("nosuch") == ""
    (tmp_path / "densify/external").mkdir(parents=True)
    for name in split("adc zeta alpha external/mine"):
        (tmp_path / f"densify/{name}.yaml").touch()
    found = options("densify", [tmp_path])
    assert found[: len(options("densify"))] == options("densify")
    assert found[len(options("densify")) :] == ["alpha", "zeta", "external/mine"]
