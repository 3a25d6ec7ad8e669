# SPDX-License-Identifier: Apache-2.0
"""Every cell of the table in docs/policies.md."""

from __future__ import annotations

from pathlib import Path

import pytest

from accerl_lerobot.policies.loading import POLICIES
from tests.policies.matrix import KINDS, examine, fixed, markdown
from tests.policies.tiny import TOLERANCE

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs" / "policies.md"


@pytest.mark.parametrize("name", KINDS)
def test_a_policy_type_does_all_of_it(name: str, tmp_path: Path):
    row = examine(name, tmp_path)
    assert row.losses is None or row.losses[1] < 0.99 * row.losses[0]
    assert row.mismatch <= TOLERANCE and row.reloaded
    assert row.chunk[1] == 2 and row.factors > 0 and 0 < row.parameters < 20e6
    assert "nan" not in markdown({name: row}).lower()
    cells = f"| `{name}` | {' | '.join(fixed(row))} |"
    assert cells in DOCS.read_text(), "python -m tests.policies.matrix prints it anew"


def test_the_table_has_every_type_and_names_tests_that_exist():
    assert set(KINDS) == set(POLICIES)
    text = DOCS.read_text()
    for name, kind in KINDS.items():
        file, test = kind.learns.split("::")
        assert f"def {test}(" in (ROOT / file).read_text()
        (line,) = [line for line in text.splitlines() if line.startswith(f"| `{name}` |") and test in line]
        assert line.count("|") == 9 and "| yes |" in line
