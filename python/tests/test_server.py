"""The protocol, its errors, and what guards a server."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from client import Client, last_words, patiently, refusal, reset, step
from conftest import Isodream
from numpy.typing import NDArray
from worlds import World

from isodream import EnvError, Row, Secrets, SecurityError, Server, Spec
from isodream.service import PROTOCOL_VERSION
from isodream.v1 import environment_pb2 as pb


def test_an_environment_belongs_to_one_client() -> None:
    with Server(World, environments=3) as server:
        with Client(server.address, 2) as first:
            spec = first.welcome.spec
            assert (spec.id, spec.height, spec.channels, spec.action_dim) == ("test/world", 64, 3, 2)
            assert (first.welcome.environments, spec.action_repeat, spec.time_limit) == (2, 1, 12)
            with Client(server.address, 0) as curious:
                assert curious.welcome.spec == spec
                curious.batch(1, reset())
                assert last_words(curious) == "INVALID_ARGUMENT: environment 0 does not exist"
            with Client(server.address, 1) as second:
                rows = [client.obey(reset(0, 5), *more)[0].row for client, more in ((first, [reset(1)]), (second, []))]
                assert rows[0] == rows[1]
            words = refusal(server.address, 2)
            assert words.startswith("UNAVAILABLE: 2 environments were asked for and 1 of 3 are free"), words
        with patiently(server.address, 3) as third:
            assert third.welcome.environments == 3


def test_rows_tell_rewards_ends_and_metrics() -> None:
    class Known(World):
        def step(self, action: NDArray[np.float32]) -> Row:
            row = super().step(action)
            fell = row.reward > 1.5
            return Row(
                row.image,
                row.reward,
                fell,
                fell,
                "off_road" if fell else "",
                {"speed": 3.5, "nan": float("nan")},
                interaction=True,
                segmentation=np.full((64, 64), 2, np.uint8),
            )

    hello = pb.EnvironmentHello(protocol_version=PROTOCOL_VERSION, segmentation=True, environments=1)
    with Server(Known) as server, Client(server.address, first=pb.EnvironmentRequest(hello=hello)) as client:
        first = client.obey(reset())[0].row
        assert (first.reward, first.discount, first.is_last, first.segmentation) == (0.0, 1.0, False, b"")
        row = client.obey(step(0, 0.25, 0.5))[0].row
        assert (row.reward, row.discount, row.is_last, row.end_reason) == (0.75, 1.0, False, "")
        assert (row.segmentation, row.interaction) == (b"\2" * 64 * 64, True)
        assert [(metric.name, metric.value) for metric in row.metrics] == [("speed", 3.5)]
        # Components outside of [-1, 1] are clamped.
        row = client.obey(step(0, 1.0, 7.0))[0].row
        assert (row.reward, row.discount, row.is_last, row.is_terminal) == (2.0, 0.0, True, True)
        assert row.end_reason == "off_road"
        error = client.obey(step())[0].error
        assert error == "EnvError: episode is over, reset the environment before the next step"
    with Server(Known) as server, Client(server.address) as client:
        client.obey(reset())
        assert client.obey(step())[0].row.segmentation == b"", "nobody asked for it"


def test_batches_overlap_and_an_environment_is_not_commanded_twice(caplog: pytest.LogCaptureFixture) -> None:
    go_on = threading.Event()

    class Slow(World):
        def step(self, action: NDArray[np.float32]) -> Row:
            if action[0] > 0:
                assert go_on.wait(10)
            return super().step(action)

    with Server(Slow, environments=2) as server, Client(server.address, 2) as client:
        client.obey(reset(0), reset(1))
        client.batch(7, step(0, 1.0, 0.0))
        client.batch(8, step(1, 0.0, 0.0))
        assert client.receive().results.number == 8, "the quick one is not kept waiting"
        client.batch(9, step(0, 0.0, 0.0))
        assert last_words(client) == "INVALID_ARGUMENT: environment 0 is busy with an earlier command"
        assert refusal(server.address, 2).startswith("UNAVAILABLE"), "one of them still works for the client that left"
        go_on.set()
    assert not [record for record in caplog.records if record.name == "asyncio"]


def test_a_server_may_be_stopped_before_its_block_ends() -> None:
    closed = []

    class Known(World):
        def close(self) -> None:
            closed.append(self)

    with Server(Known) as server:
        server.stop()
        assert len(closed) == 1
    server.stop()
    assert len(closed) == 1


def test_what_makes_no_sense_is_refused() -> None:
    with Server(World) as server:
        old = pb.EnvironmentHello(protocol_version=PROTOCOL_VERSION + 1)
        words = refusal(server.address, first=pb.EnvironmentRequest(hello=old))
        assert words.startswith(f"FAILED_PRECONDITION: protocol version {PROTOCOL_VERSION + 1}"), words
        words = refusal(server.address, first=pb.EnvironmentRequest(batch=pb.EnvironmentBatch()))
        assert words.startswith("FAILED_PRECONDITION: the first message carries no handshake"), words
        for commands, expected in [
            ([], "a batch of commands was expected"),
            ([pb.EnvironmentCommand()], "environment 0 got an empty command"),
            ([reset(), reset()], "environment 0 is busy"),
        ]:
            with patiently(server.address, 1) as client:
                client.batch(1, *commands)
                assert expected in last_words(client)


class Odd(World):
    """Does what the first component of the action says."""

    def step(self, action: NDArray[np.float32]) -> Row:
        row = super().step(action)
        match round(4 * float(action[0])):
            case 1:
                raise RuntimeError("the simulator is gone")
            case 2:
                return Row(row.image[:7])
            case 4:
                os._exit(3)
        return row


@pytest.mark.parametrize(
    ("action", "words"),
    [
        ((0.25, 0.0), "RuntimeError: the simulator is gone"),
        ((0.5, 0.0), "test/world: the image is uint8 [7, 64, 3], must be uint8 [64, 64, 3]"),
        ((0.0, 0.0, 0.0), "action has 3 dimensions, expected 2"),
        ((float("nan"), 0.0), "must be finite"),
    ],
)
def test_an_error_of_one_environment_is_its_own(action: tuple[float, ...], words: str) -> None:
    with Server(Odd, environments=2) as server, Client(server.address, 2) as client:
        assert "before its first reset" in client.obey(step())[0].error
        client.obey(reset(0), reset(1))
        failed, sound = client.obey(step(0, *action), step(1))
        assert words in failed.error
        assert sound.row.image
        client.obey(reset(0))
        assert client.obey(step(0))[0].row.image


def test_a_process_that_dies_is_started_again() -> None:
    with Server(Odd, environments=2, processes=True) as server, Client(server.address, 2) as client:
        begun = client.obey(reset(0), reset(1))[0].row
        died, sound = client.obey(step(0, 1.0, 0.0), step(1))
        assert "BrokenProcessPool" in died.error
        assert sound.row.image
        assert "before its first reset" in client.obey(step(0))[0].error
        assert client.obey(reset(0))[0].row == begun
        assert client.obey(step(0))[0].row.image


def test_an_environment_that_cannot_be_reset_is_made_anew() -> None:
    made: list[World] = []

    class Frail(World):
        closed = False

        def reset(self, seed: int) -> Row:
            if len(made) == 1 and self.steps_ever:
                raise RuntimeError("lost the connection")
            self.steps_ever = True
            return super().reset(seed)

        steps_ever = False

        def close(self) -> None:
            self.closed = True

    def make() -> World:
        made.append(Frail())
        return made[-1]

    with Server(make) as server, Client(server.address) as client:
        assert client.obey(reset())[0].row.image
        assert "lost the connection" in client.obey(reset())[0].error
        assert client.obey(reset())[0].row.image
        assert [world.closed for world in made] == [True, False]  # type: ignore[attr-defined]


def test_what_cannot_be_served_is_said() -> None:
    with Server(World) as server, pytest.raises(OSError, match=f"cannot listen on {server.address}.*another port"):
        Server(World, address=server.address)
    with pytest.raises(ValueError, match="write host:port"):
        Server(World, address="7100")
    with pytest.raises(TypeError, match="list is neither a Gymnasium nor a dm_env environment"):
        Server(list)
    dims = iter((1, 2))
    with pytest.raises(ValueError, match=r"environment 1 is .*action_dim=2.*all must be alike"):
        Server(lambda: World(action_dim=next(dims)), environments=2)
    with pytest.raises(EnvError, match=r"make_env cannot be sent to another process.*a function of a module"):
        Server(lambda: World(), processes=True)


def test_an_unguarded_server_opens_on_loopback_only(tmp_path: Path) -> None:
    with pytest.raises(SecurityError, match=r"0\.0\.0\.0 can be reached from other machines.*insecure=True"):
        Server(World, address="0.0.0.0:0")
    with pytest.raises(SecurityError, match="can be reached"):
        Server(World, address="[::]:0")
    tokens = tmp_path / "tokens"
    tokens.write_text("actor 0123456789abcdef\n")
    for options in ({"insecure": True}, {"secrets": Secrets(tokens=tokens)}):
        with Server(World, address="0.0.0.0:0", **options) as server:
            assert server.address.startswith("0.0.0.0:")


def test_clients_show_certificates_and_tokens(isodream: Isodream, tmp_path: Path) -> None:
    folder = tmp_path / "secrets"
    isodream("secrets", folder)
    with Server(World, address="localhost:0", secrets=folder) as server:
        remote = f"grpc://{server.address}"
        bench = ["env", "bench", remote, "--seconds", 0.01]
        isodream(*bench, "--secrets", folder)
        isodream("health", server.address, "--secrets", folder)
        assert "connection lost" in isodream.refused(*bench)
        viewer = isodream.refused(*bench, "--secrets", folder, "--token-file", folder / "viewer.token")
        assert "role is viewer" in viewer
        client = [
            "--tls-ca",
            folder / "ca.pem",
            "--tls-cert",
            folder / "client.pem",
            "--tls-key",
            folder / "client.key",
        ]
        assert "none came" in isodream.refused(*bench, *client)
        other = tmp_path / "other.token"
        other.write_text("fedcba9876543210fedcba")
        assert "does not know the token" in isodream.refused(*bench, *client, "--token-file", other)
        bare = isodream.refused(*bench, "--tls-ca", folder / "ca.pem", "--token-file", folder / "actor.token")
        assert "connection lost" in bare


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "holds no token"),
        ("\n# only this\n", "holds no token"),
        ("actor", "line 1: a token has at least 16"),
        ("\nking 0123456789abcdef", "line 2: `king` is no role"),
        ("actor short-secret", "line 1: a token has at least 16"),
        ("actor 01234567 89abcdef0", "no spaces"),
        ("actor 0123456789abcdef\nlearner\t0123456789abcdef", "line 2: the same token"),
    ],
)
def test_senseless_tokens_are_refused_without_being_shown(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "tokens"
    path.write_text(text)
    with pytest.raises(SecurityError) as error:
        Server(World, secrets=Secrets(tokens=path))
    assert words in str(error.value)
    assert "short-secret" not in str(error.value)
    assert "0123" not in str(error.value)


def test_secrets_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    (tmp_path / "junk").write_text("junk")
    for secrets, words in [
        (Secrets(cert=tmp_path / "junk"), "both cert and key"),
        (Secrets(client_ca=tmp_path / "junk"), "without cert"),
        (Secrets(cert=tmp_path / "junk", key=tmp_path / "junk"), "no PEM block of a private key"),
        (Secrets.of(tmp_path / "nowhere"), "isodream secrets DIR"),
    ]:
        with pytest.raises(SecurityError, match=words):
            Server(World, secrets=secrets)


def test_specs_are_the_environments_own() -> None:
    with Server(lambda: World(action_dim=5, time_limit=9)) as server:
        assert server.spec == Spec("test/world", 5, 9)
    with pytest.raises(ValueError, match="test/world: action_repeat is 0, must be at least 1"):
        Spec("test/world", 5, 9, action_repeat=0)


def program(folder: Path, world: str, *, processes: bool) -> subprocess.Popen[str]:
    """One that serves a world of the tests."""
    path = folder / "serve.py"
    path.write_text(
        "import isodream, worlds\n"
        f"if __name__ == '__main__':\n    isodream.serve(worlds.{world}, processes={processes})"
    )
    paths = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, path],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": paths},
    )


@pytest.mark.parametrize("processes", [False, True])
def test_a_server_ends_without_an_environment_that_hangs(tmp_path: Path, processes: bool) -> None:
    with program(tmp_path, "Hanging", processes=processes) as server:
        assert server.stdout
        with Client(server.stdout.readline().split("grpc://")[1].strip()) as client:
            client.obey(reset())
            client.batch(2, step())
            assert server.stdout.readline() == "hangs\n"
        server.terminate()
        try:
            _, said = server.communicate(timeout=20)
        finally:
            server.kill()
    assert server.returncode == 1
    assert "does not end its command" in said


def test_processes_end_with_a_server_that_is_killed(tmp_path: Path) -> None:
    with program(tmp_path, "World", processes=True) as server:
        assert server.stdout
        assert server.stdout.readline().startswith("test/world at grpc://127.0.0.1:")
        # The environment and Python's own watcher of resources.
        children = Path(f"/proc/{server.pid}/task/{server.pid}/children").read_text().split()
        assert children
        server.kill()
    deadline = time.monotonic() + 10
    while any(map(alive, children)):
        assert time.monotonic() < deadline, f"{children} were left behind"
        time.sleep(0.05)


def alive(process: str) -> bool:
    """Whether it runs, and is no zombie."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(") ")[2][0] != "Z"
    except FileNotFoundError:
        return False
