# SPDX-License-Identifier: Apache-2.0
"""The latent state: its loss against a slow one by hand, what it reads, how it learns and is restored."""

import numpy as np
import pytest
import torch

from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Observations, task_codes
from accerl_lerobot.world_model import latent
from accerl_lerobot.world_model.config import LatentConfig
from accerl_lerobot.world_model.latent import LatentModel, shifted
from accerl_lerobot.world_model.states import StateSpec, Transitions

FRONT, WRIST, ROBOT = "observation.images.front", "observation.images.wrist", "observation.state"
SPEC = StateSpec(cameras={FRONT: 3}, state=3, environment_state=0, chunk=(2, 2))


NUMBERS = {ROBOT: np.random.default_rng(0).standard_normal((100, 3)).astype(np.float32)}


def model(spec: StateSpec = SPEC) -> LatentModel:
    torch.manual_seed(0)
    return LatentModel(spec, LatentConfig(latents=8)).eval()  # in float32


def dots(places: np.ndarray, numbers: np.ndarray) -> Observations:
    """Black images (B, 64, 64, 3) with a white square at each place (B, 2), in pixels."""
    images = np.zeros((len(places), 64, 64, 3), np.uint8)
    for image, (row, column) in zip(images, places, strict=True):
        image[row : row + 12, column : column + 12] = 255
    return {FRONT: images, ROBOT: numbers}


