# SPDX-License-Identifier: Apache-2.0
"""Answers as a hostile Hub might give them: good ones, changed at random, to `pull`.

Run: ``python -m tests.hub.hostile_hub SEED SCRATCH TIMES`` pulls so many times, and prints what became of it.
"""

from __future__ import annotations

import json
import random
import shutil
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from accerl_lerobot.errors import InputError
from tests.hostile import VALUES, Trial, changed_bytes, changed_tree
from tests.hub.folders import write_json, write_policy_folder, write_run_folder
from tests.hub_server import Answer, HubServer, serving

SECONDS = 20
"""For a single pull."""
STATUSES = (
    100, 200, 204, 206, 301, 302, 307, 308, 400, 401, 403, 404, 408, 409, 416, 418, 429, 500, 503, 799,
)  # fmt: skip
HEADERS = (
    "Content-Length", "ETag", "X-Linked-ETag", "X-Linked-Size", "X-Repo-Commit", "Location", "Link",
    "Retry-After", "RateLimit", "Content-Encoding", "Content-Type", "Content-Range", "X-Error-Code",
    "X-Error-Message", "X-Xet-Hash", "X-Xet-Refresh-Route", "Content-Disposition", "Transfer-Encoding",
)  # fmt: skip
TEXTS = (
    "../../../../escaped", "/tmp/escaped-from-a-pull", "main", "0" * 40, "A" * 40, "f" * 39, "", "-1",
    "Infinity", "1e9", "999999999", "gzip", "br", "chunked", "RepoNotFound", "EntryNotFound", "GatedRepo",
    "file:///etc/passwd", "bytes 0-1/2", "inline; filename=../x", "x" * 9000, "http://127.0.0.1:1/x",
    "{url}/alice/policy/resolve/main/config.json", '"api";r=0;t=999999999',
    "<{url}/api/models/alice/policy/tree/main?again=1>; rel=next",
)  # fmt: skip
NAMES = (
    "../escaped", "/tmp/escaped-from-a-pull", "a/../../escaped", ".cache/huggingface/x", "config.json/x",
    "CONFIG.json", "x" * 300, "a\\b", "C:x", "~/x", "nul\0", "\ud800", "", ".", "a//b", "checkpoints/last",
    "accerl_pulled.json/x", ".lock/x", "evil.py", "e\u0301", "\xe9", "config.yaml", 7, None, ["a"], {"a": 1},
)  # fmt: skip
KINDS = (
    "tree", "tree", "names", "sizes", "bytes", "status", "header", "header", "pages", "slow", "cut",
)  # fmt: skip
CONSENT = (
    b"env: {type: lerobot, trust_remote_code: true, kwargs: {hub_path: a/b}}\nlaunch: {address: 'a:1'}\n"
)


def plant(hub: HubServer, scratch: Path) -> list[str]:
    """A policy, a run and a dataset; returns their names."""
    write_json(scratch / "data" / "meta" / "info.json", {"codebase_version": "v3.0"})
    for name in ("tasks.parquet", "stats.json", "episodes/chunk-000/file-000.parquet"):
        write_json(scratch / "data" / "meta" / name, {})
    write_json(scratch / "data" / "data" / "chunk-000" / "file-000.parquet", {})
    write_run_folder(scratch / "run")
    (scratch / "run" / "config.yaml").write_bytes(CONSENT)
    write_policy_folder(scratch / "policy")
    for name in ("policy", "run", "data"):
        files = [path for path in (scratch / name).rglob("*") if path.is_file()]
        named = {path.relative_to(scratch / name).as_posix(): path.read_bytes() for path in files}
        hub.plant(f"alice/{name}", named)
    return ["alice/policy", "alice/run", "alice/data"]


