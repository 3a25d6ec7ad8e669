# SPDX-License-Identifier: Apache-2.0
"""Files as somebody might send them: good ones, changed at random, and the checks and loaders that read them.

Run: ``python -m tests.hostile SEED SCRATCH TIMES`` goes through it under limits of memory and time, and
prints how many were refused and how many were found good. A test starts it in a process of its own, because a
crash in a library would take the whole session along.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from accerl_lerobot.errors import InputError

DATASET = Path(__file__).parents[1] / "datasets" / "metaworld_tiny"
MEMORY = 3 * 1024**3  # bytes of address space beyond what the libraries take
SECONDS = 60  # for a single file
VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2, 3, 7, 64, 4097, 10**6, 10**9, 2**31, 2**63, 10**30, 10**400, 0.5, -0.0,
    1e308, float("nan"), float("inf"), "", "a", "..", "../../x", "/etc/passwd", "C:\\x", "a\x00b", "\ud800",
    "x" * 5000, "{0.__class__}", "{chunk_index:999999999}", "{chunk_index.real}", "{video_key!r:>99999}", "{",
    "}", "float32", "image", "video", "smolvla", "gaussian_actor", "act", "subprocess.Popen", "builtins.eval",
    [], [[]], {}, [1, 2], [0, 0, 0], [10**6, 10**6, 3], ["a"], [None], {"a": 1}, {"type": "act"},
    {"shape": [3], "dtype": "float32"},
)  # fmt: skip
NAMES = (
    "..", ".", "", "/", "//", "\\", "a", "data", "C:", "C:\\", "~", "~root", "\x00", "\n", "\x7f", "\ud800",
    "%2e%2e", "..;", "...", " ", "x" * 256, "é" * 128, "file.parquet", "CON", "{chunk_index}", "$HOME", "-rf",
)  # fmt: skip


CPU_S = 3  # processor seconds of a child process that loads one


class TimeLimitError(Exception):
    """A single file took too long."""


def changed_bytes(content: bytes, rng: random.Random) -> bytes:
    """A few flips, cuts, insertions and copies; more often than not near the beginning, where headers are."""
    raw = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 4, 16))):
        near = min(len(raw), 400) if rng.random() < 0.6 else len(raw)
        at = rng.randrange(near + 1)
        kind = rng.randrange(6)
        if kind == 0 and at < len(raw):
            raw[at] ^= 1 << rng.randrange(8)
        elif kind == 1 and at < len(raw):
            raw[at] = rng.choice((0, 0x7F, 0xFF, 0x30, 0x39, 0x22, 0x7B, rng.randrange(256)))
        elif kind == 2:
            del raw[at : at + rng.choice((1, 2, 8, 64))]
        elif kind == 3:
            raw[at:at] = bytes(rng.randrange(256) for _ in range(rng.choice((1, 2, 8))))
        elif kind == 4:
            raw[at:at] = raw[at : at + rng.choice((4, 32, 256))]
        else:
            del raw[at:]
    return bytes(raw)


def changed_tree(tree: Any, rng: random.Random) -> Any:
    """A copy in which a few values are others, keys are gone, or have other names."""
    tree = json.loads(json.dumps(tree))
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        places = list(_places(tree))
        if not places:
            return rng.choice(VALUES)
        holder, key = rng.choice(places)
        kind = rng.random()
        if kind < 0.75:
            holder[key] = json.loads(json.dumps(rng.choice(VALUES), allow_nan=True))
        elif kind < 0.85:
            del holder[key]
        elif isinstance(holder, dict):
            holder[str(rng.choice((*VALUES, *NAMES)))[:300]] = holder.pop(key)
        else:
            holder.append(holder[key])
    return tree


def _places(tree: Any) -> Iterator[tuple[Any, Any]]:
    keys: Any = tree.keys() if isinstance(tree, dict) else range(len(tree)) if isinstance(tree, list) else ()
    for key in list(keys):
        yield tree, key
        yield from _places(tree[key])


def hostile_names(rng: random.Random) -> Iterator[str]:
    """Names that are put together of `NAMES`, without end."""
    while True:
        parts = [rng.choice(NAMES) for _ in range(rng.choice((1, 2, 2, 3, 5, 400)))]
        first = rng.choice(("", "/", "./", "../", "\\\\host\\", "file://"))
        yield first + rng.choice(("/", "/", "\\")).join(parts)


def write_examples(scratch: Path) -> dict[str, Path]:
    """A small world model, a small checkpoint and a dataset, all of them good."""
    from accerl_lerobot.policies.config import PolicyConfig
    from accerl_lerobot.policies.loading import load_adapter
    from accerl_lerobot.policies.saving import save_pretrained
    from accerl_lerobot.world_model.config import PixelModelConfig
    from accerl_lerobot.world_model.contract import WorldModelSpec
    from accerl_lerobot.world_model.pixels import PixelWorldModel
    from accerl_lerobot.world_model.store import save_world_model
    from accerl_lerobot.world_model.success_model import SuccessPairsConfig, SuccessPairsRewardModel
    from tests.policies.checkpoints import write_act

    spec = WorldModelSpec(
        cameras=("observation.images.front",), image_size=(8, 8), state_dim=2, action_dim=2, chunk=2, fps=10,
        context=1, tasks=("reach",),
    )  # fmt: skip
    environment = PixelWorldModel(spec, PixelModelConfig(context=1, channels=(8,)))
    success = SuccessPairsRewardModel(SuccessPairsConfig(chunk=2, channels=(8,), device="cpu"))
    save_world_model(scratch / "world_model", environment, success, {"a": "learnt", "b": "held out"})
    config = PolicyConfig(path=str(write_act(scratch / "made")), device="cpu")
    save_pretrained(load_adapter(config), scratch / "policy", config)
    shutil.copytree(DATASET, scratch / "dataset")
    return {name: scratch / name for name in ("world_model", "policy", "dataset")}


def changed_rows(table: Any, rng: random.Random) -> Any:
    """A parquet table of which cells, columns or rows are others."""
    import pyarrow as pa

    name = rng.choice(table.schema.names)
    at, values = table.schema.get_field_index(name), table.column(name).to_pylist()
    kind, row = rng.randrange(8), rng.randrange(len(values))
    if kind == 0:
        return table.slice(rng.randrange(2), rng.randrange(len(values) + 1))
    if kind == 1:
        return rng.choice((table.drop_columns([name]), table.append_column("more", table.column(name))))
    if kind == 2:
        return table.set_column(at, name, pa.array([rng.choice(VALUES)] * len(values)))
    if isinstance(values[row], dict):
        image = values[row]["bytes"]
        others = (
            b"%!PS-Adobe-3.0 EPSF-3.0\n",
            b"GIF89a",
            b"",
            None,
            b"\xff\xd8\xff\xe0",
            b"#EXTM3U\nfile:///x",
        )
        values[row]["bytes"] = changed_bytes(image, rng) if rng.random() < 0.7 else rng.choice(others)
        if rng.random() < 0.2:
            values[row]["path"] = rng.choice(NAMES)
        return table.set_column(at, name, pa.array(values, table.schema.field(name).type))
    if isinstance(values[row], list) and rng.random() < 0.5:
        changed = [*values[row]][: rng.randrange(5)] + [0.0] * rng.randrange(3)
        values[row] = rng.choice((changed, [rng.choice(VALUES)] * 4, None))
        return table.set_column(at, name, pa.array(values, pa.list_(pa.float32())))
    values[row] = rng.choice(VALUES)
    return table.set_column(at, name, pa.array(values))


class Trial:
    """Runs checks and loaders on changed files, and counts what became of them."""

    def __init__(self, rng: random.Random, scratch: Path) -> None:
        self.rng, self.scratch, self.outcomes = rng, scratch, Counter[str]()
        self._log = os.open(scratch / "written.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        signal.signal(signal.SIGALRM, _too_long)
        sys.addaudithook(self._audit)

    def one(self, name: str, run: Callable[[], object], what: object) -> None:
        """Whatever is neither good nor refused ends all of it, with what it was made of."""
        signal.setitimer(signal.ITIMER_REAL, SECONDS)
        try:
            run()
        except InputError as error:
            said = str(error)
            if "\n" in said or not error.hint or len(said) > 2000:
                raise AssertionError(f"{name}: no line for people: {said[:500]!r}") from error
            self.outcomes[f"{name} refused"] += 1
        except BaseException as error:
            error.add_note(f"{name}: {str(what)[:3000]}")
            raise
        else:
            self.outcomes[f"{name} good"] += 1
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)

    def trees(self, name: str, tree: Any, check: Callable[[Any], object], count: int) -> None:
        """Content that has been parsed."""
        for _ in range(count):
            made = changed_tree(tree, self.rng)
            if isinstance(made, dict):
                self.one(name, lambda made=made: check(made), made)

    def files(self, name: str, path: Path, check: Callable[[], object], count: int) -> None:
        """A file's bytes, or, of JSON, every other time its content; it is put back in the end."""
        good = path.read_bytes()
        tree = json.loads(good) if path.suffix == ".json" else None
        for i in range(count):
            made = changed_bytes(good, self.rng)
            if tree is not None and i % 2:
                made = json.dumps(changed_tree(tree, self.rng)).encode("utf-8", "surrogatepass")
            path.write_bytes(made)
            self.one(name, check, f"{path.name}: {made[:2000]!r}")
        path.write_bytes(good)

    def _audit(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open" and isinstance(arguments[0], (str, bytes)):
            path, _, flags = arguments
            if isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
                self._note(os.fsdecode(path))
        elif event in ("subprocess.Popen", "os.system", "os.exec", "socket.connect"):
            self._note(f"{event} {arguments}")

    def _note(self, what: str) -> None:  # a child process has the same file, and not the same memory
        if what != os.devnull:
            os.write(self._log, f"{json.dumps(what)}\n".encode())

    def written(self) -> set[str]:
        """Files that were opened to be written, programs and connections."""
        return set(map(json.loads, (self.scratch / "written.log").read_text().splitlines()))


def _too_long(*_: object) -> None:
    raise TimeLimitError(f"more than {SECONDS} s")


def checks(trial: Trial, at: dict[str, Path], times: int) -> None:
    """Checks that are called before anything is loaded."""
    from accerl_lerobot.checkpoint.isolation import rehearse
    from accerl_lerobot.checkpoint.safety import FileSource, read_json, tensor_shapes
    from accerl_lerobot.demos.dataset_files import check_info, check_metadata
    from accerl_lerobot.policies import untrusted

    origin = FileSource("path", "hostile")
    policy, dataset = at["policy"], at["dataset"]

    def metadata() -> None:  # in a child process, as `checked` does: Arrow may end it on a damaged footer
        rehearse(lambda: check_metadata(dataset, origin), dataset, origin, "meta/**/*")

    weights = trial.scratch / "few.safetensors"
    weights.write_bytes((policy / "value_head.safetensors").read_bytes())
    trial.files("safetensors", weights, lambda: tensor_shapes(weights, origin), 300 * times)
    ours = json.loads((policy / "accerl.json").read_text())
    trial.trees("accerl.json", ours, lambda t: untrusted.check_ours(t, origin), 40 * times)
    file = policy / "accerl.json"
    trial.files("JSON", file, lambda: read_json(file, origin), 130 * times)
    name = "policy_preprocessor.json"
    trial.files(
        "processor", policy / name, lambda: untrusted.check_processor(policy, name, origin), 60 * times
    )
    trial.files(
        "checkpoint", policy / "config.json", lambda: untrusted.check_checkpoint(policy, origin), 5 * times
    )
    info = json.loads((dataset / "meta/info.json").read_text())
    trial.trees("info.json", info, lambda t: check_info(t, origin), 250 * times)
    for part in ("meta/info.json", "meta/tasks.parquet", "meta/episodes/chunk-000/file-000.parquet"):
        trial.files(part, dataset / part, metadata, 3 * times)


def loaders(trial: Trial, at: dict[str, Path], times: int) -> None:
    """All of it, as a run does: in a child process first."""
    from accerl_lerobot.checkpoint import isolation
    from accerl_lerobot.demos.dataset_files import open_metadata
    from accerl_lerobot.engine.config import DatasetConfig
    from accerl_lerobot.policies.config import PolicyConfig
    from accerl_lerobot.policies.loading import load_adapter, rehearsed_config
    from accerl_lerobot.world_model.store import load_roles, load_world_model, rehearse_world_model

    isolation.CPU_S = CPU_S
    environment, policy, dataset = at["world_model"], at["policy"], at["dataset"]

    def whole_world() -> None:
        load_roles(environment)
        rehearse_world_model(environment)
        load_world_model(environment)

    def whole_policy() -> None:
        rehearsed_config(config)
        load_adapter(config)

    for part, share in (("config.json", 8), ("model.safetensors", 8), ("success_model/config.json", 4)):
        trial.files(f"load world model, {part}", environment / part, whole_world, share * times // 10)
    config = PolicyConfig(path=str(policy), device="cpu")
    for part in ("config.json", "accerl.json", "policy_preprocessor.json", "policy_postprocessor.json"):
        trial.files(f"load policy, {part}", policy / part, whole_policy, times // 10)
    for part in ("model.safetensors", "value_head.safetensors"):
        trial.files(f"load policy, {part}", policy / part, whole_policy, times // 10)
    named = DatasetConfig(repo_id="a/b", root=str(dataset))
    for part in ("info.json", "stats.json", "tasks.parquet", "episodes/chunk-000/file-000.parquet"):
        trial.files(
            f"open dataset, {part}", dataset / "meta" / part, lambda: open_metadata(named), times // 2
        )


def rows(trial: Trial, dataset: Path, times: int) -> None:
    """A dataset whose rows are others, as LeRobot loads it; then all of its frames are read."""
    import pyarrow as pa
    import pyarrow.parquet as pq
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from accerl_lerobot.checkpoint.safety import FileSource
    from accerl_lerobot.demos.dataset_files import checked

    path = dataset / "data/chunk-000/file-000.parquet"
    good = path.read_bytes()
    with pq.ParquetFile(path) as file:
        table = file.read()

    def load() -> None:
        with checked(FileSource("dataset.root", str(dataset)), whole=True):
            loaded = LeRobotDataset("a/b", root=dataset, video_backend="pyav")
            with contextlib.suppress(TypeError, ValueError, RuntimeError):  # LeRobot's, of what is no number
                for index in range(0, len(loaded), 8):
                    loaded[index]

    for number in range(times):
        try:
            pq.write_table(changed_rows(table, trial.rng), path)
        except (pa.ArrowException, OverflowError, UnicodeError, TypeError, ValueError):
            continue  # Arrow cannot make it
        trial.one("load rows", load, number)
    for _ in range(times):  # the description of its columns is at its end
        tail = changed_bytes(good[-9000:][::-1], trial.rng)[::-1]
        path.write_bytes(good[:-9000] + tail)
        trial.one("load data", load, tail[-400:])
    path.write_bytes(good)


def main(seed: int, scratch: Path, times: int) -> dict[str, Any]:
    """Goes through all of it; gives what became of how many."""
    os.environ["HF_DATASETS_CACHE"] = str(scratch / "cache")
    tempfile.tempdir = str(scratch)
    at = write_examples(scratch)
    trial = Trial(random.Random(seed), scratch)
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (taken + MEMORY, taken + MEMORY))
    checks(trial, at, times)
    loaders(trial, at, times)
    rows(trial, at["dataset"], times // 4)
    outside = [path for path in trial.written() if not Path(path).is_relative_to(scratch)]
    return {"outcomes": dict(sorted(trial.outcomes.items())), "written": sorted(outside)[:20]}


if __name__ == "__main__":
    found = main(int(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]))
    sys.stdout.write(json.dumps(found) + "\n")
