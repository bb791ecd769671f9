#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Build a site of README.md and docs/, with an API page from the docstrings. Requires the extra `docs`.

    .venv/bin/python tools/ci/site.py [FOLDER]

Writes HTML to FOLDER (build/site): open its index.html. Nothing in it, the search included, needs a server or another
host. The exit status is 1 if there are warnings, for example of a broken link or a missing docstring. docs/mkdocs.yml
has the settings. With the variable MIKE_DOCS_VERSION pages show the list of versions of site_versions.py.

mkdocs reads only one folder, so the pages are copied to a temporary one, with the same links between them. Three things
are added to the copy: a list of the decisions, the text of each example below the link to it, and formulas as MathML.
"""

from __future__ import annotations

import html
import logging
import os
import re
import shutil
import sys
import tempfile
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.commands.build import build
from mkdocs.config import load_config
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import MkDocsException

ROOT = Path(__file__).resolve().parents[2]
PAGES = ("README.md", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "SECURITY.md", "LICENSE")
"""Files that are copied beside docs/, as pages link to them; .github is too, as `github`."""
DECISIONS = "docs/decisions"
HIDDEN = re.compile(r"(?<=\]\()((?:\.\./)*)\.github/")
"""Pattern of a link to .github. Artefacts of GitHub Pages leave out a folder of this name."""
EXAMPLE = re.compile(r"^\[[^]]+\]\((examples/\w+\.py)\)$", re.MULTILINE)
"""Pattern of a link to an example on a line of its own."""
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
TAG = re.compile(r"\\tag\{(\w+)\}")


def copy_pages(folder: Path) -> list[str]:
    """Copy the pages to the folder. Returns the pages of the decisions, in order."""
    shutil.copytree(ROOT / "docs", folder / "docs", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / ".github", folder / "github")
    for name in PAGES:
        shutil.copyfile(ROOT / name, folder / name)
    decisions = sorted((folder / DECISIONS).glob("*.md"))
    lines = [f"- [{path.read_text('utf-8').partition(chr(10))[0].lstrip('# ')}]({path.name})" for path in decisions]
    (folder / DECISIONS / "README.md").write_text("\n".join(["# Decisions", "", *lines, ""]), "utf-8")
    for path in folder.rglob("*.md"):
        text = path.read_text("utf-8").replace("decisions/)", "decisions/README.md)")
        text = HIDDEN.sub(r"\1github/", text)
        path.write_text(EXAMPLE.sub(lambda link: with_code(link, folder / "docs"), text), "utf-8")
    return [f"{DECISIONS}/README.md", *(f"{DECISIONS}/{path.name}" for path in decisions)]


def with_code(link: re.Match[str], docs: Path) -> str:
    """The link to an example, followed by the example's text."""
    return f"{link[0]}\n\n```python\n{(docs / link[1]).read_text('utf-8')}```"


def formulas(text: str, **_: object) -> str:
    """Replace TeX in a page's HTML by MathML, which browsers display. Equation numbers are put on the right."""

    def mathml(found: re.Match[str]) -> str:
        tex = html.unescape(found[2])
        tag = TAG.search(tex)
        number = f'<span style="float: right; clear: right">({tag[1]})</span>' if tag else ""
        formula: str = convert(TAG.sub("", tex), display="block" if found[1] == "div" else "inline")
        return number + formula

    return FORMULA.sub(mathml, text)


def main() -> int:
    """Build the site. Returns the exit status."""
    logging.basicConfig(format="%(levelname)s %(message)s", level=logging.WARNING)
    target = Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / "build/site").resolve()
    with tempfile.TemporaryDirectory() as folder:
        decisions = copy_pages(Path(folder))
        config: MkDocsConfig = load_config(
            str(ROOT / "docs/mkdocs.yml"), docs_dir=folder, site_dir=str(target), strict=True
        )
        assert config.nav is not None
        next(part for part in config.nav if "Decisions" in part)["Decisions"] = decisions
        config.plugins.events["page_content"].append(formulas)
        if "MIKE_DOCS_VERSION" in os.environ:  # by site_versions.py, as mike sets it; alone the site has no such list
            config.extra["version"] = {"provider": "mike"}
        try:
            build(config)
        except MkDocsException as error:
            print(f"tools/ci/site.py: {error}", file=sys.stderr)
            return 1
    print(target / "index.html")
    return 0


if __name__ == "__main__":
    sys.exit(main())
