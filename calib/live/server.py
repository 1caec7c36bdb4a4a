"""The page of a live session and its websocket, on this machine alone.

Every request must name this server in `Host`, come from its own page by `Origin`, and know the token in the
address: a page of another site, even one whose name leads here, cannot drive the session. Frames, pictures
and tabs are bounded before anything is decoded. The state is the session and its folder; a page that
reloads gets all of it.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import json
import secrets
import socket
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from calib.core.arrays import AnyArray
from calib.core.errors import BadInputError, CalibError
from calib.core.files import read_bytes, shown
from calib.core.rig import Rig
from calib.core.workers import Failure, Pool, Task, run_tasks
from calib.io.pictures import declared_pixels, decode, decoded_picture
from calib.live.album import MOST_PICTURES, Album, fit_of
from calib.live.board import Board
from calib.live.marker import Marker
from calib.live.plane import Flat
from calib.live.session import Seen, Session
from calib.live.sources import MOST_PIXELS, Source

PAGE = Path(__file__).with_name("live.html")
MOST_BYTES = 64_000_000
"""Of one message: a picture of `MOST_PIXELS` as PNG."""
_MOST_PREVIEW_BYTES = 4_000_000
_MOST_WORDS = 2_000
_MOST_TABS = 6
_MOST_WAITING = 100
"""Messages that wait for a page: those of some seconds."""
_LAST_WORDS_S = 1.0
_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
_PREVIEW_PX = 800
_SWITCH_S = 0.0005
STEPS = ("camera", "plane", "marker", "board")
_PLOTS_S = 0.3
_CLOCK_S = 5.0
"""By how much the times of a page's camera may be off this computer's before they are another camera's."""
_SHOT_S = 5.0
"""How long a page may take to send the whole picture that it was asked for."""


@dataclass(eq=False)
class _Tab:
    """One page that is open."""

    socket: WebSocket
    waiting: asyncio.Queue[str | bytes] = field(default_factory=lambda: asyncio.Queue(_MOST_WAITING))
    behind: asyncio.Event = field(default_factory=asyncio.Event)
    """It does not take what it is told, as one that sleeps: no other page waits for it."""
    busy: bool = False
    size_px: tuple[int, int] | None = None
    shot_until: float = 0.0
    by_hand: bool = False
    taken_s: float | None = None
    clock_s: float | None = None
    """What its camera's times lack to those of this computer."""

    async def tell(self, message: dict[str, Any] | bytes) -> None:
        """Send words or a frame, when it is their turn."""
        text = message if isinstance(message, bytes) else json.dumps(message, allow_nan=False)
        try:
            self.waiting.put_nowait(text)
        except asyncio.QueueFull:
            self.behind.set()

    async def show(self, jpeg: bytes) -> None:
        """Send a frame, unless the page is still busy with another."""
        if not self.busy and self.waiting.empty():
            await self.tell(jpeg)

    async def send(self) -> None:
        """Send what waits, until the page has gone, which is no reason to fail."""
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            while True:
                message = await self.waiting.get()
                self.busy = True
                if isinstance(message, bytes):
                    await self.socket.send_bytes(message)
                else:
                    await self.socket.send_text(message)
                self.busy = False
                self.waiting.task_done()


