# SPDX-License-Identifier: Apache-2.0
"""Does a world model know which policy is better?

    python -m benchmarks ranking --path=outputs/door_model/world_model --env.task=door-open-v3 \\
      --env.image_size=64 --env.max_steps=150 --policies=RUN_A/checkpoints/last/pretrained_model,RUN_B/…

Every policy plays the same episodes, in the environment and in imagination, from the same observations.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

from rich.table import Table

from accerl_lerobot.config.ranges import Device, Range, Section, Threads
from accerl_lerobot.console import Console
from accerl_lerobot.envs import EnvConfig, MetaWorldConfig
from accerl_lerobot.errors import InputError, check_absent, make_folder
from accerl_lerobot.evaluation import Rate, drawing


@dataclass(frozen=True, kw_only=True)
class BenchRankingConfig(Section):
    """Success rates of policies in an environment and in its world model."""

    path: str | None = None
    """The folder named world_model that ``accerl world-model`` wrote."""
    discover_packages_path: str | None = None
    """Package to import that registers the type of the world model, where that is not one of ours."""
    policies: tuple[str, ...] = ()
    """Checkpoints. One is enough for the threshold by which it succeeds as often as in reality; 3
    can be ranked, and 12 and more say something."""
    env: EnvConfig = field(default_factory=MetaWorldConfig)
    """The environment."""
    episodes: Annotated[int, Range("[1, 1000000]")] = 50
    """Episodes of each policy, in the environment and in imagination."""
    worlds: Annotated[int, Range("[1, 1000]")] = 8
    """Environments at a time."""
    device: Device = "auto"
    """cpu, cuda, or auto."""
    num_threads: Threads = 1
    """CPU threads."""
    output_dir: str | None = None
    """Folder to create, for ranking.json and ranking.png. None: only prints."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(set(self.policies)) < max(1, len(self.policies)):
            raise InputError("policies", self.policies, "name at least one checkpoint, none of them twice")
        if self.path is None:
            raise InputError("path", None, "give the folder world_model that accerl world-model has written")
        if self.output_dir is not None:
            check_absent(Path(self.output_dir).expanduser())


def bench_ranking(config: BenchRankingConfig) -> dict[str, Any]:
    """Plays and imagines.

    Returns:
        ``policies``: path, real and imagined successes of each; ``threshold`` of the success model, by which
        they are; ``agreement``, see `paired_eval.agreement`; ``outcomes``: by policy and start, the
        ``real`` success and the imagined ``score``; ``even``: another ``threshold``, see `even_threshold`,
        with ``imagined`` successes of each and ``agreement`` by that; ``config``.

    Raises:
        InputError: the world model, or a policy, cannot be loaded or does not fit the world.
    """
    import numpy as np
    import torch

    from accerl_lerobot.envs import make_world
    from accerl_lerobot.evaluation import evaluation_plans
    from accerl_lerobot.policies.config import PolicyConfig
    from accerl_lerobot.policies.loading import load_adapter, rehearsed_config, resolve_device
    from accerl_lerobot.world_model.registry import ImaginationModels, check_fit
    from accerl_lerobot.world_model.store import load_world_model, rehearse_world_model
    from benchmarks.paired_eval import agreement, even_threshold, rollout_imagined, rollout_real

    torch.set_num_threads(config.num_threads)
    device, console = resolve_device(config.device, "device"), Console()
    path = Path(str(config.path)).expanduser()
    rehearse_world_model(path, config.discover_packages_path)
    model, success = load_world_model(path, config.discover_packages_path)
    models = ImaginationModels(model.to(device), None if success is None else success.to(device))
    of = [PolicyConfig(path=path, device=config.device) for path in config.policies]
    worlds = [make_world(config.env) for _ in range(min(config.worlds, config.episodes))]
    try:
        spec = worlds[0].spec
        for policy in of:
            settings = rehearsed_config(policy)
            executed = getattr(settings, "n_action_steps", 1)
            check_fit(model.spec, spec, executed, settings.n_obs_steps, success is not None)
        starts = [(plan.task, plan.seed) for plan in evaluation_plans(spec.tasks, config.episodes, "ranking")]
        real, scores = [], []
        for number, policy in enumerate(of, 1):
            adapter = load_adapter(policy)
            with console.stage(f"policy {number} of {len(of)}", total=len(starts)) as stage:
                real.append(rollout_real(adapter, worlds, starts, stage.update))
                scores.append(rollout_imagined(adapter, models, worlds[0], starts))
    finally:
        for world in worlds:
            world.close()
    outcomes, score = np.stack(real), np.stack(scores)
    assert success is not None  # as `check_fit` has found
    threshold = success.config.threshold
    imagined, even = score > threshold, even_threshold(outcomes, score)
    result = {
        "config": asdict(config),
        "policies": [
            {"path": path, "real": int(r.sum()), "imagined": int(d.sum()), "n": len(starts)}
            for path, r, d in zip(config.policies, outcomes, imagined, strict=True)
        ],
        "threshold": threshold,
        "agreement": agreement(outcomes, imagined),
        "even": {
            "threshold": even,
            "imagined": (score > even).sum(1).tolist(),
            "agreement": agreement(outcomes, score > even),
        },
        "outcomes": {"real": outcomes.tolist(), "score": score.tolist()},
    }
    if config.output_dir is not None:
        folder = Path(config.output_dir).expanduser()
        make_folder(folder, "output_dir")
        (folder / "ranking.json").write_text(json.dumps(result, indent=2) + "\n")
        draw(folder / "ranking.png", result)
        console.say(f"wrote ranking.json and ranking.png into {folder}")
    return result


def table(result: dict[str, Any]) -> Table:
    """`result` for people."""
    even = result["even"]
    shown = Table(
        title=f"{len(result['policies'])} policies, by a threshold of {result['threshold']:.6g}: "
        f"{_estimates(result['agreement'])}\nby {even['threshold']:.6g}, with equal success: "
        f"{_estimates(even['agreement'])}"
    )
    for column in ("policy", "real", "imagined", f"by {even['threshold']:.6g}"):
        shown.add_column(column)
    for row, imagined in zip(result["policies"], even["imagined"], strict=True):
        rates = (Rate(successes=made, n=row["n"]) for made in (row["real"], row["imagined"], imagined))
        shown.add_row(row["path"], *map(str, rates))
    return shown


def _estimates(found: dict[str, Any]) -> str:
    names = {
        "Spearman": "spearman", "Pearson": "pearson", "MMRV": "mmrv", "imagination less reality": "bias",
        "start by start": "mcc",
    }  # fmt: skip
    return ", ".join(
        f"{name} {found[key]['value']:.2f} [{found[key]['low']:.2f}, {found[key]['high']:.2f}]"
        for name, key in names.items()
    )


def draw(path: Path, result: dict[str, Any]) -> None:
    """Real over imagined success, a dot with 95 % Wilson intervals per policy."""
    with drawing(path, (4.5, 4.5)) as axes:
        axes.plot([0, 1], [0, 1], color="0.7", lw=1, ls="--")
        for row in result["policies"]:
            real, imagined = (Rate(successes=row[kind], n=row["n"]) for kind in ("real", "imagined"))
            ends = [[[r.value - r.interval().low], [r.interval().high - r.value]] for r in (imagined, real)]
            axes.errorbar(
                imagined.value, real.value, xerr=ends[0], yerr=ends[1], fmt="o", color="C0", alpha=0.7
            )
        axes.set(xlabel="success in imagination", ylabel="success", xlim=(-0.03, 1.03), ylim=(-0.03, 1.03))
