# SPDX-License-Identifier: Apache-2.0
"""Flags: the groups of --help, near names for wrong ones, and errors as JSON."""

from __future__ import annotations

import json
import re
from dataclasses import fields
from pathlib import Path

import pytest
import tyro
from calls import Capture, error_line, printed, raising, rejected
from models import random_gaussians

from clsplat.cli.flags import OTHER_FLAGS_TITLE, grouped_help, near, options
from clsplat.cli.main import main
from clsplat.cli.parsing import VERBS, _text_rules, verb_class
from clsplat.cli.render.flags import RenderVerb
from clsplat.cli.render.help_page import MOST_NEEDED_FLAGS, RENDER_GROUPS
from clsplat.config.pictures import SamplingConfig

FLAG = re.compile(r"(?<![\w-])--[a-z][\w.-]*")
CALL = ["render", "model.ply", "-o", "x.png"]


def section(text: str, title: str) -> list[str]:
    """The flags below a title of a help, in their order."""
    part = text.split(f"\n{title}:\n", 1)[1].split("\n\n", 1)[0]
    heads = [line.split() for line in part.splitlines() if re.match(r"  \S", line)]
    return [words[1] if words[0].endswith(",") else words[0] for words in heads]


def render_help(capsys: Capture, monkeypatch: pytest.MonkeyPatch, width: int = 80) -> str:
    monkeypatch.setenv("COLUMNS", str(width))
    return str(printed(capsys, ["render", "--help"]).out)


@pytest.mark.filterwarnings("ignore:get_parser:DeprecationWarning")
@pytest.mark.parametrize("verb", VERBS)
def test_the_flags_are_those_that_the_parser_takes(verb: str) -> None:
    """Each of them, with a text."""
    kind = verb_class(verb)
    with _text_rules():
        parser = tyro.extras.get_parser(kind)
    theirs = {name for action in parser._actions for name in action.option_strings}
    every = list(options(kind))
    ours = {name for option in every for name in (*option.names, option.off) if name}
    assert theirs - {"-h", "--help", "-H", "--help-verbose"} == ours
    assert [option.key for option in every if not option.text] == []


