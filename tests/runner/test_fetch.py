"""Folders from URLs: what is fetched, what is refused, and what is tried again."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from calib.core.errors import BadInputError
from calib.runner import fleet as fetch
from calib.runner.fleet import Allowed, local_folder

fsspec = pytest.importorskip("fsspec")


@pytest.fixture
def memory() -> Iterator[Any]:
    system = fsspec.filesystem("memory")
    system.store.clear()
    system.pseudo_dirs[:] = [""]
    yield system
    system.store.clear()


ANY = Allowed(("ftp", "memory"))


@pytest.fixture(autouse=True)
def _no_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fetch.time, "sleep", lambda _: None)


def test_what_belongs_to_a_rig_is_fetched_and_no_more(memory: Any, tmp_path: Path) -> None:
    for name in ("images/a.png", "images/board.yaml", "images/plane/p.jpg", "logs/x.csv", "rig.yaml"):
        memory.pipe(f"/rig/{name}", name.encode())
    for name in ("images/run.sh", "secret/key.csv", "images/deep/er/b.png"):
        memory.pipe(f"/rig/{name}", b"no")
    root = local_folder("memory://rig", tmp_path / "here", ANY)
    found = {path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()}
    assert found == {"images/a.png", "images/board.yaml", "images/plane/p.jpg", "logs/x.csv", "rig.yaml"}
    assert (root / "logs/x.csv").read_bytes() == b"logs/x.csv"


def test_what_is_too_large_is_refused(memory: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fetch, "MOST_BYTES", 1000)
    memory.pipe("/rig/images/a.png", b"x" * 600)
    memory.pipe("/rig/images/b.png", b"x" * 600)
    with pytest.raises(BadInputError, match="larger than"):
        local_folder("memory://rig", tmp_path / "here", ANY)


@pytest.mark.parametrize("name", ["a/../../evil.png", "a\\..\\..\\evil.png", "/etc/evil.png"])
def test_names_that_lead_out_stay_in(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class System:
        def ls(self, place: str, **_: Any) -> list[dict[str, str]]:
            if place.endswith("images"):
                return [{"name": name, "type": "file"}]
            return []

        def open(self, remote: str, mode: str) -> Any:
            assert remote == name
            return (tmp_path / "source").open(mode)

    (tmp_path / "source").write_bytes(b"x")
    monkeypatch.setattr(fsspec.core, "url_to_fs", lambda url, **_: (System(), "/rig"))
    root = local_folder("ftp://host/rig", tmp_path / "deep" / "er" / "here", ANY)
    assert list(tmp_path.rglob("evil.png")) == [root / "images" / "evil.png"]


@pytest.mark.parametrize("name", ["-rf.png", ".hidden.png", "a\nb.png"])
def test_names_that_are_no_names_are_refused(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class System:
        def ls(self, *_: Any, **__: Any) -> list[dict[str, str]]:
            return [{"name": f"/rig/{name}", "type": "file"}]

    monkeypatch.setattr(fsspec.core, "url_to_fs", lambda url, **_: (System(), "/rig"))
    with pytest.raises(BadInputError, match="has a file with the name"):
        local_folder("ftp://host/rig", tmp_path / "here", ANY)


class _Flaky:
    def __init__(self, failures: int, error: Exception) -> None:
        self.failures, self.error, self.calls = failures, error, 0

    def ls(self, *_: Any, **__: Any) -> list[dict[str, str]]:
        self.calls += 1
        if self.calls <= self.failures:
            raise self.error
        return []


@pytest.mark.parametrize(
    ("failures", "error", "said", "calls"),
    [
        (99, ConnectionResetError("gone"), "could not be fetched in 3 attempts: gone", 3),
        (99, PermissionError("locked"), "cannot be read: locked", 1),
        (99, FileNotFoundError("none"), "cannot be read: none", 1),
        (2, TimeoutError("slow"), "holds no pictures and no logs", 7),
    ],
)
def test_what_may_pass_is_tried_again(
    failures: int, error: Exception, said: str, calls: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = _Flaky(failures, error)
    monkeypatch.setattr(fsspec.core, "url_to_fs", lambda url, **_: (system, "/rig"))
    with pytest.raises(BadInputError, match=said) as told:
        local_folder("ftp://me:secret@host/rig?key=1", tmp_path / "here", ANY)
    # Two failed attempts and four folders with nothing in them; the first one is asked again each time.
    assert system.calls == calls - (error.args == ("slow",))
    assert "secret" not in str(told.value) and "key" not in str(told.value)


def test_what_a_file_system_says_of_a_url_has_no_secret_in_it() -> None:
    url = "https://user:word@host/a/b.png?key=1&x=2"
    said = fetch._words(FileNotFoundError(f"('{url}', 404) and {url}"))
    assert said == "('https://host/a/b.png', 404) and https://host/a/b.png"
    assert fetch._words(OSError("is this a?b")) == "is this a?b"


@pytest.mark.parametrize(
    ("url", "said"),
    [
        (
            "ftp://host/rig",
            "scheme ftp, expected file, gs, https, s3; allow it with --allow-scheme ftp",
        ),
        ("http://example.org/rig", "scheme http"),
        ("zip://rig::https://example.org/a.zip", "scheme zip"),
        ("https://example.org/a::ssh://host/rig", "scheme ssh"),
        ("https://127.0.0.1/rig", "private network; allow that with --allow-private"),
        ("https://[::1]/rig", "scheme"),
        ("https://169.254.169.254/latest/meta-data", "private network"),
        ("https://10.0.0.7/rig", "private network"),
        ("https://localhost:8443/rig", "private network"),
    ],
)
def test_what_is_not_to_be_fetched_is_not_asked_for(
    url: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: Any, **__: Any) -> Any:
        raise AssertionError

    monkeypatch.setattr(fsspec.core, "url_to_fs", never)
    with pytest.raises(BadInputError, match=re.escape(said)):
        local_folder(url, tmp_path)


def test_what_a_person_allows_is_fetched_and_no_further(tmp_path: Path) -> None:
    """From a server on this machine; the place where it sends one on to is not asked."""
    asked: list[str] = []

    class Server(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)
            if self.path.startswith("/elsewhere"):
                self.send_response(302)
                self.send_header("Location", self.path.replace("elsewhere", "rig"))
                self.end_headers()
                return
            listing = b"<a href='x.csv'>x.csv</a>" if self.path.rstrip("/").endswith("logs") else b""
            self.send_response(200)
            self.end_headers()
            self.wfile.write(b"t_s\n0\n" if self.path.endswith("x.csv") else listing)

        do_HEAD = do_GET

        def log_message(self, *_: Any) -> None: ...

    server = ThreadingHTTPServer(("127.0.0.1", 0), Server)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        base, allowed = f"http://127.0.0.1:{server.server_port}", Allowed(("http",), private=True)
        root = local_folder(f"{base}/rig", tmp_path / "a", allowed)
        assert (root / "logs" / "x.csv").read_bytes() == b"t_s\n0\n"
        asked.clear()
        with pytest.raises(BadInputError):
            local_folder(f"{base}/elsewhere", tmp_path / "b", allowed)
        assert asked and all(path.startswith("/elsewhere") for path in asked)
    finally:
        server.shutdown()
        server.server_close()
