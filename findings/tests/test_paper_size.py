"""The table of the page on the paper's size agrees with the archives."""

import json
import re
import zipfile
from pathlib import Path

FINDINGS = Path(__file__).parents[1]
PAGE = (FINDINGS / "paper_size.md").read_text(encoding="utf-8")


def test_the_rows_of_30000_iterations_and_of_the_authors_are_those_of_the_archives():
    found = set()
    for archive in FINDINGS.glob("archives/bonsai_gpu_*.zip"):
        for line in zipfile.ZipFile(archive).read("results.jsonl").decode().splitlines():
            record = json.loads(line)
            result = record.get("results", record)
            metrics = result["metrics"]
            figures = [f"{metrics['psnr']:.2f}"]
            figures += [f"{metrics[n]:.4f}".lstrip("0") for n in ("ssim", "lpips_squeeze", "flip")]
            if result["num_gaussians"] is not None:
                figures.append(f"{result['num_gaussians']:,}")
            found.add(" | ".join(figures))
    assert len(found) == 5
    assert [row for row in found if row not in PAGE] == []


def test_the_archives_that_the_page_names_exist():
    names = re.findall(r"\((archives/\w+\.zip)\)", PAGE)
    assert len(names) == 2
    assert all((FINDINGS / name).is_file() for name in names)
