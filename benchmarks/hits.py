# SPDX-License-Identifier: Apache-2.0
"""One thing that goes wrong in a run: where, the proof that it did, what became of the run, and how soon.

survived    the run's process went on: the loss was made good below it, or nobody was lost
stopped     it ended, by the fault or with an error of its own, and was gone on with by `--resume`
lost        neither
"""

from __future__ import annotations

import itertools
import random
import signal
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

from accerl_lerobot.errors import MAX_NONFINITE
from benchmarks.audit import audit_updates
from benchmarks.fault_injection import FULL, NAN, POINTS, TORN, inject, proof, withdraw
from benchmarks.tables import last_words
from benchmarks.victims import DRIVER, EVERYTHING, Victim, alive, await_hit, hit

SIGNALS = {"kill": signal.SIGKILL, "stop": signal.SIGSTOP}
"""Fault → what is sent from outside, at any moment."""
NANS = "nans"
"""``nan`` in as many updates in a row as end the trainer."""
FAULTS = ("kill", "stop", "exception", "exit", "hang", NAN, NANS, FULL, TORN)
ANYWHERE = "anywhere"
"""Place of a fault that comes from outside."""
PREFIX = {"trainer rank": "rank", "world-model learning": "learning"}
"""Target → what its points' names begin with, where that is not its own name."""
VISITS = 3
"""A fault happens at one of so many visits of its point."""
AWAIT_S = 90.0
"""How long a point may take to be reached."""
START_S = 300.0
"""How long a run may take to recover, or to its first update."""
SPARE = 20
"""Updates after a fault that ends nobody: some were made before it and told of late, and some can be made of
what replay has."""
TIDY_S = 10.0
"""How long what was killed may take to be gone."""


@dataclass(frozen=True, kw_only=True)
class Hit:
    """Outcome of one fault."""

    target: str
    fault: str
    place: str
    """One of `POINTS`, or `ANYWHERE`."""
    fired: bool
    """True if there is a proof that it happened."""
    outcome: str
    """See above."""
    seconds: float | None = None
    """From the fault to an update that had not been made before; of inference to decisions that had not, of a
    rollout worker to its successor; where nobody is lost: None."""
    lost: int = 0
    """Updates missing from the log."""
    doubled: int = 0
    """Updates in it twice."""
    books: bool | None = None
    """True if replay's add up."""
    said: str = ""
    """Why it was lost, or what the run ended with."""


def places(target: str, fault: str) -> list[str]:
    """Where this can befall a target; none: it cannot."""
    if target == EVERYTHING:
        return [ANYWHERE] if fault == "kill" else []
    if fault == NANS:
        return ["trainer.loss"] if target == "trainer" else []
    prefix = PREFIX.get(target, target)
    found = [p for p, faults in POINTS.items() if p.split(".")[0] == prefix and fault in faults]
    if fault in SIGNALS and (target, fault) != (DRIVER, "stop"):
        found.insert(0, ANYWHERE)
    return found


def strike(victim: Victim, orders: Path, name: str, target: str, fault: str, rng: random.Random) -> Hit:
    """Does it once, and waits until the run has recovered, or has not."""
    place, count = rng.choice(places(target, fault)), len(victim.pids(target))
    said_before = victim.log.stat().st_size
    fired = False
    outcome = "survived"
    said = ""
    seconds = None
    try:
        began, pid = _befall(victim, orders, name, target, fault, place, rng)
        fired = True
        try:
            _recover(victim, target, fault, pid, count)
        except RuntimeError as error:
            if victim.process.poll() is None:
                raise
            outcome = "stopped"
            said = _reason(victim, error, said_before)
            # What has ended may have left workers behind, which end with it, if not at once.
            last = max(victim.updates(), default=0)
            victim.go_on()
            victim.await_update(last + 1, START_S)
        seconds = None if fault == NAN else round(time.monotonic() - began, 2)
    except RuntimeError as error:
        outcome = "lost"
        said = str(error)
    found = audit_updates(victim.records())
    return Hit(
        target=target, fault=fault, place=place, fired=fired, outcome=outcome, seconds=seconds, said=said,
        lost=found["lost"], doubled=found["doubled"], books=found["books"],
    )  # fmt: skip


def _befall(
    victim: Victim, orders: Path, name: str, target: str, fault: str, place: str, rng: random.Random
) -> tuple[float, int]:
    """Makes it happen; when it did, by the monotonic clock, and to which process."""
    if place != ANYWHERE:
        times = MAX_NONFINITE if fault == NANS else 1
        what = NAN if fault == NANS else fault
        taken = inject(orders, name, place, what, at=rng.randint(1, VISITS), times=times)
        deadline = time.monotonic() + AWAIT_S
        while (said := proof(taken)) is None:
            if time.monotonic() > deadline or (victim.process.poll() is not None and not taken.is_file()):
                withdraw(orders, place)
                raise RuntimeError(f"{place} was not reached; {victim.log}:\n{last_words(victim.log)}")
            time.sleep(0.01)
        return float(said["monotonic"]), int(said["pid"])
    time.sleep(rng.uniform(0.2, 2.0))
    pids = victim.pids(target)
    if not pids:
        raise RuntimeError(f"there is no process of {target} to be hit")
    pid, began = rng.choice(pids), time.monotonic()
    if target == EVERYTHING:
        killed = victim.kill()
        while any(map(alive, killed)):
            if time.monotonic() - began > TIDY_S:
                raise RuntimeError("processes outlived SIGKILL")
            time.sleep(0.02)
    elif not (hit(pid, SIGNALS[fault]) and await_hit(pid, SIGNALS[fault])):
        raise RuntimeError(f"{target} {pid} took no notice of {fault}")
    return began, pid


def _recover(victim: Victim, target: str, fault: str, pid: int, count: int) -> None:
    """Waits until the run has, with as many processes of the target as before."""
    last = max(victim.updates(), default=0)
    if fault == NAN:
        victim.await_update(last + SPARE, START_S)
    elif target in (DRIVER, EVERYTHING):
        try:
            code = victim.process.wait(START_S)
        except subprocess.TimeoutExpired as error:
            raise RuntimeError("the run's process did not end") from error
        raise RuntimeError(f"the run's process ended with code {code}")
    else:
        victim.wait(lambda: pid not in victim.pids(target), START_S, f"{target} {pid} was left as it is")
        victim.await_successors(target, pid, count, START_S)
        if target == "inference":
            # More than may have been decided before and is told of late.
            told = victim.decisions()
            enough = told[-1] + max((b - a for a, b in itertools.pairwise(told)), default=0.0)
            victim.wait(lambda: victim.decisions()[-1] > enough, START_S, "nothing was decided any more")
        elif target != "rollout":
            # Who is there now was started from a checkpoint, long after what was made before was told.
            victim.await_update(max(last, *victim.updates()) + 1, START_S)


def _reason(victim: Victim, error: RuntimeError, since: int) -> str:
    """How its process ended, and what it said last."""
    with victim.log.open("rb") as log:
        log.seek(since)
        lines = [line.strip() for line in log.read().decode(errors="replace").splitlines() if line.strip()]
    errors = [line for line in lines if "Error" in line]
    return f"{str(error).splitlines()[0]}; {errors[-1][:200]}" if errors else str(error).splitlines()[0]
