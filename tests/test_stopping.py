# SPDX-License-Identifier: Apache-2.0
"""SIGTERM and Ctrl-C: noted, and heeded at once where nothing is to be saved; resuming."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from accerl_lerobot.engines.config import RunConfig
from accerl_lerobot.engines.stopping import StoppedError, Stopping, handled
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.config import PolicyConfig, TuningConfig
from accerl_lerobot.run.resuming import continued


def test_a_signal_is_noted_first_and_interrupts_when_it_comes_again():
    stop = Stopping()
    with pytest.raises(KeyboardInterrupt), handled(stop.note):
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.asked == signal.SIGTERM
        os.kill(os.getpid(), signal.SIGTERM)
        pytest.fail("it goes on")


@pytest.mark.parametrize("before", [False, True])
def test_where_nothing_can_be_saved_the_first_signal_interrupts(before: bool):
    stop = Stopping("a command")
    with handled(stop.note):
        if before:
            os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(StoppedError, match="stopped by SIGINT; to resume: a command"), stop.at_once():
            os.kill(os.getpid(), signal.SIGINT)
            pytest.fail("it goes on")
        assert stop.asked == signal.SIGINT


def test_handlers_of_a_library_that_starts_are_taken_back():
    stop = Stopping()
    with handled(stop.note):
        with handled():
            signal.signal(signal.SIGTERM, lambda number, frame: pytest.fail("a handler of its own"))
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.asked == signal.SIGTERM


def test_low_rank_adapters_need_the_policy_that_they_adapt(tmp_path: Path):
    checkpoint = tmp_path / "checkpoints" / "000001"
    for path, found in ((str(tmp_path), True), ("alice/start", True), (str(tmp_path / "gone"), False)):
        config = RunConfig(policy=PolicyConfig(path=path, tuning=TuningConfig(mode="lora")))
        if found:
            assert continued(config, tmp_path, checkpoint).policy.path == path
            continue
        with pytest.raises(InputError, match=r"^policy\.path=.*gone': the policy that this run began from"):
            continued(config, tmp_path, checkpoint)
