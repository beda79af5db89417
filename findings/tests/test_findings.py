"""The findings agree with the archives, and the files that they name exist."""

import re
import sys
import zipfile
from pathlib import Path

import pytest

from gsbench.app.command import compose_trials

FINDINGS = Path(__file__).parents[1]
sys.path.append(str(FINDINGS / "scripts"))
import tables  # noqa: E402

pytestmark = pytest.mark.slow

FIGURE = re.compile(
    r"[+−]\d+\.\d+|(?<![\d.,])0\.\d+|\d{1,3}(?:,\d{3})+"
)  # differences, shares and large counts
# Figures of settings, and one of a training without a cap that is in no archive (1.96 million is
# written otherwise).
SETTINGS = {
    "1,000",
    "1,500",
    "2,000",
    "3,000",
    "5,000",
    "6,000",
    "10,000",
    "15,000",
    "20,000",
    "30,000",
    "40,000",
    "100,000",
}
PAGE = tables.README.read_text(encoding="utf-8")


def test_the_tables_follow_from_the_archives():
    assert tables.TABLES.read_text(encoding="utf-8") == tables.all_tables()
    assert "nan" not in tables.all_tables()


def test_every_figure_of_the_page_is_in_a_table():
    known = set(FIGURE.findall(tables.TABLES.read_text(encoding="utf-8")))
    known |= {figure.lstrip("+−") for figure in known} | SETTINGS
    prose = re.sub(r"<!-- verdicts -->.*?<!-- end -->", "", PAGE, flags=re.DOTALL)
    # The trials of the replication are not ours.
    prose, found = re.subn(r"## A replication from outside.*?\n## ", "## ", prose, flags=re.DOTALL)
    assert found == 1
    # Verdicts by earlier rules cannot be made again.
    earlier = re.compile(r"^(\| [^|]+ \| )(?:supported|refuted|undecided), [^|]+ \|", re.MULTILINE)
    prose, found = earlier.subn(r"\1", prose)
    assert found == 6
    assert [figure for figure in FIGURE.findall(prose) if figure not in known] == []


def test_the_pages_statements_on_seeds_are_true():
    def of(name, arm, scene, split="interpolation", **kept):
        frame = tables.read_trials(name)
        for key, value in kept.items():
            frame = frame[frame[key] == value]
        found = tables.differences(frame, arm, "adc", tables.LPIPS).loc[split, scene]
        return float(found.min()), float(found.max())

    for split in tables.SPLITS:
        assert of("volume", "volumetric", "flower", split)[1] < 0
        assert of("dimension", "volumetric-1", "flower", split)[1] < 0
    assert all(
        of("dimension", "volumetric-1", scene)[0] > 0
        for scene in ("bonsai", "courtyard", "kitchen")
    )
    assert of("full", "volumetric", "bonsai", cap="soft")[0] > 0
    assert of("full", "volumetric_once", "bonsai", cap="soft")[1] < 0
    clouds = tables.differences(tables.read_trials("initialisers"), "sfm", "random", tables.LPIPS)
    assert (clouds < 0).all()


def test_files_that_the_page_names_exist():
    for name in re.findall(r"\]\(((?!http)[^)#]+)\)", PAGE):
        assert (FINDINGS / name).exists(), name
    for name in re.findall(r"findings/(?:claims|archives|scripts)/\w+\.\w+", PAGE):
        assert (FINDINGS.parent / name).is_file(), name
    for name in re.findall(r"claims/\w+\.yaml", PAGE):
        assert (FINDINGS / name).is_file(), name


@pytest.mark.parametrize(
    "file", sorted(FINDINGS.glob("experiment/*.yaml")), ids=lambda file: file.stem
)
def test_experiments_are_composed(file):
    path = ["init.path=/somewhere"] if "override /init: points" in file.read_text() else []
    trials = compose_trials(
        [f"hydra.searchpath=['file://{FINDINGS}']", f"+experiment={file.stem}", *path]
    )
    assert len(trials) >= 6


@pytest.mark.parametrize(
    "file", sorted(FINDINGS.glob("archives/*.zip")), ids=lambda file: file.stem
)
def test_archives_are_small_and_name_no_folder_of_a_machine(file):
    with zipfile.ZipFile(file) as archive:
        maps = sum(member.endswith("/regions.json") for member in archive.namelist())
        assert file.stat().st_size < 300_000 + 10_000 * maps
        for member in archive.namelist():
            assert not re.search(rb"/(root|home|work|tmp|Users)/", archive.read(member)), member
