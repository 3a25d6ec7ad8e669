# SPDX-License-Identifier: Apache-2.0
"""Only the code of the policy type that is wanted is imported, and any other as soon as it is asked for."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from accerl_lerobot.policies.deferred import OURS

CODE = """
import sys
from accerl_lerobot.policies.config import PolicyConfig, register_policies
from accerl_lerobot.policies.loading import load_adapter

load_adapter(PolicyConfig(path=sys.argv[1], device="cpu"))  # as trainer and inference begin
loaded = [n for n in ("smolvla", "act", "groot") if f"lerobot.policies.{n}.processor_{n}" in sys.modules]
assert loaded == ["smolvla"], loaded
from lerobot.configs.policies import PreTrainedConfig
assert {"smolvla", "act", "groot"} <= set(PreTrainedConfig.get_known_choices())
from lerobot.policies.factory import get_policy_class
from lerobot.policies.act import ACTPolicy
assert get_policy_class("act") is ACTPolicy
register_policies("of another package")
assert "lerobot.policies.groot.processor_groot" in sys.modules
"""


@pytest.mark.slow
def test_one_policy_is_imported_without_the_others(tiny_checkpoint: Path):
    command = [sys.executable, "-c", CODE, str(tiny_checkpoint)]
    subprocess.run(command, check=True, timeout=300, env=os.environ | {OURS: "1"})
