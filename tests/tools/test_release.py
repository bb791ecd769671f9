# SPDX-License-Identifier: Apache-2.0
"""`tools/release`: its checks on a small checkout of their own, and the files that it compares. No network."""

from __future__ import annotations

import re
import subprocess
import tarfile
import zipfile
from pathlib import Path

import pytest
import release_build
import release_checks
import release_command
from needs import require

ROOT = Path(__file__).resolve().parents[2]
SECTION = "## [0.1.0] - 2026-11-30\n\n### Added\n\n- Everything.\n"
FILES = {
    "pyproject.toml": """[project]
name = "clsplat"
version = "0.1.0"
classifiers = []
[tool.hatch.build.targets.sdist]
only-include = ["clsplat", "docs", "README.md"]
""",
    "CITATION.cff": "title: clsplat\nversion: 0.1.0\n",
    "packaging/conda/recipe.yaml": 'context:\n  version: "0.1.0"\n',
    "CHANGELOG.md": f"# Changelog\n\n## [Unreleased]\n\n{SECTION}",
    "README.md": "".join(release_checks.INSTALLS["README.md"].values()),
    "docs/install.md": "".join(release_checks.INSTALLS["docs/install.md"].values()),
    "docs/more/formats.md": "`pip install 'clsplat[photos]'`, or `pip install -e '.[dev]'` in a checkout\n",
    "clsplat/__init__.py": "# SPDX-License-Identifier: Apache-2.0\n",
    "REUSE.toml": """version = 1
[[annotations]]
path = ["*.md", "docs/**.md", "pyproject.toml"]
SPDX-License-Identifier = "Apache-2.0"
""",
}


