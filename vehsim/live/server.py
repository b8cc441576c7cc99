"""The server of a live session: one page, one socket, one thread that solves.

It listens on this machine only unless it is given another address and a token. A message that cannot be understood is
answered with its error; nothing that a browser sends ends the session. One browser edits, the others watch.
"""

from __future__ import annotations

import asyncio
import hmac
import json
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

from vehsim.errors import InputError, VehsimError
from vehsim.exporters.web.html import PAGE, page
from vehsim.live.messages import Compare, Drag, Edit, Message, MoveSticks, Place, TakeControls, kinds_of, parse
from vehsim.live.session import Session, Superseded
from vehsim.runtime.registry import whose_error

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

LOCAL = ("localhost", "127.0.0.1", "::1")
MAX_MESSAGE = 65_536
"""Largest message from a browser, bytes."""
EVERY = 0.1
"""Shortest time between two progress messages, s."""
MOST = 256 * 2**20
"""What may wait for a browser that does not read, bytes; then it is disconnected; if it returns, it sees everything."""
PAUSE = 0.15
"""Time without an event after which a drag pauses, s: a motion that lags behind is then solved to its end."""
SILENT = 120.0
"""Time after which a browser that answers no ping has gone, s."""
PARTING = 1.0
"""Time for a browser to answer when the server ends, s."""
PASSING = ("progress", "draft", "iterate", "preview", "live", "water")
"""Kinds of messages of which a slow browser needs only the newest."""
OWN = Path(__file__).parent / "page"
SCRIPTS = (PAGE / "three.min.js", PAGE / "viewer.js", OWN / "live.js", OWN / "edit.js", OWN / "drive.js")
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src blob: data:; connect-src 'self'"
)


