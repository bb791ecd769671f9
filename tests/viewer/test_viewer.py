# SPDX-License-Identifier: Apache-2.0
"""`clsplat view` before there is a page: wrong calls, and what its server refuses."""

from __future__ import annotations

import asyncio
import socket
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import pytest
from calls import Capture, rejected
from models import random_gaussians
from needs import require
from systems import posix
from tiny import CONFIG
from viewer_browser import clsplat

from clsplat.cli.main import parse
from clsplat.cli.train import TrainVerb
from clsplat.errors import InputError
from clsplat.images.colour import LINEAR, comment
from clsplat.runs.run import Run
from clsplat.viewer.server import Address, refused

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
    assert "model.ply" in rejected(capsys, ["view", tmp_path / "model.ply"])


def test_a_model_without_gaussians(tmp_path: Path, capsys: Capture) -> None:
    random_gaussians(0).save(tmp_path / "empty.ply")
    assert "empty.ply" in rejected(capsys, ["view", tmp_path / "empty.ply", "--port", "0"])


def test_the_page_has_the_models_colour_space(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    def shown(*given: object) -> None:
        raise InputError(f"shown in {given[4:]}")

    monkeypatch.setattr("clsplat.viewer.models.HeldModel", shown)
    random_gaussians(5).save(tmp_path / "linear.ply", comments=[comment(LINEAR)])
    assert f"shown in ('{LINEAR}',)" in rejected(capsys, ["view", tmp_path / "linear.ply", "--port", "0"])


def test_viser_is_missing(model: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    assert "pip install 'clsplat[view]'" in rejected(capsys, ["view", model])


@pytest.mark.parametrize("verb", ["view", "train"])
def test_a_port_that_is_taken(verb: str, model: Path, scene: Path, tmp_path: Path, capsys: Capture) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        run = tmp_path / "run"
        call = ["view", str(model)] if verb == "view" else ["train", str(scene), "-o", str(run), "--view"]
        assert f"--port {port}: cannot listen there" in rejected(capsys, [*call, "--port", port])
        assert not run.exists()


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--port", "0", "--scene", "/nowhere/none"], "none"),
        (["--port", "70000"], "expected 0 to 65535"),
        (["--host", "203.0.113.7"], "cannot listen there"),
        (["--host", "no such host"], "cannot listen there"),
        (["--paths", "/nowhere/at/all"], "no such folder"),
    ],
)
def test_wrong_calls(flags: list[str], words: str, model: Path, capsys: Capture) -> None:
    assert words in rejected(capsys, ["view", model, *flags])


def test_addresses_of_this_machine() -> None:
    assert all(Address(host).local for host in ("localhost", "127.0.0.1", "127.1.2.3", "::1"))
    assert not any(Address(host).local for host in ("0.0.0.0", "::", "192.168.1.2", "example.org"))


@pytest.mark.slow
def test_it_listens_on_this_machine_alone(url: str) -> None:
    port = int(url.rsplit(":", 1)[1])
    with socket.create_connection(("127.0.0.1", port), timeout=10):
        pass
    name = socket.gethostbyname(socket.gethostname())
    if not name.startswith("127."):
        with pytest.raises(OSError), socket.create_connection((name, port), timeout=10):
            pass


@pytest.mark.slow
@pytest.mark.parametrize(
    "path",
    ["/etc/passwd", "//etc/passwd", "/../../../../../etc/passwd", "/%2e%2e/%2e%2e/%2e%2e/etc/passwd", "/model.ply",
     "/..%5c..%5cetc/passwd", "/index.html/../../build/../../__init__.py"],
)  # fmt: skip
def test_no_path_is_served(url: str, path: str) -> None:
    with pytest.raises(urllib.error.HTTPError) as found:
        urllib.request.urlopen(url + path, timeout=20)
    assert found.value.code in (400, 404)


async def connected(url: str, *messages: str | bytes, origin: str | None = None, host: str | None = None) -> None:
    """Open the socket as a page does, send this and wait for the server to end it, if there is anything to send."""
    from viser import __version__
    from websockets.asyncio.client import connect
    from websockets.exceptions import ConnectionClosed

    port = int(url.rsplit(":", 1)[1])
    async with connect(
        f"ws://{host or f'127.0.0.1:{port}'}/",
        origin=origin,  # type: ignore[arg-type]
        subprotocols=[f"viser-v{__version__}"],  # type: ignore[list-item]
        open_timeout=20,
        host="127.0.0.1",
        port=port,
        max_size=None,
    ) as connection:
        for message in messages:
            await connection.send(message)
        with pytest.raises(ConnectionClosed) if messages else nullcontext():
            while messages:
                await asyncio.wait_for(connection.recv(), 20)


