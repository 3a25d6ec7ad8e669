# SPDX-License-Identifier: Apache-2.0
"""A timeline as a Chrome trace, which Perfetto (ui.perfetto.dev) and chrome://tracing show.

The format is Google's "Trace Event Format": a process for each role, a thread for each worker, and a complete
event for each interval, times in microseconds.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from accerl_lerobot.timeline.read import ABSENT, Timeline, Window
from accerl_lerobot.timeline.states import STATES

COLOURS = (
    "thread_state_running", "white", "thread_state_iowait", "rail_load", "rail_animation", "olive",
    "terrible", "good", "generic_work",
)  # fmt: skip
"""Colours of the states: names that the viewers know."""


def trace(timeline: Timeline, window: Window) -> dict[str, Any]:
    """The trace of a part of a timeline.

    Args:
        timeline: of a run.
        window: first and last second.
    """
    events: list[dict[str, Any]] = []
    roles = list(dict.fromkeys(row.role for row in timeline.rows))
    for pid, role in enumerate(roles, start=1):
        events.append({"ph": "M", "name": "process_name", "pid": pid, "tid": 0, "args": {"name": role}})
        events.append(
            {"ph": "M", "name": "process_sort_index", "pid": pid, "tid": 0, "args": {"sort_index": pid}}
        )
    first, last = (round(1e9 * end) for end in window)
    for tid, row in enumerate(timeline.rows, start=1):
        place = {"pid": roles.index(row.role) + 1, "tid": tid}
        events.append({"ph": "M", "name": "thread_name", **place, "args": {"name": row.worker}})
        begins, ends = np.maximum(row.times[:-1], first), np.minimum(row.times[1:], last)
        there = np.flatnonzero((ends > begins) & (row.states != ABSENT))
        for begin, end, state in zip(
            begins[there].tolist(), ends[there].tolist(), row.states[there].tolist(), strict=True
        ):
            event = {"ph": "X", "name": STATES[state], "cat": row.role, "cname": COLOURS[state]}
            events.append({**event, **place, "ts": begin / 1e3, "dur": (end - begin) / 1e3})
    return {"traceEvents": events, "displayTimeUnit": "ms"}