class Server:
    """Serves one `Session`. ``ready`` is called with the page's address."""

    def __init__(self, path: Path, out: Path, host: str = "localhost", port: int = 0, token: str = "") -> None:
        if host not in LOCAL and not token:
            raise InputError("others could edit the shot", "give a --token too", key="--host", value=host)
        self._host, self._port, self._token = host, port, token
        self._session = Session(path, out, self._progress, self._show_now)
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="solver")
        self._browsers: list[Browser] = []
        self._scene: bytes | None = None
        self._water: bytes | None = None
        """How the water moves, if the page has been shown."""
        self._drawing_water = False
        self._told_motion = False
        self._drag: tuple[Drag, Browser] | None = None
        """A drag that is not drawn yet."""
        self._held: tuple[Drag, Browser] | None = None
        """The handle that a browser holds, where it was dragged last."""
        self._wake = asyncio.Event()
        self._jobs: list[Job] = []
        self._told = 0.0
        self._loop: asyncio.AbstractEventLoop | None = None

    async def run(self, ready: Callable[[str], None]) -> None:
        """Serve until cancelled."""
        from websockets.asyncio.server import serve

        self._loop = asyncio.get_running_loop()
        serving = serve(
            self._connected, self._host, self._port, process_request=self._answer, max_size=MAX_MESSAGE,
            compression=None, ping_timeout=SILENT, close_timeout=PARTING,
        )  # fmt: skip
        try:
            async with serving as server:
                try:
                    port = next(iter(server.sockets)).getsockname()[1]
                    query = f"?token={self._token}" if self._token else ""
                    ready(f"http://{self._host}:{port}/{query}")
                    await self._work()
                finally:
                    self._session.end()  # at once: parting from the browsers takes a while
                    await self._finish()
        finally:
            self._thread.shutdown(wait=True)
            self._session.close()

    # ------------------------------------------------------------ HTTP

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """The page, or None to go on with the socket."""
        where = urlsplit(request.path)
        if not self._allowed(request, where.query):
            return _response(HTTPStatus.FORBIDDEN, b"forbidden")
        if where.path == "/":
            text = page(self._session.document.path.stem, scripts=SCRIPTS)
            shown = text.encode(errors="replace")  # a file's name may be no text
            return _response(HTTPStatus.OK, shown, "text/html; charset=utf-8")
        if where.path == "/favicon.ico":
            return _response(HTTPStatus.NO_CONTENT, b"")
        return None if where.path == "/socket" else _response(HTTPStatus.NOT_FOUND, b"not found")

    def _allowed(self, request: Request, query: str) -> bool:
        """Whether a request comes from this page: with the token; from another site's page, never."""
        host = request.headers.get("Host", "")
        origin = request.headers.get("Origin")
        try:
            if origin is not None and urlsplit(origin).netloc != host:
                return False
            if self._token:
                given = parse_qs(query).get("token", [""])[0]
                return hmac.compare_digest(given.encode(), self._token.encode())
            return urlsplit(f"//{host}").hostname in LOCAL  # another name for this machine is an attack
        except ValueError:  # such as an address with one bracket
            return False

    # ------------------------------------------------------------ browsers

    async def _connected(self, socket: ServerConnection) -> None:
        from websockets.exceptions import ConnectionClosed

        browser = Browser(socket)
        self._browsers.append(browser)
        sending = asyncio.create_task(browser.send())
        self._roles()
        if self._told_motion:
            self._queue(Job(partial(self._show, browser)))
        elif self._scene is not None:  # else the first solve, which still runs, shows it the scene
            browser.tell(self._scene)
            if self._water is not None:
                browser.tell(self._water)
        browser.tell(self._session.state)
        try:
            with suppress(ConnectionClosed):
                async for text in socket:
                    self._received(browser, text)
        finally:
            sending.cancel()
            self._browsers.remove(browser)
            self._roles()
            if self._held is not None and self._held[1] is browser:  # closing in a drag releases the handle
                self._release(self._held[0])

    def _received(self, browser: Browser, text: str | bytes) -> None:
        try:
            message = parse(text)
            if browser is not self._browsers[0]:
                raise InputError("another browser is editing this shot", "close it first")
        except InputError as error:
            browser.tell({"kind": "refused", "text": str(error)})
            return
        if isinstance(message, MoveSticks):
            self._session.move_sticks(message)
        elif isinstance(message, Drag):
            self._drag = self._held = message, browser  # an older one that has not begun is of no use any more
            if self._session.take is not None:  # a drag needs a solved motion, so it waits for the first
                self._session.superseded.set()
            self._wake.set()
        else:
            self._act(message)

    def _release(self, held: Drag) -> None:
        """Place a handle where it was dragged last."""
        self._act(Place(**held.model_dump(exclude={"kind"})))

    def _act(self, message: Message) -> None:
        self._drag = self._held = None
        action = ACTIONS[message.kind]
        self._queue(Job(partial(self._do, action, message), action.supersedes))

    def _queue(self, job: Job) -> None:
        self._jobs.append(job)
        if job.supersedes or self._drawing_water:
            self._session.superseded.set()
        self._wake.set()

    def _roles(self) -> None:
        """Tell every browser whether it may edit: the one that came first may."""
        for k, browser in enumerate(self._browsers):
            browser.tell({"kind": "role", "editor": k == 0})

    def _tell(self, message: Any) -> None:
        for browser in self._browsers:
            browser.tell(message)

    def _progress(self, what: str, done: float) -> None:
        """Tell the browsers; called in the solver's thread."""
        now = monotonic()
        if self._loop is None or now < self._told + EVERY:
            return
        self._told = now
        message = {"kind": "progress", "text": what, "done": round(done, 3)}
        self._loop.call_soon_threadsafe(self._tell, message)

    def _show_now(self, block: bytes) -> None:
        """Tell the browsers what is drawn during a solve; called in the solver's thread."""
        assert self._loop is not None
        self._loop.call_soon_threadsafe(self._tell_block, block)

    def _tell_block(self, block: bytes) -> None:
        """Tell the browsers, and keep a scene for those that come later until motion follows it."""
        if (kind := _kind(block)) in ("scene", "motion"):
            self._scene = block if kind == "scene" else None
        if kind in ("scene", "water"):
            self._water = block if kind == "water" else None
        self._tell(block)

    # ------------------------------------------------------------ work

    async def _work(self) -> None:
        """Do what was requested, one after the other; then draw a drag, or finish what was interrupted."""
        await self._solve(self._session.solve)
        self._wake.set()
        while True:
            try:
                async with asyncio.timeout(PAUSE if self._session.lags else None):
                    await self._wake.wait()
            except TimeoutError:
                await self._draw_draft(self._session.catch_up, self._tell)
                continue
            self._wake.clear()
            while self._jobs or self._drag or (self._unfinished and self._held is None):
                job = self._jobs.pop(0) if self._jobs else None
                if not any(one.supersedes for one in self._jobs):
                    self._session.superseded.clear()
                if job is not None:
                    await job.run()
                elif self._drag:
                    (message, browser), self._drag = self._drag, None
                    await self._dragged(message, browser)
                elif self._session.interrupted:
                    await self._solve(self._session.solve)
                else:
                    await self._draw_water()

    async def _finish(self) -> None:
        """Write what was requested before the session ended, and a drag, into the document; nothing is solved."""
        if self._held is not None:
            self._release(self._held[0])
        for job in self._jobs:
            with suppress(Superseded):
                await job.run()

    @property
    def _unfinished(self) -> bool:
        """Whether something remains to be solved or drawn that a newer request interrupts."""
        return self._session.interrupted or self._session.waits_for_water

    async def _do(self, action: Action, message: Message) -> None:
        """Act on a message, and tell the browsers the new state, then how it went."""
        try:
            if action.solved and self._session.interrupted:
                await self._solve(self._session.solve)
            said = await action.run(self, message)
            answer = said and {"kind": "said", "text": said}
        except VehsimError as error:
            answer = {"kind": "refused", "text": str(error)}
        except OSError as error:
            answer = {"kind": "refused", "text": _described(error)}
        self._tell(self._session.state)
        if answer:
            self._tell(answer)

    async def _edit(self, message: Message) -> None:
        self._session.check(message)
        change = getattr(self._session, message.kind)
        await self._solve(lambda: change(message))

    async def _save(self, message: Message) -> str:
        await self._in_thread(self._session.document.save)  # after an edit that is made there when the session ends
        return f"saved {self._session.document.path.name}"

    async def _export(self, message: Message) -> str:
        return f"exported {await self._in_thread(self._session.export)}"

    async def _compare(self, message: Compare) -> None:
        self._tell(await self._in_thread(partial(self._session.compare, message)))

    async def _stop(self, message: Message) -> None:
        """Its arrival has ended the drive."""

    async def _solve(self, solve: Callable[[], bytes | None]) -> None:
        """Solve and show the result, or say why there is none."""
        self._tell({"kind": "progress", "text": "solving", "done": 0.0})
        refused, block = None, None
        try:
            block = await self._in_thread(solve)
        except Superseded:
            return
        except VehsimError as error:
            refused = {"kind": "refused", "text": str(error)}
        if block is not None:
            self._told_motion = True
            self._tell_block(block)
            await self._compared(self._tell)
            try:
                kept = await self._in_thread(self._session.compare_dragged)
            except Superseded:
                return
            except VehsimError:
                kept = None
            if kept is not None:
                self._tell_block(kept)
        self._tell(self._session.state)
        if refused is not None:
            self._tell(refused)
        if self._session.solved and not (self._jobs or self._drag):
            with suppress(VehsimError):
                await self._in_thread(self._session.prepare)

    async def _draw_water(self) -> None:
        """Show how the water moves around the vehicles."""
        self._drawing_water = True
        try:
            self._tell_block(await self._in_thread(self._session.water))
        except Superseded:
            return
        except VehsimError as error:
            self._tell({"kind": "refused", "text": str(error)})
        finally:
            self._drawing_water = False
        self._tell(self._session.state)

    async def _drive(self, message: TakeControls) -> None:
        """Drive until anything else is requested, or the browser that drives has gone."""
        session, loop, driver = self._session, self._loop, self._browsers[:1]
        assert loop is not None
        if session.waits_for_water and self._water is None:
            await self._draw_water()  # else a boat would ride waves that are not those of the picture
            if self._jobs or self._drag:
                return

        def ended() -> bool:
            gone = not driver or self._browsers[:1] != driver
            return gone or bool(self._jobs or self._drag) or session.superseded.is_set()

        def tell(what: Any) -> None:
            loop.call_soon_threadsafe(self._tell, what)

        driving = {"kind": "driving", "vehicle": message.vehicle}
        try:
            await self._solve(lambda: session.drive(message, lambda: tell(driving), tell, ended))
        finally:
            self._tell({"kind": "driven"})

    async def _show(self, browser: Browser) -> None:
        """Send a browser that came later what the others see."""
        if self._scene is None:
            with suppress(VehsimError, Superseded):
                self._scene = await self._in_thread(self._session.scene)
            self._tell(self._session.state)  # else every page goes on to say "drawing"
        if self._scene is not None:
            browser.tell(self._scene)
            if self._water is not None:
                browser.tell(self._water)
            await self._compared(browser.tell)

    async def _compared(self, tell: Callable[[bytes], None]) -> None:
        """Tell the recordings that are compared, if there are any."""
        if self._session.compared:
            with suppress(VehsimError):
                tell(await self._in_thread(self._session.comparison))

    async def _dragged(self, message: Drag, browser: Browser) -> None:
        await self._draw_draft(lambda: self._session.drag(message), browser.tell)

    async def _draw_draft(self, draft: Callable[[], bytes], refuse: Callable[[Any], None]) -> None:
        """Show a draft, or tell why there is none."""
        began = monotonic()
        try:
            block = await self._in_thread(draft)
        except VehsimError as error:
            refuse({"kind": "undrawn", "text": str(error)})
            return
        self._tell(block)
        self._tell({"kind": "drafted", "seconds": round(monotonic() - began, 4)})

    async def _in_thread(self, do: Callable[[], Any]) -> Any:
        """The result of ``do`` in the solver's thread. An error of vehsim itself must not end the session either.

        If the session ends first, it is done nevertheless.
        """
        assert self._loop is not None
        try:
            doing = self._loop.run_in_executor(self._thread, do)
            doing.add_done_callback(lambda done: done.cancelled() or done.exception())  # without a reader too
            return await asyncio.shield(doing)
        except (VehsimError, Superseded):
            raise
        except OSError as error:
            raise VehsimError(_described(error)) from error
        except Exception as error:
            raise VehsimError(f"{type(error).__name__}: {error}; this is {whose_error(error)}") from error