class Live:
    """A session, its folder, where frames come from, and the pages that look at it."""

    def __init__(
        self, session: Session, album: Album, source: Source | None, port: str | None = None
    ) -> None:
        self.session, self.album, self.source = session, album, source
        self.step = STEPS[0]
        self.flat, self.marker = Flat(session), Marker(album)
        self.board = None if port is None else Board(album, port)
        self.rig = Rig.load(album.rig, missing_ok=True)
        self.token = secrets.token_urlsafe(24)
        self.finished = threading.Event()
        self.auto = True
        self._lock = threading.Lock()
        self._tabs: list[_Tab] = []
        self._camera: _Tab | None = None
        self._lent: _Tab | None = None
        self._looking = ThreadPoolExecutor(1, "look")
        self._fitting = ThreadPoolExecutor(1, "fit")
        # Of its own, so that no frame waits for the interpreter while pictures are fitted.
        self._process = Pool(1)
        self._wanted, self._fits = 0, 0
        self._by_hand = False
        self._known: tuple[Any, Any] = (None, None)
        self._saved = ""
        self._tasks: set[asyncio.Task[None]] = set()

    # ------------------------------------------------------------------
    # What pages are told.

    def state(self) -> dict[str, Any]:
        """All that a page shows."""
        with self._lock:
            shown_ = self.session.shown()
            steps = {"plane": self.flat.shown(self.rig), "marker": self.marker.shown()}
        return {
            "type": "state",
            **shown_,
            **steps,
            "step": self.step,
            "board": None if self.board is None else self.board.shown(),
            "dropped": self.album.left_out(),
            "folder": str(self.album.folder),
            "source": "browser" if self.source is None else "single" if self.source.single else "here",
            "saved": self._saved,
            "auto": self.auto,
            "fitting": self._fits < self._wanted,
        }

    async def tell_all(self, message: dict[str, Any]) -> None:
        """Send words to every page."""
        for tab in list(self._tabs):
            await tab.tell(message)

    async def _in(self, pool: ThreadPoolExecutor, work: Callable[..., Any], *given: Any) -> Any:
        return await asyncio.get_running_loop().run_in_executor(pool, work, *given)

    def _start(self, work: Any) -> None:
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    # ------------------------------------------------------------------
    # Frames and pictures.

    def _look(
        self, frame: AnyArray, size_px: tuple[int, int] | None, still: bool, taken_s: float | None = None
    ) -> tuple[dict[str, Any], bool]:
        """What a page is told of a frame, and whether it shall be taken."""
        now = time.monotonic()
        with self._lock:
            if self.step == "board":
                return {"type": "seen", "code": "hold", "says": "", "corners": None}, False
            if self.step == "marker":
                told = self.marker.follow(frame, now if taken_s is None else taken_s)
                return {"type": "seen", "corners": None, **told}, False
            gray = frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
            gray8 = np.asarray(gray, dtype=np.uint8)
            if self.step == "plane":
                return _seen(self.flat.look(gray8, size_px)), False
            seen = self.session.look(gray8, now, size_px, still)
            return _seen(seen), seen.take and self.auto

    def _take(self, png: bytes, by_hand: bool) -> str | Seen:
        """Name of a picture that was taken and saved, or why it was not, or what else is to be done."""
        gray = decoded_picture(png, "the picture", "picture", "").gray
        with self._lock:
            if self.step == "plane":
                return self.flat.take(gray, png)
            # A picture that was asked for may still be under way when taking by itself is switched off.
            if self.step != "camera" or not (by_hand or self.auto):
                return Seen(None, "hold", "")
            if len(self.session.views) >= MOST_PICTURES:
                raise BadInputError(f"there are {MOST_PICTURES} pictures already, the most of one session")
            name = self.album.new_name()
            taken = self.session.accept(gray, name, by_hand)
            if isinstance(taken, Seen):
                return taken
            try:
                self.album.describe(self.session.board_file())
                self.album.add(name, png)
            except BadInputError:
                self.session.drop(name)
                raise
        return name

    async def _learnt(self) -> None:
        """Where a frame has told the size of the picture or of the board, the outline is another one."""
        learnt = self.session.size_px, self.session.corners
        if learnt != self._known:
            if self._known[1] is None:
                self._fitting.submit(self._fitted, None)
            self._known = learnt
            await self.tell_all(self.state())

    async def _taken(self, png: bytes, by_hand: bool) -> None:
        try:
            name = await self._in(self._looking, self._take, png, by_hand)
        except CalibError as error:
            await self.tell_all({"type": "fault", "says": str(error)})
            return
        if isinstance(name, Seen):
            await self.tell_all({**_seen(Seen(None, name.code, name.says)), "answer": True})
            if name.code == "taken":
                await self.tell_all({"type": "taken", "name": ""})
                await self.tell_all(self.state())
            return
        await self.tell_all({"type": "taken", "name": name})
        await self._changed()

    async def _changed(self) -> None:
        """The pictures are others now: calibrate again, in the background."""
        self._wanted += 1
        await self.tell_all(self.state())
        self._start(self._fit(self._wanted))

    async def _fit(self, number: int) -> None:
        # Of several changes in a row only the last is worth a fit.
        await self._in(self._fitting, self._calibrate, number)
        await self.tell_all(self.state())

    def _calibrate(self, number: int) -> None:
        if number < self._wanted:
            return
        fit, self._saved = None, ""
        if self.album.names():
            fit = self._fitted(self.album)
            if isinstance(fit, Failure):
                words = fit.error if isinstance(fit.error, CalibError) else "the calibration broke off"
                fit, self._saved = None, f"not saved: {words}"
            else:
                self._saved = str(self.album.rig)
        try:
            rig = Rig.load(self.album.rig, missing_ok=True)
        except BadInputError as error:
            # An editor may have it open at this moment.
            rig, self._saved = self.rig, f"not saved: {error}"
        with self._lock:
            self.session.fitted(fit)
            self.rig = rig
        self._fits = number

    def _fitted(self, album: Album | None) -> Any:
        """What `fit_of` returns in the process for fits, or a `Failure`."""
        return next(result for _, result in run_tasks(self._process, [Task("fit", fit_of, (album,))]))

    async def pump(self) -> None:
        """Take frames from a source of this machine until it is over."""
        assert self.source is not None
        fault = ""
        while True:
            frame = await asyncio.to_thread(self.source.read)
            if self.source.fault != fault:
                fault = self.source.fault
                await self.tell_all({"type": "camera", "fault": fault})
            if frame is None:
                continue
            seen, take = await self._in(self._looking, self._look, frame, None, self.source.single)
            await self._learnt()
            preview = await asyncio.to_thread(_preview, frame)
            for tab in list(self._tabs):
                await tab.show(preview)
            await self.tell_all(seen)
            by_hand, self._by_hand = self._by_hand, False
            if by_hand or take:
                _, png = cv2.imencode(".png", frame)
                await self._taken(png.tobytes(), by_hand)

    # ------------------------------------------------------------------
    # A page.

    async def page(self, websocket: WebSocket) -> None:
        """Serve one tab until it closes."""
        if len(self._tabs) >= _MOST_TABS:
            await websocket.close(1013)
            return
        await websocket.accept()
        tab = _Tab(websocket)
        self._tabs.append(tab)
        work = [asyncio.ensure_future(one) for one in (self._listen(tab), tab.send(), tab.behind.wait())]
        try:
            # The first that ends is the end; a page that was behind connects again, and gets all.
            for one in (await asyncio.wait(work, return_when=asyncio.FIRST_COMPLETED))[0]:
                one.result()
        finally:
            for each in work:
                each.cancel()
            self._tabs.remove(tab)
            if self._camera is tab:
                self._camera = None
                await self.tell_all({"type": "free"})

    async def _listen(self, tab: _Tab) -> None:
        await tab.tell(await asyncio.to_thread(self.state))
        if self.source is not None and self.source.fault:
            await tab.tell({"type": "camera", "fault": self.source.fault})
        while (message := await tab.socket.receive())["type"] != "websocket.disconnect":
            if message.get("bytes") is not None:
                await self._frame(tab, message["bytes"])
            else:
                await self._asked(tab, message.get("text") or "")

    async def _asked(self, tab: _Tab, text: str) -> None:
        asked: Any = None
        if len(text) <= _MOST_WORDS:
            with contextlib.suppress(ValueError, RecursionError):
                asked = json.loads(text)
        what = asked.get("do") if isinstance(asked, dict) else None
        name = str(asked.get("name", "")) if isinstance(asked, dict) else ""
        if what == "camera":
            tab.size_px = _size_px(asked.get("size"))
            await self._lend(tab)
        elif what == "at":
            await self._at(tab, asked.get("t_s"))
        elif what == "take":
            if self.source is not None:
                self._by_hand = True
            elif self._camera is not None:
                await self._shoot(self._camera, by_hand=True)
        elif what == "auto":
            self.auto = asked.get("on") is True
            await self.tell_all(self.state())
        elif what in ("drop", "back"):
            await self._put(name, what == "back")
        elif what == "done":
            await self._done()
        elif what in self._steps:
            try:
                pool = self._fitting if what == "place" else self._looking
                says = await self._in(pool, self._steps[what], asked)
                if says is not None:
                    await self.tell_all({**_seen(Seen(None, "hold", says)), "answer": True})
            except CalibError as error:
                says = str(error)
                await self.tell_all({"type": "fault", "says": says[:1].upper() + says[1:]})
            await self.tell_all(await asyncio.to_thread(self.state))
        else:
            await tab.tell({"type": "fault", "says": "The page asked for what this version does not know."})

    # ------------------------------------------------------------------
    # Plane, marker and board: what a page asks of them.

    @property
    def _steps(self) -> dict[str, Callable[[dict[str, Any]], str | None]]:
        return {
            "step": self._go,
            "point": self._point,
            "place": self._place,
            "again": lambda asked: self._held(self.flat.drop),
            "colour": lambda asked: self._held(self.marker.named, str(asked.get("name", ""))),
            "record": self._record,
            "stop": self._stop,
        }

    def _held(self, work: Callable[..., None], *given: Any) -> None:
        with self._lock:
            work(*given)

    def _go(self, asked: dict[str, Any]) -> None:
        step = asked.get("name")
        if step not in STEPS:
            raise BadInputError("there is no such step")
        if step == "board" and self.board is None:
            raise BadInputError("no board is connected: start calib live with --port, as --port /dev/ttyUSB0")
        if step == "plane" and self.rig.camera is None:
            raise BadInputError("the camera comes first: take its pictures")
        with self._lock:
            self.marker.stop()
            self.step = step

    def _point(self, asked: dict[str, Any]) -> None:
        at = asked.get("at")
        if not (
            isinstance(at, list)
            and len(at) == 2
            and all(isinstance(x, int | float) and abs(x) < 1e5 for x in at)
        ):
            raise BadInputError("that is no place in the picture")
        if self.step == "plane":
            self._held(self.flat.choose, (at[0], at[1]))
        elif self.step == "marker":
            self._held(self.marker.click, (at[0], at[1]))

    def _place(self, asked: dict[str, Any]) -> str:
        """Save the board in the plane where a person says it lies, calibrate the plane, and say so."""
        with self._lock:
            board, png = self.flat.place(asked), self.flat.png
        assert png is not None
        self.album.lay(png, board)
        rig = Rig.load(self.album.rig)
        with self._lock:
            self.rig = rig
            self.flat.drop()
        assert rig.plane is not None
        return f"The plane is saved. Its verdict: {rig.plane.verdict.word}."

    def _record(self, asked: dict[str, Any]) -> None:
        if self.step == "marker":
            self._held(self.marker.start)
        elif self.step == "board" and self.board is not None:
            self._held(self.board.start, str(asked.get("name", "")))

    def _stop(self, asked: dict[str, Any]) -> None:
        del asked
        self._held(self.marker.stop)
        if self.board is not None:
            self.board.stop()

    async def _plots(self) -> None:
        """Tell the pages what a board sends, as long as it does."""
        while True:
            await asyncio.sleep(_PLOTS_S)
            board = self.board
            if board is not None and board.at_work and self._tabs:
                ended = await asyncio.to_thread(board.ended)
                if ended:
                    await self.tell_all(await asyncio.to_thread(self.state))
                else:
                    await self.tell_all({"type": "board", "board": await asyncio.to_thread(board.shown)})
            elif self.step == "marker" and self._tabs:
                with self._lock:
                    told = self.marker.shown()
                await self.tell_all({"type": "marker", "marker": told})

    async def _lend(self, tab: _Tab) -> None:
        """Let this page's camera be the one that counts."""
        before, self._camera = self._camera, tab
        if self._lent not in (None, tab):
            await self._other_camera()
        self._lent = tab
        if before is not None and before is not tab:
            await before.tell({"type": "lent"})

    async def _at(self, tab: _Tab, at_s: Any) -> None:
        """Take the time of a page's next frame, on this computer's clock from its first one on."""
        before, now, tab.taken_s = tab.taken_s, time.monotonic(), None
        if not (isinstance(at_s, int | float) and 0 <= at_s < 1e9):
            return
        if tab.clock_s is not None:
            taken_s = at_s + tab.clock_s
            if abs(now - taken_s) > _CLOCK_S or (before is not None and taken_s < before):
                await self._other_camera()
                tab.clock_s = None
        if tab.clock_s is None:
            tab.clock_s = now - at_s
        tab.taken_s = at_s + tab.clock_s

    async def _other_camera(self) -> None:
        """End a recording whose camera is another one from now on: a log has one clock."""
        if self.marker.recording:
            await self._in(self._looking, self._held, self.marker.stop)
            says = "The camera is another one now: the recording has ended. Begin a new one."
            await self.tell_all({"type": "fault", "says": says})
            await self.tell_all(await asyncio.to_thread(self.state))

    async def _shoot(self, tab: _Tab, by_hand: bool) -> None:
        tab.shot_until, tab.by_hand = time.monotonic() + _SHOT_S, by_hand
        await tab.tell({"type": "shoot"})

    async def _frame(self, tab: _Tab, data: bytes) -> None:
        """A frame of a page's camera: a JPEG to look at, or the PNG that was asked for."""
        if tab is not self._camera or self.source is not None:
            return
        pixels = declared_pixels(data)
        if not 0 < pixels <= MOST_PIXELS:
            await tab.tell({"type": "fault", "says": f"A frame has no size, or over {MOST_PIXELS} pixels."})
        elif data.startswith(_PNG) and time.monotonic() < tab.shot_until:
            tab.shot_until = 0.0
            await self._taken(data, tab.by_hand)
        elif data.startswith(_JPEG) and len(data) <= _MOST_PREVIEW_BYTES:
            frame = await self._in(self._looking, decode, data, True)
            if frame is None:
                await tab.tell({"type": "fault", "says": "A frame cannot be decoded."})
                return
            seen, take = await self._in(self._looking, self._look, frame, tab.size_px, False, tab.taken_s)
            await self._learnt()
            for other in list(self._tabs):
                await other.tell(seen)
                if other is not tab:
                    await other.show(data)
            if take and time.monotonic() >= tab.shot_until:
                await self._shoot(tab, by_hand=False)

    async def _put(self, name: str, back: bool) -> None:
        """Drop a picture or take it back, on the disk and in the session."""
        try:
            if back and self.album.take_back(name):
                data = await asyncio.to_thread(read_bytes, self.album.images / name)
                await self._in(self._looking, self._again, name, data)
            elif not back and self.album.drop(name):
                with self._lock:
                    self.session.drop(name)
            elif self.album.picture(name) is None:
                raise BadInputError(f"{shown(name)}: is not there")
        except CalibError as error:
            await self.tell_all({"type": "fault", "says": str(error)})
            return
        await self._changed()

    def _again(self, name: str, data: bytes) -> None:
        gray = decoded_picture(data, shown(name), name, "").gray
        with self._lock:
            self.session.accept(gray, name, by_hand=True)

    async def _done(self) -> None:
        await self.tell_all({"type": "done", "folder": str(self.album.folder)})
        told = [asyncio.ensure_future(tab.waiting.join()) for tab in self._tabs]
        await asyncio.wait(told, timeout=_LAST_WORDS_S)
        self.finished.set()

    # ------------------------------------------------------------------
    # Serving.

    def application(self, port: int) -> ASGIApp:
        """The ASGI application behind its guard."""

        async def html(request: Request) -> Response:
            del request
            nonce = secrets.token_urlsafe(16)
            text = PAGE.read_text(encoding="utf-8").replace("{{nonce}}", nonce)
            policy = (
                f"default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; "
                "img-src 'self' data:; connect-src 'self'; media-src 'self' mediastream:; "
                "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
            )
            return HTMLResponse(text, headers={"content-security-policy": policy})

        async def thumb(request: Request) -> Response:
            path = self.album.picture(str(request.path_params["name"]))
            if path is None:
                return PlainTextResponse("no such picture\n", 404)
            return Response(await asyncio.to_thread(_thumbnail, path), media_type="image/jpeg")

        async def held(request: Request) -> Response:
            del request
            png = self.flat.png
            frame = None if png is None else await asyncio.to_thread(decode, png, True)
            if frame is None:
                return PlainTextResponse("no picture in hand\n", 404)
            return Response(await asyncio.to_thread(_preview, frame), media_type="image/jpeg")

        @contextlib.asynccontextmanager
        async def lifespan(_: Starlette) -> Any:
            if self.album.names():
                await self._changed()
            if self.source is not None:
                self._start(self.pump())
            self._start(self._plots())
            yield
            for task in list(self._tasks):
                task.cancel()

        root = f"/{self.token}"
        routes = [
            Route(f"{root}/", html),
            Route(f"{root}/picture/{{name}}", thumb),
            Route(f"{root}/held", held),
            WebSocketRoute(f"{root}/socket", self.page),
        ]
        return Guard(Starlette(routes=routes, lifespan=lifespan), self.token, port)

    def serve(self, ready: Callable[[str], None]) -> None:
        """Serve until a page says that it is done, or Ctrl-C; `ready` gets the address.

        The last fit is waited for.
        """
        listener = socket.create_server(("127.0.0.1", 0))
        port = int(listener.getsockname()[1])
        config = uvicorn.Config(
            self.application(port), log_config=None, access_log=False, server_header=False,
            ws="websockets-sansio", ws_max_size=MOST_BYTES, lifespan="on", timeout_graceful_shutdown=1,
        )  # fmt: skip
        server = uvicorn.Server(config)
        # A frame is to be answered while pictures are fitted in the next thread.
        usual = sys.getswitchinterval()
        sys.setswitchinterval(_SWITCH_S)
        # In a thread of its own it leaves Ctrl-C to the command.
        thread = threading.Thread(target=server.run, args=([listener],), daemon=True)
        thread.start()
        try:
            ready(f"http://127.0.0.1:{port}/{self.token}/")
            while not self.finished.wait(0.5):
                if not thread.is_alive():
                    raise BadInputError("the page cannot be served: the server has stopped")
        finally:
            server.should_exit = True
            thread.join(5.0)
            self._stop({})
            if self.source is not None:
                self.source.close()
            self._looking.shutdown(cancel_futures=True)
            self._fitting.shutdown()
            self._process.__exit__()
            listener.close()
            sys.setswitchinterval(usual)


