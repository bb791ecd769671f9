# SPDX-License-Identifier: Apache-2.0
"""The weights of LPIPS: looked for, fetched with a limit, never on standard output; what is missing is told once."""

from __future__ import annotations

import hashlib
import json
import sys
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from calls import Capture, ran, refuses
from calls import train as command_train
from tiny import short

from clsplat.errors import ClsplatError
from clsplat.evaluation import held_out, lpips_weights, metrics

BODY = b"the weights" * 1000
NAME = f"vgg16-{hashlib.sha256(BODY).hexdigest()[:8]}.pth"


class Answer(BaseHTTPRequestHandler):
    """What the address says how: whole, other bytes, or nothing at all, as a silent proxy."""

    def do_GET(self) -> None:
        if "/silent/" in self.path:
            time.sleep(3)
            return
        body = BODY if "/whole/" in self.path else b"<html>log in first</html>"
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:  # type: ignore[override]
        """Says nothing."""


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.delenv(lpips_weights.LPIPS_TIMEOUT_VARIABLE, raising=False)
    metrics.prepare_lpips.cache_clear()
    metrics._lpips_model.cache_clear()
    found = ThreadingHTTPServer(("127.0.0.1", 0), Answer)
    threading.Thread(target=found.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{found.server_port}"
    found.shutdown()
    found.server_close()
    metrics.prepare_lpips.cache_clear()
    metrics._lpips_model.cache_clear()


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The extra, by stand-ins that talk on standard output."""

    class Network:
        def __init__(self, **_: object) -> None:
            print("Setting up")

        def eval(self) -> Network:
            return self

    monkeypatch.setattr(metrics, "find_spec", lambda _name: object())
    stand_in = ModuleType("lpips")
    stand_in.LPIPS = Network  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "lpips", stand_in)
    torch = ModuleType("torch")
    torch.device = type("device", (), {})  # type: ignore[attr-defined]  # tyro looks for it
    torch.Tensor = type("Tensor", (), {})  # type: ignore[attr-defined]  # scipy looks for it
    monkeypatch.setitem(sys.modules, "torch", torch)


def test_they_are_fetched_once(server: str, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    monkeypatch.setattr(lpips_weights, "VGG16_WEIGHTS_URL", f"{server}/whole/{NAME}")
    lpips_weights.fetch()
    assert lpips_weights.place().read_bytes() == BODY
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "downloading VGG-16's weights for LPIPS, for 300 s at most (CLSPLAT_LPIPS_TIMEOUT)" in captured.err
    monkeypatch.setattr(lpips_weights, "VGG16_WEIGHTS_URL", f"http://127.0.0.1:9/{NAME}")
    lpips_weights.fetch()
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("seconds", ["0.3", "0"])
def test_a_silent_server_has_a_limit(seconds: str, server: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lpips_weights, "VGG16_WEIGHTS_URL", f"{server}/silent/{NAME}")
    monkeypatch.setenv(lpips_weights.LPIPS_TIMEOUT_VARIABLE, seconds)
    start = time.monotonic()
    said = refuses(
        f"curl --create-dirs -o {lpips_weights.place()} {server}/silent/{NAME}", lpips_weights.fetch, error=ClsplatError
    )
    assert time.monotonic() - start < 2
    assert ("did not arrive in 0.3 s" in said) == (seconds != "0")


def test_a_page_in_their_place_is_not_kept(server: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lpips_weights, "VGG16_WEIGHTS_URL", f"{server}/other/{NAME}")
    refuses(r"could not be downloaded \(the SHA-256 of the download", lpips_weights.fetch, error=ClsplatError)
    assert not list(lpips_weights.place().parent.iterdir())


def test_a_limit_that_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    for text in ("soon", "-1", "nan", "inf"):
        monkeypatch.setenv(lpips_weights.LPIPS_TIMEOUT_VARIABLE, text)
        refuses(
            f"{lpips_weights.LPIPS_TIMEOUT_VARIABLE} is '{text}', expected a number of seconds", lpips_weights.limit
        )


@pytest.mark.usefixtures("installed")
def test_nothing_is_on_standard_output(server: str, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    monkeypatch.setattr(lpips_weights, "VGG16_WEIGHTS_URL", f"{server}/whole/{NAME}")
    assert metrics.lpips_missing() is None
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "Setting up" in captured.err


@pytest.mark.usefixtures("installed")
def test_train_says_once_what_is_missing(
    server: str, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.setattr(lpips_weights, "VGG16_WEIGHTS_URL", f"{server}/silent/{NAME}")
    monkeypatch.setenv(lpips_weights.LPIPS_TIMEOUT_VARIABLE, "0.2")
    config = short(iterations=2, eval_at=(1,), report=False, density={"every": 0})
    captured = ran(capsys, command_train, scene, tmp_path / "run", config, "--json")
    told = [line for line in captured.err.splitlines() if line.startswith("no LPIPS: ")]
    assert len(told) == 1
    assert told[0].startswith(
        "no LPIPS: VGG-16's weights did not arrive in 0.2 s (CLSPLAT_LPIPS_TIMEOUT); download them with: curl"
    )
    assert captured.err.index("no LPIPS") < captured.err.index("step 2/2"), "before the work"
    result = json.loads(captured.out)
    assert result["lpips_missing"] == told[0].removeprefix("no LPIPS: ")
    assert json.loads((tmp_path / "run" / "eval.json").read_text()) == result


def test_without_the_extra_the_file_says_so(server: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics, "find_spec", lambda _name: None)
    monkeypatch.setattr(lpips_weights, "VGG16_WEIGHTS_URL", f"{server}/whole/{NAME}")

    class View:
        name = "a.png"

        def load(self) -> np.ndarray:
            return np.zeros((16, 16, 3), np.float32)

        load_masked = load

    result = held_out.evaluate(View.load, [View()], (0, 0, 0), model=held_out.EvaluatedModel(1, 1, 0.0))
    assert result["lpips_missing"] == "the optional extra is not installed (no lpips): pip install 'clsplat[lpips]'"
    assert not lpips_weights.place().exists(), "nothing is fetched that nobody could use"