def changed_answer(url: str, rng: random.Random) -> Callable[[Answer], Answer]:
    """Changes answers of one sort, or of any, in one way."""
    kind = rng.choice(KINDS)
    where = rng.choice(("/tree/", "/revision/", "/api/", "/resolve/", "config", "/"))
    if kind in ("names", "sizes", "pages"):
        where = "/tree/"
    share = rng.choice((0.2, 1.0))

    def change(answer: Answer) -> Answer:
        if where not in answer.path or rng.random() > share:
            return answer
        body = b"".join(answer.pieces)
        if kind in ("tree", "names", "sizes"):
            try:
                tree = json.loads(body)
            except ValueError:
                return answer
            if kind == "tree":
                tree = changed_tree(tree, rng)
            elif isinstance(tree, list) and tree:
                entry = rng.choice(tree)
                if kind == "names":
                    entry["path"] = rng.choice(NAMES)
                else:
                    entry[rng.choice(("size", "oid", "lfs", "type", "path"))] = rng.choice(VALUES)
            answer.pieces = [json.dumps(tree).encode("utf-8", "surrogatepass")]
        elif kind == "bytes":
            answer.pieces = [changed_bytes(body, rng)]
        elif kind == "status":
            answer.status = rng.choice(STATUSES)
        elif kind == "header":
            text = rng.choice(TEXTS).replace("{url}", url)
            answer.headers[rng.choice(HEADERS)] = text
            return answer
        elif kind == "pages":
            body = rng.choice((body, b"[]"))
            answer.headers["Link"] = f'<{url}{answer.path}?page={rng.random()}>; rel="next"'
            answer.pieces = [body]
        elif kind == "slow":
            body = rng.choice((body, b" " * 4000 + body))
            answer.pieces, answer.pause_s = [body[i : i + 1] for i in range(len(body))], 0.02
        else:
            answer.pieces = [body[: rng.randrange(len(body) + 1)]]
            return answer
        answer.headers["Content-Length"] = str(sum(map(len, answer.pieces)))
        return answer

    return change


def main(seed: int, scratch: Path, times: int) -> dict[str, Any]:
    """Pulls so many times; gives outcomes, what was written elsewhere, the slowest pull and the memory."""
    from huggingface_hub import constants, file_download
    from huggingface_hub.utils import _http

    from accerl_lerobot.config.parsing import consents, read_recipe
    from accerl_lerobot.hub import errors, pull
    from accerl_lerobot.hub.card import PullConfig

    errors.WINDOW_S, errors.SILENT_S, errors.SLOWEST = 0.5, 2.0, 1000
    constants.HF_HUB_ETAG_TIMEOUT = constants.HF_HUB_DOWNLOAD_TIMEOUT = 2
    constants.HF_HUB_CACHE = str(scratch / "cache")
    constants.HF_HUB_OFFLINE, constants.HF_HUB_DISABLE_XET = False, True
    naps: list[float] = []
    for module in (_http, file_download):
        module.time = SimpleNamespace(**(vars(time) | {"sleep": naps.append}))
    rng, slowest, consented = random.Random(seed), 0.0, 0
    uncaught: list[str] = []
    trial = Trial(rng, scratch)
    with serving(scratch / "hub") as hub:
        names = plant(hub, scratch)
        constants.ENDPOINT = hub.url
        constants.HUGGINGFACE_CO_URL_TEMPLATE = f"{hub.url}/{{repo_id}}/resolve/{{revision}}/{{filename}}"
        before = trial.written()
        for number in range(times):
            hub.change = changed_answer(hub.url, random.Random(f"{seed} {number}"))
            target, name = scratch / "pulled", names[number % len(names)]
            config = PullConfig(repo_id=name, output_dir=str(target), repo_type=rng.choice((None, "model")))
            began = time.perf_counter()
            try:
                trial.one(name, lambda config=config: pull.pull(config), f"case {number}")
            except Exception as error:
                uncaught.append("".join(traceback.format_exception(error))[-1500:])
            slowest = max(slowest, time.perf_counter() - began)
            for recipe in target.rglob("config.yaml"):
                try:
                    consented += bool(consents(read_recipe(recipe)))
                except InputError:
                    continue
            for folder in (target, *scratch.glob(".pulling-*"), scratch / "cache"):
                shutil.rmtree(folder, ignore_errors=True)
        hub.change = None
    allowed = f"('127.0.0.1', {hub.server_address[1]})"
    outside = [path for path in trial.written() - before if not _expected(path, scratch, allowed)]
    return {
        "outcomes": dict(Counter(trial.outcomes)), "outside": sorted(outside), "slowest_s": round(slowest, 2),
        "uncaught": uncaught, "consented": consented, "longest_nap_s": max(naps, default=0.0),
        "memory_mib": _memory_mib(),
    }  # fmt: skip


def _memory_mib() -> int:
    """The most that this program has held; `getrusage` would count what its parent held at its start."""
    (line,) = [x for x in Path("/proc/self/status").read_text().splitlines() if x.startswith("VmHWM:")]
    return int(line.split()[1]) // 1024


def _expected(written: str, scratch: Path, server: str) -> bool:
    """True if it is the server, a port on which nobody listens, or lies where a pull may write."""
    if written.startswith("socket.connect"):
        return server in written or "('127.0.0.1', 1)" in written
    path = Path(written)
    if not path.is_relative_to(scratch) or ".." in path.parts:
        return False
    first = path.relative_to(scratch).parts[0]
    return first in ("pulled", "hub", "cache") or first.startswith(".pulling-")


if __name__ == "__main__":
    sys.stdout.write(json.dumps(main(int(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]))) + "\n")
