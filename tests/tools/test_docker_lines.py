# SPDX-License-Identifier: Apache-2.0
"""The Docker files, as `docker_lines.py` reads them. To run their lines in Debian roots takes minutes: no test does."""

from __future__ import annotations

import re
from pathlib import Path

import docker_lines
import pytest
from docker_lines import Image, Line, base_of, lines_of

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "packaging/docker"
IMAGES = sorted(FOLDER.glob("*.Dockerfile"))


def test_lines_are_joined_and_comments_left_out() -> None:
    text = "# a\nFROM debian:trixie\n\nRUN one \\\n    # between\n    && two\nENV A=1\n"
    assert list(lines_of(text)) == [
        Line(2, "FROM", "debian:trixie"),
        Line(4, "RUN", "one && two"),
        Line(7, "ENV", "A=1"),
    ]


@pytest.mark.parametrize("path", IMAGES, ids=lambda path: path.stem)
def test_an_image_installs_the_wheel_and_is_checked_by_doctor(path: Path) -> None:
    assert base_of(path) in {"bookworm", "trixie"}
    lines = list(lines_of(path.read_text("utf-8")))
    runs = [line.text for line in lines if line.keyword == "RUN"]
    assert runs[-1] == "clsplat doctor"
    assert [line.text for line in lines if line.keyword == "COPY"] == ["dist/clsplat-*.whl /tmp/"]
    assert [line.text for line in lines[-2:]] == ['["clsplat"]', '["doctor"]']
    assert f"-f {path.relative_to(ROOT)} -t clsplat:{path.stem} ." in path.read_text("utf-8")


def test_there_is_an_image_for_each_kind_of_driver() -> None:
    assert [path.stem for path in IMAGES] == ["amd", "cpu", "intel", "nvidia"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("FROM debian:trixie\nADD a b\n", r"a\.Dockerfile:2: ADD, expected one of CMD, COPY, ENTRYPOINT"),
        ("FROM alpine\n", r"a\.Dockerfile: the first line is not FROM debian:RELEASE"),
        ("", r"a\.Dockerfile: the first line is not FROM debian:RELEASE"),
    ],
)
def test_a_file_of_another_kind_is_refused(
    tmp_path: Path, text: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.Dockerfile"
    path.write_text(text)
    for name, message in ((path, words), (tmp_path / "none", r"none: no such file, expected a Docker file")):
        with pytest.raises(SystemExit) as ended:
            docker_lines.main([str(name)])
        assert ended.value.code == 2 and re.search(message, capsys.readouterr().err)


def test_lines_change_the_image(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = Image(tmp_path / "root")
    (image.folder / "tmp").mkdir(parents=True)
    (tmp_path / "dist").mkdir()
    (tmp_path / "dist/clsplat-1-any.whl").write_text("wheel")
    steps = ['ENV PATH=/opt/bin:$PATH KIND="a b"', "WORKDIR /work", 'ENTRYPOINT ["clsplat"]', 'CMD ["doctor"]']
    for text in (*steps, "COPY dist/clsplat-*.whl /tmp/"):
        (line,) = lines_of(text)
        assert docker_lines._step(image, line, tmp_path)
    assert image.variables["PATH"] == f"/opt/bin:{docker_lines.PATHS}" and image.variables["KIND"] == "a b"
    assert (image.working, image.entrypoint, image.command) == ("/work", ["clsplat"], ["doctor"])
    assert (image.folder / "work").is_dir() and (image.folder / "tmp/clsplat-1-any.whl").read_text() == "wheel"
    assert not docker_lines._step(image, Line(1, "COPY", "dist/nothing.whl /tmp/"), tmp_path)
    assert "no file dist/nothing.whl; tools/release --build makes dist/" in capsys.readouterr().err
