"""Files in the root of the project agree on facts that several of them state."""

import re
import tomllib
from urllib.parse import urlsplit

import pytest
import yaml

import gsbench
from tests.conftest import ROOT, script
from tests.helpers import table

PUBLIC = {"pypi.org", "files.pythonhosted.org"}
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
MAKEFILE = (ROOT / "Makefile").read_text()
LOCK = (ROOT / "uv.lock").read_text()
WORKFLOWS = sorted((ROOT / ".github/workflows").glob("*.yml"))


def normal(name):
    """A distribution's name as the package index compares it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def constraints():
    lines = (ROOT / "constraints.txt").read_text().split()
    return {normal(name): version for name, version in (line.split("==") for line in lines)}


def locked():
    return tomllib.loads(LOCK)["package"]


def names(requirements):
    return {normal(re.match(r"[\w.-]+", line).group()) for line in requirements}


def steps(workflow):
    return [
        step
        for job in yaml.safe_load(workflow.read_text())["jobs"].values()
        for step in job["steps"]
    ]


def test_the_lock_has_the_versions_of_the_constraints():
    pinned = constraints()
    different = {
        package["name"]: (package["version"], pinned[package["name"]])
        for package in locked()
        if package["name"] in pinned and package["version"] != pinned[package["name"]]
    }
    assert different == {}, "make lock"
    assert set(pinned) - {normal(package["name"]) for package in locked()} == set()


def test_the_lock_has_the_requirements_of_the_project_file():
    (own,) = (package for package in locked() if "editable" in package["source"])
    project, groups = PYPROJECT["project"], PYPROJECT["dependency-groups"]
    asked = [
        *project["dependencies"],
        *(line for extra in project["optional-dependencies"].values() for line in extra),
    ]
    assert own["name"] == project["name"]
    assert {entry["name"] for entry in own["metadata"]["requires-dist"]} == names(asked), (
        "make lock"
    )
    for group, lines in groups.items():
        assert {entry["name"] for entry in own["metadata"]["requires-dev"][group]} == names(
            lines
        ), "make lock"
    assert tomllib.loads(LOCK)["requires-python"] == project["requires-python"], "make lock"


def test_the_lock_names_public_addresses_only():
    assert {
        urlsplit(address).hostname for address in re.findall(r'"([a-z+]+://[^"]*)"', LOCK)
    } == PUBLIC
    sources = [package["source"] for package in locked()]
    assert {*map(tuple, sources)} == {("registry",), ("editable",)}
    assert [source["editable"] for source in sources if "editable" in source] == ["."]


def test_all_files_state_the_same_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == gsbench.__version__
    newest = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert newest.group(1) == gsbench.__version__.removesuffix(".dev0")


def test_the_pre_commit_hook_uses_the_pinned_ruff():
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    (ruff,) = (entry for entry in hooks if entry["repo"].endswith("/ruff-pre-commit"))
    assert ruff["rev"] == f"v{constraints()['ruff']}"


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.stem)
def test_workflows_call_existing_targets_and_files(workflow):
    targets = set(re.findall(r"^([a-z-]+):", MAKEFILE, re.MULTILINE))
    called = {
        name
        for step in steps(workflow)
        for name in re.findall(r"\bmake ([a-z-]+)", step.get("run", ""))
    }
    assert called <= targets
    for step in steps(workflow):
        for name in re.findall(r"@(\S+)", step.get("run", "")):
            assert (ROOT / name).exists()


def test_the_scripts_that_make_calls_exist():
    assert [
        name for name in re.findall(r"scripts/\S+", MAKEFILE) if not (ROOT / name).is_file()
    ] == []


def test_every_target_for_tests_is_called_by_a_workflow_and_by_ci():
    wanted = {
        name
        for name in re.findall(r"^([a-z-]+):.*##", MAKEFILE, re.MULTILINE)
        if name.startswith("test")
    }
    wanted |= {"lint", "docs"}
    text = "".join(step.get("run", "") + "\n" for workflow in WORKFLOWS for step in steps(workflow))
    assert wanted <= set(re.findall(r"\bmake ([a-z-]+)", text))
    calls = re.findall(r"^ *make ([a-z -]+)", (ROOT / ".ci/run").read_text(), re.MULTILINE)
    assert wanted <= set(" ".join(calls).split())


def test_linux_is_tested_from_the_oldest_supported_python():
    (tests,) = (path for path in WORKFLOWS if path.stem == "tests")
    tested = yaml.safe_load(tests.read_text())["jobs"]["linux"]["strategy"]["matrix"]["python"]
    assert PYPROJECT["project"]["requires-python"] == f">={tested[0]}"
    assert tested == sorted(tested, key=lambda version: int(version.split(".")[1]))


def test_the_core_tests_exist():
    for name in (ROOT / "tests/core.txt").read_text().split():
        assert (ROOT / name).exists(), name


def test_the_site_has_every_document():
    """This test is quick and does not build the site; `make docs` finds broken links."""

    class Loader(yaml.SafeLoader):
        """Reads the tag for environment variables as a list."""

    Loader.add_constructor("!ENV", lambda loader, node: loader.construct_sequence(node))
    config = yaml.load((ROOT / "mkdocs.yml").read_text(), Loader)
    pages = re.findall(r"'([\w./-]+\.md)'", str(config["nav"]))
    assert len(pages) == len(set(pages))
    build_site = script("build_site")
    made = {page for name, page in build_site.PAGES.items() if (ROOT / name).is_file()} | {"api.md"}
    docs = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")}
    assert set(pages) >= docs
    assert set(pages) <= docs | made
    index = (ROOT / "docs/index.md").read_text()
    assert [name for name in docs - {"index.md"} if f"]({name}" not in index] == []


REPOSITORY = "https://example.org/owner/gsbench/"


@pytest.mark.parametrize(
    "link, folder, repository, wanted",
    table(__file__, "links"),
)
def test_links_are_rewritten_for_the_site(link, folder, repository, wanted):
    assert script("build_site").with_site_links(link, ROOT / folder, repository) == wanted


@pytest.mark.parametrize(
    "link, wanted",
    [
        ("[a](docs/gpu.md#x)", f"[a]({REPOSITORY}blob/main/docs/gpu.md#x)"),
        ("![a](docs/demo.jpg)", f"![a]({REPOSITORY}raw/main/docs/demo.jpg)"),
        ("[a](#here) [b](https://example.com)", "[a](#here) [b](https://example.com)"),
        ("```\n[a](b.md)\n```", "```\n[a](b.md)\n```"),
    ],
)
def test_the_readme_of_the_package_has_absolute_links(link, wanted):
    pytest.importorskip("hatchling", reason="needs hatchling (group dev)")
    assert script("hatch_readme").absolute_links(link, REPOSITORY) == wanted
