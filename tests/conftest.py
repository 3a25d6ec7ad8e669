# SPDX-License-Identifier: Apache-2.0
"""Fixtures shared by all tests: offline, one tiny checkpoint of LeRobot's own SmolVLA class, and one Ray."""

from __future__ import annotations

import atexit
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pytest

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
if "LIBERO_CONFIG_PATH" not in os.environ:
    # LIBERO remembers folders in the user's home, which may be those of another installation.
    os.environ["LIBERO_CONFIG_PATH"] = tempfile.mkdtemp()
    atexit.register(shutil.rmtree, os.environ["LIBERO_CONFIG_PATH"], ignore_errors=True)
# A policy type in a package of its own, as if it were installed; in LeRobot's commands too.
EXAMPLE = str(Path(__file__).parents[1] / "docs" / "examples" / "lerobot_policy_smolvla_bins")
sys.path.insert(0, EXAMPLE)
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (EXAMPLE, os.environ.get("PYTHONPATH"))))

from accerl_lerobot.engines import ray_session  # noqa: E402

ray_session.prepare()


@pytest.fixture(scope="session")
def tiny_checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A random SmolVLA that fits ``SimulatedConfig()``; about 0.1 M parameters."""
    from tests.policies.checkpoints import write_smolvla

    return write_smolvla(tmp_path_factory.mktemp("tiny") / "pretrained_model")


@pytest.fixture(scope="session")
def light_ray() -> Iterator[None]:
    """Ray for the rest of the test session; engines that find it leave it running."""
    import ray

    from accerl_lerobot.engines.ray_session import start_ray

    if not ray.is_initialized():
        start_ray()
    yield
    ray.shutdown()


@pytest.fixture
def light_engine(light_ray: None, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Any]]:
    """Makes asynchronous engines with stand-ins for inference and trainer, and closes them."""
    from accerl_lerobot.engines.ray_engine import RayEngine
    from tests.light_workers import LightInference, LightTrainer
    from tests.runs import tiny_run

    monkeypatch.setattr("accerl_lerobot.engines.ray_engine.POLL_S", 0.05)
    monkeypatch.setattr("accerl_lerobot.inference.worker.InferenceWorker", LightInference)
    monkeypatch.setattr("accerl_lerobot.trainer.worker.TrainerWorker", LightTrainer)
    with ExitStack() as made:

        def make(state: Path | None = None, learns: bool = True, **sections: Any) -> RayEngine:
            config = tiny_run(Path("nowhere"), **sections)
            return made.enter_context(closing(RayEngine(config, ("match",), state=state, learns=learns)))

        yield make
