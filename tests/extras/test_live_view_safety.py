"""What reaches the live view from elsewhere: pages, addresses and messages that are none of its own."""

from __future__ import annotations

import contextlib
import socket
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from mifit.cli import main
from mifit.errors import InputError
from mifit.extras.live_view import MAX_CLIENTS, LiveView, browser_camera, check_address, is_of_our_page
from tests.output.conftest import ball_result

viser = pytest.importorskip("viser", reason="needs the extra mifit[view]")


@pytest.mark.parametrize(
    ("host", "origin", "ours"),
    [
        ("127.0.0.1:8080", "http://127.0.0.1:8080", True),
        ("localhost:8080", "http://localhost:8080", True),
        ("[::1]:8080", "http://[::1]:8080", True),
        ("192.168.0.7:8080", "http://192.168.0.7:8080", True),
        ("127.0.0.1:8080", None, True),
        ("127.0.0.1:8080", "http://evil.example", False),
        ("127.0.0.1:8080", "http://127.0.0.1:8081", False),
        ("127.0.0.1:8080", "null", False),
        ("evil.example:8080", "http://evil.example:8080", False),
        ("evil.example:8080", None, False),
        ("", None, False),
    ],
)
def test_pages_of_elsewhere_are_told_apart(host: str, origin: str | None, ours: bool) -> None:
    assert is_of_our_page(host, origin, "127.0.0.1") is ours
    assert is_of_our_page("studio:8080", "http://studio:8080", "studio")


def camera_message(**changes: Any) -> bytes:
    import msgspec

    message = {
        "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, 0.0, -70.0), "fov": 0.5,
        "near": 0.01, "far": 1000.0, "image_height": 300, "image_width": 400, "look_at": (0.0, 0.0, 0.0),
        "up_direction": (0.0, -1.0, 0.0),
    }  # fmt: skip
    return msgspec.msgpack.encode({**message, **changes})


@contextlib.contextmanager
def connected(live: LiveView, **options: Any) -> Iterator[Any]:
    from websockets.sync.client import connect

    address = live.address.replace("http", "ws")
    with connect(address, subprotocols=[f"viser-v{viser.__version__}"], max_size=None, **options) as connection:
        yield connection


@pytest.fixture
def live(variant: str) -> Iterator[LiveView]:
    view = LiveView(ball_result(), port=0)
    yield view
    view.close()


def test_a_page_of_elsewhere_opens_no_socket(live: LiveView) -> None:
    from websockets.exceptions import InvalidStatus

    with connected(live, origin=live.address):
        pass
    with pytest.raises(InvalidStatus, match="403"), connected(live, origin="http://evil.example"):
        pass
    request = urllib.request.Request(live.address, headers={"Host": "evil.example"})
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(request, timeout=10)
    with urllib.request.urlopen(live.address, timeout=10) as page:
        assert page.status == 200


def test_no_more_pages_than_are_answered(live: LiveView) -> None:
    from websockets.exceptions import InvalidStatus

    with contextlib.ExitStack() as pages:
        for _ in range(MAX_CLIENTS):
            pages.enter_context(connected(live))
        with pytest.raises(InvalidStatus, match="503"), connected(live):
            pass
    time.sleep(0.5)
    with connected(live):
        pass


NOT_CAMERAS: list[dict[str, Any]] = [
    {"image_height": 0}, {"image_width": 0}, {"image_height": -5}, {"image_height": "x"}, {"image_height": None},
    {"image_width": 2**63}, {"image_height": float("nan")}, {"fov": 0.0}, {"fov": float("inf")}, {"fov": "x"},
    {"fov": 1e-300}, {"wxyz": (0.0, 0.0, 0.0, 0.0)}, {"wxyz": (float("nan"),) * 4}, {"wxyz": (1.0,)}, {"wxyz": None},
    {"wxyz": (1e300,) * 4}, {"position": (1e300,) * 3}, {"position": (float("inf"),) * 3}, {"position": "abc"},
    {"position": ("a", "b", "c")}, {"position": ()}, {"position": (0.0, 0.0, 0.0)},
]  # fmt: skip


def run(live: LiveView, seconds: float) -> None:
    stop = time.monotonic() + seconds
    live.run(until=lambda: time.monotonic() > stop)


def test_no_message_ends_the_server(live: LiveView) -> None:
    from websockets.exceptions import ConnectionClosed

    with connected(live) as other:
        for changes in NOT_CAMERAS:
            with contextlib.suppress(ConnectionClosed), connected(live) as page:
                page.send(camera_message())
                run(live, 0.1)
                page.send(camera_message(**changes))
                run(live, 0.1)
        other.send(camera_message())
        run(live, 1.0)
        pictures = 0
        with contextlib.suppress(TimeoutError):
            while True:
                pictures += b"BackgroundImage" in other.recv(timeout=0.5)
    assert pictures


def test_a_camera_that_is_none_is_refused() -> None:
    turn, place = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
    assert browser_camera(turn, place, 0.5, 1e6, 100).width == 800
    for bad in ((0 * turn, place, 0.5, 1.0), (turn, place, 0.5, 0.0), (turn, place + np.nan, 0.5, 1.0)):
        with pytest.raises(InputError, match="camera: found"):
            browser_camera(*bad, 100)


@pytest.mark.parametrize("host", ["", "203.0.113.1", "no.such.host.invalid", "a" * 300, "\ud800"])
def test_a_host_that_can_not_be_bound_is_an_error_at_once(host: str, tmp_path, capfd) -> None:
    with pytest.raises(InputError, match="can't listen there"):
        check_address(host, 0)
    ball_result().model.save(tmp_path / "ball.npz")
    import dataclasses

    dataclasses.replace(ball_result(), model_source=str(tmp_path / "ball.npz")).save(tmp_path / "result")
    assert main(["view", str(tmp_path / "result"), "--port", "0", f"--host={host}"]) == 2
    assert "can't listen there" in capfd.readouterr().err


def test_a_port_that_is_taken(variant: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=f"--port {port}: can't listen there"):
            LiveView(ball_result(), port=port)
