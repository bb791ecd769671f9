# SPDX-License-Identifier: Apache-2.0
"""tools/ci/site.py: what it adds to the pages, and that it ends with an error where one of them is wrong.

tools/ci/site_versions.py: a folder for each release, and the list of them on the pages.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import subprocess
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from browser import watched_page
from calls import ended, python

ROOT = Path(__file__).resolve().parents[2]
PAGES = ("README.md", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "SECURITY.md")
STUB = """import os, shutil, sys
from pathlib import Path
here = Path(__file__).parents[2]
print(os.environ["MIKE_DOCS_VERSION"], file=sys.stderr)
if (here / "broken").exists():
    sys.exit(1)
shutil.copytree(here / "pages", sys.argv[1])
"""
"""A tools/ci/site.py that copies pages which are there."""
pytestmark = pytest.mark.needs("mkdocs")


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """Sources of the site, to be changed."""
    return copied(tmp_path)


def copied(tmp_path: Path) -> Path:
    for name in ("clsplat", "docs", ".github"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "tools" / "ci").mkdir(parents=True)
    for name in (*PAGES, "LICENSE", "tools/ci/site.py"):
        shutil.copyfile(ROOT / name, tmp_path / name)
    return tmp_path


def build(root: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """The site of a copy, in its `out`. variables: of the environment."""
    return python(root / "tools/ci/site.py", root / "out", timeout=240, env={**os.environ, **variables})


@pytest.mark.slow
def test_pages_have_docstrings_examples_formulas_and_decisions(copy: Path) -> None:
    done = build(copy)
    assert (done.returncode, done.stderr) == (0, "")
    pages = {path.relative_to(copy / "out").as_posix(): path.read_text("utf-8") for path in copy.glob("out/**/*.html")}
    assert 'id="clsplat.rasterize"' in pages["docs/api.html"]
    assert pages["docs/examples.html"].count("SPDX-License-Identifier") == 5
    assert pages["docs/cameras.html"].count("<math") > 50 and "arithmatex" not in pages["docs/cameras.html"]
    assert pages["docs/decisions/index.html"].count('href="00') >= len(list((ROOT / "docs/decisions").glob("*.md")))
    # a link to a page became one to its HTML; one to a folder of pages, to the page that stands for the folder
    assert [name for name, text in pages.items() if re.search(r'href="(?!\w+:)[^"]*\.md["#]', text)] == []
    assert 'href="decisions/index.html"' in pages["docs/architecture.html"]
    assert not (copy / "docs/decisions/README.md").exists()
    # artefacts of GitHub Pages leave out what is hidden
    assert list(copy.glob("out/**/.*")) == []
    assert 'href="../github/workflows/test.yml"' in pages["docs/drivers.html"]
    # nothing comes from another host, and there is no list of versions
    loaded = [tag for text in pages.values() for tag in re.findall(r"<(?:script|link|img|iframe)[^>]+>", text)]
    assert loaded != [] and [tag for tag in loaded if re.search(r'(?:src|href)="(?:https?:)?//', tag)] == []
    assert '"version": null' in pages["docs/install.html"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "wrong",
    [
        {
            "[page](nowhere.md)": "the target 'docs/nowhere.md' is not found",
            "[place](render.md#nowhere)": "does not contain an anchor '#nowhere'",
            "[code](../clsplat/nowhere.py)": "the target 'clsplat/nowhere.py' is not found",
        },
        {"::: clsplat.nowhere": "clsplat.nowhere could not be found"},
    ],
    ids=["links", "docstrings"],
)
def test_what_leads_nowhere_is_an_error(copy: Path, wrong: dict[str, str]) -> None:
    with (copy / "docs/examples.md").open("a", encoding="utf-8") as page:
        page.write("".join(f"\n{line}\n" for line in wrong))
    done = build(copy)
    assert done.returncode == 1
    assert [message for message in wrong.values() if message not in done.stderr] == []
    assert len(wrong) == 1 or f"Aborted with {len(wrong)} warnings" in done.stderr


@contextlib.contextmanager
def served(folder: Path) -> Iterator[str]:
    """Address at which the files of a folder are served meanwhile."""

    class Handler(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    handler = partial(Handler, directory=str(folder))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def repository(folder: Path, *tags: str) -> Path:
    """A repository of site_versions.py, STUB and a page. Each tag has a commit and a page of its own."""
    (folder / "tools/ci").mkdir(parents=True)
    shutil.copyfile(ROOT / "tools/ci/site_versions.py", folder / "tools/ci/site_versions.py")
    (folder / "tools/ci/site.py").write_text(STUB)
    (folder / "pages").mkdir()
    git(folder, "init", "-q")
    for tag in (*tags, ""):
        (folder / "pages/index.html").write_text(f"page of {tag}")
        (folder / "broken").write_text("") if "broken" in tag else (folder / "broken").unlink(missing_ok=True)
        git(folder, "add", ".")
        git(folder, "commit", "-q", "-m", f"commit {tag}")
        if tag:
            git(folder, "tag", tag.removesuffix(" broken"))
    return folder


def git(folder: Path, *words: str) -> None:
    done = ended("git", "-c", "user.name=A", "-c", "user.email=a@example.org", *words, cwd=folder)
    assert done.returncode == 0, done.stderr


def versions(folder: Path, *words: object) -> subprocess.CompletedProcess[str]:
    """Run site_versions.py of a repository."""
    return python(folder / "tools/ci/site_versions.py", *words, timeout=240)


@pytest.mark.needs("mike")
def test_a_folder_for_each_release_and_the_checkout(tmp_path: Path) -> None:
    folder, out = repository(tmp_path / "a", "v0.2.0", "v0.10.0", "v0.1.0", "v1", "v0.11.0rc1"), tmp_path / "out"
    done = versions(folder, out)
    assert (done.returncode, done.stdout) == (0, f"{out / 'index.html'}\n")
    assert done.stderr.split() == ["dev", "v0.1.0", "v0.2.0", "v0.10.0"]  # by number, not by name or date
    found = json.loads((out / "versions.json").read_text("utf-8"))
    assert [(each["version"], each["aliases"]) for each in found] == [
        *[("dev", []), ("0.10.0", ["latest"])],
        *[("0.2.0", []), ("0.1.0", [])],
    ]
    assert (out / "0.2.0/index.html").read_text() == "page of v0.2.0"
    assert (out / "dev/index.html").read_text() == "page of "
    assert 'url=latest/"' in (out / "index.html").read_text()
    assert 'url=../0.10.0/index.html"' in (out / "latest/index.html").read_text()
    assert [path for path in out.rglob("*") if path.is_symlink()] == []
    # anew, with what has changed, and nothing left of before
    (folder / "pages/index.html").write_text("changed")
    (out / "dev/old.html").write_text("")
    assert versions(folder, out).returncode == 0
    assert (out / "dev/index.html").read_text() == "changed" and not (out / "dev/old.html").exists()
    done = ended("git", "branch", "--all", cwd=folder)
    assert len(done.stdout.split()) == 2, "the repository has no branch of the site"


@pytest.mark.needs("mike")
def test_without_releases_the_first_page_is_the_checkouts(tmp_path: Path) -> None:
    folder = repository(tmp_path / "a")
    assert versions(folder).returncode == 0
    assert 'url=dev/"' in (folder / "build/versions/index.html").read_text()


@pytest.mark.needs("mike")
def test_sites_that_cannot_be_built(tmp_path: Path) -> None:
    folder, out = repository(tmp_path / "a", "v0.1.0", "v0.2.0 broken"), tmp_path / "out"
    done = versions(folder, out)
    assert done.returncode == 0
    assert "site_versions.py: left out v0.2.0: its site cannot be built\n" in done.stderr
    assert 'url=../0.1.0/index.html"' in (out / "latest/index.html").read_text()
    kept = (out / "versions.json").read_bytes()
    (folder / "broken").write_text("")
    done = versions(folder, out)
    assert (done.returncode, done.stdout) == (1, "")
    assert (out / "versions.json").read_bytes() == kept  # as it was


@pytest.mark.needs("mike")
def test_calls_that_are_wrong(tmp_path: Path) -> None:
    folder = repository(tmp_path / "a")
    done = versions(folder, folder)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"tools/ci/site_versions.py: {folder} has files but no versions.json; give a new folder\n"
    assert versions(folder, "a", "b").returncode == 2
    assert "--versions" not in versions(folder, "--help").stdout


def look_up(page: Any, word: str, title: str) -> None:
    """Search for a word until a page with this title is found: results come while the word is typed. Raises an error
    after a minute."""
    page.click("input.md-search__input")
    page.keyboard.type(word)
    page.wait_for_selector(f'.md-search-result__item a h1:has-text("{title}")', timeout=60_000)


@pytest.mark.slow
@pytest.mark.needs("mike")
def test_the_search_runs_from_a_folder_and_the_list_of_versions_from_a_server(browser: Any, tmp_path: Path) -> None:
    root = copied(tmp_path / "copy")
    assert build(root).returncode == 0
    page, trouble = watched_page(browser)
    page.goto((root / "out/docs/install.html").as_uri())
    look_up(page, "Postshot", "Coming from another program")
    assert trouble == []
    page.close()
    assert build(root, MIKE_DOCS_VERSION="dev").returncode == 0
    folder = repository(tmp_path / "a", "v0.1.0")
    shutil.rmtree(folder / "pages")
    shutil.copytree(root / "out", folder / "pages")
    git(folder, "add", ".")
    git(folder, "commit", "-q", "-m", "pages")
    git(folder, "tag", "v0.2.0")
    assert versions(folder, tmp_path / "out").returncode == 0
    with served(tmp_path / "out") as address:
        page, trouble = watched_page(browser)
        page.goto(f"{address}/latest/docs/install.html")
        page.wait_for_url(f"{address}/0.2.0/docs/install.html")
        page.wait_for_selector(".md-version__link", state="attached")
        links = page.query_selector_all(".md-version__link")
        assert [link.text_content().strip() for link in links] == ["dev", "0.2.0", "0.1.0"]
        look_up(page, "Postshot", "Coming from another program")
        page.goto(links[0].get_attribute("href"))
        assert page.url.startswith(f"{address}/dev/") and trouble == []
        page.close()
