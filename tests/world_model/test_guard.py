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

from __future__ import annotations

import math

from accerl_lerobot.world_model.guard import KillSwitch


def test_dreams_that_succeed_too_often_trip_it():
    switch = KillSwitch(gap=0.3, window=10)
    assert all(math.isnan(share) for share in switch.shares)
    for i in range(10):
        assert not switch.tripped, "not before the window is full"
        switch.add(i < 5, i < 1)
    assert switch.shares == (0.5, 0.1) and switch.tripped
    switch.reset()
    assert not switch.tripped and all(math.isnan(share) for share in switch.shares)


def test_equal_and_unknown_outcomes_do_not():
    switch = KillSwitch(gap=0.3, window=4)
    for _ in range(20):
        switch.add(True, True)
        switch.add(True, None)
        switch.add(False, True)
    assert switch.shares == (0.5, 1.0) and not switch.tripped
    exact = KillSwitch(gap=0.5, window=2)
    exact.add(True, False)
    exact.add(False, False)
    assert not exact.tripped, "more than the gap, not as much"