@dataclass(frozen=True)
class Job:
    """What the server does when its turn comes. ``supersedes``: it makes the present solve pointless."""

    run: Callable[[], Awaitable[None]]
    supersedes: bool = False


@dataclass(frozen=True)
class Action:
    """What the server does with a message, and the text that it answers, if any.

    ``supersedes``: it makes the present solve pointless; ``solved``: a solve that was interrupted comes first.
    """

    run: Callable[[Server, Any], Awaitable[str | None]]
    supersedes: bool = False
    solved: bool = False


ACTIONS = {
    **dict.fromkeys(kinds_of(Edit), Action(Server._edit, supersedes=True)),
    "drive": Action(Server._drive, supersedes=True, solved=True),
    "stop": Action(Server._stop),
    "compare": Action(Server._compare),
    "save": Action(Server._save),
    "export": Action(Server._export, solved=True),
}
"""Kind of message -> what the server does; drags and sticks are not queued."""


class Browser:
    """A connected browser. It receives messages at its own pace: one that does not read holds up none of the others."""

    def __init__(self, socket: ServerConnection) -> None:
        self._socket = socket
        self._waiting: list[tuple[str, str | bytes]] = []
        self._there = asyncio.Event()
        self._leaving: asyncio.Task[None] | None = None

    def tell(self, message: Any) -> None:
        """Send bytes, or a message as JSON, when those before are sent."""
        if self._leaving is not None:
            return
        kind = _kind(message) if isinstance(message, bytes) else str(message["kind"])
        if kind in PASSING:
            self._waiting = [one for one in self._waiting if one[0] != kind]
        self._waiting.append((kind, message if isinstance(message, bytes) else json.dumps(message)))
        if sum(len(text) for _, text in self._waiting) > MOST:
            self._leaving = asyncio.create_task(self._socket.close(1013, "it does not read"))
        self._there.set()

    async def send(self) -> None:
        """Send what waits, until cancelled or the browser has gone."""
        from websockets.exceptions import ConnectionClosed

        with suppress(ConnectionClosed):
            while await self._there.wait():
                self._there.clear()
                while self._waiting:
                    await self._socket.send(self._waiting.pop(0)[1])


def _described(error: OSError) -> str:
    return f"{error.filename}: {error.strerror}" if error.filename else error.strerror or str(error)


def _kind(block: bytes) -> str:
    length = int.from_bytes(block[:4], "little")
    return str(json.loads(block[4 : 4 + length])["kind"])


def _response(status: HTTPStatus, body: bytes, kind: str = "text/plain; charset=utf-8") -> Response:
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    headers = Headers(
        {
            "Content-Type": kind,
            "Content-Length": str(len(body)),
            "Content-Security-Policy": POLICY,
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cache-Control": "no-store",
            "Connection": "close",
        }
    )
    return Response(status.value, status.phrase, headers, body)