def test_the_groups_have_every_flag_once(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    text = render_help(capsys, monkeypatch)
    titles = [title for title, _ in RENDER_GROUPS]
    assert f"\n{OTHER_FLAGS_TITLE}:\n" not in text, "a flag is in no group of render_help"
    found = [flag for title in titles for flag in section(text, title)]
    assert sorted(found) == sorted((option.names or (option.metavar,))[-1] for option in options(RenderVerb))
    assert len(set(found)) == len(found) > 60
    assert max(len(section(text, title)) for title in titles[1:]) <= 8
    assert max(map(len, text.splitlines())) <= 80
    assert "{None}" not in text
    assert "(default: None)" not in text


def test_the_twelve_come_first(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    text = render_help(capsys, monkeypatch)
    assert section(text, "Needed most") == ["RUN|MODEL", *(f"--{name}" for name in MOST_NEEDED_FLAGS)]
    assert len(MOST_NEEDED_FLAGS) == 12
    assert text.startswith("usage: clsplat render RUN|MODEL -o PATTERN [OPTIONS]\n\nRender a model from the cameras")
    lines = text.splitlines()
    for word in ("width", "frames", "channels", "colorspace", "shutter-angle"):  # on the first two pages of 40 lines
        assert any(line.startswith(f"  --{word}") for line in lines[:80]), word
    for title in ("Resolution and framing", "Channels", "Colour space", "Motion blur", "Depth of field", "Stereo"):
        assert any(line.startswith(title) for line in lines), title


def test_what_is_said_is_the_fields_docstring_and_default(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    wide = " ".join(render_help(capsys, monkeypatch, 100).split())
    for part in (
        f"More are smoother, and take proportionally longer. (default: {SamplingConfig().samples})",
        "--shutter-open FLOAT Time at which the shutter opens, in frames before (-) or after the",
        "--eye both|left|right Eyes of --stereo to render. One eye alone is useful for a video",
        "--rasterizer.transmittance-min FLOAT Stop at a pixel before the Gaussian that would reduce",
        "-o, --output PATTERN File names of the images",
    ):
        assert part in wide
    assert {field.name.replace("_", "-") for field in fields(SamplingConfig)} <= {
        option.key for option in options(RenderVerb)
    }


def test_a_flag_of_no_group_is_among_others() -> None:
    text = grouped_help(RenderVerb, "clsplat render", (("First", ("output", "video.*")),), 80)
    assert section(text, "First")[0] == "--output"
    assert {"--video.fps", "--video.crf"} <= set(section(text, "First"))
    assert {"--cameras", "--samples"} <= set(section(text, OTHER_FLAGS_TITLE))


NO_NUMBER = "could not convert string to float"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([*CALL, "--shutter-angel", "180"], "--shutter-angel is not a flag, did you mean --shutter-angle?"),
        ([*CALL, "--shutter-angel=180"], "--shutter-angel is not a flag, did you mean --shutter-angle?"),
        ([*CALL, "--colourspace", "ACEScg"], "--colourspace is not a flag, did you mean --colorspace?"),
        ([*CALL, "--colour_space", "ACEScg"], "--colour_space is not a flag, did you mean --colorspace?"),
        ([*CALL, "--fps", "25"], "--fps is not a flag, did you mean --video.fps?"),
        ([*CALL, "--shutter", "180"], "--shutter is not a flag, did you mean --shutter-angle?"),
        (
            [*CALL, "--Frames", "1", "--over-scan", "5"],
            "--Frames is not a flag, did you mean --frames? --over-scan is not a flag, did you mean --overscan?",
        ),
        ([*CALL, "--frobnicate"], "--frobnicate is not a flag, expected one of clsplat render --help"),
        # a wrong name of what is needed is said before what is missing
        (["render", "model.ply", "--ouput", "x.png"], "--ouput is not a flag, did you mean --output?"),
        (
            ["train", "S", "-o", "R", "--densty.split-factor", "2"],
            "--densty.split-factor is not a flag, did you mean --density.split-factor?",
        ),
        (["rendr", "x"], "rendr is not a verb, did you mean render?"),
        (["vew", "x"], "vew is not a verb, did you mean view?"),
        (["Train", "x"], "Train is not a verb, did you mean train?"),
        (["nonsense", "x"], "Unrecognized options: nonsense, x"),
        ([*CALL, "--f-stop", "2,8"], f"Error parsing --f-stop: {NO_NUMBER}: '2,8'"),
        (["convert", "a.ply", "b.ply", "--scale", "1,2,1"], f"Error parsing --scale: {NO_NUMBER}: '1,2,1'"),
    ],
)
def test_a_word_that_is_nearly_right_gets_its_name(words: list[str], said: str, capsys: Capture) -> None:
    assert rejected(capsys, words) == f"clsplat: error: {said}"


def test_no_name_is_made_up() -> None:
    known = ["--frames", "--scale", "--video.fps", "--up"]
    assert [near(word, known) for word in ("--scal", "--fps", "--upp", "--x", "--resolution")] == [
        "--scale", "--video.fps", "--up", "", "",
    ]  # fmt: skip


def test_a_number_that_is_none_is_said_in_few_words(capsys: Capture) -> None:
    assert main([*CALL, "--f-stop", "2,8"]) == 2
    assert error_line(capsys) == "clsplat: error: Error parsing --f-stop: could not convert string to float: '2,8'"
    assert main(["convert", "a.ply", "b.ply", "--scale", "1,2,1"]) == 2
    assert error_line(capsys) == "clsplat: error: Error parsing --scale: could not convert string to float: '1,2,1'"


@pytest.mark.parametrize(
    ("steps", "found"), [("scale=1,2,1", "1,2,1"), ("scale=", ""), ("rotate=0,90,0 scale=2,2", "2,2")]
)
def test_one_scale_is_one_number(steps: str, found: str, tmp_path: Path, capsys: Capture) -> None:
    random_gaussians(5).save(tmp_path / "model.ply")
    call = f"render {tmp_path}/model.ply -o x.png --path turntable --dry-run --transform"
    assert main([*call.split(), steps]) == 2
    wanted = f"expected one number, the same scale in all directions, found '{found}'"
    assert error_line(capsys) == f"clsplat: error: --transform {steps}: {wanted}"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([*CALL, "--json"], "model.ply: no such"),
        ([*CALL, "--json", "--shutter-angel", "1"], "--shutter-angel is not a flag, did you mean --shutter-angle?"),
        (["convert", "nowhere.ply", "b.ply", "--json"], "nowhere.ply: no such"),
        (["report", "nowhere", "--json"], "nowhere"),
        (["view", "nowhere.ply", "--json"], "--json is not a flag"),
        (["eval", "--json", "--test-every"], "--test-every"),
    ],
)
def test_an_error_is_json_where_json_is_asked_for(
    words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.chdir(tmp_path)
    words = [*words, "--path", "turntable"] if words[0] == "render" else words
    captured = printed(capsys, words, status=2)
    said = json.loads(captured.out)
    assert said["status"] == 2
    assert message in said["error"]
    assert captured.err == f"clsplat: error: {said['error']}\n"
    assert main([word for word in words if word != "--json"]) in (1, 2)
    assert capsys.readouterr().out == ""


def test_work_that_failed_or_was_interrupted_is_json_too(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    for error, status, said in (
        (MemoryError("1 GiB"), 1, "there is not enough main memory: 1 GiB"),
        (OSError(28, "No space left on device", "a.png"), 1, "a.png"),
        (KeyboardInterrupt("after 3 of 9 frames"), 130, "interrupted after 3 of 9 frames"),
    ):
        monkeypatch.setattr("clsplat.cli.devices.run", raising(error))
        found = json.loads(printed(capsys, ["devices", "--json"], status=status).out)
        assert found["status"] == status
        assert said in found["error"]
        assert printed(capsys, ["devices"], status=status).out == ""
