# SPDX-License-Identifier: Apache-2.0
"""Rehearsal of a load in a child process with a memory limit and a time limit.

A config of a hundred bytes can ask for a terabyte, a tokenizer can loop for hours, and a native library can
abort its process. The child is forked, since importing LeRobot again would take longer than most loads; it
runs one thread, as PyTorch's data loaders do, and does not touch a GPU.
"""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import json
import os
import resource
import select
import signal
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import cast

from accerl_lerobot import errors
from accerl_lerobot.checkpoint.safety import MIB, FileSource
from accerl_lerobot.errors import InputError

SLACK, PER_BYTE = 1536 * MIB, 4
"""Bytes that a child may take beside the files, and for each of their bytes: weights are held twice as
float32, because SmolVLA builds layers that it then drops."""
CPU_S, CPU_S_PER_BYTE = 15, 1e-7
"""Seconds of processor time, and those for each byte of the files: a decision computes with all weights.
Processor time, because a busy machine must not refuse a good file."""
PATIENCE = 20  # times its processor time after which a child is given up, whatever it waits for
IDLE_S = 10.0
"""Seconds without processor time after which a child is replaced: it may wait for a lock that another thread
of this process held at the fork and that nobody in the child can release."""
NO_MEMORY = (
    "MemoryError", "can't allocate", "Cannot allocate", "bad_alloc", "Unable to allocate", "malloc of",
)  # fmt: skip
"""Words of errors, of Python, PyTorch, Linux, C++, NumPy and Arrow."""
PR_SET_PDEATHSIG = 1


def rehearse[T](
    task: Callable[[], T], folder: Path, origin: FileSource, pattern: str = "**/*.safetensors"
) -> T:
    """Runs `task` in a child process and returns its result, which JSON can hold.

    `task` loads what is in `folder`, on the CPU; files there that match `pattern` set the limits. Where
    there is no ``/proc``, as on macOS, limits cannot be set, and it runs in this process.
    """
    if not sys.platform.startswith("linux"):
        return task()
    size = sum(path.stat().st_size for path in folder.glob(pattern) if path.is_file())
    memory, cpu_s = SLACK + PER_BYTE * size, round(CPU_S + CPU_S_PER_BYTE * size)
    deadline = time.monotonic() + PATIENCE * cpu_s
    message, status = b"", None
    while status is None and time.monotonic() < deadline:
        message, status = _try(task, memory, cpu_s, deadline)
    answer = json.loads(message) if message else {}
    errors.show_warnings(answer.get("warnings", ()))
    if "result" in answer:
        return cast(T, answer["result"])
    why = f"fails with {answer['error']}" if "error" in answer else _cause(status, cpu_s)
    if any(words in answer.get("why", why) for words in NO_MEMORY):
        why = f"takes more than {memory // MIB} MiB beside the libraries"
    else:
        errors.raise_refusal(answer)
    hint = "the size of its files does not account for that; get it again, or another one"
    raise InputError(origin.field, origin.value, f"loading it, tried in a process apart, {why}; {hint}")


def _try(task: Callable[[], object], memory: int, cpu_s: int, deadline: float) -> tuple[bytes, int | None]:
    """A child's message, and how it ended; None if it was given up."""
    reader, writer = os.pipe()
    parent = os.getpid()
    with warnings.catch_warnings():  # Python's about threads: the child runs none of the others
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        os.close(reader)
        _run(task, writer, parent, memory, cpu_s)
    os.close(writer)
    status = None
    try:
        message, status = _wait(child, reader, deadline)
    finally:
        os.close(reader)
        if status is None:  # it may still run
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
    return message, status


def _cause(status: int | None, cpu_s: int) -> str:
    if status is None:
        return f"takes more than {PATIENCE * cpu_s:.0f} s"
    code = os.waitstatus_to_exitcode(status)
    if -code in (signal.SIGXCPU, signal.SIGKILL):
        return f"takes more than {cpu_s} s of processor time"
    return f"ends the process with {signal.Signals(-code).name if code < 0 else f'code {code}'}"


def _run(task: Callable[[], object], writer: int, parent: int, memory: int, cpu_s: int) -> None:
    """Runs in the child, and ends it."""
    answer: dict[str, object] = {}
    errors.collect_warnings()
    try:
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)
        _confine(memory, cpu_s)
        answer = {"result": task()}
    except BaseException as error:  # Rust's panics are no `Exception`
        answer = errors.error_as_json(error)
    answer["warnings"] = errors.collected_warnings()
    with contextlib.suppress(BaseException):
        os.write(writer, json.dumps(answer).encode())
    os._exit(0)


def _confine(memory: int, cpu_s: int) -> None:
    faulthandler.disable()
    null = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(null, descriptor)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
    os.environ["TOKENIZERS_PARALLELISM"] = "false"
    if (torch := sys.modules.get("torch")) is not None:
        torch.set_num_threads(1)  # the threads of a pool are not copied by a fork
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limits = {resource.RLIMIT_AS: taken + memory, resource.RLIMIT_CPU: cpu_s, resource.RLIMIT_CORE: 0}
    for kind, limit in limits.items():
        hard = resource.getrlimit(kind)[1]
        limit = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
        resource.setrlimit(kind, (limit, limit))


def _wait(child: int, reader: int, deadline: float) -> tuple[bytes, int | None]:
    """The child's message, and how it ended; None if it takes longer, or does nothing for `IDLE_S`."""
    message, worked = b"", -1
    while (left := deadline - time.monotonic()) > 0:
        if select.select([reader], [], [], min(left, IDLE_S))[0]:
            if not (part := os.read(reader, select.PIPE_BUF)):  # it has closed its end
                return message, os.waitpid(child, 0)[1]
            message += part
        elif (ticks := _ticks(child)) == worked:
            break
        else:
            worked = ticks
    return b"", None


def _ticks(process: int) -> int:
    """Processor time that it has taken, in clock ticks."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return int(fields[11]) + int(fields[12])
