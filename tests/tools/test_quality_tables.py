# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/quality.md: finished rows are kept, others go on; half of the better one's Gaussians."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from calls import Capture, ran, refuses
from quality import tables
from quality.kept_rows import Kept, Same, bare_python, code_digest
from quality.run import main as quality
from quality.run import parser_of
from quality.tables import ROOT, Book, Row

KEPT = ROOT / "docs" / "quality-rows.json"


class FakeClsplat:
    """The command, which writes what a training would; the first `ends` calls of `train` are interrupted."""

    def __init__(self, ends: int = 0) -> None:
        self.calls: list[tuple[str, ...]] = []
        self.seeds: dict[Path, int] = {}
        self.ends = ends

    def __call__(self, *arguments: str) -> str:
        self.calls.append(arguments)
        if arguments[0] == "eval":
            return json.dumps({"mean": {"psnr": 20.0 + int(arguments[3])}})
        run = Path(arguments[3])
        assert ("--resume" in arguments) == (run in self.seeds), "a run that is there goes on"
        if "--resume" in arguments:
            assert "--schedule" not in arguments, "the run has its settings"
        else:
            self.seeds[run] = int(arguments[arguments.index("--seed") + 1])
        run.mkdir(parents=True, exist_ok=True)
        (run / "config.toml").write_text("")
        if self.ends:
            self.ends -= 1
            raise SystemExit("interrupted")
        psnr = 31.0 if "short" in run.name else 30.0
        count = (1000 if "short" in run.name else 500) + 10 * self.seeds[run]
        told = {"mean": {"psnr": psnr, "ssim": 0.9}, "gaussians": count, "seconds": 7.0}
        (run / "eval.json").write_text(json.dumps(told))
        session = {"device": "a device", "driver": "a driver 1.0  and its parts"}
        (run / "metrics.jsonl").write_text(json.dumps({"step": 1, "session": session}) + "\n")
        return ""


ENDS = [Row("fox default", "fox"), Row("fox short", "fox", ("--schedule", "short"))]
HALF = Row("fox mcmc", "fox", half_of=("fox default", "fox short"))


def book_at(folder: Path, seeds: int, work: str = "work") -> Book:
    return Book(folder, folder / work, seeds, 40, 0, Kept(folder / "rows.json"))


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeClsplat:
    """In place of the command line."""
    made = FakeClsplat()
    monkeypatch.setattr(tables, "_clsplat", made)
    return made


def test_a_finished_row_is_kept_for_other_folders(tmp_path: Path, fake: FakeClsplat) -> None:
    found = [book_at(tmp_path, 2, work).results("growth", ENDS[0], ENDS) for work in ("work", "elsewhere")]
    assert [call[0] for call in fake.calls] == ["train", "train"]
    assert found[0] == found[1]
    assert (found[0][0].psnr, found[0][0].gaussians, found[0][0].device) == (30.0, 500, "a device, a driver 1.0")


@pytest.mark.parametrize("change", ["code", "settings", "iterations", "seed"])
def test_rows_of_other_code_or_settings_are_made_anew(
    change: str, tmp_path: Path, fake: FakeClsplat, monkeypatch: pytest.MonkeyPatch
) -> None:
    book_at(tmp_path, 1).results("growth", ENDS[0], ENDS)
    book, row = book_at(tmp_path, 2 if change == "seed" else 1), ENDS[0]
    if change == "code":
        monkeypatch.setattr(tables, "code_digest", lambda root, *, mcmc: "another")
    if change == "settings":
        row = replace(row, settings=("--schedule", "short"))
    if change == "iterations":
        book.iterations = 41
    book.results("growth", row, ENDS)
    assert len(fake.calls) == 2


def test_a_statement_that_bytes_are_the_same(
    tmp_path: Path, fake: FakeClsplat, monkeypatch: pytest.MonkeyPatch
) -> None:
    where = ["--kept", str(tmp_path / "rows.json"), "--why", "compared"]
    for code in ("first", "second", "third"):
        monkeypatch.setattr(tables, "code_digest", lambda root, *, mcmc, code=code: code)
        if code == "second":
            assert tables.run(["--same-as", "first", *where]) == 0
        if code == "third":
            Kept(tmp_path / "rows.json").say_same(Same("third", "second", "compared"))
        book_at(tmp_path, 1).results("growth", ENDS[0], ENDS)
    assert len(fake.calls) == 1
    refuses(r"rows\.json has this digest$", tables.run, ["--same-as", "fourth", *where])


def test_the_digest_is_of_code_alone(tmp_path: Path) -> None:
    def digests(python: str, kernel: str, mcmc: str = "a = 1\n") -> tuple[str, str]:
        root = tmp_path / str(len(list(tmp_path.iterdir())))
        for name, text in (
            ("kernels/blend.cl", kernel),
            ("clsplat/config/training.py", python),
            ("clsplat/training/density/mcmc.py", mcmc),
        ):
            (root / name).parent.mkdir(parents=True)
            (root / name).write_text(text)
        return code_digest(root, mcmc=False), code_digest(root, mcmc=True)

    plain, kernel = "class A:\n    rate: float = 1.0\n", "float a = 1;\n"
    first = digests(plain, kernel)
    words = 'class A:\n    """Words."""\n\n    rate: float = 1.0  # one\n    """A rate."""\n'
    assert digests(words, "float a = /* 1 */\n  1; // one\n") == first
    assert digests(plain.replace("1", "2"), kernel)[0] != first[0]
    assert digests(plain, kernel.replace("1", "2"))[0] != first[0]
    other = digests(plain, kernel, "a = 2\n")
    assert other[0] == first[0]
    assert other[1] != first[1]


