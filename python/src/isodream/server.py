"""Serves environments to Isodream's actors (`proto/isodream/v1/environment.proto`)."""

import asyncio
import logging
import os
import signal
import threading
from collections.abc import Coroutine
from concurrent.futures import wait
from pathlib import Path
from typing import Any, Self, TypedDict, Unpack

import grpc.aio
from grpc_health.v1 import health, health_pb2, health_pb2_grpc

from isodream.environment import Spec
from isodream.security import Secrets
from isodream.service import SERVICE, EnvironmentService
from isodream.workers import MakeEnv, Worker

MAX_MESSAGE_BYTES = 64 << 20
# How long streams, and then environments, may take to end when the server stops.
GRACE_SECS = 3.0
OPTIONS = [
    ("grpc.max_receive_message_length", MAX_MESSAGE_BYTES),
    ("grpc.max_send_message_length", MAX_MESSAGE_BYTES),
    # Otherwise a second server takes the same port, and half of the clients.
    ("grpc.so_reuseport", 0),
    ("grpc.keepalive_time_ms", 10_000),
    ("grpc.keepalive_timeout_ms", 10_000),
    # Clients ping every ten seconds also while they wait, which gRPC takes for an attack.
    ("grpc.http2.max_ping_strikes", 0),
]

_log = logging.getLogger("isodream")


class Server:
    """A server that runs beside the rest of the program.

    ```python
    with isodream.Server(make_env) as server:
        print(server.address)
    ```
    """

    def __init__(
        self,
        make_env: MakeEnv,
        *,
        environments: int = 1,
        address: str = "127.0.0.1:0",
        processes: bool = False,
        secrets: str | Path | Secrets | None = None,
        insecure: bool = False,
    ) -> None:
        """Makes the environments and begins to serve them.

        Args:
            make_env: Makes one environment: Gymnasium's, dm_env's, what `from_gymnasium` and `from_dm_env` return, or
                an `Environment` of your own.
            environments: How many. Training takes those of all its actors and one for evaluation:
                `actor.collectors` x `actor.environments` + 1.
            address: Where to listen; port 0 takes a free one.
            processes: Whether each environment has a process of its own instead of a thread, which is faster where its
                steps are slow Python. Then `make_env` is a function of a module, and a script calls this under
                `if __name__ == "__main__":`.
            secrets: A folder that `isodream secrets` made, or `Secrets`: clients are asked who they are.
            insecure: Listen where other machines can reach it though nothing guards it.

        Raises:
            SecurityError: if the secrets cannot be used, or if nothing would guard the server.
            EnvError: if an environment cannot be used.
            OSError: if the address cannot be listened on.
        """
        if not isinstance(secrets, Secrets):
            secrets = Secrets() if secrets is None else Secrets.of(secrets)
        secrets.check(address, insecure=insecure)
        self.hangs = False
        """Whether an environment was still busy with a command when the server had stopped."""
        self._workers = [Worker(make_env, process=processes) for _ in range(environments)]
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="isodream", daemon=True)
        self._thread.start()
        try:
            self.spec = _common_spec(self._workers)
            """What the environments show and take."""
            self._server, self.address = self._run(self._listen(address, secrets))
            """Where the server listens, `host:port`."""
        except BaseException:
            self._end()
            raise

    def stop(self) -> None:
        """Ends all streams, then closes the environments, in three seconds each at most; once."""
        if self._loop.is_closed():
            return
        self._run(self._server.stop(GRACE_SECS))
        self._end()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    async def _listen(self, address: str, secrets: Secrets) -> tuple[grpc.aio.Server, str]:
        server = grpc.aio.server(interceptors=secrets.guards(), options=OPTIONS)
        server.add_generic_rpc_handlers((EnvironmentService(self.spec, self._workers).handler(),))
        watched = health.aio.HealthServicer()
        for name in ("", SERVICE):
            await watched.set(name, health_pb2.HealthCheckResponse.SERVING)
        health_pb2_grpc.add_HealthServicer_to_server(watched, server)
        credentials = secrets.credentials()
        try:
            if credentials is None:
                port = server.add_insecure_port(address)
            else:
                port = server.add_secure_port(address, credentials)
        except RuntimeError as error:
            words = f"cannot listen on {address}: {error}; stop the process that does, or choose another port"
            raise OSError(words) from error
        await server.start()
        return server, f"{address.rpartition(':')[0]}:{port}"

    def _run(self, work: Coroutine[Any, Any, Any]) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result()

    def _end(self) -> None:
        self.hangs = bool(wait([worker.stop() for worker in self._workers], GRACE_SECS).not_done)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


class Options(TypedDict, total=False):
    """The options of a `Server`."""

    environments: int
    address: str
    processes: bool
    secrets: str | Path | Secrets | None
    insecure: bool


def serve(make_env: MakeEnv, **options: Unpack[Options]) -> None:
    """Serves environments until the process is interrupted or told to end (SIGINT, SIGTERM).

    Takes what `Server` takes, and raises the same. Prints the address once environments can be driven. Leaves an
    environment that hangs behind, and ends the process with status 1 then.
    """
    ended = threading.Event()
    signals = (signal.SIGINT, signal.SIGTERM)
    handlers = [signal.signal(number, lambda *_: ended.set()) for number in signals]
    try:
        with Server(make_env, **options) as server:
            print(f"{server.spec.id} at grpc://{server.address}", flush=True)
            ended.wait()
        if server.hangs:
            _log.error("an environment does not end its command; this process ends without it")
            # Python itself would wait for it.
            os._exit(1)
    finally:
        for number, handler in zip(signals, handlers, strict=True):
            signal.signal(number, handler)


def _common_spec(workers: list[Worker]) -> Spec:
    """Has all environments made, at once, and returns what they are."""
    specs = [made.result() for made in [worker.spec() for worker in workers]]
    if not specs:
        raise ValueError("environments=0, must be at least 1")
    for index, spec in enumerate(specs):
        if spec != specs[0]:
            raise ValueError(f"environment {index} is {spec}, the first one is {specs[0]}; all must be alike")
    return specs[0]