@pytest.mark.parametrize(
    ("origin", "host", "let_in"),
    [
        (None, "localhost:{port}", True),
        (None, "127.0.0.1", True),
        (None, "[::1]:{port}", True),
        (None, "example.org:{port}", False),  # a name that has been led to this machine
        (None, "localhost.example.org", False),
        ("http://localhost:{port}", "localhost:{port}", True),
        ("http://127.0.0.1:{port}", "127.0.0.1:{port}", True),
        ("http://LOCALHOST:9000", "localhost:9000", True),  # through a tunnel
        ("http://localhost:5173", "localhost:{port}", False),
        ("http://127.0.0.1", "127.0.0.1:{port}", False),
        ("http://localhost:{port}", "127.0.0.1:{port}", False),
        ("https://example.org", "localhost:{port}", False),
        ("http://example.org:{port}", "example.org:{port}", False),
        ("http://127.0.0.1.example.org:8080", "127.0.0.1:{port}", False),
        ("null", "localhost:{port}", False),
        ("", "localhost:{port}", False),
    ],
)
def test_pages_of_other_servers_are_refused(url: str, origin: str | None, host: str, let_in: bool) -> None:
    from websockets.exceptions import InvalidStatus

    port = url.rsplit(":", 1)[1]
    origin, host = origin if origin is None else origin.format(port=port), host.format(port=port)
    if let_in:
        asyncio.run(connected(url, origin=origin, host=host))
        return
    with pytest.raises(InvalidStatus) as found:
        asyncio.run(connected(url, origin=origin, host=host))
    assert found.value.response.status_code == 403


def test_who_is_let_in_elsewhere() -> None:
    """A server for others is known by any name, but not to the pages of others."""
    from websockets.datastructures import Headers

    def of(**headers: str) -> str:
        return refused(Headers(**headers), local=False)

    assert of(Host="render7:8080") == of(Host="render7:8080", Origin="http://render7:8080") == ""
    assert "pages of other servers" in of(Host="render7:8080", Origin="http://render7:9090")
    assert "one Host" in of(Origin="http://render7:8080")


@posix
def test_what_makes_no_sense_is_a_line(model: Path) -> None:
    with clsplat("view", str(model)) as (url, process):
        for request in (
            b"\x00\xff\r\n\r\n",
            b"POST / HTTP/1.1\r\n\r\n",
            b"GET / HTTP/1.1\r\n\r\n",
            b"GET / HTTP/9\r\n\r\n",
        ):
            with socket.create_connection(("127.0.0.1", int(url.rsplit(":", 1)[1])), timeout=10) as talk:
                talk.sendall(request)
                talk.recv(100)
        for message in ("text", b"\xff\xfe", b"\x92\x01\x02", b"\x81\xa4type\xa4Nope"):
            asyncio.run(connected(url, message))
        asyncio.run(connected(url))
        process.send_signal(2)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (0, "")
    lines = err.splitlines()
    assert len(lines) == 4, "one for each message"
    assert all(line.startswith("clsplat: warning: a page sent an invalid message: ") for line in lines)


@pytest.mark.slow
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
    assert isinstance(plain, TrainVerb)
    assert not plain.view
    for more in ([], ["--preset", "fast"], ["--schedule", "short"]):
        verb = parse(["train", "scene", "-o", "run", "--view", "--port", "81", "--host", "::1", *more])
        assert isinstance(verb, TrainVerb)
        assert (verb.view, verb.page.port, verb.page.host) == (True, 81, "::1")
    run = tmp_path / "run"
    Run.create(run, CONFIG, scene=tmp_path)
    verb = parse(["train", "-o", str(run), "--resume", "--view", "--paths", str(tmp_path)])
    assert isinstance(verb, TrainVerb)
    assert (verb.view, verb.resume, verb.page.paths, verb.config) == (True, True, tmp_path, CONFIG)
