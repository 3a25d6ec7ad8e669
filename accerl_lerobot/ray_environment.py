# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Environment variables that Ray and its workers read, set before Ray is imported: it reads them once.

Every run gets a Ray of its own: token authentication with a token that only this process and its children know, so nobody
else on the machine can talk to its ports.
"""

from __future__ import annotations

import os
import secrets
import sys

WORKERS = {
    "OMP_NUM_THREADS": "1",  # several CPU workers share the cores; spinning threads would cost more than they give
    "OMP_WAIT_POLICY": "PASSIVE",
    "TOKENIZERS_PARALLELISM": "false",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
}


def prepare() -> None:
    """Sets them; does nothing about the token when Ray has been imported already or a token is configured."""
    for key, value in WORKERS.items():
        os.environ.setdefault(key, value)
    configured = any(os.environ.get(k) for k in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"))
    if "ray" not in sys.modules and not configured:
        os.environ["RAY_AUTH_MODE"] = "token"
        os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(32)
