# SPDX-License-Identifier: Apache-2.0
"""LeRobot's policies of any type: they act by LeRobot's sampler and learn by LeRobot's training loss.

Evaluated, a decision is one call of LeRobot's `select_action`, for one env step; a policy may keep
observations, a chunk or a plan from one call to the next, so each episode has a policy object of its own,
which shares the weights with the others. Given a `ChunkNoiseConfig`, a decision is a whole chunk, whose rows
are what `select_action` gives one after the other. It depends on the observation and its history alone, and
one call may be for many environments.

Shapes: B rows, T env steps of an observation (``n_obs_steps``), H rows of a training chunk, K executed ones,
A dims.
"""

from __future__ import annotations

import copy
import logging
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor, nn

from accerl_lerobot.errors import InputError, in_one_line
from accerl_lerobot.experience import Decision, Observations, Request, stack_observations
from accerl_lerobot.policies.adapter import Evaluation, PretrainedAdapter
from accerl_lerobot.policies.config import ChunkNoiseConfig, executed_rows
from accerl_lerobot.policies.family import Latent
from accerl_lerobot.policies.features import ACTION
from accerl_lerobot.policies.processing import CONSTANT, Processing
from accerl_lerobot.seeds import decision_of, episode_of, torch_seeded

logger = logging.getLogger(__name__)

EPISODES = 256  # episodes whose state is kept; the one that acted longest ago goes first
ROUNDED = 0.01  # largest error of an action that went to environment units and back
NOISE = 6  # distinguishes the seeds of the noise on executed chunks


