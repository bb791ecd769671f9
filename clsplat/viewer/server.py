# SPDX-License-Identifier: Apache-2.0
"""The viewer's server, by viser (the extra `view`): viewers that come and go, and what all of them see.

It serves viser's own page and the messages of its web socket; no path of this machine.
"""

from __future__ import annotations

import asyncio
import contextlib
import http
import io
import ipaddress
import logging
import math
import os
import re
import socket
import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.config.verbs import HOST, PORT
from clsplat.errors import InputError, plain
from clsplat.viewer.page import ViserPage, World
from clsplat.viewer.pose import read_pose
from clsplat.viewer.scheduler import Viewer, Viewing

LOCAL = r"(?i:localhost|127(\.\d+){3}|\[::1\])(:\d+)?"
"""Names, as a pattern, by which a server for this machine alone may be asked."""
FAR = 1000.0
"""viser's own far plane, of what it draws itself: cameras and boxes."""


@dataclass(frozen=True)
class Address:
    """Address that the server listens at, and the folder for paths that are saved, None for none."""

    host: str = HOST
    port: int = PORT
    paths: Path | None = None

    def check(self) -> None:
        """Raise InputError where viser is missing, the folder is, or nothing can listen there. viser itself would take
        the next port that is free."""
        try:
            import viser  # noqa: F401
        except ImportError:
            raise InputError("the viewer needs viser: pip install 'clsplat[view]'") from None
        if not 0 <= self.port <= 65535:
            raise InputError(f"--port {self.port}: expected 0 to 65535; 0 is any that is free")
        if self.paths is not None and not self.paths.is_dir():
            raise InputError(f"--paths {self.paths}: no such folder, expected one to save camera paths in")
        try:
            addresses = socket.getaddrinfo(self.host, self.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
            family, kind, protocol, _, address = addresses[0]
            with socket.socket(family, kind, protocol) as probe:
                if os.name == "posix":  # as asyncio does; on Windows it would take the port of another server
                    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address)
                probe.listen()
        except (OSError, UnicodeError, IndexError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise InputError(
                f"--host {self.host} --port {self.port}: cannot listen there ({reason}), expected an address of this "
                "machine and a port that no other program has; --port 0 takes any"
            ) from None

    @property
    def local(self) -> bool:
        """True if only this machine can reach it."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False


class Server:
    """Serves pages until it is closed. Raises InputError where it cannot listen.

    training: whether there is one to be paused.
    """

    def __init__(self, viewing: Viewing, world: World, address: Address, *, training: bool = False) -> None:
        address.check()
        import viser

        self.viewing, self.world, self.address = viewing, world, address
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")  # viewers that left
        with _quiet(), _guarded(address):
            self._server: Any = viser.ViserServer(host=address.host, port=address.port, label="clsplat", verbose=False)
        server = self._server
        server.request_share_url = lambda *_, **__: None  # a page may not ask for a tunnel out of this machine
        server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True, control_width="medium")
        server.scene.set_up_direction(world.start.up)
        # nothing in the scene is lit: filtering a sky and drawing shadows would hold up a browser without a GPU
        server.scene.configure_environment_map(hdri=None)
        server.scene.configure_default_lights(cast_shadow=False)
        begin, start = server.initial_camera, world.start
        begin.position, begin.look_at = start.position - world.origin, start.target - world.origin
        begin.up, begin.fov = start.up, start.fov
        begin.far = max(FAR, 20 * float(np.linalg.norm(start.position - start.target)))
        self.paused = False
        self._status: Any = None
        if training:
            self._add_training()

        viewers: dict[int, Viewer] = {}

        async def came(client: Any) -> None:
            viewer = viewers[client.client_id] = ViserPage(client, viewing, world, address.paths).viewer
            fov, before = start.fov, (0, 0)

            async def moved(camera: Any) -> None:
                nonlocal fov, before
                size = (camera.image_width, camera.image_height)
                # the start's angle, on a page of another shape now, and not that of a camera which was gone to
                if size != before and min(size) > 0 and math.isclose(camera.fov, fov, rel_tol=1e-6):
                    fov = camera.fov = start.fov_on(*size)
                before = size
                pose = read_pose(camera.wxyz, camera.position, camera.fov, size, world.origin)
                if pose is not None:
                    viewing.moved(viewer, pose)

            client.camera.on_update(moved)
            await moved(client.camera)

        async def left(client: Any) -> None:
            if viewer := viewers.pop(client.client_id, None):
                viewing.leave(viewer)

        server.on_client_connect(came)
        server.on_client_disconnect(left)

    @property
    def url(self) -> str:
        """Address for this machine's browser, or with the host's name where it listens elsewhere."""
        host = self.address.host
        name = "localhost" if self.address.local else f"[{host}]" if ":" in host else host
        return f"http://{name}:{self._server.get_port()}"

    def tell(self, text: str) -> None:
        """Show the state of a training on the pages."""
        if self._status is not None and self._status.content != text:
            self._status.content = text

    def close(self) -> None:
        """All pages lose their server."""
        with _quiet():
            self._server.stop()

    def _add_training(self) -> None:
        gui = self._server.gui
        with gui.add_folder("Training"):
            self._status = gui.add_markdown("waiting for the first step")
            button = gui.add_button("Pause")

        async def pressed(_: Any) -> None:
            self.paused = not self.paused
            button.label = "Resume" if self.paused else "Pause"
            self.viewing.wake()

        button.on_click(pressed)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """viser prints to standard output, which belongs to --json."""
    with contextlib.redirect_stdout(io.StringIO() if sys.stdout is not None else None):
        yield


@contextlib.contextmanager
def _guarded(address: Address) -> Iterator[None]:
    """Inside, a server refuses pages that are not its own, which a browser here may have open, and what makes no sense
    ends its connection, with a line. viser has no setting for that, the library it listens with has."""
    from websockets.asyncio import server

    usual = server.serve
    log = logging.getLogger("clsplat.viewer")  # of its own: the usual one prints tracebacks of requests that are none
    log.propagate = False
    log.addHandler(logging.NullHandler())

    def serve(handler: Any, *arguments: Any, process_request: Any = None, **options: Any) -> Any:
        def asked(connection: Any, request: Any) -> Any:
            if reason := refused(request.headers, local=address.local):
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"{reason}\n")
            return process_request(connection, request) if process_request else None

        async def handled(connection: Any) -> None:
            asyncio.get_running_loop().set_exception_handler(_tell)
            try:
                await handler(connection)
            except Exception as error:  # noqa: BLE001  # whatever a message has led to
                _tell(None, {"exception": error})
                await connection.close(1007)

        return usual(handled, *arguments, process_request=asked, logger=log, **options)

    server.serve = serve  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        server.serve = usual  # type: ignore[misc]


def _tell(_: Any, context: dict[str, Any]) -> None:
    """Print a line in place of a traceback; it takes what asyncio gives its handler for errors in tasks."""
    error = context.get("exception")
    words = f"{type(error).__name__}: {error}" if error is not None else str(context.get("message", ""))
    message = plain(" ".join(words.split()))[:200].rstrip(": ")
    print(f"clsplat: warning: a page sent what makes no sense here: {message}", file=sys.stderr)


def refused(headers: Any, *, local: bool) -> str:
    """The reason that a request is not answered, '' if it is.

    Requests from a page that is not this server's are refused; so are, by a server for this machine alone, those for
    another name, as when a foreign name has been led here. Ports count, but not which: a tunnel (ssh -L) may have led
    another one here. A request without an origin is from no page.
    """
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) != 1 or len(origins) > 1:
        return "expected one Host, and at most one Origin"
    if local and not re.fullmatch(LOCAL, hosts[0]):
        return "this server is for its machine alone, as localhost"
    if origins and re.sub("^https?://", "", origins[0].lower()) != hosts[0].lower():
        return "pages of other servers are not let in"
    return ""
