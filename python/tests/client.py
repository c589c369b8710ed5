"""A client that sends what it is told, also what no client of ours would."""

from __future__ import annotations

import queue
import time
from typing import Self

import grpc

from isodream.service import PROTOCOL_VERSION, SERVICE
from isodream.v1 import environment_pb2 as pb

DEADLINE_SECS = 20.0


class Client:
    """A stream that has greeted, unless it is told to say something else first."""

    def __init__(self, address: str, environments: int = 1, *, first: pb.EnvironmentRequest | None = None) -> None:
        self._requests: queue.Queue[pb.EnvironmentRequest | None] = queue.Queue()
        self._channel = grpc.insecure_channel(address)
        run = self._channel.stream_stream(
            f"/{SERVICE}/Run", pb.EnvironmentRequest.SerializeToString, pb.EnvironmentReply.FromString
        )
        hello = pb.EnvironmentHello(protocol_version=PROTOCOL_VERSION, environments=environments)
        self.send(first or pb.EnvironmentRequest(hello=hello))
        self._replies = run(iter(self._requests.get, None), timeout=DEADLINE_SECS)
        self.welcome = self.receive().welcome

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._requests.put(None)
        self._channel.close()

    def send(self, request: pb.EnvironmentRequest) -> None:
        self._requests.put(request)

    def batch(self, number: int, *commands: pb.EnvironmentCommand) -> None:
        self.send(pb.EnvironmentRequest(batch=pb.EnvironmentBatch(number=number, commands=commands)))

    def receive(self) -> pb.EnvironmentReply:
        return next(self._replies)

    def obey(self, *commands: pb.EnvironmentCommand) -> list[pb.EnvironmentResult]:
        """The results of a batch."""
        self.batch(1, *commands)
        return list(self.receive().results.results)


def patiently(address: str, environments: int) -> Client:
    """A client once so many environments are free, which those of one that left are a moment later."""
    deadline = time.monotonic() + DEADLINE_SECS
    while True:
        try:
            return Client(address, environments)
        except grpc.RpcError as error:
            if " are free" not in words(error) or time.monotonic() > deadline:
                raise
            time.sleep(0.05)


def reset(environment: int = 0, seed: int = 1) -> pb.EnvironmentCommand:
    return pb.EnvironmentCommand(environment=environment, reset=pb.EnvironmentReset(seed=seed))


def step(environment: int = 0, *action: float) -> pb.EnvironmentCommand:
    return pb.EnvironmentCommand(environment=environment, step=pb.EnvironmentStep(action=action or (0.0, 0.0)))


def refusal(address: str, environments: int = 1, *, first: pb.EnvironmentRequest | None = None) -> str:
    """How the server refuses a greeting."""
    try:
        with Client(address, environments, first=first):
            raise AssertionError("it was taken")
    except grpc.RpcError as error:
        return words(error)


def last_words(client: Client) -> str:
    """Why the server ends the stream."""
    try:
        client.receive()
    except grpc.RpcError as error:
        return words(error)
    raise AssertionError("it goes on")


def words(error: grpc.RpcError) -> str:
    assert isinstance(error, grpc.Call)
    return f"{error.code().name}: {error.details()}"