def transitions(count: int, seed: int, state: int = 3, chunk: int = 2) -> Transitions:
    """A square that moves by the chunk; the return is how far down it is at first."""
    rng = np.random.default_rng(seed)
    places = rng.integers(10, 40, (count, 2))
    moves = rng.integers(-10, 11, (count, 2))
    robot = rng.standard_normal((2, count, state)).astype(np.float32)
    return Transitions(
        observations=dots(places, robot[0]),
        following=dots(places + moves, robot[1]),
        tasks=["a", "b"] * (count // 2),
        elapsed=torch.from_numpy(rng.random(count, dtype=np.float32)),
        chunk=torch.from_numpy(np.stack([moves / 10] * chunk, 1).astype(np.float32)),
        returns=torch.from_numpy((places[:, 0] / 40).astype(np.float32)),
        success=torch.from_numpy(rng.random(count) < 0.5),
    )


def slowly(net: torch.nn.Sequential, x: np.ndarray) -> np.ndarray:
    """A network of linear layers, LayerNorm and SiLU in NumPy and float64."""
    for layer in net:
        if isinstance(layer, torch.nn.Linear):
            x = x @ layer.weight.detach().double().numpy().T + layer.bias.detach().double().numpy()
        elif isinstance(layer, torch.nn.LayerNorm):
            x = (x - x.mean(1, keepdims=True)) / np.sqrt(x.var(1, keepdims=True) + 1e-5)
        else:
            x = x / (1 + np.exp(-x))
    return x


def test_the_loss_by_hand(monkeypatch: pytest.MonkeyPatch):
    made, batch = model(), transitions(6, seed=1)
    monkeypatch.setattr(latent, "shifted", lambda images: images)
    with torch.no_grad():
        for parameter in made.slow.parameters():
            parameter.add_(0.01)
    made.fit({ROBOT: np.array([[1.0, 2.0, 3.0], [3.0, 2.0, 1.0]], np.float32)})
    assert made.mean.tolist() == [2, 2, 2] and made.std.tolist() == pytest.approx([1, 1e-3, 1])
    with torch.no_grad():
        made.std.fill_(2.0)

    def latents(observations: Observations, encoder: torch.nn.Module) -> np.ndarray:
        both = observations, batch.observations
        seen, all_seen = (each[FRONT].transpose(0, 3, 1, 2) / 255 for each in both)
        scaled = (seen - all_seen.mean(0)) / np.maximum(all_seen.std(0), 0.05)
        images = torch.from_numpy(scaled.clip(-5, 5).astype(np.float32))
        return encoder(images).detach().double().numpy()

    before = [parameter.detach().clone() for parameter in made.slow.parameters()]
    loss, parts = made.loss(batch)
    for old, new, fast in zip(before, made.slow.parameters(), made.encoder.parameters(), strict=True):
        torch.testing.assert_close(new, old + 0.02 * (fast - old))

    code, chunk = task_codes(batch.tasks), batch.chunk.double().numpy().reshape(6, 4)
    robot, robot_then = ((seen[ROBOT] - 2) / 2 for seen in (batch.observations, batch.following))
    now = np.concatenate([latents(batch.observations, made.encoder), robot], 1)
    then = np.concatenate([latents(batch.following, made.encoder), robot_then], 1)
    predicted = now + slowly(made.dynamics, np.concatenate([now, chunk, code], 1))
    observed = latents(batch.following, made.slow)
    unit = predicted[:, :8] / np.linalg.norm(predicted[:, :8], axis=1, keepdims=True)
    similar = unit @ (observed / np.linalg.norm(observed, axis=1, keepdims=True)).T
    contrast = np.mean([np.log(np.exp(10 * row).sum()) - 10 * row[i] for i, row in enumerate(similar)])
    cloned = slowly(made.cloned, np.concatenate([now, code], 1))
    by_hand = {
        "contrast": contrast,
        "proprioception": np.square(predicted[:, 8:] - robot_then).mean(),
        "inverse": np.square(slowly(made.inverse, np.concatenate([now, then], 1)) - chunk).mean(),
        "cloning": (np.square(cloned - chunk).mean(1) * batch.success.numpy()).mean(),
    }
    assert parts == pytest.approx(by_hand, rel=1e-3)
    weights = {"contrast": 0.1, "proprioception": 1.0, "inverse": 0.3, "cloning": 0.5}
    assert float(loss.detach()) == pytest.approx(sum(weights[k] * v for k, v in by_hand.items()), rel=1e-3)


def test_a_state_is_latents_of_several_cameras_proprioception_with_a_history_and_time():
    spec = StateSpec(cameras={FRONT: 3, WRIST: 1}, state=6, environment_state=0, chunk=(2, 2))
    made, rng = model(spec), np.random.default_rng(0)
    seen = {
        FRONT: rng.integers(0, 256, (2, 2, 96, 128, 3), dtype=np.uint8),
        WRIST: rng.integers(0, 256, (2, 2, 64, 64, 1), dtype=np.uint8),
        ROBOT: rng.standard_normal((2, 2, 3)).astype(np.float32),
    }
    time = np.array([0.25, 0.5], np.float32)
    state = made.encode(seen, ["a", "b"], time).detach()
    assert state.shape == (2, made.size) == (2, 8 + 6 + 1)
    torch.testing.assert_close(state[:, :8].mean(1), torch.zeros(2), atol=1e-5, rtol=0)
    np.testing.assert_array_equal(state[:, 8:14], seen[ROBOT].reshape(2, 6))
    assert state[:, 14].tolist() == time.tolist()
    for camera, frame in ((FRONT, 0), (FRONT, 1), (WRIST, 1)):
        other = seen | {camera: seen[camera].copy()}
        other[camera][:, frame] = 255 - other[camera][:, frame]
        same = torch.allclose(made.encode(other, ["a", "b"], time).detach()[:, :8], state[:, :8])
        assert same is (frame == 0), "of the images the newest is read"


def test_each_image_is_moved_by_itself_and_its_edge_repeated():
    torch.manual_seed(0)
    images = torch.rand(40, 2, 9, 9)
    moved = shifted(images)
    padded = torch.nn.functional.pad(images, (3, 3, 3, 3), mode="replicate")
    found = set()
    for now, then in zip(moved, padded, strict=True):
        windows = {(r, c): then[:, r : r + 9, c : c + 9] for r in range(7) for c in range(7)}
        found.add(next(place for place, window in windows.items() if torch.equal(now, window)))
    assert len(found) > 20


def test_a_policy_without_proprioception_or_without_images():
    spec = SPEC._replace(state=0)
    made, batch = model(spec), transitions(6, seed=1)
    made.fit({})
    for seen in (batch.observations, batch.following):
        del seen[ROBOT]
    loss, parts = made.loss(batch)
    assert bool(torch.isfinite(loss)) and parts["proprioception"] == 0
    assert made.encode(batch.observations, batch.tasks, np.zeros(6, np.float32)).shape == (6, 8 + 1)
    with pytest.raises(InputError, match=r"world_model\.type='latent': the policy reads no images"):
        model(SPEC._replace(cameras={}))
