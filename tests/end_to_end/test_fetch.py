"""On a fresh machine, one command downloads all data of the paper's sweep."""

import time

import pytest

from tests.datasets.conftest import archive_content, write_archives
from tests.datasets.server import Manners, serve
from tests.processes import wait_until

pytestmark = pytest.mark.slow


@pytest.fixture
def server(tmp_path):
    folder = tmp_path / "archives"
    folder.mkdir()
    with serve(write_archives(folder, photos=2)) as running:
        yield running


def test_after_fetch_table1_misses_no_data(gsbench, server, tmp_path):
    one = gsbench("scene=garden", code=2)
    assert "`gsbench fetch mipnerf360 garden` brings what is missing" in one.stderr
    before = gsbench("+experiment=table1", "--dry-run", code=None)
    assert before.stdout.count("does not exist") == 13
    advice = before.stdout.splitlines()[-1]
    commands = [
        words.split()[1:] for words in advice.split("`") if words.startswith("gsbench fetch")
    ]
    assert len(commands) == 2
    for command in commands:
        assert "licence:" in gsbench(*command, GSBENCH_MIRROR=server.url).stdout
    after = gsbench("+experiment=table1", "--dry-run")
    assert "does not exist" not in after.stdout
    assert "fetch" not in after.stdout
    assert (tmp_path / "data/tandt/truck/images/IMG_0001.JPG").is_file()


def test_a_killed_fetch_continues(server, tmp_path, start, gsbench):
    def slowly(_, __, body):
        time.sleep(0.05)
        return body

    server.manners = Manners(damage=slowly)
    process = start("fetch", "mipnerf360", "--mirror", server.url)
    wait_until(lambda: list((tmp_path / "data/.fetch").glob("*/*/*.JPG")), 60)
    process.kill()
    process.communicate()
    server.manners = Manners()
    gsbench("fetch mipnerf360 --mirror", server.url)
    for name, content in archive_content("garden", photos=2).items():
        path = tmp_path / f"data/{name}"
        assert path.exists() == name.startswith(("garden/images_4/IMG", "garden/sparse/"))
        assert not path.exists() or path.read_bytes() == content
    assert not list((tmp_path / "data").rglob("*.tmp-*"))
