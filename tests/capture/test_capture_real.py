# SPDX-License-Identifier: Apache-2.0
"""A capture with real structure from motion: interrupted while cameras are found, it ends with the same model."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from calls import Capture, printed

from clsplat.capture.progress import CaptureProgress
from clsplat.cli.main import main
from clsplat.demo.ray_caster import write_photos


@pytest.mark.slow
def test_ctrl_c_while_cameras_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    photos = tmp_path / "photos"
    write_photos(photos, count=12, width=320, height=240)

    def call(name: str) -> list[str]:
        return ["capture", str(photos), "-o", str(tmp_path / name), "--iterations", "30"]

    printed(capsys, call("undisturbed"))
    real = CaptureProgress.__call__

    def report(self: CaptureProgress, text: str, fraction: float | None = None, detail: str = "") -> None:
        real(self, text, fraction, detail)
        if text.startswith("matching"):
            signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(CaptureProgress, "__call__", report)
        assert main(call("stopped")) == 130
    assert "interrupted in the stage cameras; go on with: " in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "stopped").iterdir()] == ["capture.json"]
    printed(capsys, call("stopped"))
    models = [(tmp_path / name / "run" / "model.ply").read_bytes() for name in ("undisturbed", "stopped")]
    assert models[0] == models[1]