class Guard:
    """Lets through what comes from this server's own page and knows the token."""

    def __init__(self, app: ASGIApp, token: str, port: int) -> None:
        self._app, self._token = app, token
        self._hosts = {f"127.0.0.1:{port}", f"localhost:{port}"}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """As an ASGI application."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        status = self._refusal(scope)
        if status is None:
            await self._app(scope, receive, _with_headers(send))
        elif scope["type"] == "websocket":
            # Before it is accepted, closing is answered with 403.
            await send({"type": "websocket.close", "code": 1008})
        else:
            await PlainTextResponse("refused\n", status)(scope, receive, send)

    def _refusal(self, scope: Scope) -> int | None:
        """Status of what is refused; None for what may pass."""
        headers = [(key.decode("latin-1"), value.decode("latin-1")) for key, value in scope["headers"]]
        hosts = [value for key, value in headers if key == "host"]
        origins = [value for key, value in headers if key == "origin"]
        if len(hosts) != 1 or hosts[0] not in self._hosts:
            return 403
        # A browser says where a websocket comes from; one without is no page of this server.
        if len(origins) != (1 if scope["type"] == "websocket" else len(origins[:1])):
            return 403
        if any(one != f"http://{hosts[0]}" for one in origins):
            return 403
        if scope["type"] == "http" and scope["method"] not in ("GET", "HEAD"):
            return 405
        first = str(scope["path"]).split("/")[1] if str(scope["path"]).startswith("/") else ""
        return None if hmac.compare_digest(first.encode(), self._token.encode()) else 404


def _size_px(size: Any) -> tuple[int, int] | None:
    """Width and height of a page's camera, as far as they can be that."""
    if not (isinstance(size, list) and len(size) == 2 and all(isinstance(side, int) for side in size)):
        return None
    width, height = size
    return (width, height) if min(size) >= 8 and width * height <= MOST_PIXELS else None


