"""A shot in the browser while it is edited: the document, the session, the server and the page."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

from vehsim.errors import InputError
from vehsim.runtime.signals import calling

NEEDS = ("websockets", "tomlkit")


def edit(path: Path, out: Path, host: str, port: int, token: str, ready: Callable[[str], None]) -> None:
    """Serve the shot file ``path`` until interrupted; ``ready`` is called with the page's address.

    Raises ``InputError`` for a file that cannot be read, an address that cannot be used, or without the extra ``live``.
    """
    missing = [name for name in NEEDS if find_spec(name) is None]
    if missing:
        raise InputError(f"needs {' and '.join(missing)}", 'pip install "vehsim[live]"', key="vehsim live")
    from vehsim.live.server import Server

    async def serve() -> None:
        loop, task = asyncio.get_running_loop(), asyncio.current_task()
        assert task is not None
        with calling(lambda: loop.call_soon_threadsafe(task.cancel)):
            await Server(path, out, host, port, token).run(ready)

    try:
        asyncio.run(serve())
    except (KeyboardInterrupt, asyncio.CancelledError):  # how a session ends
        return
    except OSError as error:
        raise InputError(f"cannot listen: {error.strerror}", "give another --port", key="--port", value=port) from None
