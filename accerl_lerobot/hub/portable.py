# SPDX-License-Identifier: Apache-2.0
"""Takes the paths of a machine out of what leaves it.

Only records are rewritten: configs, recipes, metrics, cards. Weights, pictures, tables and the vocabularies
of tokenisers, in which anything may stand, are left as they are.
"""

from __future__ import annotations

import json
import re
from pathlib import Path, PurePosixPath
from typing import Any

import yaml

from accerl_lerobot.checkpoint.layout import AWAY, places_of_names

RECORDS = (".json", ".jsonl", ".yaml", ".yml", ".md", ".txt", ".log", ".csv", ".html")
VOCABULARIES = ("tokenizer.json", "vocab.json", "merges.txt", "added_tokens.json", "special_tokens_map.json")
PATH = re.compile(r"(?<![\w:/.~}>\-])(?:~|)(?:/[\w.+@%,\-]+){2,}/?")
"""At least two names after a slash that nothing stands before which would make it a URL or a quotient."""
HOMES = (
    "home",
    "Users",
    "root",
    "tmp",
    "mnt",
    "data",
    "workspace",
    "var",
    "srv",
    "opt",
    "private",
    "scratch",
)
"""Tops of paths of other machines, from where a file may have come here."""


def is_record(name: str) -> bool:
    """True if a file is text that may name paths."""
    path = PurePosixPath(name)
    return path.suffix in RECORDS and path.name not in VOCABULARIES


def cleaned(name: str, data: bytes, folder: Path) -> bytes:
    """A record without paths of this machine; the bytes themselves if it has none.

    A path below the pushed folder becomes relative to it, of any other only the last name is kept.

    Args:
        name: of the file; says how it is read.
        data: its content.
        folder: what is pushed.
    """
    try:
        text = data.decode()
    except UnicodeDecodeError:
        return data
    if _relative(text, folder) == text:
        return data
    suffix = PurePosixPath(name).suffix
    try:
        if suffix == ".json":
            tree = _walk(json.loads(text), folder)
            new = json.dumps(tree, indent=_indent(text), ensure_ascii=text.isascii())
            return (new + ("\n" if text.endswith("\n") else "")).encode()
        if suffix in (".yaml", ".yml"):
            return yaml.safe_dump(_walk(yaml.safe_load(text), folder), sort_keys=False).encode()
    except (ValueError, yaml.YAMLError):
        pass  # not what its name says: it is text then
    return _relative(text, folder).encode()


def own_names(config: dict[str, Any], processor: dict[str, Any], has: set[str]) -> list[str]:
    """Points a policy's config and processor at folders beside them, by their bare names.

    Args:
        config: LeRobot's policy config; changed.
        processor: LeRobot's preprocessor; changed.
        has: folders that there are beside them.

    Returns:
        The folders of this machine that they go on naming.
    """
    places = places_of_names(config, processor)
    local = [place for place in places if Path(place[0].get(place[1]) or "").is_absolute()]
    for fields, key, own in local:
        if own in has:
            fields[key] = own
    return [fields[key] for fields, key, own in local if own not in has]


def _walk(value: Any, folder: Path) -> Any:
    if isinstance(value, dict):
        # Where results went is nobody's business, and null is a folder of its own for whoever repeats it.
        return {k: None if k == "output_dir" and _is_local(v) else _walk(v, folder) for k, v in value.items()}
    if isinstance(value, list):
        return [_walk(v, folder) for v in value]
    return _relative(value, folder) if isinstance(value, str) else value


def _relative(text: str, folder: Path) -> str:
    """Text in which paths of a machine are replaced; a text that is a path as a whole may hold blanks."""
    if _is_local(text):
        return _portable(text, folder)
    for root in {str(folder.absolute()), str(folder.resolve())}:
        text = text.replace(f"{root}/", "")
    return PATH.sub(lambda m: _portable(m[0], folder) if _of_a_machine(m[0]) else m[0], text)


def _is_local(value: Any) -> bool:
    """True if it is a path of a machine as a whole."""
    whole = isinstance(value, str) and value.startswith(("/", "~/")) and "\n" not in value
    return whole and _of_a_machine(value)


def _of_a_machine(path: str) -> bool:
    top = path.split("/")[1]
    return path.startswith("~") or path.count("/") > 1 and (top in HOMES or Path("/", top).is_dir())


def _portable(path: str, folder: Path) -> str:
    where = Path(path)
    for root in (folder.absolute(), folder.resolve()):
        if where.is_relative_to(root):
            return where.relative_to(root).as_posix()
    return f"{AWAY}/{where.name}"


def _indent(text: str) -> int | None:
    """The indentation of a JSON text, so that no more of it changes than must."""
    found = re.match(r"[\[{]\n( +)", text)
    return len(found[1]) if found else None
