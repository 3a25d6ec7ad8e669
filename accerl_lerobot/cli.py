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
"""The verbs. Answers ``--help`` at once; everything heavy is imported by the verb that needs it."""

from __future__ import annotations

import difflib
import importlib
import logging
import os
import sys
from collections.abc import Callable

from accerl_lerobot import __version__
from accerl_lerobot.errors import InputError

VERBS = {
    "train": (
        "verbs:train",
        "improve a policy by online RL (demonstrations and SFT first, if the recipe says so)",
    ),
    "demos": ("verbs:demos", "record scripted-expert demonstrations into a LeRobotDataset"),
    "sft": ("verbs:sft", "fine-tune on a LeRobotDataset with LeRobot's own trainer"),
    "eval": ("verbs:evaluate", "success of a checkpoint, with its confidence interval"),
    "world-model": ("verbs:world_model", "learn to dream a world from LeRobotDatasets, and be tried on them"),
    "world-model-eval": ("verbs:world_model_eval", "try a world model on episodes of one or several sources"),
    "push": ("verbs:push", "a policy, world model, dataset or run to the Hub, as one commit"),
    "pull": ("verbs:pull", "what was pushed into a new folder, pinned and checked"),
    "report": ("verbs:report", "one HTML page of a run, or of several beside each other, to look at"),
    "timeline": ("verbs:timeline", "what every worker of a run did when: a picture, a trace and shares"),
    "export": ("verbs:export", "the episodes of a run as a LeRobotDataset, with a picture at every env step"),
    "doctor": ("doctor:main", "resolve a recipe and check this machine"),
    "bench": ("verbs:bench", "measure: accerl bench world, policy, lag, dream, ranking, …"),
}


def usage() -> str:
    """The text of ``accerl --help``."""
    lines = [
        f"accerl {__version__}: online reinforcement learning of LeRobot policies",
        "",
        "usage: accerl VERB [recipe.yaml] [--room.field=value …]",
        "",
    ]
    lines += [f"  {verb:16} {what}" for verb, (_, what) in VERBS.items()]
    lines += [
        "",
        "examples:",
        "  accerl doctor recipes/quickstart.yaml",
        "  accerl train --config_path=recipes/quickstart.yaml --trainer.lr=1e-5",
        "  accerl eval --config_path=RUN/config.yaml --policy.path=RUN/checkpoints/last/pretrained_model",
        "",
        "accerl VERB --help lists the verb's fields. ACCERL_LOG=INFO says more.",
    ]
    return "\n".join(lines)


def show_help(verb: str, rest: list[str]) -> int:
    """``accerl VERB --help``; for bench, of the measurement that is named, or of all."""
    from accerl_lerobot.field_help import help_text
    from accerl_lerobot.verbs import CONFIGS

    names = [name for name in CONFIGS if name.split()[0] == verb]
    named = [name for name in names if name.split()[-1] in rest]
    texts = [help_text(name, CONFIGS[name], VERBS[verb][1]) for name in named or names]
    sys.stdout.write("\n\n".join(texts) + "\n")
    return 0


def main(arguments: list[str] | None = None) -> int:
    """Runs a verb; returns the exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        sys.stdout.write(usage() + "\n")
        return 0
    if arguments[0] == "--version":
        sys.stdout.write(__version__ + "\n")
        return 0
    verb, rest = arguments[0], arguments[1:]
    if verb not in VERBS:
        near = difflib.get_close_matches(verb, VERBS, n=1)
        hint = f"did you mean {near[0]}? Otherwise " if near else ""
        sys.stderr.write(f"accerl: no verb {verb!r}; {hint}use one of {', '.join(VERBS)}\n")
        return 2
    logging.basicConfig(
        level=os.environ.get("ACCERL_LOG", "WARNING"), format="%(levelname)s %(name)s: %(message)s"
    )
    module, _, name = VERBS[verb][0].partition(":")
    try:
        if "-h" in rest or "--help" in rest:
            return show_help(verb, rest)
        function: Callable[[list[str]], int] = getattr(
            importlib.import_module(f"accerl_lerobot.{module}"), name
        )
        return function(rest)
    except InputError as error:
        # Ray raises a subclass whose text is a whole traceback; the error itself is inside.
        sys.stderr.write(f"accerl: {getattr(error, 'cause', error)}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("accerl: interrupted\n")
        return 130


if __name__ == "__main__":
    sys.exit(main())
