"""Serves dm_control's walker walk as an isodream EnvironmentService: as many walkers as clients ask for.

    serve_dm_control.py PROTO_FOLDER [SECONDS_PER_STEP]

Needs dm-control, grpcio and grpcio-tools. Prints its port on the first line. There is no renderer in it: the
picture shows the observations as grey bars, so that it runs on machines without any OpenGL.
"""

import concurrent.futures
import os
import pathlib
import sys
import tempfile
import time

os.environ["MUJOCO_GL"] = "disable"

import grpc
import grpc_tools.protoc
import numpy as np
from dm_control import suite

SIZE = 64
ACTION_REPEAT = 2
TIME_LIMIT = 500
ACTION_DIM = 6
PROTOCOL_VERSION = 1


def stubs(proto: pathlib.Path):
    """Modules of the protocol, generated from its source."""
    folder = tempfile.mkdtemp()
    files = ["isodream/v1/environment.proto"]
    includes = [f"-I{proto}"]
    outputs = [f"--python_out={folder}", f"--grpc_python_out={folder}"]
    if grpc_tools.protoc.main(["protoc", *includes, *outputs, *files]) != 0:
        sys.exit(f"cannot compile {files} in {proto}")
    sys.path.insert(0, folder)
    from isodream.v1 import environment_pb2, environment_pb2_grpc

    return environment_pb2, environment_pb2_grpc


pb, pb_grpc = stubs(pathlib.Path(sys.argv[1]))
PAUSE_SECS = float(sys.argv[2]) if len(sys.argv) > 2 else 0.0


class Walker:
    """The task with an action repeat, as rows of the protocol."""

    def __init__(self):
        self.env = suite.load("walker", "walk", task_kwargs={"random": 0})
        self.steps = 0

    def reset(self, seed: int):
        self.env.task._random = np.random.RandomState(seed % 2**32)
        self.steps = 0
        return self.row(self.env.reset(), 0.0)

    def step(self, action):
        time.sleep(PAUSE_SECS)
        reward = 0.0
        for _ in range(ACTION_REPEAT):
            timestep = self.env.step(np.asarray(action))
            reward += timestep.reward
            if timestep.last():
                break
        self.steps += 1
        return self.row(timestep, reward)

    def row(self, timestep, reward: float):
        is_last = self.steps >= TIME_LIMIT or timestep.last()
        metric = pb.EnvironmentMetric(name="speed_m_s", value=self.env.physics.horizontal_velocity())
        return pb.EnvironmentRow(
            image=self.picture(timestep.observation),
            reward=reward,
            discount=1.0,
            is_last=is_last,
            end_reason="time_limit" if is_last else "",
            metrics=[metric],
        )

    def picture(self, observation) -> bytes:
        values = np.concatenate([np.ravel(value) for value in observation.values()])
        levels = (127.5 + 127.5 * np.tanh(values)).astype(np.uint8)
        columns = levels[np.arange(SIZE) * len(levels) // SIZE]
        return np.broadcast_to(columns[None, :, None], (SIZE, SIZE, 3)).tobytes()


class Service(pb_grpc.EnvironmentServiceServicer):
    def Run(self, requests, context):
        # Without this, grpcio holds the metadata back until the first reply, and the client its request.
        context.send_initial_metadata(())
        hello = next(requests).hello
        if hello.protocol_version != PROTOCOL_VERSION:
            words = f"protocol version {hello.protocol_version} does not match {PROTOCOL_VERSION}"
            context.abort(grpc.StatusCode.FAILED_PRECONDITION, words)
        walkers = [Walker() for _ in range(hello.environments)]
        spec = pb.EnvironmentSpec(
            id="python/walker_walk",
            height=SIZE,
            width=SIZE,
            channels=3,
            action_dim=ACTION_DIM,
            action_repeat=ACTION_REPEAT,
            time_limit=TIME_LIMIT,
        )
        welcome = pb.EnvironmentWelcome(
            protocol_version=PROTOCOL_VERSION, spec=spec, environments=len(walkers)
        )
        yield pb.EnvironmentReply(welcome=welcome)
        for request in requests:
            results = [self.obey(walkers[command.environment], command) for command in request.batch.commands]
            answer = pb.EnvironmentResults(number=request.batch.number, results=results)
            yield pb.EnvironmentReply(results=answer)

    def obey(self, walker, command):
        try:
            if command.WhichOneof("kind") == "reset":
                row = walker.reset(command.reset.seed)
            else:
                row = walker.step(command.step.action)
            return pb.EnvironmentResult(environment=command.environment, row=row)
        except Exception as error:
            return pb.EnvironmentResult(environment=command.environment, error=repr(error))


server = grpc.server(concurrent.futures.ThreadPoolExecutor(max_workers=8))
pb_grpc.add_EnvironmentServiceServicer_to_server(Service(), server)
port = server.add_insecure_port("127.0.0.1:0")
server.start()
print(port, flush=True)
server.wait_for_termination()
