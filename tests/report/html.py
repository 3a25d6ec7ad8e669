# SPDX-License-Identifier: Apache-2.0
"""A page's contents, as a program sees them."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from typing import Any

VOID = {"meta", "link", "img", "br", "hr", "input"}
EMPTY = VOID | {"path"}
"""Elements without a content."""


class Seen(HTMLParser):
    """Text, elements and addresses of a page; its own style and script are no text.

    Raises:
        AssertionError: an element is not closed where it should be.
    """

    def __init__(self, html: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.charts: list[dict[str, Any]] = []
        """Data of each chart for the page's script, strict JSON."""
        self._words: list[str] = []
        self._open: list[str] = []
        self.feed(html)
        self.close()
        assert self._open == []

    @property
    def text(self) -> str:
        """All of it, with single spaces."""
        return " ".join(" ".join(self._words).split())

    def named(self, tag: str) -> list[dict[str, str]]:
        """Attributes of all elements of a kind."""
        return [attributes for name, attributes in self.elements if name == tag]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in EMPTY:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        assert self._open and self._open[-1] == tag, (tag, self._open)
        self._open.pop()

    def handle_data(self, data: str) -> None:
        inside = self._open[-1] if self._open else ""
        if inside == "script" and self.elements[-1][1].get("type") == "application/json":
            self.charts.append(json.loads(data, parse_constant=_refuse))
        elif inside not in ("script", "style"):
            self._words.append(data)


def _refuse(constant: str) -> None:
    raise AssertionError(f"{constant} is no JSON, and a browser would stumble over it")
