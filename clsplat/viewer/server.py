# SPDX-License-Identifier: Apache-2.0
"""The viewer's web server, built with viser (the extra `view`): its address, connections of pages, and protection from
other servers' pages.

The server sends viser's page and web socket messages, and no files of this machine.

Default port: `config/cli_defaults.py`. Sizes and JPEG quality of pictures: `viewer/refinement.py`.
"""

from __future__ import annotations

import asyncio
import contextlib
import http
import io
import ipaddress
import logging
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

from clsplat.config.cli_defaults import VIEWER_HOST, VIEWER_PORT
from clsplat.errors import InputError, plain
from clsplat.viewer.page import ViserPage, World
from clsplat.viewer.pose import read_pose
from clsplat.viewer.scheduler import Viewer, Viewing

LOCAL_HOST_PATTERN = r"(?i:localhost|127(\.\d+){3}|\[::1\])(:\d+)?"
"""Pattern of the host names to which a server answers if only this machine can reach it."""
VISER_FAR_PLANE = 1000.0
"""viser's default far plane in world units, for the cameras and boxes that the browser draws."""


@dataclass(frozen=True)
class Address:
    """Address at which the server listens, and the folder in which pages may save camera paths.

    paths: the folder; None if pages may not save.
    """

    host: str = VIEWER_HOST
    port: int = VIEWER_PORT
    paths: Path | None = None

    def check(self) -> None:
        """Raise InputError if viser or the folder is missing, or if nothing can listen at the address.

        If the port is in use, viser would silently take the next free port.
        """
        try:
            import viser  # noqa: F401
        except ImportError:
            raise InputError("the viewer needs viser: pip install 'clsplat[view]'") from None
        if not 0 <= self.port <= 65535:
            raise InputError(f"--port {self.port}: expected 0 to 65535; 0 takes any free port")
        if self.paths is not None and not self.paths.is_dir():
            raise InputError(f"--paths {self.paths}: no such folder, expected an existing one for saved camera paths")
        try:
            addresses = socket.getaddrinfo(self.host, self.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
            family, kind, protocol, _, address = addresses[0]
            with socket.socket(family, kind, protocol) as probe:
                if os.name == "posix":  # asyncio sets this option; on Windows it would take over another server's port
                    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address)
                probe.listen()
        except (OSError, UnicodeError, IndexError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise InputError(
                f"--host {self.host} --port {self.port}: cannot listen there ({reason}), expected an address of this "
                "machine and a port that no other program uses; --port 0 takes any free port"
            ) from None

    @property
    def local(self) -> bool:
        """True if only this machine can reach the server."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False


class Server:
    """Server of the viewer's pages, which runs until `close`. Raises InputError if it cannot listen at the address.

    training: True to add a button that pauses training.
    """

    def __init__(self, viewing: Viewing, world: World, address: Address, *, training: bool = False) -> None:
        address.check()
        import viser

        self.viewing, self.world, self.address = viewing, world, address
        # viser warns about every message to a page that was closed
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
        with _quiet(), _guarded(address):
            self._server: Any = viser.ViserServer(host=address.host, port=address.port, label="clsplat", verbose=False)
        server = self._server
        server.request_share_url = lambda *_, **__: None  # pages must not open a tunnel from this machine
        server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True, control_width="medium")
        server.scene.set_up_direction(world.start.up)
        # the scene needs no light: an environment map and shadows would only slow down browsers without a GPU
        server.scene.configure_environment_map(hdri=None)
        server.scene.configure_default_lights(cast_shadow=False)
        begin, start = server.initial_camera, world.start
        begin.position, begin.look_at = start.position - world.origin, start.target - world.origin
        begin.up, begin.fov = start.up, start.fov
        begin.far = max(VISER_FAR_PLANE, 20 * float(np.linalg.norm(start.position - start.target)))
        self.paused = False
        self._status: Any = None
        if training:
            self._add_training()

        viewers: dict[int, Viewer] = {}

        async def came(client: Any) -> None:
            viewer = viewers[client.client_id] = ViserPage(client, viewing, world, address.paths).viewer
            fov = start.fov

            async def moved(camera: Any) -> None:
                nonlocal fov
                size = (camera.image_width, camera.image_height)
                if start.misfits(camera.fov, fov, *size):
                    fov = camera.fov = start.fov_on(*size)
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
        """URL of the page. Its host is localhost if only this machine can reach the server, else the address's host."""
        host = self.address.host
        name = "localhost" if self.address.local else f"[{host}]" if ":" in host else host
        return f"http://{name}:{self._server.get_port()}"

    def tell(self, text: str) -> None:
        """Show a text with the training's state on all pages."""
        if self._status is not None and self._status.content != text:
            self._status.content = text

    def close(self) -> None:
        """Disconnect all pages and stop the server."""
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
    """Discard viser's prints inside the context, because standard output belongs to --json."""
    with contextlib.redirect_stdout(io.StringIO() if sys.stdout is not None else None):
        yield


@contextlib.contextmanager
def _guarded(address: Address) -> Iterator[None]:
    """Make servers that are created inside the context refuse requests from pages of other servers.

    The servers also close a connection that sends an invalid message, and print a line on standard error. viser has no
    settings for this, so `serve` of its websocket library is replaced.
    """
    from websockets.asyncio import server

    usual = server.serve
    # a separate logger, since the default one prints tracebacks for malformed requests
    log = logging.getLogger("clsplat.viewer")
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
            except Exception as error:  # noqa: BLE001  # a message may cause any exception
                _tell(None, {"exception": error})
                await connection.close(1007)

        return usual(handled, *arguments, process_request=asked, logger=log, **options)

    server.serve = serve  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        server.serve = usual  # type: ignore[misc]


def _tell(_: Any, context: dict[str, Any]) -> None:
    """Print one line about an exception in asyncio, whose own handler would print a traceback."""
    error = context.get("exception")
    words = f"{type(error).__name__}: {error}" if error is not None else str(context.get("message", ""))
    message = plain(" ".join(words.split()))[:200].rstrip(": ")
    print(f"clsplat: warning: a page sent an invalid message: {message}", file=sys.stderr)


def refused(headers: Any, *, local: bool) -> str:
    """Return the reason why a request is refused, or '' if it is accepted.

    A request from a page of another server is refused: its Origin and Host differ in name or port. Both may have
    another port than the server, since a tunnel (ssh -L) may change it. A request without an Origin does not come from
    a page, and is accepted.

    local: True if only this machine can reach the server. Then requests to any host but localhost are refused, against
        DNS rebinding.
    """
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) != 1 or len(origins) > 1:
        return "expected one Host, and at most one Origin"
    if local and not re.fullmatch(LOCAL_HOST_PATTERN, hosts[0]):
        return "this server only answers requests to localhost"
    if origins and re.sub("^https?://", "", origins[0].lower()) != hosts[0].lower():
        return "pages of other servers are refused"
    return ""
