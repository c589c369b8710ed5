"""Environments in threads or processes of their own: simulators want all calls from where they were made."""

import os
import pickle
import signal
import threading
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context, parent_process
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from isodream.adapters import adapt
from isodream.environment import EnvError, Guarded, Row, Spec

T = TypeVar("T")
MakeEnv = Callable[[], Any]

# The environment of this thread; a process of our own has but one.
_here = threading.local()


class Worker:
    """One environment, made where it runs and made anew after a reset that failed or a process that died."""

    def __init__(self, make_env: MakeEnv, *, process: bool) -> None:
        if process:
            _check_that_it_travels(make_env)
        self._make_env, self._process = make_env, process
        self._executor = self._start()

    def spec(self) -> "Future[Spec]":
        """Makes the environment."""
        return self._submit(_spec)

    def reset(self, seed: int) -> "Future[Row]":
        """Begins an episode."""
        return self._submit(_reset, seed)

    def step(self, action: NDArray[np.float32]) -> "Future[Row]":
        """Takes one agent step."""
        return self._submit(_step, action)

    def stop(self) -> "Future[None]":
        """Has the environment closed once its command is done."""
        closed = self._submit(_close)
        self._executor.shutdown(wait=False)
        return closed

    def _start(self) -> Executor:
        # Forks of a process with gRPC's threads would hang.
        if self._process:
            return ProcessPoolExecutor(1, get_context("spawn"), _outlive_nobody)
        return ThreadPoolExecutor(1)

    def _submit(self, work: Callable[..., T], *args: Any) -> "Future[T]":
        try:
            return self._executor.submit(work, self._make_env, *args)
        except BrokenExecutor:
            self._executor = self._start()
            return self._executor.submit(work, self._make_env, *args)


def _check_that_it_travels(make_env: MakeEnv) -> None:
    try:
        pickle.dumps(make_env)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise EnvError(
            f"make_env cannot be sent to another process: {error}; make it a function of a module, "
            "or leave processes=True out"
        ) from error


def _outlive_nobody() -> None:
    """Leaves interrupts to the server, and ends with it however it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        if parent := parent_process():
            parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _env(make_env: MakeEnv) -> Guarded:
    if not hasattr(_here, "env"):
        _here.env = Guarded(adapt(make_env()))
    env: Guarded = _here.env
    return env


def _spec(make_env: MakeEnv) -> Spec:
    return _env(make_env).spec


def _reset(make_env: MakeEnv, seed: int) -> Row:
    try:
        return _env(make_env).reset(seed)
    except Exception:
        _close(make_env)
        raise


def _step(make_env: MakeEnv, action: NDArray[np.float32]) -> Row:
    return _env(make_env).step(action)


def _close(_make_env: MakeEnv) -> None:
    if hasattr(_here, "env"):
        env = _here.env
        del _here.env
        env.env.close()
