"""The GitHub action of the gate: its script, run with a stand-in for gsbench."""

import os
import shutil
import subprocess

import pytest
import yaml

from tests.conftest import ROOT

pytestmark = pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")


def steps():
    action = yaml.safe_load((ROOT / "action.yml").read_text(encoding="utf-8"))
    found = action["runs"]["steps"]
    return found


def ended(tmp_path, code, **inputs):
    """Run the script with a gsbench that ends with the exit code ``code``.

    Returns the script's exit code, and the words that gsbench was given.
    """
    program = tmp_path / "gsbench"
    program.write_text(
        f'#!/bin/sh\nprintf "%s\\n" "$@" > {tmp_path / "words"}\necho passed\nexit {code}\n'
    )
    program.chmod(0o755)
    given = {
        "ARCHIVE": "a b.zip",
        "SETTINGS": "x=1 y=$(id) z=*",
        "METRIC": "psnr",
        "LEAST": "",
        "SEEDS": "",
    }
    environment = {
        "PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}",
        "GITHUB_STEP_SUMMARY": str(tmp_path / "s.md"),
    }
    done = subprocess.run(
        ["bash", "-e", "-o", "pipefail", "-c", steps()[-1]["run"]],
        cwd=tmp_path,
        env=environment | given | {"UNDECIDED": "fail"} | inputs,
        check=False,
    )
    return done.returncode, (tmp_path / "words").read_text().splitlines()


ENDS = [(0, "fail", 0), (1, "pass", 1), (2, "pass", 2), (3, "fail", 3), (3, "pass", 0)]


@pytest.mark.parametrize("code, undecided, expected", ENDS)
def test_the_step_has_the_exit_code_of_the_gate(tmp_path, code, undecided, expected):
    found, words = ended(tmp_path, code, UNDECIDED=undecided)
    assert found == expected
    assert words == ["gate", "a b.zip", "x=1", "y=$(id)", "z=*", "--metric", "psnr"]
    assert "    passed" in (tmp_path / "s.md").read_text()


def test_only_options_that_are_set_are_given_and_inputs_are_not_inserted_into_scripts(tmp_path):
    _, words = ended(tmp_path, 0, LEAST="10%", SEEDS="4")
    assert words[-4:] == ["--least", "10%", "--seeds", "4"]
    assert not [step for step in steps() if "${{" in step["run"]]
