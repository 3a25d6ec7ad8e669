# SPDX-License-Identifier: Apache-2.0
"""The verbs. Answers ``--help`` at once; everything heavy is imported by the verb that needs it."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import textwrap
from collections.abc import Callable

from accerl_lerobot import __version__
from accerl_lerobot.engines.stopping import TerminatedError, interrupted
from accerl_lerobot.errors import InputError, Once, one_line, printable

LEVELS = ("DEBUG", "INFO", "WARNING", "ERROR")
VERBS = {
    "train": "improve a policy by online RL (demonstrations and SFT first, if the recipe says so)",
    "demos": "record scripted-expert demonstrations into a LeRobotDataset",
    "sft": "fine-tune on a LeRobotDataset with LeRobot's own trainer",
    "offline": "improve a policy from recorded episodes alone, such as a real robot's",
    "eval": "measure the success of a checkpoint, with its confidence interval",
    "world-model": "train a world model on a LeRobotDataset and check it on held-out episodes",
    "world-model-eval": "check a world model on episodes that it was not trained on",
    "push": "push a policy, world model or dataset to the Hub, as one commit",
    "pull": "pull from the Hub into a new folder, pinned and checked",
    "report": "write one HTML page about a run, or several side by side",
    "timeline": "show when every worker of a run did what: a trace for Perfetto, and shares",
    "export": "write the episodes of a run as a LeRobotDataset, with an image at every env step",
    "doctor": "resolve a recipe and check this machine",
}
FUNCTIONS = {"eval": "verbs:evaluate", "doctor": "doctor:main"}
"""Verb → module and function, where that is not the one of the same name in `verbs`."""


def usage() -> str:
    """The text of ``accerl --help``."""
    verbs = "\n".join(f"  {verb:16} {what}" for verb, what in VERBS.items())
    return f"""accerl {__version__}: online reinforcement learning of LeRobot policies

usage: accerl VERB [recipe.yaml] [--section.field=value …]

{verbs}

examples:
  accerl doctor quickstart
  accerl train --config_path=quickstart --trainer.lr=2e-4
  accerl eval --config_path=RUN/config.yaml --policy.path=RUN/checkpoints/last/pretrained_model

accerl VERB --help lists what people change, --help=all every field. ACCERL_LOG=INFO says more.
"""


def main(arguments: list[str] | None = None) -> int:
    """Runs a verb; returns the exit code."""
    if arguments is None:  # this process is all ours
        arguments = sys.argv[1:]
        os.environ.setdefault("ACCERL_ONE_POLICY", "1")  # see `policies.deferred`
    verb, *rest = arguments or ["--help"]
    if verb in ("-h", "--help", "help", "--version"):
        sys.stdout.write(f"{__version__}\n" if verb == "--version" else usage())
        return 0
    return exit_code("accerl", lambda: run(verb, rest))


def run(verb: str, rest: list[str]) -> int:
    """Runs a verb, or shows its help."""
    from accerl_lerobot.config.parsing import imported

    set_up_logging()
    if verb not in VERBS:
        raise InputError("VERB", verb, f"use one of {', '.join(VERBS)}")
    section = help_asked(rest)
    if section is not None:
        return show_help(verb, rest, section)
    path = FUNCTIONS.get(verb, f"verbs:{verb.replace('-', '_')}")
    with interrupted():
        function: Callable[[list[str]], int] = imported(f"accerl_lerobot.cli.{path}")
        return function(rest)


def help_asked(rest: list[str]) -> str | None:
    """The section that ``--help`` names, "" for a bare one; None: it is not asked for."""
    for argument in rest:
        flag, _, section = argument.partition("=")
        if flag in ("-h", "--help"):
            return section
    return None


def show_help(verb: str, rest: list[str], section: str) -> int:
    """``accerl VERB --help``, or of one section of its fields."""
    from accerl_lerobot.cli.verbs import CONFIGS
    from accerl_lerobot.config.help import help_text
    from accerl_lerobot.config.parsing import DISCOVER, read_arguments, register_types, shipped_recipes

    packages = [argument for argument in rest if f"{DISCOVER}=" in argument]
    register_types(CONFIGS[verb], read_arguments(packages)[1])
    sys.stdout.write(help_text(f"accerl {verb}", CONFIGS[verb], VERBS[verb], section) + "\n")
    if verb in ("train", "doctor") and not section:
        recipes = f"recipes: {', '.join(shipped_recipes())}, or a YAML file of your own"
        sys.stdout.write(f"\n{textwrap.fill(recipes, 100)}\n")
    return 0


def exit_code(program: str, work: Callable[[], int]) -> int:
    """The exit code of `work`, or of the error that ends it, which is told in one line."""
    try:
        code = work()
        sys.stdout.flush()
        return code
    except InputError as error:
        logging.getLogger(__name__).debug("%s refuses", program, exc_info=error)
        # Ray raises a subclass whose text is a whole traceback; the error itself is inside.
        return _refuse(program, str(getattr(error, "cause", error)))
    except KeyboardInterrupt as stop:
        _refuse(program, "interrupted")
        return 143 if isinstance(stop, TerminatedError) else 130
    except Exception as error:
        if isinstance(error, BrokenPipeError) and not _output_is_open():
            return 128 + signal.SIGPIPE
        logging.getLogger(__name__).debug("%s failed", program, exc_info=error)
        _refuse(program, one_line(error))
        return 1


def _refuse(program: str, text: str) -> int:
    with contextlib.suppress(OSError):  # the reader of the pipe may be gone
        sys.stderr.write(f"{program}: {printable(text)}\n")
    return 2


def _output_is_open() -> bool:
    """False if the reader of the standard output has gone, as ``head`` does; then nothing more is written."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return False
    return True


def set_up_logging() -> None:
    """Sets the level that ``ACCERL_LOG`` names."""
    level = os.environ.get("ACCERL_LOG", "WARNING").upper()
    if level not in LEVELS:
        raise InputError("ACCERL_LOG", level, f"use {', '.join(LEVELS)}")
    handler = logging.StreamHandler()
    handler.setFormatter(_Printable("%(levelname)s %(name)s: %(message)s"))
    handler.addFilter(Once())
    logging.basicConfig(level=level, handlers=[handler])


class _Printable(logging.Formatter):
    """Log lines without control characters of the files and servers that they quote."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record), keep="\n\t")
