"""Write the pages of the site to build/pages/, from which Zensical builds it (``make docs``).

The pages are docs/, the `PAGES` of the root, the findings, and parts generated from the code
(`reference.py`, `fidelity.py`). In the repository a page may link to any file. On the site, a link
to a file that is no page leads to the repository if its address is known (``$GSBENCH_REPOSITORY``);
otherwise only the file's name stays. A link to an example that stands alone on a line becomes the
example's code. A broken link is left as it is, so that Zensical refuses it.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = {
    "README.md": "first_steps.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "CODE_OF_CONDUCT.md": "conduct.md",
    "SECURITY.md": "report_a_weakness.md",
    "findings/README.md": "findings/README.md",
    "findings/simulations.md": "findings/simulations.md",
}  # file of the repository: page of the site
LINK = re.compile(r"(?<!!)\[(?P<text>[^\]]*)\]\((?P<target>[^)#\s]+)(?P<anchor>#[^)]*)?\)")
EXAMPLE = re.compile(r"^\[(examples/\w+\.py)\]\(\.\./\1\)$", re.MULTILINE)
PICTURE = re.compile(r"(!\[[^\]]*\]\()docs/")  # the README's, from the root
FENCE = re.compile(r"(^```.*?^```$)", re.DOTALL | re.MULTILINE)
# page: the part that `reference.py` or `fidelity.py` adds to its end
GENERATED = {f"{part}.md": part for part in ("settings", "results", "fidelity")}
GENERATED["captures.md"] = "rules"


def with_site_links(markdown: str, folder: Path, repository: str | None) -> str:
    """The text of a page in ``folder`` with links that work on the site.

    Blocks of code stay unchanged.
    """

    def replace(match: re.Match[str]) -> str:
        text, target, anchor = match["text"], match["target"], match["anchor"] or ""
        path = Path(os.path.normpath(folder / target))
        if "://" in target or not path.exists() or not path.is_relative_to(ROOT):
            return match[0]
        name = path.relative_to(ROOT).as_posix()
        page = page_of(name)
        if page is not None:
            own_page = page_of(folder.relative_to(ROOT).as_posix() + "/x.md") or ""
            relative = os.path.relpath(page, Path(own_page).parent).replace(os.sep, "/")
            return f"[{text}]({relative}{anchor})"
        if repository:
            kind = "tree" if path.is_dir() else "blob"
            return f"[{text}]({repository.rstrip('/')}/{kind}/main/{name}{anchor})"
        return text if name in text else f"{text} (`{name}`)"

    parts = FENCE.split(markdown)
    parts[::2] = [LINK.sub(replace, part) for part in parts[::2]]
    return "".join(parts)


def code_of_example(match: re.Match[str]) -> str:
    """The example that is linked, as a block of code under its name."""
    code = (ROOT / match[1]).read_text(encoding="utf-8")
    return f"`{match[1]}`\n\n```python\n{code}```"


def page_of(name: str) -> str | None:
    """The page of the site that a file of the repository becomes; None for other files."""
    if name.startswith("docs/"):
        return name.removeprefix("docs/")
    return name if name.startswith("findings/") and name.endswith(".md") else PAGES.get(name)


def write_pages(target: Path, repository: str | None) -> None:
    """Write every page, and the pictures beside them, to the folder ``target``."""
    import fidelity
    import reference

    parts = reference.PAGES | {"fidelity": fidelity.table}
    shutil.rmtree(target, ignore_errors=True)
    for folder in (DOCS, ROOT / "findings"):
        for path in sorted(folder.rglob("*")) if folder.is_dir() else ():
            if path.suffix in {".jpg", ".png", ".svg", ".txt", ".css"}:
                place = target / str(
                    page_of(path.relative_to(ROOT).as_posix()) or path.relative_to(ROOT)
                )
                place.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, place)
    sources = [
        *DOCS.rglob("*.md"),
        *(ROOT / "findings").glob("*.md"),
        *(ROOT / name for name in PAGES),
    ]
    for path in sources:
        if not path.is_file():
            continue
        name = path.relative_to(ROOT).as_posix()
        place = target / (PAGES.get(name) or str(page_of(name)))
        place.parent.mkdir(parents=True, exist_ok=True)
        text = path.read_text(encoding="utf-8")
        if name.removeprefix("docs/") in GENERATED:
            text += "\n" + parts[GENERATED[name.removeprefix("docs/")]]()
        text = PICTURE.sub(r"\1", EXAMPLE.sub(code_of_example, text))
        place.write_text(with_site_links(text, path.parent, repository), encoding="utf-8")
    (target / "api.md").write_text(reference.api_page(), encoding="utf-8")
    (target / "results.schema.json").write_text(reference.schema_text(), encoding="utf-8")


if __name__ == "__main__":
    write_pages(
        Path(sys.argv[1]) if sys.argv[1:] else ROOT / "build" / "pages",
        os.environ.get("GSBENCH_REPOSITORY"),
    )
