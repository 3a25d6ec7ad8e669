# SPDX-License-Identifier: Apache-2.0
"""Small networks for π0 and its kin, and one checkpoint of each case."""

from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.policies.cases import CASES, VARIANTS
from tests.policies.tiny_pi import small


@pytest.fixture(scope="module", autouse=True)
def sizes() -> Iterator[None]:
    with small():
        yield


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The checkpoint of a case of `cases`, by its name."""

    @cache
    def write(name: str) -> Path:
        return (CASES | VARIANTS)[name].write(tmp_path_factory.mktemp("policy") / "pretrained_model")

    return write
