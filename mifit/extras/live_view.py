"""A live view of a result in the browser: turn the head and the light, switch parts, load an environment.

The browser keeps the camera; every picture is rendered here by the code that renders files, a small one at once and
a full one when the camera rests. Rendering stays in the thread that set Mitsuba's variant: callbacks of the server
only note what was asked for.
"""

from __future__ import annotations

import contextlib
import io
import ipaddress
import logging
import socket
import sys
import tempfile
import threading
import time
import warnings
import weakref
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mifit.core.arrays import Recent
from mifit.core.camera import Camera, inverse, rigid
from mifit.core.image import to_8_bit
from mifit.errors import InputError
from mifit.output.deferred import render_local
from mifit.output.relight import relit
from mifit.output.views import face_middle, on_backdrop, orbit_camera, vertical
from mifit.result import METHODS, Method, Reconstruction

if TYPE_CHECKING:
    import viser
    from websockets.asyncio.server import Request, Response, ServerConnection

ROWS = (160, 600)
"""Rows of a picture while something moves, and when it rests."""
MAX_UPLOAD_BYTES = 256 * 2**20
"""An environment that a browser sends: 16384 x 8192 pixels in a Radiance file, half of that in an EXR."""
MAX_CLIENTS = 8
"""Browsers that are answered at once."""
LABELS = {"pca": "morphable model", "diffuse": "without specular", "full": "everything"}


@dataclass(frozen=True)
class Shown:
    """What the controls ask for: ``turn`` is that of the light about the vertical, degrees; ``environment`` a lat-long
    one in place of the recovered light.
    """

    method: Method
    timestep: int
    turn: float = 0.0
    environment: Path | None = None


class Picture:
    """Renders what is shown from any camera and keeps the last relit result."""

    def __init__(self, result: Reconstruction) -> None:
        self.result = result
        self._lit = Recent[Reconstruction](1)

    def render(self, shown: Shown, camera: Camera) -> NDArray[np.uint8]:
        """(H, W, 3) 8-bit sRGB; raises InputError for an environment that can't be read."""
        key = (shown.turn, shown.environment)
        lit = self._lit.get(key, lambda: under(self.result, *key))
        image = render_local(lit, camera, shown.timestep, shown.method, 1)
        return to_8_bit(on_backdrop(image))


def under(result: Reconstruction, turn: float, environment: Path | None) -> Reconstruction:
    """A result under its own light or an environment, turned about the vertical by degrees."""
    if environment is not None:
        return relit(result, environment, [turn], "auto")[0]
    if turn == 0.0 or result.reflectance is None:
        return result
    rotation = Rotation.from_rotvec(np.radians(turn) * vertical(result)).as_matrix()
    illumination = result.reflectance.illumination.rotated(rotation)
    return result.with_illumination(illumination)


def browser_camera(wxyz: NDArray, position: NDArray, fov: float, aspect: float, rows: int) -> Camera:
    """The camera of a browser window, for a picture of so many ``rows``.

    ``wxyz`` (4,) is the rotation, camera to world in OpenCV's axes, as a quaternion; ``position`` (3,) the centre in
    world space; ``fov`` the vertical field of view in radians; ``aspect`` width over height.
    """
    numbers = np.array([*wxyz, *position, fov, aspect], dtype=np.float64)
    within = np.abs(numbers) < 1e9  # False for NaN
    if len(numbers) != 9 or not (within.all() and np.any(wxyz) and 1e-3 < fov < np.pi and aspect > 0):
        raise InputError(f"camera: found {numbers.tolist()}, expected a rotation, a position, an angle and an aspect")
    columns = int(np.clip(rows * min(aspect, 8.0), 16, 8 * rows).round())
    pose = inverse(rigid(Rotation.from_quat(np.roll(wxyz, -1)).as_matrix(), position))
    focal = 0.5 * rows / np.tan(0.5 * fov)
    return Camera("browser", columns, rows, focal, focal, columns / 2, rows / 2, pose)


def check_address(host: str, port: int) -> None:
    """Refuse an address at which no server can listen; InputError names it."""
    try:
        if not host:
            raise OSError("an empty name stands for every network")
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        socket.create_server((host, port), family=family).close()
    except (OSError, UnicodeError) as error:
        where = f"--host {host!r} --port {port}"
        raise InputError(f"{where}: can't listen there: {getattr(error, 'strerror', None) or error}") from None


