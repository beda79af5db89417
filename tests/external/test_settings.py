"""Settings of another program that are refused before it runs."""

from __future__ import annotations

from typing import Any

import pytest

from gsbench.errors import InputError
from gsbench.external.settings import External


def external(result: str, **options: Any) -> External:
    return External(command=["train", "{data}"], result=result, version="1", **options)


@pytest.mark.parametrize(
    "result",
    [
        "a.ply",
        "**/point_cloud.ply",
        "out/*/view_*.png",
        "it_{iterations}/a.ply",
        "{kind}/x.ply",
        "./a.ply",
        "[ab].ply",
    ],
)
def test_patterns_below_the_output_folder_are_accepted(result: str) -> None:
    assert external(result, options={"kind": "deep"}).result == result


@pytest.mark.parametrize(
    ("result", "words"),
    [
        ("**.ply", "not a pattern of files"),
        ("a**/b.ply", "not a pattern of files"),
        ("/home/me/a.ply", "below the program's output folder"),
        ("{output}/a.ply", "below the program's output folder"),
        ("{kind}/a.ply", "below the program's output folder"),  # the option is an absolute path
        ("../a.ply", "below the program's output folder"),
        ("a/../../b.ply", "below the program's output folder"),
        ("C:/a.ply", "below the program's output folder"),
        (".", "below the program's output folder"),
        ("a\0.ply", "below the program's output folder"),
        ("x" * 300, "not a pattern of files"),
    ],
)
def test_patterns_that_fit_no_file_below_the_folder_are_refused(result: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as refused:
        external(result, options={"kind": "/abs"})
    assert "densify.result" in str(refused.value)