class StockAdapter(PretrainedAdapter):
    """A LeRobot policy without a likelihood. Without a `sampler` it acts and does not learn."""

    def __init__(
        self,
        policy: Any,
        processing: Processing,
        precision: str = "fp32",
        sampler: ChunkNoiseConfig | None = None,
    ) -> None:
        super().__init__(policy, processing, precision)
        self._sampler = sampler
        self.explores = sampler is not None
        self._takes_batches = True
        self._one_at_a_time = False
        self._episodes: OrderedDict[tuple[int, str], Any] = OrderedDict()

    @torch.no_grad()
    def decide(self, requests: Sequence[Request], version: int) -> list[Decision]:
        if self.explores:
            return self._decide_chunks(requests, version)
        return [self._decide_step(request, version) for request in requests]

    @torch.no_grad()
    def try_out(self) -> None:
        """Lets the policy act once, before any episode has a policy object of its own.

        Some load a text encoder only then, which all episodes share from now on. Where acting leaves tensors
        in the policy's networks, and `reset` removes them, the networks hold the state of one episode.
        """
        networks = [vars(module) for module in self.policy.modules() if module is not self.policy]
        action = self._act(self.policy, self.example_requests()[0])
        self.processing.unnormalise(action)
        acted = tensors_in(networks)
        self.policy.reset()
        self._one_at_a_time = acted > tensors_in(networks)

    def imitate(self, observations: Observations, tasks: Sequence[str], chunk: Tensor) -> tuple[Tensor, None]:
        batch = self._training_batch(observations, tasks, chunk)
        self.policy.train()
        for module in self.policy.modules():
            if isinstance(module, nn.modules.batchnorm._BatchNorm):
                module.eval()  # its running statistics are not published
        try:
            return self.policy.forward(batch)[0], None
        finally:
            self.policy.eval()

    def self_check(self, dry_run: bool) -> None:
        """Proves that the policy can be asked twice for a chunk, and that its training loss can be computed.

        In a `dry_run` its buffers are not the checkpoint's.

        Raises:
            InputError: it answers the same question differently, is trained on more than its chunks, learns
                more than weights, or its preprocessor does not undo what its postprocessor does to actions.
        """
        config = self.policy.config
        averaged = getattr(config, "temporal_ensemble_coeff", None)
        if averaged is not None:
            hint = "actions averaged over earlier chunks are not learned; set it to null in config.json"
            raise InputError("policy.temporal_ensemble_coeff", averaged, hint)
        coarse = sum(tensor.dtype == torch.bfloat16 for tensor in self.trainable().values())
        if coarse:
            why = "steps that are small beside a weight are lost"
            logger.warning(
                "%s: LeRobot keeps %d of its trained tensors in bfloat16: %s", config.type, coarse, why
            )
        later = [delta for delta in config.observation_delta_indices or () if delta > 0]
        if later or config.reward_delta_indices is not None:
            raise self._unable("LeRobot trains it on what follows a chunk, rewards or observations")
        requests = self.example_requests()
        first = self.decide(requests[:1], 0)[0].chunk
        second = self.decide(requests[:1], 0)[0].chunk
        if not np.array_equal(first, second):
            why = "asked twice with the same noise, it gives two chunks: it changes while it acts"
            raise self._unable(why)
        try:
            with torch.no_grad():
                self._chunk(requests)
        except Exception as error:  # a policy of another package, which may fail in any way
            self._takes_batches = False
            reason = in_one_line(error)
            logger.warning(
                "%s policies decide for one environment at a time, which takes as many calls as there are "
                "environments: a batch of two fails (%s)",
                config.type,
                reason,
            )
        chunk = torch.zeros(len(requests), *first.shape, device=self.device)
        self._check_targets(requests, chunk)
        buffers = {name: buffer.clone() for name, buffer in self.policy.named_buffers()}
        with torch.no_grad(), torch.random.fork_rng(), self.autocast():
            self.imitate(*stack_observations(requests), chunk)
        for name, buffer in self.policy.named_buffers():
            if not dry_run and not torch.equal(buffer, buffers[name]):
                why = f"its training moves {name}, which is no weight: vqbet finishes its codebook first"
                raise self._unable(f"{why} (n_vqvae_training_steps), in SFT")

    def _check_targets(self, requests: Sequence[Request], zeros: Tensor) -> None:
        """Refuses a policy that would be trained on other chunks (B, K, A) than it is told to imitate."""
        _, scale = self.processing.units(zeros[0, :1])
        varies = scale[0].abs() > CONSTANT
        for value in (-0.5, 0.5):
            prepared = self._training_batch(*stack_observations(requests), zeros + value)[ACTION]
            error = prepared[..., : len(varies)].float() - value
            if (error[..., varies].abs() > ROUNDED).any():
                why = "LeRobot's preprocessor does not undo what its postprocessor does to actions"
                raise self._unable(why)

    def evaluate(self, observations: Observations, tasks: Sequence[str], latent: Latent) -> Evaluation:
        raise self._unable("it has no likelihood here")

    def values(self, observations: Observations, tasks: Sequence[str]) -> Tensor:
        raise self._unable("it has no critic here")

    def _unable(self, why: str) -> InputError:
        """The error to raise where the policy cannot learn."""
        return InputError("policy.type", self.policy.config.type, f"{why}; it can be evaluated (accerl eval)")

    def _decide_step(self, request: Request, version: int) -> Decision:
        action = self._act(self._policy_of(request), request)
        return _decision(self.processing.unnormalise(action).cpu().numpy(), version)

    def _act(self, policy: Any, request: Request) -> Tensor:
        """(1, A) by LeRobot's `select_action`, in normalised units."""
        arrays, tasks = stack_observations([request])
        # LeRobot's samplers draw from the global generator: here from the request's seed.
        with torch_seeded(request.noise_seed), self.autocast():
            action: Tensor = policy.select_action(self.processing.prepare(arrays, tasks))
        return action.float()

    def _policy_of(self, request: Request) -> Any:
        """The policy object of the request's episode; new, and reset, if this is its first decision.

        Raises:
            InputError: the policy acts in one environment at a time, and another episode has begun; or the
                object of an episode under way is not here.
        """
        episode = episode_of(request.noise_seed), request.task
        begins = decision_of(request.noise_seed) == 0
        latest = next(reversed(self._episodes), episode)
        if self._one_at_a_time and not begins and latest != episode:
            why = "its networks hold the state of one episode, so it acts in one environment at a time"
            hint = f"{why}; set rollout.workers=1 and rollout.environments=1"
            raise InputError("policy.type", self.policy.config.type, hint)
        if not begins and episode not in self._episodes:
            why = "what it remembers of an episode is lost: its inference worker was replaced, or more than"
            hint = f"{why} {EPISODES} environments share one; evaluate again, with more inference.workers"
            raise InputError("policy.type", self.policy.config.type, hint)
        if begins:  # perhaps once more, after a rollout worker was lost
            memo = {id(part): part for part in shared_parts(self.policy)}
            self._episodes[episode] = copy.deepcopy(self.policy, memo)
            self._episodes[episode].reset()
        self._episodes.move_to_end(episode)
        if len(self._episodes) > EPISODES:
            self._episodes.popitem(last=False)
        return self._episodes[episode]

    def _decide_chunks(self, requests: Sequence[Request], version: int) -> list[Decision]:
        """Exploring environments are decided for together, the others one by one, each with its own noise."""
        assert self._sampler is not None
        exploring = [i for i, request in enumerate(requests) if request.explore]
        together = exploring if self._takes_batches else []
        groups = [[i] for i in range(len(requests)) if i not in together]
        if together:
            groups.append(together)
        chunks: dict[int, Tensor] = {}
        for rows in groups:
            chunk = self._chunk([requests[i] for i in rows])
            chunks |= dict(zip(rows, chunk, strict=True))
        executed = torch.stack([chunks[i] for i in range(len(requests))])
        for i in exploring:
            generator = np.random.default_rng((requests[i].noise_seed, NOISE))
            noise = torch.from_numpy(generator.standard_normal(executed[i].shape))
            executed[i] += self._sampler.noise_level * noise.to(executed)
        return [_decision(chunk, version) for chunk in self.execute(executed, requests)]

    def _chunk(self, requests: Sequence[Request]) -> Tensor:
        """(B, K, A) by LeRobot's sampler, in normalised units; its noise follows from the first request."""
        arrays, tasks = stack_observations(requests)
        policy = self.policy
        action_dim = policy.config.action_feature.shape[0]
        with torch_seeded(requests[0].noise_seed), self.autocast():
            policy.reset()
            batches = [self.processing.prepare(frame, tasks) for frame in self._frames(arrays)]
            *earlier, newest = batches
            # It only notes these observations, as nothing of this chunk is used.
            unused = torch.zeros(len(requests), 1, action_dim, device=self.device)
            with patch.object(policy, "predict_action_chunk", return_value=unused):
                for batch in earlier:
                    policy.select_action(batch)
            # It computes a chunk at the first call, and takes one action after the other out of it.
            rows = [policy.select_action(dict(newest)) for _ in range(executed_rows(policy.config))]
            policy.reset()
        return torch.stack(rows, 1)[..., :action_dim].float()  # without padding

    def _frames(self, arrays: Observations) -> list[Observations]:
        """The env steps of an observation, oldest first."""
        steps = self.policy.config.n_obs_steps
        if steps == 1:
            return [arrays]
        frames: list[Observations] = []
        for step in range(steps):
            frames.append({name: values[:, step] for name, values in arrays.items()})
        return frames

    def _training_batch(
        self, observations: Observations, tasks: Sequence[str], chunk: Tensor
    ) -> dict[str, Any]:
        """A batch as LeRobot's trainer makes it, in which the chunk is padded around the executed rows."""
        config = self.policy.config
        count = len(tasks)
        executed = self.processing.unnormalise(chunk)
        batch: dict[str, Any] = {"task": list(tasks), ACTION: executed[:, 0]}
        if config.action_delta_indices is not None:
            rows = torch.tensor(list(config.action_delta_indices), device=executed.device)
            inside = rows.clamp(0, chunk.shape[1] - 1)
            batch[ACTION] = executed[:, inside]
            batch[f"{ACTION}_is_pad"] = (rows != inside).expand(count, -1)
        steps = config.observation_delta_indices
        for key, tensor in self.processing.tensors(observations).items():
            batch[key] = tensor
            if steps is not None:
                if config.n_obs_steps == 1:
                    batch[key] = tensor[:, None]
                batch[f"{key}_is_pad"] = tensor.new_zeros(count, len(steps), dtype=torch.bool)
        prepared: dict[str, Any] = self.processing.preprocessor(batch)
        return prepared


def shared_parts(policy: Any) -> list[Any]:
    """All that the policy objects of different episodes share: config, networks and their weights.

    Networks that PyTorch does not know as parts of the policy, as it keeps them in a dict, are among them.
    """
    parts = [policy.config, *policy.parameters(), *policy.buffers()]
    for held in vars(policy).values():
        for network in held.values() if isinstance(held, dict) else [held]:
            if isinstance(network, nn.Module):
                parts += network.modules()
    return parts


def tensors_in(value: Any) -> int:
    """Number of tensors in nested dicts, lists and tuples."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list | tuple):
        return sum(map(tensors_in, value))
    return isinstance(value, Tensor)


def _decision(chunk: np.ndarray, version: int) -> Decision:
    """A decision without a likelihood."""
    return Decision(chunk=chunk, latent={}, log_prob=np.zeros(1, np.float32), version=version)
