"""`scripts/install.py` installs by uv with the indexes of pip's settings, else by pip."""

import subprocess

import pytest

from tests.conftest import script


@pytest.fixture
def install():
    return script("install")


def recorded(install, monkeypatch, fails):
    """The commands that the script runs from now on; one fails if ``fails(command)``."""
    ran = []

    def run(command, **_):
        ran.append(command)
        return subprocess.CompletedProcess(command, int(fails(command)), stdout="")

    monkeypatch.setattr(install.subprocess, "run", run)
    return ran


def test_indexes_of_pips_settings_are_passed_to_uv(install, monkeypatch):
    listed = "global.index-url='https://a.org/simple'\nglobal.timeout='9'\n:env:.extra-index-url='https://b.org'\n"
    monkeypatch.setattr(
        install.subprocess,
        "run",
        lambda *_, **__: subprocess.CompletedProcess([], 0, stdout=listed),
    )
    assert install.uv_settings(["pip"]) == {
        "UV_DEFAULT_INDEX": "https://a.org/simple",
        "UV_INDEX": "https://b.org",
    }


@pytest.mark.parametrize("uv, code, last", [("uv", 0, "uv"), ("uv", 1, "pip"), (None, 0, "pip")])
def test_pip_installs_if_uv_is_missing_or_fails(install, monkeypatch, uv, code, last):
    ran = recorded(install, monkeypatch, lambda command: code and command[0] == "uv")
    monkeypatch.setattr(install, "find_uv", lambda pip: uv)
    assert install.main(["-e", "."]) == 0
    assert ran[-1][-2:] == ["-e", "."]
    assert (ran[-1][0] == "uv") == (last == "uv")


@pytest.mark.parametrize("base_fails, used", [(0, "BASE_PIP"), (1, "OWN_PIP")])
def test_an_environment_without_pip_uses_that_of_its_base_else_makes_one(
    install, monkeypatch, base_fails, used
):
    ran = recorded(install, monkeypatch, lambda command: base_fails)
    monkeypatch.setattr(install.importlib.util, "find_spec", lambda name: None)
    assert install.find_pip() == getattr(install, used)
    assert ("ensurepip" in ran[-1]) == bool(base_fails)


@pytest.mark.parametrize("newer, made", [(0, False), (1, True)])
def test_an_environment_without_pip_gets_pythons_own_if_no_newer_one_is_found(
    install, monkeypatch, newer, made
):
    ran = recorded(install, monkeypatch, lambda command: newer and "pip>=25.1" in command)
    monkeypatch.setattr(install, "find_uv", lambda pip: None)
    monkeypatch.setattr(install, "find_pip", lambda: install.BASE_PIP)
    assert install.main(["-e", "."]) == 0
    assert any("ensurepip" in command for command in ran[:-1]) == made
