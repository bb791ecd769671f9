# SPDX-License-Identifier: Apache-2.0
"""Videos of `clsplat render`: what is in them, how they are replaced, and their frame rate."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from calls import Capture, error_line, fails, ran
from rendered import contents, render_shot
from systems import can_link
from tiny import HEIGHT


@pytest.mark.slow
@pytest.mark.needs("av")
def test_video(shot: list[str], tmp_path: Path, capsys: Capture) -> None:
    import av

    small = tmp_path / "small.mp4"
    flags = "--video.fps 12 --video.crf 10 --video.preset fast --count 9 --path through --json"
    records = json.loads(ran(capsys, render_shot, shot, tmp_path, flags, "a.mp4").out)
    assert [record["frame"] for record in records] == list(range(1, 10))
    assert {record["path"] for record in records} == {str(tmp_path / "a.mp4")}
    assert render_shot(shot, tmp_path, flags.replace("crf 10", "crf 45"), small.name) == 0
    assert small.stat().st_size < (tmp_path / "a.mp4").stat().st_size
    assert render_shot(shot, tmp_path, f"{flags} --device all", "all.mp4") == 0
    assert (tmp_path / "all.mp4").read_bytes() == (tmp_path / "a.mp4").read_bytes()
    assert sorted(contents(tmp_path)) == ["a.mp4", "all.mp4", "small.mp4"]
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        frames = [frame.to_ndarray() for frame in container.decode(stream)]
    assert (stream.average_rate, len(frames)) == (12, 9)
    assert render_shot(shot, tmp_path, "--path through --count 9", "####.exr") == 0
    for index, frame in enumerate(frames, 1):  # in their order: each is nearest to its own
        means = [oiio.ImageBuf(str(tmp_path / f"{at:04d}.exr")).get_pixels(oiio.FLOAT) for at in (index, 10 - index)]
        lumas = [16 + 219 * np.clip(image, 0, 1) @ [0.2126, 0.7152, 0.0722] for image in means]
        errors = [np.abs(frame[:HEIGHT] - luma).mean() for luma in lumas]
        assert index == 5 or errors[0] < errors[1]


@pytest.mark.needs("av")
@pytest.mark.parametrize(("name", "flags"), [("a.mp4", "--video.crf 10"), ("a.mov", "--video.prores 4444 --alpha")])
def test_a_video_says_how_it_was_made(name: str, flags: str, shot: list[str], tmp_path: Path, capsys: Capture) -> None:
    video = tmp_path / name
    assert render_shot(shot, tmp_path, flags, name) == 0
    stamp, whole = video.stat().st_mtime_ns, video.read_bytes()
    captured = ran(capsys, render_shot, shot, tmp_path, f"{flags} --skip-existing --json", name)
    assert captured.err == ""
    assert all(record["skipped"] for record in json.loads(captured.out))
    assert video.stat().st_mtime_ns == stamp
    for change, content in (("--frames 1-3", whole), ("--region 0,0,8,8", whole), ("", whole[: len(whole) * 2 // 3])):
        video.write_bytes(content)
        assert render_shot(shot, tmp_path, f"{flags} --skip-existing {change}", name) == 0
        assert (
            f"--skip-existing: {video} is incomplete, or was rendered from another model or" in capsys.readouterr().err
        )
    assert video.read_bytes() == whole
    video.write_bytes(b"precious")
    assert "exists already" in fails(capsys, render_shot, shot, tmp_path, f"{flags} --skip-existing", name)
    assert video.read_bytes() == b"precious"


@pytest.mark.needs("av")
@pytest.mark.parametrize("kind", ["file", "link"])
def test_a_video_that_is_there_is_replaced_only_if_asked(
    kind: str, shot: list[str], tmp_path: Path, capsys: Capture
) -> None:
    video, target = tmp_path / "a.mp4", tmp_path / "real.mp4"
    if kind == "file":
        video.write_bytes(b"precious")
    elif can_link():
        video.symlink_to(target)
    else:
        pytest.skip("this user may not make symbolic links")
    assert render_shot(shot, tmp_path, "", "a.mp4") == 2
    said = f"clsplat: error: {video}: exists already; name another file, or give --overwrite to replace it\n"
    assert capsys.readouterr().err == said
    assert not target.exists() and (kind == "link" or video.read_bytes() == b"precious")
    assert render_shot(shot, tmp_path, "--dry-run", "a.mp4") == 0, "which writes nothing"
    assert render_shot(shot, tmp_path, "--overwrite", "a.mp4") == 0
    assert video.read_bytes()[4:8] == b"ftyp"


@pytest.mark.needs("av")
def test_a_video_has_the_rate_of_its_cameras(shot: list[str], tmp_path: Path, capsys: Capture) -> None:
    import av

    document = json.loads(Path(shot[2]).read_text())
    (tmp_path / "cameras.json").write_text(json.dumps({**document, "fps": 29.97}))
    own = [*shot[:2], str(tmp_path / "cameras.json")]
    for name, flags, rate in (("own", "", "30000/1001"), ("asked", "--video.fps 25", "25")):
        assert render_shot(own, tmp_path, flags, f"{name}.mp4") == 0
        with av.open(str(tmp_path / f"{name}.mp4")) as container:
            assert str(container.streams.video[0].average_rate) == rate
        capsys.readouterr()
        assert render_shot(own, tmp_path, f"{flags} --dry-run", f"{name}.mp4") == 0
        assert f"video     {rate} frames a second" in capsys.readouterr().out
    (tmp_path / "cameras.json").write_text(json.dumps({**document, "fps": 1e9}))
    assert render_shot(own, tmp_path, "", "fast.mp4") == 2
    assert "has 1e+09 frames a second, expected 0.01 to 1000; give --video.fps" in error_line(capsys)
    assert render_shot(own, tmp_path, "--frames 1", "fast.exr") == 0, "which has no rate"
