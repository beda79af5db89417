"""Reading bytes of files that may be strange."""

from __future__ import annotations

from pathlib import Path

import pytest

from gsbench.parsing import DamagedError, read_bytes


@pytest.mark.skipif(not Path("/proc/meminfo").exists(), reason="needs /proc")
def test_a_file_that_reports_no_size_is_read_whole() -> None:
    path = Path("/proc/version")
    assert path.stat().st_size == 0
    assert read_bytes(path) == path.read_bytes()


def test_a_file_is_read_up_to_its_limit_and_refused_beyond(tmp_path: Path) -> None:
    file = tmp_path / "a"
    file.write_bytes(b"x" * 10)
    assert read_bytes(file, most=10) == b"x" * 10
    with pytest.raises(DamagedError, match="more than 9 bytes"):
        read_bytes(file, most=9)