def git(folder: Path, *arguments: str) -> None:
    author = ("-c", "user.name=A", "-c", "user.email=a@example.org")
    subprocess.run(["git", "-C", str(folder), *author, *arguments], check=True, capture_output=True)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A checkout of a few files that passes every check."""
    require("git")
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, "utf-8")
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", "--all")
    git(tmp_path, "commit", "--quiet", "--message", "all")
    git(tmp_path, "tag", "v0.1.0")
    return tmp_path


def failed(root: Path) -> dict[str, str]:
    """Problems by check."""
    return {each.title: each.problem for each in release_checks.findings(root) if each.problem}


def changed(root: Path, name: str, before: str, after: str) -> None:
    """Replace a text in a file, and commit and tag the result."""
    text = (root / name).read_text("utf-8")
    assert before in text
    (root / name).write_text(text.replace(before, after), "utf-8")
    git(root, "commit", "--all", "--quiet", "--message", "changed")
    git(root, "tag", "--force", "v0.1.0")


def test_a_commit_that_has_all_passes(checkout: Path) -> None:
    assert failed(checkout) == {}


@pytest.mark.parametrize(
    ("version", "title", "words"),
    [
        ("0.2.0", "version 0.2.0", "CITATION.cff: version 0.1.0, expected 0.2.0 as in pyproject.toml"),
        ("0.1", "version 0.1", "pyproject.toml: version '0.1', expected three numbers such as 0.1.0"),
        ("0.1.0.dev1", "version 0.1.0.dev1", "pyproject.toml: version '0.1.0.dev1', expected three numbers"),
    ],
)
def test_a_wrong_version_is_told(checkout: Path, version: str, title: str, words: str) -> None:
    changed(checkout, "pyproject.toml", '"0.1.0"', f'"{version}"')
    problems = failed(checkout)
    assert problems[title].startswith(words)
    assert problems[f"tag v{version}"] == f"tag v0.1.0 at this commit, but pyproject.toml has version {version}"


def test_a_recipe_of_another_version_is_told(checkout: Path) -> None:
    changed(checkout, "packaging/conda/recipe.yaml", "0.1.0", "0.0.9")
    message = "packaging/conda/recipe.yaml: version 0.0.9, expected 0.1.0 as in pyproject.toml"
    assert failed(checkout) == {"version 0.1.0": message}


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        (SECTION, "- Everything.\n", "no section [0.1.0] below [Unreleased]"),
        ("## [Unreleased]\n\n", "", "no section [0.1.0] below [Unreleased]"),
        (
            "[Unreleased]\n",
            "[Unreleased]\n\n## [0.2.0] - 2026-12-01\n",
            "the newest section is [0.2.0], expected [0.1.0]",
        ),
        (" - 2026-11-30", "", "the line of [0.1.0] ends in '', expected a date such as ' - 2026-11-30'"),
        ("### Added\n\n- Everything.\n", "", "the section [0.1.0] is empty, expected what changed"),
        ("[Unreleased]\n", "[Unreleased]\n\n- More.\n", "[Unreleased] has lines, which [0.1.0] would not list"),
    ],
)
def test_a_changelog_without_the_section_is_told(checkout: Path, before: str, after: str, words: str) -> None:
    changed(checkout, "CHANGELOG.md", before, after)
    (problem,) = failed(checkout).values()
    assert problem.startswith(f"CHANGELOG.md: {words}")


def test_a_dirty_tree_is_told(checkout: Path) -> None:
    (checkout / "clsplat/__init__.py").write_text("# SPDX-License-Identifier: Apache-2.0\nx = 1\n")
    for name in "abcdef":
        (checkout / f"{name}.txt").touch()
    names = "clsplat/__init__.py, a.txt, b.txt, c.txt, d.txt and 2 more"
    assert failed(checkout) == {"clean tree": f"{names}: not committed; commit or remove what differs"}


def test_a_commit_without_the_tag_is_told(checkout: Path) -> None:
    git(checkout, "tag", "--delete", "v0.1.0")
    message = "no tag at this commit, expected v0.1.0: git tag --annotate v0.1.0 --message 'clsplat 0.1.0'"
    assert failed(checkout) == {"tag v0.1.0": message}
    git(checkout, "tag", "v0.1.0")
    git(checkout, "tag", "v0.2.0")
    assert failed(checkout)["tag v0.1.0"].startswith("tag v0.2.0 at this commit, but")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x = 1\n", "clsplat/theirs.py: no licence; add a line SPDX-License-Identifier, or a row of REUSE.toml"),
        (
            "# SPDX-License-Identifier: GPL-3.0-only\n",
            "clsplat/theirs.py: licence GPL-3.0-only, expected one of Apache-2.0,",
        ),
        (
            "# SPDX-License-Identifier: MIT\n",
            "clsplat/theirs.py: licence MIT, whose text is missing; write it to LICENSES/",
        ),
    ],
)
def test_a_bundled_file_without_a_free_licence_is_told(checkout: Path, text: str, words: str) -> None:
    (checkout / "clsplat/theirs.py").write_text(text)
    (checkout / "theirs.bin").touch()  # not bundled
    git(checkout, "add", "--all")
    git(checkout, "commit", "--quiet", "--message", "theirs")
    git(checkout, "tag", "--force", "v0.1.0")
    (problem,) = failed(checkout).values()
    assert problem.startswith(words)


def test_a_row_of_reuse_states_a_licence(checkout: Path) -> None:
    row = '[[annotations]]\npath = ["clsplat/data/*.bin"]\nSPDX-License-Identifier = "CC0-1.0"\n'
    (checkout / "REUSE.toml").write_text(FILES["REUSE.toml"] + row)
    release_checks._annotations.cache_clear()
    for name in ("clsplat/data/a.bin", "clsplat/data/deeper/a.bin"):
        (checkout / name).parent.mkdir(parents=True, exist_ok=True)
        (checkout / name).write_bytes(b"\xff\x00")
    assert release_checks.licence_of(checkout, "clsplat/data/a.bin") == "CC0-1.0"
    assert release_checks.licence_of(checkout, "clsplat/data/deeper/a.bin") is None
    assert release_checks.licence_of(checkout, "docs/install.md") == "Apache-2.0"


def test_a_folder_without_git_ends_with_a_message(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=r"git status failed in .*expected a git checkout"):
        release_checks.tree_problem(tmp_path)


def test_prepare_writes_what_check_asks_for(checkout: Path) -> None:
    for name, lines in release_checks.INSTALLS.items():
        (checkout / name).write_text("".join(lines), "utf-8")
    page = checkout / "docs" / "more" / "formats.md"
    page.write_text(FILES["docs/more/formats.md"].replace("clsplat[", ".["), "utf-8")
    (checkout / "CHANGELOG.md").write_text("# Changelog\n\n## [Unreleased]\n\n### Added\n\n- Everything.\n")
    assert len(failed(checkout)) == 3  # and the tree
    names = release_checks.prepare(checkout, "2026-11-30")
    assert names == ["CHANGELOG.md", "CITATION.cff", "README.md", "docs/install.md", "docs/more/formats.md"]
    assert page.read_text() == FILES["docs/more/formats.md"]
    assert (checkout / "CHANGELOG.md").read_text() == FILES["CHANGELOG.md"]
    assert (checkout / "CITATION.cff").read_text() == "title: clsplat\nversion: 0.1.0\ndate-released: 2026-11-30\n"
    assert list(failed(checkout)) == ["clean tree"]
    assert release_checks.prepare(checkout, "2026-11-30") == []


@pytest.mark.parametrize(
    ("line", "released"),
    [
        (".venv/bin/pip install .", ".venv/bin/pip install clsplat"),
        ("`pip install .` there", "`pip install clsplat` there"),
        ("`pip install '.[view]'`, `'.[jax]'`", "`pip install 'clsplat[view]'`, `'clsplat[jax]'`"),
        ("pip install -e '.[docs,dev]'", "pip install -e '.[docs,dev]'"),
        ("pip install .venv/x.whl ./y.whl", "pip install .venv/x.whl ./y.whl"),
    ],
)
def test_lines_about_installing(line: str, released: str) -> None:
    assert release_checks.from_index("docs/library.md", f"{line}\n") == f"{released}\n"


def test_every_page_that_tells_how_to_install_is_prepared() -> None:
    """Afterwards only editable installs are of a checkout. CONTRIBUTING is about a checkout, and stays."""
    names = release_checks.pages(ROOT)
    texts = {name: (ROOT / name).read_text("utf-8") for name in names}
    released = {name: release_checks.from_index(name, text) for name, text in texts.items()}
    assert {"README.md", "docs/coming-from.md", "docs/gpus/devices.md"} <= set(names)
    assert "CONTRIBUTING.md" not in names
    if released["README.md"] != texts["README.md"]:  # before the first release
        changed = {name for name in names if released[name] != texts[name]}
        assert changed >= {"README.md", "docs/install.md", "docs/conventions.md", "docs/library.md", "docs/render.md"}
    for name, text in released.items():
        for line in text.splitlines():
            assert "-e '.[" in line or not ("'.[" in line or "pip install . " in f"{line} "), (name, line)
            assert not ("pip" in line and "checkout" in line), (name, line)


def test_this_checkout_can_be_prepared() -> None:
    """Every bundled file has a licence, and lines about installing are those of a checkout or those of a release."""
    require("git")
    if not (ROOT / ".git").exists():
        pytest.skip("not a git checkout, so that its files are not known")
    assert release_checks.version_problem(ROOT) == ""
    assert release_checks.licence_problem(ROOT) == ""
    for name, lines in release_checks.INSTALLS.items():
        text = (ROOT / name).read_text("utf-8")
        for before, after in lines.items():
            assert (before in text) != (after in text.replace(before, "")), (name, before)


def test_files_that_differ_from_gits_are_named(tmp_path: Path) -> None:
    sdist, wheel = tmp_path / "clsplat-0.1.0.tar.gz", tmp_path / "clsplat-0.1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for name in ("clsplat/a.py", "clsplat/kernels/a.cl", "clsplat-0.1.0.dist-info/METADATA"):
            archive.writestr(name, "")
    (tmp_path / "a.py").touch()
    with tarfile.open(sdist, "w:gz") as archive:
        archive.add(tmp_path / "a.py", "clsplat-0.1.0/clsplat/a.py")
    assert release_build.wheel_names(wheel) == {"clsplat/a.py", "clsplat/kernels/a.cl"}
    assert release_build.sdist_names(sdist) == {"clsplat/a.py"}
    assert release_build.differences("wheel", {"a", "b"}, {"a", "b"}) == []
    assert release_build.differences("wheel", {"a", "b"}, {"a", "c"}) == [
        "wheel: without c, which git has",
        "wheel: with b, which git does not have; remove what the build must not take",
    ]


@pytest.mark.parametrize("arguments", [[], ["--check", "--build"], ["--publish"], ["--build", "--python", "nothing"]])
def test_other_arguments_are_refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        release_command.main(arguments)
    assert ended.value.code == 2
    assert capsys.readouterr().err.startswith("usage: tools/release ")


def test_the_command_prints_a_line_a_check(
    checkout: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(release_command, "ROOT", checkout)
    assert release_command.main(["--check"]) == 0
    assert [line[:8] for line in capsys.readouterr().out.splitlines()] == ["ok      "] * 6
    git(checkout, "tag", "--delete", "v0.1.0")
    assert release_command.main(["--check"]) == 1
    assert (
        capsys.readouterr()
        .out.splitlines()[-1]
        .startswith("FAILED  tag v0.1.0: no tag at this commit, expected v0.1.0")
    )


def test_the_workflow_publishes_tags_without_a_password() -> None:
    yaml = pytest.importorskip("yaml", reason="the extra `test` brings it")
    text = (ROOT / ".github/workflows/release.yml").read_text("utf-8")
    workflow = yaml.safe_load(text)
    assert workflow[True]["push"] == {"tags": ["v*"]}  # YAML takes the key `on` for a truth value
    assert workflow["permissions"] == {"contents": "read"}
    jobs = workflow["jobs"]
    assert jobs["publish"]["permissions"] == {"contents": "read", "id-token": "write", "attestations": "write"}
    assert {name for name, job in jobs.items() if "permissions" in job} == {"publish"}
    assert set(jobs["publish"]["needs"]) == set(jobs) - {"publish"}
    used = [step["uses"] for job in jobs.values() for step in job["steps"] if "uses" in step]
    assert all(re.fullmatch(r"[\w/-]+@v\d+(\.\d+\.\d+)?", name) for name in used)
    assert [name.partition("@")[0] for name in used if not name.startswith(("actions/upload", "actions/download"))][
        -2:
    ] == [
        "actions/attest-build-provenance",
        "pypa/gh-action-pypi-publish",
    ]
    assert "secrets." not in text and "password" not in text.replace("without a password", "")
    commands = [step["run"] for step in jobs["build"]["steps"] if "run" in step]
    assert commands[:2] == ["tools/release --check", "tools/release --build"]
    drivers = jobs["images"]["strategy"]["matrix"]["driver"]
    assert sorted(drivers) == sorted(path.stem for path in (ROOT / "packaging/docker").glob("*.Dockerfile"))


def test_the_start_script_for_windows_parses() -> None:
    require("tree_sitter_powershell")
    import tree_sitter
    import tree_sitter_powershell as grammar

    parser = tree_sitter.Parser(tree_sitter.Language(grammar.language()))
    text = (ROOT / "packaging/windows/start.ps1").read_bytes()
    assert not parser.parse(text).root_node.has_error
    assert parser.parse(text.replace(b"function Find-Python {", b"function Find-Python")).root_node.has_error
    assert text.isascii()  # Windows PowerShell reads scripts without a mark in the system's code page
