"""The name under which gsbench is installed, and the commands that hints give."""

import re
import shutil
import tomllib

import pytest

from gsbench.system import install
from gsbench.system.install import DISTRIBUTION, checkout, install_command
from tests.conftest import ROOT
from tests.processes import completed


def test_the_name_is_that_of_the_project_file():
    content = tomllib.loads((ROOT / "pyproject.toml").read_text())
    project = content["project"]
    assert project["name"] == DISTRIBUTION
    assert list(project["scripts"]) == ["gsbench"]
    assert f"{DISTRIBUTION}[dim,search,tensorboard,view]" in content["dependency-groups"]["dev"]


def test_from_a_checkout_the_hint_installs_the_checkout(tmp_path, monkeypatch):
    assert checkout() == ROOT
    monkeypatch.chdir(ROOT)
    assert install_command("view") == "pip install -e '.[view]'"
    monkeypatch.chdir(tmp_path)
    assert install_command("view") == f"pip install -e '{ROOT}[view]'"


def test_elsewhere_the_hint_names_the_distribution(monkeypatch):
    monkeypatch.setattr(install, "__file__", "/usr/lib/python3/site-packages/gsbench/install.py")
    monkeypatch.setattr(install, "installed_from", lambda: None)
    assert install_command() == "pip install 'gsbench-3dgs'"
    assert install_command("view") == "pip install 'gsbench-3dgs[view]'"


@pytest.mark.parametrize(
    "record, found",
    [
        ('{"dir_info": {}, "url": "file://FOLDER"}', True),
        ('{"dir_info": {}, "url": "file://FOLDER/gone"}', False),
        ('{"archive_info": {}, "url": "https://example.org/a.whl"}', False),
        (None, False),
    ],
)
def test_installed_from_a_folder_the_hint_names_the_folder(record, found, tmp_path, monkeypatch):
    class Known:
        def read_text(self, name):
            assert name == "direct_url.json"
            return record and record.replace("FOLDER", tmp_path.as_posix())

    monkeypatch.setattr(install, "__file__", "/usr/lib/python3/site-packages/gsbench/install.py")
    monkeypatch.setattr(install, "distribution", lambda name: Known())
    assert install.installed_from() == (tmp_path if found else None)
    assert install_command("view") == f"pip install '{tmp_path if found else DISTRIBUTION}[view]'"


def test_no_text_tells_to_install_the_foreign_project_gsbench():
    foreign = re.compile(r"pip install [^`\n]*\bgsbench(?!-3dgs)(\[|['\"`\s]|$)", re.MULTILINE)
    assert foreign.search("pip install 'gsbench[view]'")
    assert not foreign.search("pip install 'gsbench-3dgs[view]'")
    places = [
        *ROOT.glob("*.md"),
        *(ROOT / "docs").rglob("*.md"),
        *(ROOT / "notebooks").glob("*.py"),
    ]
    places += [*(ROOT / "src").rglob("*.py"), *(ROOT / "conf").rglob("*.yaml")]
    assert [str(path) for path in places if foreign.search(path.read_text(encoding="utf-8"))] == []


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_the_dockerfile_calls_existing_make_targets():
    """Docker builds what the README's two commands build."""
    targets = re.findall(r"RUN make (\S+)", (ROOT / "Dockerfile").read_text())
    assert {"demo", "test"} < set(targets)
    for target in targets:
        completed(["make", "-n", target], cwd=ROOT)
    # In .dockerignore, names without a wildcard match in the root only.
    ignored = (ROOT / ".dockerignore").read_text().split()
    assert {name.lstrip("/") for name in (ROOT / ".gitignore").read_text().split()} < set(
        ignored
    )  # so no local file gets into the image
