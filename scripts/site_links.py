"""Hook of MkDocs (`mkdocs.yml`): adds the changelog and the guide for contributors, and leads links out of docs/ on.

In the repository a page may link to any file. On the site, a module becomes its page in the reference; any other file
becomes a link to the repository where its address is known (`repo_url`), else its plain name. A link to nothing is
left as it is, and `mkdocs build --strict` refuses it.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mkdocs.structure.files import Files

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = {
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
}  # file: page of the site
LINK = re.compile(r"(?<!!)\[(?P<text>[^\]]*)\]\((?P<target>[^)#\s]+)(?P<anchor>#[^)]*)?\)")
FENCE = re.compile(r"(^```.*?^```$)", re.DOTALL | re.MULTILINE)


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that lie outside docs/."""
    from mkdocs.structure.files import File

    for name, page in PAGES.items():
        text = (ROOT / name).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=led_on(text, ROOT, config["repo_url"])))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Resolve the links of a page of docs/; those of generated pages are resolved already."""
    if page.file.generated_by is not None:
        return markdown
    return led_on(markdown, (DOCS / page.file.src_uri).parent, config["repo_url"])


def led_on(markdown: str, folder: Path, repository: str | None) -> str:
    """The text of a page that lies in ``folder``, with links that work on the site; blocks of code are left alone."""

    def replace(match: re.Match[str]) -> str:
        text, target, anchor = match["text"], match["target"], match["anchor"] or ""
        path = Path(os.path.normpath(folder / target))
        if "://" in target or not path.exists() or not path.is_relative_to(ROOT):
            return match[0]
        name = path.relative_to(ROOT).as_posix()
        if name in PAGES:
            return f"[{text}]({PAGES[name]}{anchor})"
        if name == "README.md":
            return f"[{text}](index.md)"
        if path.is_file() and path.is_relative_to(DOCS):
            return f"[{text}]({path.relative_to(DOCS).as_posix()}{anchor})"
        if path.suffix == ".py" and name.startswith("src/gsbench/"):
            module = name.removeprefix("src/").removesuffix(".py")
            return f"[{text}](reference/{module.replace('__init__', 'index')}.md)"
        if repository:
            return f"[{text}]({repository.rstrip('/')}/{'tree' if path.is_dir() else 'blob'}/main/{name}{anchor})"
        return text if name in text else f"{text} (`{name}`)"

    parts = FENCE.split(markdown)
    parts[::2] = [LINK.sub(replace, part) for part in parts[::2]]
    return "".join(parts)
