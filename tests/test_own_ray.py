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
"""Who starts Ray ends it, and one that does not respond is not kept."""

from __future__ import annotations

import pytest

from accerl_lerobot import own_ray
from accerl_lerobot.config import LaunchConfig
from accerl_lerobot.own_ray import OwnRay


class Stand:
    """Stands in for `ray`, and counts."""

    def __init__(self, there: bool = False) -> None:
        self.there, self.calls = there, list[str]()

    def is_initialized(self) -> bool:
        return self.there

    def init(self, launch: LaunchConfig) -> None:
        self.there = True
        self.calls.append("init")

    def shutdown(self) -> None:
        self.there = False
        self.calls.append("shutdown")


@pytest.mark.parametrize(
    ("responds", "calls"),
    [(True, ["init", "shutdown"]), (False, ["init", "shutdown", "init", "shutdown"])],
)
def test_it_is_kept_for_those_who_come_later_while_it_responds(
    responds: bool, calls: list[str], monkeypatch: pytest.MonkeyPatch
):
    stand = Stand()
    monkeypatch.setattr(own_ray, "ray", stand)
    monkeypatch.setattr(own_ray, "start_ray", stand.init)
    monkeypatch.setattr(own_ray, "_responds", lambda: responds)
    own = OwnRay(LaunchConfig())
    own.start()
    own.start()
    own.close()
    own.close()
    assert stand.calls == calls and not stand.there


def test_one_that_was_there_before_is_left_as_it_is(monkeypatch: pytest.MonkeyPatch):
    stand = Stand(there=True)
    monkeypatch.setattr(own_ray, "ray", stand)
    monkeypatch.setattr(own_ray, "start_ray", stand.init)
    monkeypatch.setattr(own_ray, "_responds", lambda: pytest.fail("it is not ours to judge"))
    own = OwnRay(LaunchConfig())
    own.start()
    own.close()
    assert stand.calls == [] and stand.there