def is_of_our_page(host: str, origin: str | None, given: str) -> bool:
    """Whether a request comes from a page of this server, by its headers ``Host`` and ``Origin``.

    A page of elsewhere that a browser here shows has another origin; one whose name was made to lead here (DNS
    rebinding) has that name for a host. Names of this machine and addresses are ours, as is the host ``given`` to
    listen at. No browser leaves the origin out of what opens a socket.
    """
    name = (urlsplit(f"//{host}").hostname or "").rstrip(".")
    own = {"localhost", given.lower(), socket.gethostname().lower()}
    try:
        ipaddress.ip_address(name)
    except ValueError:
        if name not in own:
            return False
    return origin is None or urlsplit(origin).netloc == host


@contextlib.contextmanager
def _guarded(host: str) -> Iterator[None]:
    """Make servers that viser starts in the block answer their own pages alone, and `MAX_CLIENTS` at once."""
    from websockets.asyncio import server as websockets

    serve_any: Callable[..., object] = websockets.serve
    sockets: weakref.WeakSet[ServerConnection] = weakref.WeakSet()

    def serve(*arguments: object, process_request: Callable[..., Response | None], **options: object) -> object:
        def answer(connection: ServerConnection, request: Request) -> Response | None:
            hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
            try:
                ours = len(hosts) == 1 and len(origins) < 2 and is_of_our_page(hosts[0], (*origins, None)[0], host)
            except ValueError:  # no address
                ours = False
            if not ours:
                return connection.respond(HTTPStatus.FORBIDDEN, "This view answers its own page alone.\n")
            if request.headers.get("Upgrade", "").lower() == "websocket":
                if sum(s.state.name in ("CONNECTING", "OPEN") for s in sockets) >= MAX_CLIENTS:
                    return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "Too many pages show this view.\n")
                sockets.add(connection)
            return process_request(connection, request)

        return serve_any(*arguments, process_request=answer, **options)

    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)  # a message that is none is no news
    websockets.serve = serve  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.serve = serve_any  # type: ignore[assignment, misc]