def _with_headers(send: Send) -> Send:
    async def sends(message: Any) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [
                *message["headers"],
                (b"cache-control", b"no-store"),
                # The address holds the token.
                (b"referrer-policy", b"no-referrer"),
                (b"x-content-type-options", b"nosniff"),
                (b"cross-origin-resource-policy", b"same-origin"),
                (b"cross-origin-opener-policy", b"same-origin"),
            ]
        await send(message)

    return sends


def _seen(seen: Seen) -> dict[str, Any]:
    corners = None if seen.corners_px is None else np.round(seen.corners_px, 1).tolist()
    return {
        "type": "seen",
        "code": seen.code,
        "says": seen.says,
        "corners": corners,
        "matched": round(seen.matched, 2),
    }


def _smaller(frame: AnyArray, most_px: int) -> AnyArray:
    share = most_px / max(frame.shape[:2])
    return frame if share >= 1 else cv2.resize(frame, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)


def _preview(frame: AnyArray) -> bytes:
    return cv2.imencode(".jpg", _smaller(frame, _PREVIEW_PX), [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()


def _thumbnail(path: Path) -> bytes:
    frame = decode(read_bytes(path), colour=True)
    blank = np.zeros((8, 8), dtype=np.uint8)
    return _preview(_smaller(blank if frame is None else frame, 240))
