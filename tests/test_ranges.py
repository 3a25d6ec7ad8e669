# SPDX-License-Identifier: Apache-2.0
"""Every number and choice in every config has declared values, and construction enforces them."""

import math
import typing
from collections.abc import Iterator
from typing import Annotated, Any, Literal

import pytest

from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.cli.verbs import CONFIGS
from accerl_lerobot.config.parsing import choices_of, section_of
from accerl_lerobot.config.ranges import Device, Pattern, Range, Section, Share, annotations_of, check
from accerl_lerobot.demos.backbone import BackboneConfig
from accerl_lerobot.demos.sft import SFTConfig
from accerl_lerobot.engines.config import LaunchConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.config import TuningConfig
from accerl_lerobot.timeline import TimelineConfig
from accerl_lerobot.world_model.config import PixelModelConfig
from benchmarks.__main__ import CONFIGS as BENCHMARKS


def sections(cls: type[Any]) -> Iterator[type[Any]]:
    yield cls
    for hint in annotations_of(cls).values():
        if (below := section_of(hint)) is not None:
            for kind in choices_of(below).values() or (below,):
                yield from sections(kind)


EVERY = {cls for config in (*CONFIGS.values(), *BENCHMARKS.values()) for cls in sections(config)}
SECTIONS = sorted(EVERY, key=lambda cls: cls.__name__)


def ranges(hint: Any) -> Iterator[tuple[Any, Range | None]]:
    """Each number in an annotation with its range."""
    if typing.get_origin(hint) is Annotated:
        kind, *marks = typing.get_args(hint)
        if kind in (int, float):
            yield kind, next((mark for mark in marks if isinstance(mark, Range)), None)
    elif hint in (int, float):
        yield hint, None
    elif typing.get_origin(hint) is not Literal:
        for below in typing.get_args(hint):
            yield from ranges(below)


@pytest.mark.parametrize("cls", SECTIONS, ids=lambda cls: cls.__name__)
def test_every_field_refuses_a_value_that_is_not_in_its_range(cls: type[Any]):
    assert issubclass(cls, Section)
    for name, hint in annotations_of(cls).items():
        for kind, span in ranges(hint):
            assert kind is float or span is not None, f"{name} needs a Range"
            outside = [math.nan, span.low - 1 if span is not None else math.inf]
            outside += [span.high + 1] if span is not None and span.high < math.inf else []
            for number in outside:
                value = number if kind is float or math.isnan(number) else int(number)
                many = typing.get_origin(hint) is tuple
                entries = 1 if many and Ellipsis in typing.get_args(hint) else len(typing.get_args(hint))
                with pytest.raises(InputError) as error:
                    cls(**{name: (value,) * entries if many else value})
                assert error.value.field == (f"{cls.SECTION}.{name}" if cls.SECTION else name)
                assert error.value.hint.startswith("use ")


@pytest.mark.parametrize(
    ("cls", "values", "said"),
    [
        (BackboneConfig, {"patch": 24}, "sft.backbone.patch=24: use "),
        (BackboneConfig, {"hidden": 12}, "sft.backbone.hidden=12: use a multiple of 8"),
        (PixelModelConfig, {"channels": ()}, "world_model.model.channels="),
        (LaunchConfig, {"placement": {"rollout": " "}}, "launch.placement.rollout=' ': use one of"),
        (SFTConfig, {"policy": {"chunk_size": 4}}, "sft.policy="),
        (TimelineConfig, {"runs": ()}, "runs="),
        (TrainerConfig, {"ranks": 9, "batch_decisions": 8}, "trainer.ranks=9: use at most trainer"),
        (TuningConfig, {"targets": "("}, "policy.tuning.targets='(': not a regular"),
    ],
)
def test_values_that_do_not_go_together_name_their_field(cls: type[Any], values: dict[str, Any], said: str):
    with pytest.raises(InputError) as error:
        cls(**values)
    assert str(error.value).startswith(said)


@pytest.mark.parametrize(
    ("hint", "fits", "does_not"),
    [
        (Annotated[int, Range("[0, 2]")], [0, 2], [-1, 3, 1.0, True, "1", None]),
        (Annotated[float, Range("(0, 1)")], [0.5], [0, 1, 1.0, math.nan, math.inf, "0.5", True]),
        (Annotated[float, Range("(0, inf]")], [1e300, math.inf], [0.0, -math.inf, math.nan]),
        (Share | None, [None, 1], [2, math.inf, "1"]),
        (tuple[Share, Share], [(0, 1), [0.5, 0.5]], [(0.5,), (0.5, 1.5), 0.5, (math.nan, 0)]),
        (list[str], [[]], ["ab", [1]]),
        (Literal["a", "b"] | None, ["a", None], ["c", 1]),
        (Annotated[str, Pattern("a", "a")], ["a"], ["b", []]),
        (Device, ["auto", "cpu", "cuda", "cuda:3"], ["foo", "cuda:999", "cuda:", "CPU", 0, ""]),
        (dict[str, Any], [{}], []),
    ],
    ids=str,
)
def test_values_that_fit_an_annotation(hint: Any, fits: list[Any], does_not: list[Any]):
    for value in fits:
        check(hint, value, "field")
    for value in does_not:
        with pytest.raises(InputError, match=r"^field="):
            check(hint, value, "field")