class LiveView:
    """A server that shows a result; `run` answers requests until it is stopped, `poll` those that are waiting.

    Port 0 takes a free one. InputError where the result has no cameras, viser isn't installed, or nothing can listen at
    the address.
    """

    def __init__(self, result: Reconstruction, host: str = "127.0.0.1", port: int = 8080) -> None:
        try:
            import viser
        except ImportError:
            raise InputError('the live view needs viser; install it with: pip install "mifit[view]"') from None
        check_address(host, port)
        self._start = orbit_camera(result, result.timesteps[0], 0.0)
        self._up = vertical(result)
        self._centre = face_middle(result, 0)
        self._steps = sorted(result.timesteps)
        self._picture = Picture(result)
        self._shown = Shown(result.methods[-1], self._steps[0])
        self._rested = time.monotonic()
        self._changed: dict[int, float] = {}  # client -> when its picture went out of date
        self._coarse: set[int] = set()  # clients whose last picture was a small one
        self._woken = threading.Event()
        self._folder = tempfile.TemporaryDirectory(prefix="mifit-view-")
        with contextlib.redirect_stdout(io.StringIO()), _guarded(host):  # it prints a table of its own
            self._server = viser.ViserServer(host=host, port=port, label="mifit", verbose=False)
        self._server.scene.set_up_direction(self._up)
        self._server.scene.world_axes.visible = False
        self._server.gui.configure_theme(control_width="small", show_logo=False, show_share_button=False)
        self._controls(result)
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._gone)

    @property
    def address(self) -> str:
        """Where a browser finds the view."""
        return f"http://{self._server.get_host()}:{self._server.get_port()}"

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        """Answer requests until ``until`` says so, or for ever."""
        while not until():
            self._woken.wait(0.05)
            self.poll()

    def poll(self) -> None:
        """Answer the requests that are waiting; from the thread that set the variant."""
        self._woken.clear()
        now = time.monotonic()
        for client, handle in self._server.get_clients().items():
            if client in self._changed:
                del self._changed[client]
                self._coarse.add(client)
                self._send(handle, ROWS[0])
                self._rested = now
            elif client in self._coarse and now - self._rested > 0.3:  # seconds
                self._coarse.discard(client)
                self._send(handle, ROWS[1])

    def say(self, text: str) -> None:
        """Write a line under the controls."""
        self._message.content = text

    def close(self) -> None:
        """Stop the server."""
        self._server.stop()
        self._folder.cleanup()

    def _controls(self, result: Reconstruction) -> None:
        gui = self._server.gui
        parts = {LABELS[m]: m for m in METHODS}
        shown = gui.add_dropdown(
            "Show", tuple(LABELS[m] for m in METHODS if m in result.methods), initial_value=LABELS[self._shown.method]
        )
        shown.on_update(lambda _: self._show(method=parts[shown.value]))
        if len(self._steps) > 1:
            step = gui.add_slider("Timestep", self._steps[0], self._steps[-1], 1, self._steps[0])
            step.on_update(lambda _: self._move_to(int(step.value)))
        if result.reflectance is not None:
            turn = gui.add_slider("Turn light", -180.0, 180.0, 5.0, 0.0)
            turn.on_update(lambda _: self._show(turn=float(np.clip(np.nan_to_num(turn.value), -180.0, 180.0))))
            load = gui.add_upload_button("Load environment (.hdr, .exr)")
            load.on_upload(lambda _: self._upload(load.value.name, load.value.content))
            gui.add_button("Recovered light").on_click(lambda _: self._show(environment=None))
        front = gui.add_button("Look from the front")
        front.on_click(lambda event: self._place(event.client))
        self._message = gui.add_markdown("")

    def _move_to(self, timestep: int) -> None:
        nearest = min(self._steps, key=lambda t: abs(t - timestep))
        self._show(timestep=nearest)

    def _show(self, **changes: Method | int | float | Path | None) -> None:
        self._shown = replace(self._shown, **changes)  # type: ignore[arg-type]
        self._ask(*self._server.get_clients())

    def _ask(self, *clients: int) -> None:
        for client in clients:
            self._changed[client] = time.monotonic()
        self._woken.set()

    def _upload(self, name: str, content: bytes) -> None:
        if Path(name).suffix.lower() not in (".hdr", ".exr") or len(content) > MAX_UPLOAD_BYTES:
            self.say(f"**expected a file .hdr or .exr of at most {MAX_UPLOAD_BYTES >> 20} MiB**")
            return
        path = Path(self._folder.name) / f"{time.monotonic_ns()}{Path(name).suffix.lower()}"
        path.write_bytes(content)
        before = self._shown.environment
        self._show(environment=path)
        if before is not None:
            before.unlink(missing_ok=True)

    def _connected(self, client: viser.ClientHandle) -> None:
        self._place(client)
        client.camera.on_update(lambda _: self._ask(client.client_id))
        self._ask(client.client_id)

    def _gone(self, client: viser.ClientHandle) -> None:
        self._changed.pop(client.client_id, None)
        self._coarse.discard(client.client_id)

    def _place(self, client: viser.ClientHandle | None) -> None:
        """Put a browser's camera in front of the face."""
        assert client is not None
        camera = client.camera
        camera.position = self._start.position  # first: it takes the point looked at along
        camera.up_direction, camera.look_at = self._up, self._centre
        camera.fov = 2 * np.arctan(0.5 * self._start.height / self._start.fy)

    def _send(self, client: viser.ClientHandle, rows: int) -> None:
        try:
            seen = client.camera
            camera = browser_camera(seen.wxyz, seen.position, seen.fov, seen.aspect, rows)
        except (InputError, ArithmeticError, TypeError, ValueError, AssertionError):  # what a browser sends is anything
            return
        try:
            image = self._picture.render(self._shown, camera)
        except InputError as error:
            self.say(f"**{error}**")
            if self._shown.environment is not None:
                self._show(environment=None)
            return
        with warnings.catch_warnings():  # the page may have gone meanwhile
            warnings.simplefilter("ignore", UserWarning)
            client.scene.set_background_image(image, format="jpeg", jpeg_quality=90)


def serve(live: LiveView) -> None:
    """Answer requests until Ctrl+C, then close."""
    live.say("")
    print("The view stays until Ctrl+C", file=sys.stderr, flush=True)
    try:
        live.run()
    except KeyboardInterrupt:
        pass
    finally:
        live.close()
