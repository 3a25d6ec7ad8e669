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
"""Annotations of config fields, in words and otherwise."""

from __future__ import annotations

import types
import typing
from typing import Any


def wanted(hint: Any) -> str:
    """An annotation in words, for people."""
    if is_union(hint):
        parts = [wanted(a) for a in typing.get_args(hint) if a is not type(None)]
        return " or ".join(parts + (["null"] if is_optional(hint) else []))
    plain = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}
    if hint in plain:
        return plain[hint]
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Literal:
        return f"one of {', '.join(map(str, arguments))}"
    if origin is tuple and Ellipsis not in arguments:
        return f"a list of {len(arguments)}, each {wanted(arguments[0])}"
    if origin in (list, tuple):
        return f"a list such as [a, b], each {wanted(arguments[0])}"
    if origin is dict:
        return "a mapping such as {key: value}"
    return getattr(hint, "__name__", str(hint))


def is_union(hint: Any) -> bool:
    """Whether it is of several kinds, ``X | Y``."""
    return typing.get_origin(hint) in (typing.Union, types.UnionType)


def is_optional(hint: Any) -> bool:
    """Whether None is one of them."""
    return is_union(hint) and type(None) in typing.get_args(hint)
