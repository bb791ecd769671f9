# SPDX-License-Identifier: Apache-2.0
"""`clsplat view` before there is a page: wrong calls, and what its server refuses."""

from __future__ import annotations

import asyncio
import socket
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from calls import Capture, error_line
from models import random_gaussians
from needs import require
from systems import posix
from tiny import CONFIG
from viewer_browser import clsplat

from clsplat.cli import Train, main, parse
from clsplat.runs import Run
from clsplat.viewer.server import Address

require("viser")


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("view") / "model.ply"
    random_gaussians(50).save(path)
    return path


@pytest.fixture(scope="module")
def url(model: Path) -> Iterator[str]:
    with clsplat("view", str(model)) as (found, _):
        yield found


def test_a_model_that_is_missing(tmp_path: Path, capsys: Capture) -> None:
    assert main(["view", str(tmp_path / "model.ply")]) == 2
    assert "model.ply" in error_line(capsys)


def test_a_model_without_gaussians(tmp_path: Path, capsys: Capture) -> None:
    random_gaussians(0).save(tmp_path / "empty.ply")
    assert main(["view", str(tmp_path / "empty.ply"), "--port", "0"]) == 2
    assert "empty.ply" in error_line(capsys)


def test_a_scene_that_is_missing(model: Path, tmp_path: Path, capsys: Capture) -> None:
    assert main(["view", str(model), "--port", "0", "--scene", str(tmp_path / "none")]) == 2
    assert "none" in error_line(capsys)


def test_viser_is_missing(model: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["view", str(model)]) == 2
    assert "pip install 'clsplat[view]'" in error_line(capsys)


@pytest.mark.parametrize("verb", ["view", "train"])
def test_a_port_that_is_taken(verb: str, model: Path, scene: Path, tmp_path: Path, capsys: Capture) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        run = tmp_path / "run"
        call = ["view", str(model)] if verb == "view" else ["train", str(scene), "-o", str(run), "--view"]
        assert main([*call, "--port", port]) == 2
        assert f"--port {port}: cannot listen there" in error_line(capsys)
        assert not run.exists()


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--port", "70000"], "expected 0 to 65535"),
        (["--host", "203.0.113.7"], "cannot listen there"),
        (["--host", "no such host"], "cannot listen there"),
        (["--paths", "/nowhere/at/all"], "no such folder"),
    ],
)
def test_wrong_calls(flags: list[str], words: str, model: Path, capsys: Capture) -> None:
    assert main(["view", str(model), *flags]) == 2
    assert words in error_line(capsys)


def test_addresses_of_this_machine() -> None:
    assert all(Address(host).local for host in ("localhost", "127.0.0.1", "127.1.2.3", "::1"))
    assert not any(Address(host).local for host in ("0.0.0.0", "::", "192.168.1.2", "example.org"))


def test_it_listens_on_this_machine_alone(url: str) -> None:
    port = int(url.rsplit(":", 1)[1])
    with socket.create_connection(("127.0.0.1", port), timeout=10):
        pass
    name = socket.gethostbyname(socket.gethostname())
    if not name.startswith("127."):
        with pytest.raises(OSError), socket.create_connection((name, port), timeout=10):
            pass


@pytest.mark.parametrize(
    "path",
    ["/etc/passwd", "//etc/passwd", "/../../../../../etc/passwd", "/%2e%2e/%2e%2e/%2e%2e/etc/passwd", "/model.ply",
     "/..%5c..%5cetc/passwd", "/index.html/../../build/../../__init__.py"],
)  # fmt: skip
def test_no_path_is_served(url: str, path: str) -> None:
    with pytest.raises(urllib.error.HTTPError) as found:
        urllib.request.urlopen(url + path, timeout=20)
    assert found.value.code in (400, 404)


@pytest.mark.parametrize(
    ("origin", "let_in"),
    [
        (None, True),
        ("http://localhost:8080", True),
        ("http://127.0.0.1", True),
        ("http://[::1]:9", True),
        ("https://example.org", False),
        ("http://localhost.example.org", False),
        ("http://127.0.0.1.example.org:8080", False),
        ("null", False),
    ],
)
def test_pages_of_other_sites_are_refused(url: str, origin: str | None, let_in: bool) -> None:
    from viser import __version__
    from websockets.asyncio.client import connect
    from websockets.exceptions import InvalidStatus

    async def attempt() -> None:
        async with connect(
            url.replace("http", "ws", 1),
            origin=origin,  # type: ignore[arg-type]
            subprotocols=[f"viser-v{__version__}"],  # type: ignore[list-item]
            open_timeout=20,
        ):
            pass

    if let_in:
        asyncio.run(attempt())
        return
    with pytest.raises(InvalidStatus) as found:
        asyncio.run(attempt())
    assert found.value.response.status_code == 403


@posix
def test_ctrl_c_ends_it(model: Path) -> None:
    with clsplat("view", str(model)) as (_, process):
        process.send_signal(2)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 0
    assert out == ""
    assert "Traceback" not in err


def test_the_flags_of_a_trainings_page(tmp_path: Path) -> None:
    plain = parse(["train", "scene", "-o", "run"])
    assert isinstance(plain, Train)
    assert not plain.view
    for more in ([], ["--preset", "fast"], ["--schedule", "short"]):
        verb = parse(["train", "scene", "-o", "run", "--view", "--port", "81", "--host", "::1", *more])
        assert isinstance(verb, Train)
        assert (verb.view, verb.port, verb.host) == (True, 81, "::1")
    run = tmp_path / "run"
    Run.create(run, CONFIG, scene=tmp_path)
    verb = parse(["train", "-o", str(run), "--resume", "--view", "--paths", str(tmp_path)])
    assert isinstance(verb, Train)
    assert (verb.view, verb.resume, verb.paths, verb.config) == (True, True, tmp_path, CONFIG)
