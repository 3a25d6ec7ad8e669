# SPDX-License-Identifier: Apache-2.0
"""Stock ``lerobot-train`` that runs no code from outside, unpickles nothing, and checks its dataset's files.

Same arguments, same result. π0-FAST's action tokeniser, whose newest code LeRobot would fetch and run, is
read by `policies.fast` instead. ``--code_revision=COMMIT`` has code from the Hub run, of this commit only.

Run: ``python -m accerl_lerobot.demos.guarded_train <lerobot-train arguments>``
"""

from __future__ import annotations

import contextlib
import json
import sys

from accerl_lerobot.checkpoint.safety import Origin
from accerl_lerobot.demos.dataset_files import checked
from accerl_lerobot.demos.sft import CODE_REVISION, REFUSED
from accerl_lerobot.policies.guard import guarded, input_error


def main() -> None:
    """Runs ``lerobot-train`` on the command line's arguments."""
    from lerobot.scripts import lerobot_train

    from accerl_lerobot.policies.pi0_fast import data_only

    def given(prefix: str) -> str | None:
        return next((a.removeprefix(prefix) for a in sys.argv[1:] if a.startswith(prefix)), None)

    code, root, name = given(CODE_REVISION), given("--dataset.root="), given("--dataset.repo_id=")
    origin = Origin("dataset.repo_id", name) if root is None else Origin("dataset.root", root)
    sys.argv[1:] = [a for a in sys.argv[1:] if not a.startswith(CODE_REVISION)]
    try:
        with contextlib.ExitStack() as guards:
            guards.enter_context(guarded("sft", code))
            guards.enter_context(checked(origin, whole=root is not None))
            if code is None:
                guards.enter_context(data_only())
            lerobot_train.main()
    except Exception as error:
        if (refused := input_error(error)) is None:
            raise
        said = json.dumps([refused.field, str(refused.value), refused.remedy])
        sys.stdout.write(f"{REFUSED}{said}\n")
        sys.exit(2)


if __name__ == "__main__":
    main()
