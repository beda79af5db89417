"""`scripts/install.py`: uv where it can be had, with the places that pip was told, else pip."""

from __future__ import annotations

import subprocess
from types import ModuleType
from typing import Any

import pytest

from tests.conftest import script


@pytest.fixture
def install() -> ModuleType:
    return script("install")


def test_places_that_pip_was_told_are_handed_on(
    install: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    listed = "global.index-url='https://a.org/simple'\nglobal.timeout='9'\n:env:.extra-index-url='https://b.org'\n"
    monkeypatch.setattr(
        install.subprocess,
        "run",
        lambda *_, **__: subprocess.CompletedProcess([], 0, stdout=listed),
    )
    assert install.uv_settings() == {
        "UV_DEFAULT_INDEX": "https://a.org/simple",
        "UV_INDEX": "https://b.org",
    }


@pytest.mark.parametrize(
    ("uv", "code", "last"), [("uv", 0, "uv"), ("uv", 1, "pip"), (None, 0, "pip")]
)
def test_pip_does_what_uv_does_not(
    install: ModuleType, monkeypatch: pytest.MonkeyPatch, uv: str | None, code: int, last: str
) -> None:
    ran: list[list[str]] = []

    def run(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        ran.append(command)
        return subprocess.CompletedProcess(command, code if command[0] == "uv" else 0, stdout="")

    monkeypatch.setattr(install, "find_uv", lambda: uv)
    monkeypatch.setattr(install.subprocess, "run", run)
    assert install.main(["-e", "."]) == 0
    assert ran[-1][-2:] == ["-e", "."]
    assert (ran[-1][0] == "uv") == (last == "uv")
