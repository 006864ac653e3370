"""The page's server: nodes as bytes, for this machine alone, and nothing changed but by its own page."""

import http.client
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

from flightlog.errors import SourceError
from groundproc.viewer.edits import Edit
from groundproc.viewer.served import Served
from groundproc.viewer.server import ViewServer

Clouds = Callable[[int], tuple[Path, Path]]


@pytest.fixture(scope="module")
def saved() -> list[list[Edit]]:
    return []


@pytest.fixture(scope="module")
def server(clouds: Clouds, saved: list[list[Edit]]) -> Iterator[ViewServer]:
    def save(edits: list[Edit]) -> dict[str, Any]:
        saved.append(edits)
        return {"changed": 1, "points": 2, "file": "x"}

    _, octree = clouds(150_000)
    with Served(
        [octree], Path("<b>cloud.laz"), [np.array([[533_000.0, 6_472_000, 90], [533_050, 6_472_000, 90]])]
    ) as served:
        server = ViewServer(served, 0, save)
        yield server
        server.close()


def ask(server: ViewServer, path: str, method: str = "GET", body: Any = None, **headers: str) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
    connection.request(
        method,
        path,
        None if body is None else json.dumps(body),
        {name.replace("_", "-"): value for name, value in headers.items()},
    )
    answer = connection.getresponse()
    found = answer.status, answer.read()
    connection.close()
    return found


def test_all_nodes_together_are_the_cloud(server: ViewServer, clouds: Clouds) -> None:
    scene = server.served.scene
    shades = {shade["name"]: k for k, shade in enumerate(scene["shades"])}
    places, classes = [], []
    for *key, count in scene["trees"][0]["nodes"]:
        status, body = ask(server, "/node?key=0-" + "-".join(map(str, key)))
        assert status == 200
        assert len(body) == count * (12 + len(shades))
        places.append(np.frombuffer(body, "<f4", 3 * count).reshape(-1, 3))
        classes.append(np.frombuffer(body, np.uint8)[(12 + shades["classification"]) * count :][:count])
    told = np.rint((np.concatenate(places).astype(float) + scene["origin"]) * 1000).astype(int)
    whole = laspy.read(clouds(150_000)[0])
    own = np.rint(whole.xyz * 1000).astype(int)
    np.testing.assert_array_equal(told[np.lexsort(told.T)], own[np.lexsort(own.T)])
    assert np.bincount(np.concatenate(classes)).tolist() == np.bincount(whole.classification).tolist()
    assert scene["total"] == 150_000
    assert scene["paths"] == [
        [
            [p - o for p, o in zip(place, scene["origin"], strict=True)]
            for place in [[533_000.0, 6_472_000, 90], [533_050, 6_472_000, 90]]
        ]
    ]


def test_the_page_lets_nothing_in_but_what_its_own_server_says(server: ViewServer) -> None:
    status, body = ask(server, "/")
    assert status == 200
    text = body.decode()
    assert "default-src 'none'" in text
    assert "connect-src 'self'" in text
    assert "unsafe" not in text.split("</title>")[0]
    assert "<b>cloud" not in text


@pytest.mark.parametrize(
    "path",
    [
        "/node",
        "/node?key=0-0-0-0",
        "/node?key=0-9-0-0-0",
        "/node?key=0-0-0-0-x",
        "/node?key=0-99999999999-0-0-0",
        "/node?key=1-0-0-0-0",
        "/../x",
        "/edits",
    ],
)
def test_what_is_not_there_is_said(server: ViewServer, path: str) -> None:
    assert ask(server, path)[0] == 404


def test_only_this_machine_by_its_own_name_and_only_the_page_may_change_anything(
    server: ViewServer, saved: list[list[Edit]]
) -> None:
    assert ask(server, "/", Host="evil.example")[0] == 403
    loop = {"matrix": np.eye(4).ravel().tolist(), "loop": [[0, 0], [1, 0], [1, 1]], "to": 2, "of": None, "slab": None}
    assert ask(server, "/edits", "POST", {"version": 0, "edits": [loop]})[0] == 403
    assert ask(server, "/save", "POST", None, X_Swath_Token="guessed")[0] == 403
    assert ask(server, "/save", "POST", None, X_Swath_Token=server.token, Host="evil.example")[0] == 403
    assert server.edits == []
    assert saved == []
    own = {"X_Swath_Token": server.token}
    sentence = b"edits: expected a list of 10000 at most\n"
    assert ask(server, "/edits", "POST", {"version": 0, "edits": {}}, **own) == (400, sentence)
    assert ask(server, "/edits", "POST", [loop], **own)[0] == 400
    told = ask(server, "/edits", "POST", {"version": 0, "edits": [loop]}, **own)
    assert told == (200, b'{"edits": 1, "version": 1}')
    assert server.unsaved == 1
    assert b'"edits":[{"matrix":[1.0' in ask(server, "/")[1]  # a page that is loaded again has them
    for path in (
        "/edits",
        "/save",
    ):  # a page that was loaded before that loop was drawn is told of it, and changes nothing
        status, body = ask(server, path, "POST", {"version": 0, "edits": []}, **own)
        assert (status, json.loads(body)) == (409, {"edits": [loop], "version": 1})
    assert (server.unsaved, saved) == (1, [])
    assert ask(server, "/save", "POST", {"version": 1}, **own)[0] == 200
    assert [len(edits) for edits in saved] == [1]
    assert server.unsaved == 0
    assert ask(server, "/edits", "POST", [], Content_Length=str(10**9), **own)[0] == 413


def test_a_port_that_is_taken_is_one_sentence(server: ViewServer) -> None:
    with pytest.raises(SourceError, match=rf"^TCP port {server.port} at 127.0.0.1 cannot be opened"):
        ViewServer(server.served, server.port)
