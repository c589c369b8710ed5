"""One client's stream of commands, and who drives which environment."""

from __future__ import annotations

import asyncio
import logging
import math
from typing import TYPE_CHECKING, Any

import grpc
import grpc.aio
import numpy as np

from isodream.environment import Row, Spec
from isodream.v1 import environment_pb2 as pb
from isodream.workers import Worker

if TYPE_CHECKING:
    Context = grpc.aio.ServicerContext[pb.EnvironmentRequest, pb.EnvironmentReply]

PROTOCOL_VERSION = 1
"""`PROTOCOL_VERSION` of `crates/proto/src/convert.rs`; a test compares them."""
SERVICE = "isodream.v1.EnvironmentService"
GREETING_SECS = 10.0

_log = logging.getLogger("isodream")


class EnvironmentService:
    """Hands out environments: each is driven by one client, and carries out one command, at a time."""

    def __init__(self, spec: Spec, workers: list[Worker]) -> None:
        self._spec = spec
        self._count = len(workers)
        self._free = list(workers)

    def handler(self) -> grpc.GenericRpcHandler:
        """The service as gRPC takes it."""
        run = grpc.stream_stream_rpc_method_handler(
            self.run,
            pb.EnvironmentRequest.FromString,
            pb.EnvironmentReply.SerializeToString,
        )
        return grpc.method_handlers_generic_handler(SERVICE, {"Run": run})

    async def run(self, _requests: Any, context: Context) -> None:
        """Serves one client from its greeting to the end of its stream."""
        # Without this, grpcio holds the metadata back until the first reply, and the client its request.
        await context.send_initial_metadata(())
        hello = await _greeting(context)
        count = hello.environments
        if count > len(self._free):
            await context.abort(
                grpc.StatusCode.UNAVAILABLE,
                f"{count} environments were asked for and {len(self._free)} of {self._count} are free, the others are "
                "driven by other clients; serve more of them or try again later",
            )
        session = _Session(context, [self._free.pop() for _ in range(count)], hello)
        _log.info("%s drives %d environments", context.peer(), count)
        try:
            spec = pb.EnvironmentSpec(**vars(self._spec))
            welcome = pb.EnvironmentWelcome(protocol_version=PROTOCOL_VERSION, spec=spec, environments=count)
            await context.write(pb.EnvironmentReply(welcome=welcome))
            await session.run()
        finally:
            session.release(self._free)


async def _greeting(context: Context) -> pb.EnvironmentHello:
    try:
        request = await asyncio.wait_for(context.read(), GREETING_SECS)
    except TimeoutError:
        await context.abort(grpc.StatusCode.UNAVAILABLE, "no greeting came in time")
    if not isinstance(request, pb.EnvironmentRequest) or not request.HasField("hello"):
        words = "the first message carries no handshake; connect with an isodream client"
        await context.abort(grpc.StatusCode.FAILED_PRECONDITION, words)
    if request.hello.protocol_version != PROTOCOL_VERSION:
        await context.abort(
            grpc.StatusCode.FAILED_PRECONDITION,
            f"protocol version {request.hello.protocol_version} does not match {PROTOCOL_VERSION}; install "
            "the isodream package that came with the binary",
        )
    return request.hello


class _Session:
    """One client and the environments that it drives."""

    def __init__(self, context: Context, workers: list[Worker], hello: pb.EnvironmentHello) -> None:
        self._context, self._workers, self._segmentation = context, workers, hello.segmentation
        # The newest command of each environment.
        self._commands: dict[int, asyncio.Future[Row]] = {}
        self._answers: set[asyncio.Task[None]] = set()
        self._writing = asyncio.Lock()

    async def run(self) -> None:
        """Carries out batches, which may overlap, until the client closes its side."""
        while isinstance(request := await self._context.read(), pb.EnvironmentRequest):
            try:
                begun = self._begin(request)
            except ValueError as error:
                await self._context.abort(grpc.StatusCode.INVALID_ARGUMENT, str(error))
            answer = asyncio.create_task(self._answer(request.batch.number, begun))
            self._answers.add(answer)
            answer.add_done_callback(self._answered)
        await asyncio.gather(*self._answers)

    def release(self, free: list[Worker]) -> None:
        """Gives each environment back once its last command is done."""
        for index, worker in enumerate(self._workers):
            command = self._commands.get(index)
            if command is None or command.done():
                free.append(worker)
            else:
                command.add_done_callback(lambda _, worker=worker: free.append(worker))  # type: ignore[misc]

    def _begin(self, request: pb.EnvironmentRequest) -> list[tuple[int, asyncio.Future[Row]]]:
        if not request.batch.commands:
            raise ValueError("a batch of commands was expected")
        begun = []
        for command in request.batch.commands:
            index = command.environment
            if index >= len(self._workers):
                raise ValueError(f"environment {index} does not exist")
            if index in self._commands and not self._commands[index].done():
                raise ValueError(f"environment {index} is busy with an earlier command")
            if command.HasField("reset"):
                future = self._workers[index].reset(command.reset.seed)
            elif command.HasField("step"):
                future = self._workers[index].step(np.array(command.step.action, np.float32))
            else:
                raise ValueError(f"environment {index} got an empty command")
            self._commands[index] = asyncio.wrap_future(future)
            begun.append((index, self._commands[index]))
        return begun

    async def _answer(self, number: int, begun: list[tuple[int, asyncio.Future[Row]]]) -> None:
        results = []
        for index, command in begun:
            result = pb.EnvironmentResult(environment=index)
            try:
                result.row.CopyFrom(_message(await command, segmentation=self._segmentation))
            except Exception as error:  # noqa: BLE001 - the client is told whatever it is
                _log.warning("environment %d failed", index, exc_info=error)
                result.error = f"{type(error).__name__}: {error}"
            results.append(result)
        async with self._writing:
            answer = pb.EnvironmentResults(number=number, results=results)
            await self._context.write(pb.EnvironmentReply(results=answer))

    def _answered(self, answer: asyncio.Task[None]) -> None:
        self._answers.discard(answer)
        if not answer.cancelled() and (error := answer.exception()):
            _log.info("the client left before it was answered: %r", error)


def _message(row: Row, *, segmentation: bool) -> pb.EnvironmentRow:
    return pb.EnvironmentRow(
        image=row.image.tobytes(),
        reward=row.reward,
        discount=0.0 if row.is_terminal else 1.0,
        is_last=row.is_last,
        is_terminal=row.is_terminal,
        interaction=row.interaction,
        end_reason=row.end_reason,
        segmentation=row.segmentation.tobytes() if segmentation and row.segmentation is not None else b"",
        metrics=[
            pb.EnvironmentMetric(name=name, value=value) for name, value in row.metrics.items() if math.isfinite(value)
        ],
    )