def test_bare_python_is_text_as_it_was_written() -> None:
    """Versions of Python differ in how `ast.unparse` writes a string in a string."""
    text = """'''Words.'''\nname = f'{"ä"}'  # one\n\n\ndef f():\n    "More."; return f"{name!r:>{8}}"  # two\n"""
    assert bare_python(text) == """name = f'{"ä"}'\ndef f():\n; return f"{name!r:>{8}}\""""
    assert bare_python('a = """b\n\n  # c\n"""\n\n  # d\n') == 'a = """b\n\n  # c\n"""', "a string is as it is"


def test_rows_that_are_committed_can_be_read() -> None:
    told = json.loads(KEPT.read_text("utf-8"))
    assert told["rows"]
    known = {row.name for rows in tables.TRAININGS.values() for row in rows()}
    assert {row["row"] for row in told["rows"]} <= known
    assert not Kept(KEPT).has("of no code", mcmc=True)


def test_a_broken_file_is_told(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "rows.json").write_text('{"rows": [{"row": "fox"}], "same": []}')
    given = ["--same-as", "first", "--why", "compared", "--kept", str(tmp_path / "rows.json")]
    assert ran(capsys, quality, ["tables", *given], status=2).err.count("\n") == 1
    refuses(r"rows\.json: .*expected rows as tables.py writes them", Kept(tmp_path / "rows.json").has, "x", mcmc=False)


def test_an_interrupted_row_goes_on(tmp_path: Path, fake: FakeClsplat) -> None:
    fake.ends = 1
    book = book_at(tmp_path, 1)
    with pytest.raises(SystemExit):
        book.results("growth", ENDS[1], ENDS)
    book.results("growth", ENDS[1], ENDS)
    assert ["--resume" in call for call in fake.calls] == [False, True]


def test_half_of_the_better_ones_gaussians(tmp_path: Path, fake: FakeClsplat) -> None:
    book_at(tmp_path, 2).results("growth", HALF, [*ENDS, HALF])
    assert [call[call.index("--density.max-gaussians") + 1] for call in fake.calls[-2:]] == ["500", "505"]


def test_sizes_are_measured(tmp_path: Path, fake: FakeClsplat) -> None:
    row = Row("lego", "lego", sizes=(4, 2))
    found = book_at(tmp_path, 1).results("antialiasing", row, [row])
    ends = "500 | 7 | a device, a driver 1.0 | 24.00 | 22.00 | 23.00 |"
    assert tables.line(row, found) == f"| lego | 30.00 | 0.00 | 0.9000 | {ends}"
    assert tables.header([row]).splitlines()[0].endswith("| seconds | on | 4 | 2 | mean |")


def test_a_table_that_is_not_known(tmp_path: Path, capsys: Capture) -> None:
    said = ran(capsys, quality, ["tables", str(tmp_path), "-o", str(tmp_path), "--only", "grwth"], status=2).err
    assert said.startswith("quality tables: error: --only grwth: no such table, expected some of growth")


def test_a_scene_that_is_missing_is_said(tmp_path: Path, capsys: Capture) -> None:
    where = [str(tmp_path), "-o", str(tmp_path / "work"), "--only", "antialiasing", "--list"]
    assert "lego is left out: no " in ran(capsys, tables.run, where).err


def test_only_the_rows_that_are_asked_for(tmp_path: Path, fake: FakeClsplat, capsys: Capture) -> None:
    for scene in tables.SCENES:
        (tmp_path / scene).mkdir()
    where = [str(tmp_path), "-o", str(tmp_path / "work"), "--only", "growth", "--seeds", "1"]
    where += ["--kept", str(tmp_path / "rows.json")]
    said = ran(capsys, tables.run, [*where, "--rows", "fox mcmc,bonsai mcmc ???k"]).out
    rows = [line.split(" | ")[0] for line in said.splitlines()[4:] if line]
    assert rows == ["| fox mcmc", "| bonsai mcmc 290k"]
    trained = {row["row"] for row in json.loads((tmp_path / "rows.json").read_text())["rows"]}
    assert trained == {"fox default", "fox short", "fox mcmc", "bonsai mcmc 290k"}  # and what they are half of
    assert tables.run([*where, "--rows", "sceaux_castle mcmc paper", "--iterations", "700"]) == 0
    rows = json.loads((tmp_path / "rows.json").read_text())["rows"]
    (settings,) = (row["settings"] for row in rows if row["row"] == "sceaux_castle mcmc paper")
    assert settings[settings.index("--density.stop") + 1] == "500"
    refuses(r"--rows fax \*: no such row; --list prints them$", tables.run, [*where, "--rows", "fax *"])


def test_experiments_take_the_words_of_their_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commands: list[list[str]] = []

    def run(command: Sequence[str]) -> str:
        commands.append([str(word) for word in command[1:]])
        return "a table\n"

    monkeypatch.setattr(tables, "_run", run)
    book = book_at(tmp_path, 2)
    for table, words in tables.EXPERIMENTS.items():
        assert book.printed(table) == (
            "a table\n" if "--seeds" in words else "Seed 0\n\na table\n\nSeed 1\n\na table\n"
        )
    seeds = [words[-1] for words in commands if words[-2] == "--seed"]
    assert seeds == ["0", "1"] * sum("--seeds" not in words for words in tables.EXPERIMENTS.values())
    given = [parser_of(name).parse_args(words) for _, name, *words in commands]
    folders = {each.folder for each in given}
    assert len(folders) == len(commands), "two tables would take each other's runs"
    assert all(folder.is_relative_to(book.folder) for folder in folders)
    assert all("a table\n" in book.printed(table) for table in tables.EXPERIMENTS)
    assert len(commands) == len(folders), "a table that is there is not made again"
